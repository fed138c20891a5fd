"""Facets and edges of solids whose faces and corners are known."""

import numpy as np
import pytest
import trimesh

from radiotwin.errors import BadInput
from radiotwin.propagation.paths.facets import extract_facets
from radiotwin.propagation.paths.surfaces import (
    ALONG,
    AXIS_U,
    AXIS_V,
    EXTERIOR,
    FULL,
    LENGTH,
    MATERIAL,
    NORMAL,
    NORMAL_N,
    ORIGIN,
    SIZE,
    START,
    TANGENT,
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


def test_a_box_has_four_walls_and_a_roof(city_of):
    planes = planes_of(city_of((0, 0, 10, 20, 30), angle_rad=0.4))
    normal, size_m, axis_u, axis_v = three(planes, NORMAL), planes[:, SIZE:SIZE + 2], three(planes, AXIS_U), three(planes, AXIS_V)
    assert len(planes) == 5 and (np.abs(normal[:, 2]) < 0.1).sum() == 4 and planes[:, FULL].all()
    assert sorted(np.round(size_m.prod(axis=1))) == [200, 300, 300, 600, 600]
    assert np.allclose(np.cross(axis_u, axis_v), normal)
    centre_m = three(planes, ORIGIN) + 0.5 * (size_m[:, :1] * axis_u + size_m[:, 1:] * axis_v)
    middle_m = np.append(centre_m[np.abs(normal[:, 2]) < 0.1].mean(axis=0)[:2], 15)
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


def lengths_m(edges):
    return np.sort(np.round(edges[:, LENGTH], 6))


@pytest.mark.parametrize("pieces", [1, 16])
def test_a_box_has_roof_edges_and_corners_each_in_one_piece(box_mesh, city_of, pieces):
    mesh = box_mesh(0, 0, 10, 20, 30)
    edges = extract_facets(city_of(mesh if pieces == 1 else mesh.subdivide().subdivide(), angle_rad=0.4)).surfaces.edges
    assert lengths_m(edges).tolist() == [10, 10, 20, 20, 30, 30, 30, 30]
    assert np.allclose(edges[:, EXTERIOR], 1.5 * np.pi)
    assert np.allclose((edges[:, TANGENT:TANGENT + 3] * edges[:, NORMAL_N:NORMAL_N + 3]).sum(axis=1), -1)


def test_an_inner_corner_does_not_diffract(prism):
    mesh = prism([(0, 0), (30, 0), (30, 10), (10, 10), (10, 30), (0, 30)], 12.0)
    edges = extract_facets(CityMap(mesh.vertices, mesh.faces)).surfaces.edges
    upright = np.abs(edges[:, ALONG + 2]) > 0.9
    assert upright.sum() == 5 and (~upright).sum() == 6
    assert not np.isclose(edges[upright, START:START + 2], 10).all(axis=1).any()


def test_a_roof_goes_on_over_a_shared_wall(city_of):
    edges = extract_facets(city_of((0, 0, 10, 10, 20), (10, 0, 20, 10, 20))).surfaces.edges
    assert not (np.isclose(edges[:, START], 10) & (np.abs(edges[:, ALONG + 1]) > 0.9)).any()


def test_the_angle_of_a_gable(prism):
    mesh = prism([(0, 0), (10, 0), (10, 6), (5, 11), (0, 6)], 20.0)
    turned = mesh.vertices[:, [2, 0, 1]]  # the outline stands upright; a cyclic swap keeps the winding
    facets = extract_facets(CityMap(turned, mesh.faces))
    exterior_rad = facets.surfaces.edges[:, EXTERIOR]
    ridge, eaves = (np.isclose(facets.edge_ends_m[:, :, 2], height_m).all(axis=1) for height_m in (11, 6))
    assert np.allclose(exterior_rad[ridge], np.radians(270)) and ridge.sum() == 1
    assert np.allclose(exterior_rad[eaves], np.radians(360 - 135)) and eaves.sum() == 2


def test_faces_of_two_materials_form_no_edge(city_of):
    """As in Sionna RT: the roof's four edges are gone, the corners of the walls stay."""
    whole = city_of((0, 0, 10, 20, 30))
    roof = (whole.vertices[whole.faces][:, :, 2] == 30).all(axis=1)
    city = CityMap(whole.vertices, whole.faces, [itu_material("brick"), itu_material("metal")], roof.astype(int))
    assert lengths_m(extract_facets(city).surfaces.edges).tolist() == [30, 30, 30, 30]
