"""Devices that a wrong map has in a building, on two boxes: moved as far as plain geometry says, or not at all."""

import numpy as np
import pytest
import trimesh

from radiotwin.scene.citymap import CityMap
from radiotwin.scene.footing import footing

ROOF_M, HALF_M = 20.0, 30.0  # of a block about the origin


def block(sd_m=None):
    ground = trimesh.Trimesh([(-200, -200, 0), (200, -200, 0), (200, 200, 0), (-200, 200, 0)], [(0, 1, 2), (0, 2, 3)])
    tower = trimesh.creation.box(extents=(2 * HALF_M, 2 * HALF_M, ROOF_M))
    tower.apply_translation((0, 0, ROOF_M / 2))
    vertices, faces = trimesh.util.append_faces([ground.vertices, tower.vertices], [ground.faces, tower.faces])
    return CityMap(vertices, faces, height_sd_m=None if sd_m is None else np.full(len(faces), sd_m))


@pytest.mark.parametrize(("point_m", "there_m"), [
    ((0, 0, 19.6), (0, 0, 20.5)),  # a mast in the middle of the roof
    ((0, 0, 20.0), (0, 0, 20.5)),  # on its plane
    ((29, 0, 6.0), (30.5, 0, 6.0)),  # a lamp at the wall
    ((3, -30, 6.0), (3, -30.5, 6.0)),  # on the wall
    ((29.8, 0, 19.9), (29.8, 0, 20.5)),  # at the corner of both: the roof is known worse
    ((60, 0, -1.0), (60, 0, 0.5)),  # in the street
])
def test_the_nearest_surface_by_what_is_known_of_it(point_m, there_m):
    city = block()
    np.testing.assert_allclose(footing(city, np.array(point_m, float)).point_m, there_m, atol=0.11)
    assert city.misplaced(footing(city, np.array(point_m, float)).point_m)[0] == ""


@pytest.mark.parametrize(("sd_m", "depth_m", "explained"), [(None, 8.9, True), (None, 9.1, False), (1.5, 4.4, True),
                                                            (1.5, 4.6, False), (6.0, 17.0, True)])
def test_a_roof_is_as_wrong_as_its_height_is_known(sd_m, depth_m, explained):
    found = footing(block(sd_m), np.array([0.0, 0.0, ROOF_M - depth_m]))
    assert (found is not None) == explained
    if explained:
        assert f"{depth_m:.1f} m too high" in found.move and f"{depth_m + 0.5:.1f} m up" in found.move


@pytest.mark.parametrize(("depth_m", "explained"), [(5.8, True), (6.3, False)])
def test_a_wall_is_off_by_six_metres_at_most(depth_m, explained):
    assert (footing(block(), np.array([0.0, HALF_M - depth_m, 3.0])) is not None) == explained
