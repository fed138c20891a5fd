"""Which building is suspected to be gone, against exact geometry of boxes."""

import numpy as np
import pytest

from radiotwin.effects.boxes import Box, buildings
from radiotwin.effects.catalogue.missing_obstacle import MissingObstacle
from radiotwin.effects.catalogue.removed_obstacle import RemovedObstacle
from tests.scene.test_citymap import clip_interval
from tests.worlds import city_of_boxes

BOXES = ((-10.0, -10.0, 10.0, 10.0, 20.0), (60.0, -10.0, 80.0, 10.0, 20.0))  # x, y, x, y, height [m]
DEVICES_M = np.array([[-15.0, 0.0, 1.5], [85.0, 3.0, 1.5]])
LOSS_DB = 20.0
MIN_NATS = 6.0  # for a building to be suspected


def city_of(boxes):
    return city_of_boxes(*([[*box[:2], 0], box[2:]] for box in boxes))


def suspected(make_links, view, true_boxes, seed=0):
    """Fly over the true city, and return the building of the map that is suspected, or None."""
    rng = np.random.default_rng(seed)
    receiver_m = np.column_stack([rng.uniform(-80, 150, 400), rng.uniform(-60, 60, 400), rng.uniform(15, 60, 400)])
    links = make_links(DEVICES_M, receiver_m, city=city_of(BOXES))
    a_m, b_m = links.device_m[links.device], links.receiver_m
    shares = [clip_interval(a_m, b_m, box) for box in true_boxes]
    blocked = np.any([enter < leave for enter, leave in shares], axis=0)
    level_db = np.where(blocked, -LOSS_DB, 0.0) + rng.normal(0, 2.0, len(links))
    measured = make_links(DEVICES_M, receiver_m, city=links.city, level_db=level_db)

    def level_at(of, exact=False):
        return np.where(of.los, 0.0, -LOSS_DB)

    effect, residual, every = RemovedObstacle(), view(measured, level_at(measured), 3.0, level_at), np.arange(len(links))
    gains = {params.building: residual.gain_nats(every, effect.with_params(params).term(measured, level_at).offset_db).sum()
             for params in effect.propose(residual)}
    best = max(gains, key=gains.get, default=None)
    return best if gains and gains[best] > MIN_NATS else None


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("gone", (0, 1))
def test_a_building_that_is_gone_is_suspected(make_links, view, gone, seed):
    building = suspected(make_links, view, [BOXES[1 - gone]], seed)
    x_m = buildings(city_of(BOXES))[1][building][0]
    assert x_m == pytest.approx(0.5 * (BOXES[gone][0] + BOXES[gone][2]))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("lower_m", (0.0, 2.0, 4.0, 5.0))
def test_a_building_whose_roof_is_mapped_too_high_is_not(make_links, view, lower_m, seed):
    true = [(*BOXES[0][:4], BOXES[0][4] - lower_m), BOXES[1]]
    assert suspected(make_links, view, true, seed) is None


def test_a_building_that_is_lower_than_what_heights_are_off_is_never(make_links, view, monkeypatch):
    low = ((-10.0, -10.0, 10.0, 10.0, 4.5), BOXES[1])
    monkeypatch.setattr("tests.effects.test_removed_obstacle.BOXES", low)
    assert suspected(make_links, view, [low[1]]) is None


def test_each_of_several_buildings_that_are_gone_is_gone_whatever_else_has_changed():
    """By the numbers of the map as it was given, while buildings go and come before them."""
    row = city_of([(x, 0.0, x + 20.0, 20.0, 20.0) for x in (0.0, 100.0, 200.0, 300.0)])
    centres_m, effect = buildings(row)[1], RemovedObstacle()
    params = [effect.Params(building=number, centre_m=tuple(centres_m[number].tolist())) for number in range(4)]
    there, added = MissingObstacle(), Box(-100.0, 10.0, 10.0, 10.0, 15.0, 0.0)
    left = {(0, 1): [210, 310], (0, 3): [110, 210], (3, 0): [110, 210], (2, 2): [10, 110, 310]}
    for gone, left_x_m in left.items():
        city = there.with_params(there.Params(box=added)).corrected_map(row)
        for number in gone:
            city = effect.with_params(params[number]).corrected_map(city)
        np.testing.assert_allclose(np.sort(buildings(city)[1][:, 0]), [-100.0, *left_x_m])
