"""A fitted model of channel and effects, apart from its links."""


import numpy as np
import pytest

from radiotwin.effects.catalogue.lock_loss import LockLoss
from radiotwin.effects.catalogue.path_strength import WallReflection
from radiotwin.effects.catalogue.roof_heights import RoofHeights
from radiotwin.inference.gaussian import LogDistanceLine
from radiotwin.propagation.laws.log_distance import LogDistance, SegmentedLogDistance
from radiotwin.twin.model.model import Fit, FittedModel, Model, device_sd_db
from tests.worlds import city_of_boxes


def test_positions_are_sought_without_what_follows_paths_or_many_maps():
    """Each of thousands of places would need its own paths."""
    effects = LockLoss(), WallReflection(), RoofHeights()
    model = FittedModel(LogDistance(LogDistanceLine(-40.0, -2.2, 3.0)), effects, (np.zeros(0),) * 3, np.zeros(2), np.array([2.0]), 5.0,
                        np.zeros((1, 3)), ("u0",), np.nan, 0.0)
    assert [each.name for each in model.for_positions().effects] == ["lock_loss"]
    assert len(model.effects) == 3


@pytest.mark.parametrize("learnt_in_sight", [True, False])
def test_a_class_that_nothing_was_learnt_of_has_the_scale_of_the_other(make_links, learnt_in_sight):
    """A fold may hold out all links with line of sight, and a map has points that no flight saw so."""
    rng = np.random.default_rng(0)
    receiver_m = np.column_stack([rng.uniform(-60, 200, 300), rng.uniform(-80, 80, 300), np.full(300, 45.0)])
    links = make_links([[0.0, 0, 20.0]], receiver_m, city=city_of_boxes([[40, -100, 0], [80, 100, 40]]))
    level_db = -60 - 30 * np.log10(links.distance_m / 10) - 15 * ~links.los + rng.normal(0, 3, len(links))
    links = links.with_columns(level_db=level_db)
    learnt = links.los == learnt_in_sight
    assert 50 < learnt.sum() < 250
    channel = SegmentedLogDistance().fit(links.geometry, level_db, links.limit_db, 0)
    fold = Model.build(links, channel, 5.0, train=learnt)
    fit = fold.fit()
    assert fit.scale_db[0] == fit.scale_db[1] == pytest.approx(2.3, abs=0.6)  # of Student's t with 5 degrees
    alone = Model.build(links.select(learnt), channel, 5.0)
    assert np.isfinite(alone.fit().predict(links).mean_db).all()


@pytest.mark.parametrize("devices", [3, 6])
def test_what_devices_have_in_common_is_not_underestimated_for_few_of_them(make_links, devices):
    """Levels of 1 dB standard deviation, 400 draws: the mean square is 1."""
    found = []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        device_m = np.column_stack([rng.uniform(0, 500, (devices, 2)), np.full(devices, 10.0)])
        links = make_links(device_m, [[250.0, 250.0, 100.0 + 5 * i] for i in range(20)])
        level_db = -40 - 20 * np.log10(links.distance_m) + rng.normal(0, 1, devices)[links.device] + rng.normal(0, 1, len(links))
        channel = LogDistance(LogDistanceLine(-40.0, 2.0, 1.0))
        model = Model.build(links.with_columns(level_db=level_db), channel, 5.0)
        found.append(device_sd_db(Fit(np.zeros(model.level_columns.shape[1]), np.array([1.0]), 0.0, model)) ** 2)
    assert np.mean(found) == pytest.approx(1.0, abs=0.2)
