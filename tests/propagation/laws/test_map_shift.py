"""A map that lies elsewhere than it should, and surfaces that are not what they are declared to be."""

import re
from dataclasses import replace

import numpy as np
import pytest

from radiotwin.propagation.laws.image_paths import fit_offsets, moved, paths_db
from radiotwin.propagation.laws.map_error import NO_SHIFT, MapError, estimate_shift
from tests.propagation.laws.houses import flight, houses, levels, links_over

DIFFUSE = (-140.0, 3.0)  # gain at 100 m [dB], and exponent


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("shift_m", [(2.5, -1.5), (-3.0, 0.0)])
def test_the_shift_of_a_map_is_found(shift_m, seed):
    receiver_m, device = flight(240, seed)
    level_db = levels(houses(), receiver_m, device, seed + 10)
    east_m, north_m, radius_m = estimate_shift(links_over(houses(shift_m), receiver_m, device), level_db, None, 0)
    assert np.hypot(east_m - shift_m[0], north_m - shift_m[1]) <= min(max(radius_m, 0.5), 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3, 4])
@pytest.mark.parametrize("off_m", [0.0, 2.0])
def test_houses_that_are_off_each_in_their_own_way_are_not_called_a_shift(off_m, seed):
    """A shift that is found all the same is no larger than the errors: the mean of nine is one, too."""
    receiver_m, device = flight(240, seed)
    level_db = levels(houses(), receiver_m, device, seed + 10)
    wrong = houses(off_m=off_m, seed=seed)
    found = estimate_shift(links_over(wrong, receiver_m, device), level_db, None, 0)
    assert found == NO_SHIFT or (off_m and np.hypot(*found[:2]) < 3.0)


def test_one_device_or_few_links_do_not_tell_a_shift():
    receiver_m, device = flight(100, 1)
    links = links_over(houses((3.0, 0.0)), receiver_m, np.zeros(100, dtype=int))
    assert estimate_shift(links, np.full(100, -90.0), None, 0) == NO_SHIFT
    assert estimate_shift(links.select(slice(30)), np.full(30, -90.0), None, 0) == NO_SHIFT
    estimated = replace(links_over(houses(), receiver_m, device), estimated=np.ones(100, dtype=bool))
    assert estimate_shift(estimated, np.full(100, -90.0), None, 0) == NO_SHIFT


def test_links_are_moved_to_where_they_are_on_the_map():
    receiver_m, device = flight(100, 1)
    true, shifted = links_over(houses(), receiver_m, device), links_over(houses((3.0, -2.0)), receiver_m, device)
    there = MapError(shift_m=(3.0, -2.0, 0.5)).on_map(shifted)
    np.testing.assert_array_equal(there.los, true.los)
    np.testing.assert_allclose(paths_db(there, DIFFUSE), paths_db(true, DIFFUSE), atol=1e-6)
    assert MapError().on_map(shifted) is shifted
    assert (moved(shifted, 3.0, -2.0).los != shifted.los).any()


def test_offsets_of_reflections_and_diffractions_are_found():
    receiver_m, device = flight(400, 4)
    links = links_over(houses(), receiver_m, device)
    for true_db in ((0.0, 0.0), (-6.0, 0.0), (0.0, 5.0)):
        level_db = levels(houses(), receiver_m, device, 5, factors=10 ** (np.array(true_db) / 10))
        found = fit_offsets(links, level_db, None, DIFFUSE)
        assert np.abs(np.subtract(found, true_db)).max() < 2.0
        assert abs((found[0] - found[1]) - (true_db[0] - true_db[1])) < 1.5


@pytest.mark.parametrize("error, words", [
    (MapError(), ""), (MapError(wall_m=(0.5, 0, 1), offsets_db=(2.0, -2.0)), ""),
    (MapError(shift_m=(2.0, -1.0, 0.7)), r"lies \+2.0 m east and -1.0 m north .* within 0.7 m"),
    (MapError((1.5, 1, 2), (3, 2, 4)), r"walls are off by 1.5 m .*heights are off by 3.0 m \(90 %: 2.0-4.0\)"),
    (MapError(offsets_db=(-6.0, 0.0)), "reflections are 6.0 dB weaker"),
    (MapError(offsets_db=(0.0, 4.0)), "diffractions are 4.0 dB stronger")])
def test_what_is_told_of_a_map(error, words):
    assert bool(error.warning) == bool(words) and re.search(words, error.warning)
