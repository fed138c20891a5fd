"""Where a building that the map does not show is proposed."""

import numpy as np
import pytest
import trimesh

from radiotwin.effects.boxes import Box
from radiotwin.effects.missing_obstacle import MissingObstacle
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.vegetation import Vegetation, VegetationConfig


def test_where_no_link_has_line_of_sight_nothing_can_be_missing(make_links, view):
    """A wall 100 m high stands between the device and every receiver."""
    wall = trimesh.creation.box(bounds=[[40, -500, 0], [50, 500, 100]])
    receiver_m = np.column_stack([np.linspace(100, 200, 40), np.linspace(-50, 50, 40), np.full(40, 20.0)])
    links = make_links([[0.0, 0, 1.5]], receiver_m, city=CityMap(wall.vertices, wall.faces))
    assert MissingObstacle().propose(view(links, np.full(40, 30.0), 1.0)) == []


def test_a_map_with_a_box_in_it_keeps_its_woods():
    wood = VegetationConfig(name="w", kind="wood", height_m=15.0, rings_m=[[(0.0, 0.0), (90.0, 0.0), (90.0, 90.0)]])
    house = trimesh.creation.box(bounds=[[200, 0, 0], [230, 30, 12]])
    city = CityMap(house.vertices, house.faces, vegetation=Vegetation.of([wood]))
    params = MissingObstacle.Params(box=Box(100.0, 150.0, 20.0, 10.0, 30.0, 0.0))
    corrected = MissingObstacle().corrected_map(city, params)
    assert corrected.height_at(100.0, 150.0) == pytest.approx(30.0)
    assert corrected.vegetation.height_m.tolist() == [15.0]
