"""Buildings of a map: what is joined is one, and how well its height is known."""

import numpy as np
import pytest
import trimesh

from radiotwin.effects.boxes import (
    HEIGHT_SD_M,
    building_extents_m,
    building_height_sds_m,
    buildings,
)
from radiotwin.scene.citymap import CityMap

BOUNDS_M = [[[0, 0, 0], [20, 10, 12]], [[40, 0, 0], [50, 30, 25]]]


@pytest.fixture
def mesh():
    return trimesh.util.concatenate([trimesh.creation.box(bounds=each) for each in BOUNDS_M])


def test_each_block_is_a_building_with_its_extents(mesh):
    city = CityMap(mesh.vertices, mesh.faces)
    label, centres_m = buildings(city)
    assert sorted(np.bincount(label)) == [12, 12]
    assert sorted(map(tuple, centres_m.tolist())) == [(10.0, 5.0, 12.0), (45.0, 15.0, 25.0)]
    low_m, high_m = building_extents_m(city, label)
    order = np.argsort(centres_m[:, 0])
    np.testing.assert_allclose(np.stack([low_m, high_m], axis=1)[order], BOUNDS_M)


def test_a_height_is_known_as_well_as_its_map_says(mesh):
    told = CityMap(mesh.vertices, mesh.faces, height_sd_m=np.repeat([6.5, np.nan], 12))
    first = np.argsort(buildings(told)[1][:, 0])
    assert building_height_sds_m(told)[first].tolist() == [6.5, HEIGHT_SD_M]
    well = CityMap(mesh.vertices, mesh.faces, height_sd_m=np.full(24, 0.5))
    assert building_height_sds_m(well).tolist() == [HEIGHT_SD_M] * 2
    assert building_height_sds_m(CityMap(mesh.vertices, mesh.faces)).tolist() == [HEIGHT_SD_M] * 2
