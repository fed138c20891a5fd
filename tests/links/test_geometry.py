"""Geometry of links against hand calculation, and what they refuse."""

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.links import LinkGeometry, link_geometry

DEVICE_M = np.array([[0.0, 0.0, 1.5], [np.nan, np.nan, 1.5], [10.0, 20.0, 0.0]])


class Wall:
    """A map in which only links that end north of y = 0 are free."""

    def line_of_sight(self, a_m, b_m):
        return b_m[:, 1] >= 0.0


def test_distance_and_elevation_of_a_345_triangle():
    links = link_geometry(DEVICE_M, np.array([[30.0, 0.0, 41.5]]), np.array([0]), None)
    assert links.distance_m[0] == pytest.approx(50.0)
    assert links.log_distance[0] == pytest.approx(1.69897, abs=1e-5)
    assert np.degrees(links.elevation_rad[0]) == pytest.approx(53.1301, abs=1e-4)


def test_elevation_is_negative_below_the_device_and_90_degrees_overhead():
    receiver_m = np.array([[10.0, 20.0, -7.0], [10.0, 20.0, 60.0]])
    links = link_geometry(DEVICE_M, receiver_m, np.array([2, 2]), None)
    assert np.degrees(links.elevation_rad) == pytest.approx([-90.0, 90.0])


def test_receiver_at_the_device_has_the_reference_distance():
    links = link_geometry(DEVICE_M, np.array([[0.0, 0.0, 1.5]]), np.array([0]), None)
    assert links.log_distance[0] == 0.0
    assert links.elevation_rad[0] == 0.0


def test_line_of_sight_is_the_maps_and_true_without_one():
    receiver_m = np.array([[5.0, -5.0, 30.0], [5.0, 5.0, 30.0]])
    device = np.array([0, 2])
    assert link_geometry(DEVICE_M, receiver_m, device, Wall()).los.tolist() == [False, True]
    assert link_geometry(DEVICE_M, receiver_m, device, None).los.all()


def test_select_keeps_rows_together():
    receiver_m = np.arange(12.0).reshape(4, 3)
    links = link_geometry(DEVICE_M, receiver_m, np.array([0, 2, 0, 2]), Wall())
    picked = links.select(links.device == 2)
    assert picked.receiver_m.tolist() == receiver_m[[1, 3]].tolist()
    assert (picked.device_m == DEVICE_M[2]).all()
    assert len(picked) == 2


def test_no_links_are_fine():
    assert len(link_geometry(DEVICE_M, np.empty((0, 3)), np.empty(0, int), None)) == 0


@pytest.mark.parametrize("device", [[-1], [3]])
def test_device_outside_the_table(device):
    with pytest.raises(BadInput, match="there are 3 devices"):
        link_geometry(DEVICE_M, np.zeros((1, 3)), np.array(device), None)


def test_unknown_position_is_named():
    with pytest.raises(BadInput, match="position of device row 1 is blank"):
        link_geometry(DEVICE_M, np.zeros((2, 3)), np.array([0, 1]), None)


def test_receiver_that_is_not_finite_is_named():
    with pytest.raises(BadInput, match="row 1"):
        link_geometry(DEVICE_M, np.array([[0.0, 0, 0], [0, np.inf, 0]]), np.array([0, 0]), None)


def test_shapes_that_disagree():
    with pytest.raises(ValueError, match=r"los: shape \(3,\), expected \(2,\)"):
        LinkGeometry(np.zeros((2, 3)), np.zeros((2, 3)), np.ones(3, bool), np.zeros(2, int))
