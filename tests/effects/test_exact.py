"""Exact terms of kept effects: the channel predicts over another map, or for another position, the links near it."""

import numpy as np
import pytest

from radiotwin.effects.catalogue.clock_offset import ReceiverClockOffset
from radiotwin.effects.catalogue.missing_obstacle import MissingObstacle
from radiotwin.effects.catalogue.position_errors import DevicePositionError, ReceiverPositionError
from radiotwin.effects.catalogue.removed_obstacle import RemovedObstacle, only_blocker
from radiotwin.inference.gaussian import LogDistanceLine
from radiotwin.propagation.laws.log_distance import LogDistance
from radiotwin.twin.model import fitting
from radiotwin.twin.model.fitting import add_effect, along_paths
from radiotwin.twin.model.model import Model
from tests.effects.conftest import with_params
from tests.worlds import city_of_boxes

FAR_M, NEAR_M = [-300.0, 300, 60], [60.0, 0, 10]


def boxes(*middles_m):
    return city_of_boxes(*([[x - 10, y - 10, 0], [x + 10, y + 10, 40]] for x, y in middles_m))


class CountingChannel:
    """A channel that loses 1 dB a metre within buildings, and counts the links that it predicts."""

    def __init__(self):
        self.links = 0

    def __call__(self, links, exact=False):
        assert exact
        self.links += len(links)
        return -links.metres_inside - 0.1 * links.distance_m


@pytest.fixture
def links(make_links):
    """One link through the building at the origin, and one 200 m from it over another building."""
    return make_links([[-60.0, 0, 10]], [NEAR_M, FAR_M], city=boxes((0, 0), (-200, 200)))


def test_links_near_a_removed_building_have_the_level_without_it(links):
    channel, building = CountingChannel(), int(only_blocker(links)[0])
    exactly = with_params(RemovedObstacle, building=building, centre_m=(0.0, 0.0, 40.0)).exactly()
    np.testing.assert_allclose(exactly.term(links, channel).offset_db, [20.0, 0.0], atol=0.01)
    assert channel.links == 2  # one link, before and after


def test_a_missing_building_is_in_the_map_that_the_channel_predicts_over(links):
    channel = CountingChannel()
    exactly = with_params(MissingObstacle, box=(30.0, 0.0, 10.0, 30.0, 25.0, 90.0)).exactly()
    np.testing.assert_allclose(exactly.term(links, channel).offset_db, [-30.0, 0.0], atol=0.01)
    assert channel.links == 2
    variation = exactly.variation()
    known = exactly.with_params(exactly.params, "known_paths")
    assert variation.effect(variation.values).is_same(known)  # refined with paths that are followed once
    assert known.exactly().is_same(exactly) and (variation.resolution_sd > 0).all()
    assert len(variation.values) == 6 and len(exactly.with_params(exactly.params, "quick").variation().values) == 7


@pytest.mark.parametrize(("effect", "params"), [
    (DevicePositionError, {"device": 0, "move_m": (0.0, 60.0)}),
    (ReceiverPositionError, {"receiver": 0, "move_m": (0.0, 60.0, 0.0)})])
def test_a_moved_end_has_the_level_of_its_true_position(links, effect, params):
    exactly = with_params(effect, **params).exactly()
    offset_db = exactly.term(links, CountingChannel()).offset_db
    assert offset_db[0] == pytest.approx(20 - 0.1 * (np.hypot(120, 60) - 120), abs=0.01) and abs(offset_db[1]) > 1
    assert exactly.variation().follows_paths


def test_at_another_time_a_receiver_is_elsewhere_along_its_way(make_links):
    """Ten metres a second to the north: six seconds later it no longer looks through the building."""
    way_m = [[60.0, 10.0 * slot, 10] for slot in range(12)]
    links = make_links([[-60.0, 0, 10]], way_m, city=boxes((0, 0)), time_s=np.arange(12.0))
    exactly = with_params(ReceiverClockOffset, receiver=0, offset_s=6.0, speed_m_s=10.0).exactly()
    offset_db = exactly.term(links, CountingChannel()).offset_db
    assert offset_db[0] == pytest.approx(20 - 0.1 * (np.hypot(120, 60) - 120), abs=0.01)
    assert exactly.variation().follows_paths


class TwoAnswers(LogDistance):
    """A law whose quick levels are of another place than asked for, some metres beside it, and a little rough."""

    follows_paths = True
    beside_m, rough_db = np.array([12.0, -6.0, 0.0]), 0.2

    def level_at(self, links, exact=False):
        if exact:
            return self.predict(links.geometry)[0]
        moved_m = links.device_m - DECLARED_M
        share = np.minimum(np.linalg.norm(moved_m, axis=1), 1.0)[:, None]
        level_db = self.predict(links.with_devices(links.device_m + share * self.beside_m).geometry)[0]
        rough_db = self.rough_db * (-1.0) ** np.arange(len(links))
        return level_db + np.where(share[links.device, 0] > 0, rough_db, 0.0)


DECLARED_M, MOVE_M = np.array([[0.0, 0.0, 10.0], [300.0, 200.0, 10.0]]), (14.0, -18.0)


def two_answers_model(make_links, seed):
    """A moved anchor and one that is not, 700 receivers, and the channel that answers quickly beside the truth."""
    rng = np.random.default_rng(seed)
    receiver_m = np.column_stack([rng.uniform(-150, 400, 700), rng.uniform(-150, 350, 700), rng.uniform(20, 60, 700)])
    true_m = DECLARED_M + np.array([[*MOVE_M, 0.0], [0.0, 0.0, 0.0]])
    distance_m = np.linalg.norm(receiver_m[:, None] - true_m, axis=2).ravel()
    links = make_links(DECLARED_M, receiver_m, level_db=-40 - 22 * np.log10(distance_m) + rng.normal(0, 0.5, 1400))
    return Model.build(links, TwoAnswers(LogDistanceLine(-40.0, 2.2, 0.5)), 5.0)


def found_along_paths(model):
    """The candidate as the loop fits it: quickly, and then with levels of its own paths."""
    before = model.fit()
    return along_paths(add_effect(before, DevicePositionError()), before)


@pytest.mark.parametrize("seed", range(3))
def test_a_position_whose_exact_optimum_lies_beside_the_quick_one_is_found(make_links, seed):
    """At the quick optimum the exact levels fit worse, so they were not looked at there."""
    effect = found_along_paths(two_answers_model(make_links, seed)).effects[-1]
    assert effect.is_exact and effect.params.device == 0
    assert effect.params.move_m == pytest.approx(MOVE_M, abs=2.0)


def test_paths_of_more_links_than_can_be_followed_are_not(make_links, monkeypatch):
    """The anchor has 700 links: with fewer allowed its position is that of the quick levels."""
    monkeypatch.setattr(fitting, "MAX_FOLLOWED_LINKS", 699)
    effect = found_along_paths(two_answers_model(make_links, 0)).effects[-1]
    assert not effect.is_exact and effect.params.device == 0
