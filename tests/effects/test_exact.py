"""What a kept effect does exactly: the base is asked about another map, or another place, for the links near it."""

import numpy as np
import pytest
import trimesh

from radiotwin.effects.missing_obstacle import MissingObstacle
from radiotwin.effects.position_errors import DevicePositionError
from radiotwin.effects.removed_obstacle import RemovedObstacle
from radiotwin.scene.citymap import CityMap

FAR_M, NEAR_M = [-300.0, 300, 60], [60.0, 0, 10]


def boxes(*middles_m):
    meshes = [trimesh.creation.box(extents=[20, 20, 40]) for _ in middles_m]
    for mesh, middle_m in zip(meshes, middles_m):
        mesh.apply_translation([*middle_m, 20])
    mesh = trimesh.util.concatenate(meshes)
    return CityMap(mesh.vertices, mesh.faces)


class Asked:
    """A base whose level says how many metres of each link lie within buildings; and which links it was asked for."""

    def __init__(self):
        self.links = 0

    def __call__(self, records, exact=False):
        assert exact
        self.links += len(records)
        return -records.metres_inside - 0.1 * records.distance_m


@pytest.fixture
def records(links):
    """One link through the building at the origin, and one that passes 200 m from it, over another."""
    return links([[-60.0, 0, 10]], [NEAR_M, FAR_M], city=boxes((0, 0), (-200, 200)))


def test_a_building_that_is_gone_leaves_the_links_near_it_the_level_without_it(records):
    base, effect = Asked(), RemovedObstacle()
    building = int(effect._only_blocker(records)[0])
    setting = effect.exact({"building": building, "centre_m": [0.0, 0.0, 40.0]})
    np.testing.assert_allclose(effect.term(records, setting, base).offset_db, [20.0, 0.0], atol=0.01)
    assert base.links == 2  # one link, before and after


def test_a_building_that_no_map_shows_stands_in_the_map_that_the_base_is_asked_about(records):
    base, effect = Asked(), MissingObstacle()
    setting = effect.exact({"box": [30.0, 0.0, 10.0, 30.0, 25.0, 90.0], "scattered_db": 0.0})
    np.testing.assert_allclose(effect.term(records, setting, base).offset_db, [-30.0, 0.0], atol=0.01)
    assert base.links == 2
    assert "exact" not in effect.vary(setting).setting(effect.vary(setting).values)  # refined and varied quickly


def test_a_moved_anchor_has_the_level_of_its_true_place(records):
    base, effect = Asked(), DevicePositionError()
    setting = effect.exact({"device": 0, "move_m": [0.0, 80.0]})
    before_m = np.linalg.norm(np.array([NEAR_M, FAR_M]) - [-60, 0, 10], axis=1)
    after_m = np.linalg.norm(np.array([NEAR_M, FAR_M]) - [-60, 80, 10], axis=1)
    offset_db = effect.term(records, setting, base).offset_db
    assert offset_db[0] == pytest.approx(20 - 0.1 * (after_m[0] - before_m[0]), abs=0.01)
    assert abs(offset_db[1]) > 1
