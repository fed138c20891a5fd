"""Facets of solids whose faces are known."""

import numpy as np
import pytest
import trimesh

from radiotwin.errors import BadInput
from radiotwin.propagation.paths.facets import facets_and_edges
from radiotwin.propagation.paths.surfaces import pack, within
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.materials import itu_material


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
    facets = facets_and_edges(city_of((0, 0, 10, 20, 30), angle_rad=angle_rad))[0]
    assert len(facets) == 5 and (np.abs(facets.normal[:, 2]) < 0.1).sum() == 4 and facets.full.all()
    assert sorted(np.round(facets.size_m.prod(axis=1))) == [200, 300, 300, 600, 600]
    assert np.allclose(np.cross(facets.axis_u, facets.axis_v), facets.normal)
    centre_m = facets.origin_m + 0.5 * (facets.size_m[:, :1] * facets.axis_u + facets.size_m[:, 1:] * facets.axis_v)
    middle_m = np.array([5, 10, 15]) @ np.array([[np.cos(angle_rad), np.sin(angle_rad), 0],
                                                 [-np.sin(angle_rad), np.cos(angle_rad), 0], [0, 0, 1]])
    assert (np.einsum("ij,ij->i", facets.normal, centre_m - middle_m) > 0).all()


def test_slices_are_merged_across_t_junctions():
    facets = facets_and_edges(sliced_wall())[0]
    assert len(facets) == 5 and facets.full.all()


def test_surfaces_of_two_materials_are_two_facets(box_mesh):
    mesh = box_mesh(0, 0, 10, 20, 30)
    metal_halves = np.zeros(len(mesh.faces), dtype=int)
    metal_halves[::2] = 1
    city = CityMap(mesh.vertices, mesh.faces, [itu_material("brick"), itu_material("metal")], metal_halves)
    facets = facets_and_edges(city)[0]
    assert len(facets) > 5
    assert (facets.material[facets.of_face[facets.of_face >= 0]] == city.material[facets.of_face >= 0]).all()


def test_faces_of_the_ground_belong_to_no_facet(city_of):
    ground = trimesh.Trimesh([[-50, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]], [[0, 1, 2], [0, 2, 3]],
                             process=False)
    city = city_of((0, 0, 10, 10, 10), ground)
    facets = facets_and_edges(city)[0]
    assert len(facets) == 5 and (facets.of_face[-2:] == -1).all()


def test_an_angled_facet_ends_at_its_outline(prism):
    mesh = prism([(0, 0), (30, 0), (30, 10), (10, 10), (10, 30), (0, 30)], 12.0)
    city = CityMap(mesh.vertices, mesh.faces)
    facets, edges = facets_and_edges(city)
    roof = int(np.flatnonzero(facets.normal[:, 2] > 0.9)[0])
    surfaces = pack(facets, edges)
    on = [within(surfaces.planes, surfaces.triangle_uv_m, roof, x, y, 12.0)
          for x, y in ((5.0, 25.0), (25.0, 5.0), (25.0, 25.0), (-1.0, 5.0))]
    assert len(facets) == 7 and not facets.full[roof] and on == [True, True, False, False]


def test_corners_must_be_finite(city_of):
    city = city_of((0, 0, 10, 10, 10))
    city.vertices[0, 0] = np.nan
    with pytest.raises(BadInput, match="finite"):
        facets_and_edges(city)
