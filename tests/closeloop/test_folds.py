"""What is held out together."""

import numpy as np

from radiotwin.closeloop.crossfit import MIN_GAIN_DB, make_folds, paths_gain_db
from radiotwin.links import prepare_links
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import fly_survey, segmented_truth
from radiotwin.scene import Scene
from tests.worlds import RBM


def test_flights_are_held_out_where_they_are_alike_and_blocks_of_ground_where_not(open_ground):
    world = open_ground.fly(3)
    links = prepare_links(open_ground.measured(world), None)
    folds = make_folds(links, 0)
    assert folds.by == "flight"
    for flight in range(6):
        assert len(np.unique(folds.index[links.flight == flight])) == 1
    walks = [f"{device}-{receiver}" for device, receiver in zip(world.device, world.receiver)]
    one = prepare_links(open_ground.measured(world, flight=walks), None)
    folds = make_folds(one, 0)
    assert folds.by == "block" and folds.count == 6
    cell = np.floor(one.receiver_m[:, :2] / 60).astype(int)
    for square in np.unique(cell, axis=0)[:40]:
        assert len(np.unique(folds.index[(cell == square).all(axis=1)])) == 1
    sizes = np.bincount(folds.index)
    assert sizes.max() < 1.3 * sizes.min()


def test_a_quadrant_is_held_out_as_a_whole(open_ground):
    world = open_ground.fly(4)
    links = prepare_links(open_ground.measured(world), None)
    folds = make_folds(links, 0, "quadrant")
    assert folds.by == "quadrant" and folds.count == 4
    middle = np.median(world.receiver_m[:, :2], axis=0)
    for east in (False, True):
        for north in (False, True):
            part = ((world.receiver_m[:, 0] > middle[0]) == east) & ((world.receiver_m[:, 1] > middle[1]) == north)
            assert len(np.unique(folds.index[part])) == 1


def test_few_links_tell_whether_paths_are_worth_following():
    """RBM as Sionna RT traced it, and levels of a law with two classes of links there, in which no path is."""
    scene = Scene.load(RBM)
    gains_db = []
    for truth in (RadioMap.load(RBM / "truth.nc"), segmented_truth(scene)):
        links = prepare_links(fly_survey(scene, truth, flights=1, seed=2), scene)
        gains_db.append(paths_gain_db(links, scene, make_folds(links, 0), 0))
    assert gains_db[0] > 1.0 > MIN_GAIN_DB > gains_db[1]
