"""Edges of solids whose corners are known."""

import numpy as np
import pytest

from radiotwin.propagation.paths.facets import extract_facets
from radiotwin.propagation.paths.surfaces import ALONG, EXTERIOR, LENGTH, NORMAL_N, START, TANGENT
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.materials import itu_material


def lengths_m(edges):
    return np.sort(np.round(edges[:, LENGTH], 6))


@pytest.mark.parametrize("angle_rad", [0.0, 0.4])
def test_a_box_has_roof_edges_and_corners(city_of, angle_rad):
    edges = extract_facets(city_of((0, 0, 10, 20, 30), angle_rad=angle_rad)).surfaces.edges
    assert lengths_m(edges).tolist() == [10, 10, 20, 20, 30, 30, 30, 30]
    assert np.allclose(edges[:, EXTERIOR], 1.5 * np.pi)
    assert np.allclose((edges[:, TANGENT:TANGENT + 3] * edges[:, NORMAL_N:NORMAL_N + 3]).sum(axis=1), -1)


def test_pieces_of_an_edge_are_one(box_mesh, city_of):
    mesh = box_mesh(0, 0, 10, 20, 30).subdivide().subdivide()
    assert lengths_m(extract_facets(city_of(mesh)).surfaces.edges).tolist() == [10, 10, 20, 20, 30, 30, 30, 30]


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
