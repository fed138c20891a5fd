"""Edges of solids whose corners are known."""

import numpy as np
import pytest

from radiotwin.propagation.paths.facets import facets_and_edges
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.materials import itu_material


def lengths_m(edges):
    return np.sort(np.round(np.linalg.norm(edges.end_m - edges.start_m, axis=1), 6))


@pytest.mark.parametrize("angle_rad", [0.0, 0.4])
def test_a_box_has_roof_edges_and_corners(city_of, angle_rad):
    edges = facets_and_edges(city_of((0, 0, 10, 20, 30), angle_rad=angle_rad))[1]
    assert lengths_m(edges).tolist() == [10, 10, 20, 20, 30, 30, 30, 30]
    assert np.allclose(edges.exterior_rad, 1.5 * np.pi)
    assert np.allclose(np.einsum("ij,ij->i", edges.tangent_0, edges.normal_n), -1)


def test_pieces_of_an_edge_are_one(box_mesh, city_of):
    mesh = box_mesh(0, 0, 10, 20, 30).subdivide().subdivide()
    assert lengths_m(facets_and_edges(city_of(mesh))[1]).tolist() == [10, 10, 20, 20, 30, 30, 30, 30]


def test_an_inner_corner_does_not_diffract(prism):
    mesh = prism([(0, 0), (30, 0), (30, 10), (10, 10), (10, 30), (0, 30)], 12.0)
    edges = facets_and_edges(CityMap(mesh.vertices, mesh.faces))[1]
    upright = np.abs(edges.direction[:, 2]) > 0.9
    assert upright.sum() == 5 and (~upright).sum() == 6
    assert not np.isclose(edges.start_m[upright, :2], 10).all(axis=1).any()


def test_a_roof_goes_on_over_a_shared_wall(city_of):
    edges = facets_and_edges(city_of((0, 0, 10, 10, 20), (10, 0, 20, 10, 20)))[1]
    assert not (np.isclose(edges.start_m[:, 0], 10) & (np.abs(edges.direction[:, 1]) > 0.9)).any()


def test_the_angle_of_a_gable(prism):
    mesh = prism([(0, 0), (10, 0), (10, 6), (5, 11), (0, 6)], 20.0)
    turned = mesh.vertices[:, [2, 0, 1]]  # the outline stands upright; a cyclic swap keeps the winding
    edges = facets_and_edges(CityMap(turned, mesh.faces))[1]
    ridge = np.isclose(edges.start_m[:, 2], 11) & np.isclose(edges.end_m[:, 2], 11)
    eaves = np.isclose(edges.start_m[:, 2], 6) & np.isclose(edges.end_m[:, 2], 6)
    assert np.allclose(edges.exterior_rad[ridge], np.radians(270)) and ridge.sum() == 1
    assert np.allclose(edges.exterior_rad[eaves], np.radians(360 - 135)) and eaves.sum() == 2


def test_faces_of_two_materials_form_no_edge(city_of):
    """As in Sionna RT: the roof's four edges are gone, the corners of the walls stay."""
    whole = city_of((0, 0, 10, 20, 30))
    roof = (whole.vertices[whole.faces][:, :, 2] == 30).all(axis=1)
    city = CityMap(whole.vertices, whole.faces, [itu_material("brick"), itu_material("metal")], roof.astype(int))
    assert lengths_m(facets_and_edges(city)[1]).tolist() == [30, 30, 30, 30]
