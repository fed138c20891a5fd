"""Facets of solids whose faces are known."""

import numpy as np
import pytest
import trimesh

from radiotwin.errors import BadInput
from radiotwin.propagation.paths.facets import extract_facets
from radiotwin.propagation.paths.surfaces import (
    AXIS_U,
    AXIS_V,
    FULL,
    MATERIAL,
    NORMAL,
    ORIGIN,
    SIZE,
    within,
)
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.materials import itu_material


def planes_of(city):
    """Without the ground, the last one."""
    return extract_facets(city).surfaces.planes[:-1]


def three(planes, first):
    return planes[:, first:first + 3]


def sliced_wall(height_m=10.0):
    """An open-bottomed box whose front is cut into slices that do not end where those of the roof do."""
    sides = {"front": [(0, 0, 0), (4, 0, 0), (4, 0, height_m), (0, 0, height_m)],
             "front 2": [(4, 0, 0), (10, 0, 0), (10, 0, height_m), (4, 0, height_m)],
             "right": [(10, 0, 0), (10, 5, 0), (10, 5, height_m), (10, 0, height_m)],
             "back": [(10, 5, 0), (0, 5, 0), (0, 5, height_m), (10, 5, height_m)],
             "left": [(0, 5, 0), (0, 0, 0), (0, 0, height_m), (0, 5, height_m)],
             "roof": [(0, 0, height_m), (7, 0, height_m), (7, 5, height_m), (0, 5, height_m)],
             "roof 2": [(7, 0, height_m), (10, 0, height_m), (10, 5, height_m), (7, 5, height_m)]}
    vertices = np.array([corner for side in sides.values() for corner in side], dtype=float)
    faces = np.concatenate([[[4 * i, 4 * i + 1, 4 * i + 2], [4 * i, 4 * i + 2, 4 * i + 3]] for i in range(len(sides))])
    return CityMap(vertices, faces)


@pytest.mark.parametrize("angle_rad", [0.0, 0.4])
def test_a_box_has_four_walls_and_a_roof(city_of, angle_rad):
    planes = planes_of(city_of((0, 0, 10, 20, 30), angle_rad=angle_rad))
    normal, size_m, axis_u, axis_v = three(planes, NORMAL), planes[:, SIZE:SIZE + 2], three(planes, AXIS_U), three(planes, AXIS_V)
    assert len(planes) == 5 and (np.abs(normal[:, 2]) < 0.1).sum() == 4 and planes[:, FULL].all()
    assert sorted(np.round(size_m.prod(axis=1))) == [200, 300, 300, 600, 600]
    assert np.allclose(np.cross(axis_u, axis_v), normal)
    centre_m = three(planes, ORIGIN) + 0.5 * (size_m[:, :1] * axis_u + size_m[:, 1:] * axis_v)
    middle_m = np.array([5, 10, 15]) @ np.array([[np.cos(angle_rad), np.sin(angle_rad), 0],
                                                 [-np.sin(angle_rad), np.cos(angle_rad), 0], [0, 0, 1]])
    assert (np.einsum("ij,ij->i", normal, centre_m - middle_m) > 0).all()


def test_slices_are_merged_across_t_junctions():
    planes = planes_of(sliced_wall())
    assert len(planes) == 5 and planes[:, FULL].all()


def test_surfaces_of_two_materials_are_two_facets(box_mesh):
    mesh = box_mesh(0, 0, 10, 20, 30)
    metal_halves = np.zeros(len(mesh.faces), dtype=int)
    metal_halves[::2] = 1
    city = CityMap(mesh.vertices, mesh.faces, [itu_material("brick"), itu_material("metal")], metal_halves)
    surfaces, of_face, *_ = extract_facets(city)
    assert len(surfaces.planes) > 6
    assert (surfaces.planes[of_face[of_face >= 0], MATERIAL] == city.material[of_face >= 0]).all()


def test_faces_of_the_ground_belong_to_no_facet(city_of):
    ground = trimesh.Trimesh([[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]], [[0, 1, 2], [0, 2, 3]],
                             process=False)
    city = city_of((0, 0, 10, 10, 10), ground)
    assert len(planes_of(city)) == 5 and (extract_facets(city).of_face[-2:] == -1).all()


def test_an_angled_facet_ends_at_its_outline(prism):
    mesh = prism([(0, 0), (30, 0), (30, 10), (10, 10), (10, 30), (0, 30)], 12.0)
    city = CityMap(mesh.vertices, mesh.faces)
    surfaces = extract_facets(city).surfaces
    roof = int(np.flatnonzero(surfaces.planes[:, NORMAL + 2] > 0.9)[0])
    on = [within(surfaces.planes, surfaces.triangle_uv_m, roof, x, y, 12.0)
          for x, y in ((5.0, 25.0), (25.0, 5.0), (25.0, 25.0), (-1.0, 5.0))]
    assert len(surfaces.planes) == 8 and not surfaces.planes[roof, FULL] and on == [True, True, False, False]


def test_corners_must_be_finite(city_of):
    city = city_of((0, 0, 10, 10, 10))
    city.vertices[0, 0] = np.nan
    with pytest.raises(BadInput, match="finite"):
        extract_facets(city)
