"""Buildings of a map: what is joined is one, and how well its height is known."""

import numpy as np

from radiotwin.effects.boxes import (
    HEIGHT_SD_M,
    building_extents_m,
    building_height_sds_m,
    buildings,
)
from tests.worlds import city_of_boxes

BOUNDS_M = [[[0, 0, 0], [20, 10, 12]], [[40, 0, 0], [50, 30, 25]]]


def test_each_block_is_a_building_with_its_extents():
    city = city_of_boxes(*BOUNDS_M)
    label, centres_m = buildings(city)
    assert sorted(np.bincount(label)) == [12, 12]
    assert sorted(map(tuple, centres_m.tolist())) == [(10.0, 5.0, 12.0), (45.0, 15.0, 25.0)]
    low_m, high_m = building_extents_m(city, label)
    order = np.argsort(centres_m[:, 0])
    np.testing.assert_allclose(np.stack([low_m, high_m], axis=1)[order], BOUNDS_M)


def test_a_height_is_known_as_well_as_its_map_says():
    told = city_of_boxes(*BOUNDS_M, height_sd_m=np.repeat([6.5, np.nan], 12))
    first = np.argsort(buildings(told)[1][:, 0])
    assert building_height_sds_m(told)[first].tolist() == [6.5, HEIGHT_SD_M]
    for height_sd_m in (np.full(24, 0.5), None):
        assert building_height_sds_m(city_of_boxes(*BOUNDS_M, height_sd_m=height_sd_m)).tolist() == [HEIGHT_SD_M] * 2
