"""Receivers of a coverage map on a terrain."""

import numpy as np
import pytest

from radiotwin.coverage.areas import CoverageGrid, ground_of
from radiotwin.scene.lattice import Lattice
from tests.terrains import incline, terrain_map


def test_receivers_stand_on_the_slope():
    height = incline(0.2, -0.1)
    grid = CoverageGrid.over((-100, 100, -50, 50), 10.0, 1.5)
    at_m = grid.receivers_m(slice(None), ground_of(terrain_map(height)))
    assert at_m[:, 2] == pytest.approx(height(at_m[:, 0], at_m[:, 1]) + 1.5, abs=0.01)


def test_cells_of_a_map_above_the_ground_are_above_it():
    axis_m = np.arange(-50.0, 51, 10)
    height = incline(0.2, 0.0)
    ground_m = height(*np.meshgrid(axis_m, axis_m))
    city = terrain_map(height)
    for lattice, z_m in ((Lattice(axis_m, axis_m, np.array([30.0]), ground_m), ground_m.ravel() + 30),
                         (Lattice(axis_m, axis_m, np.array([150.0])), np.full(121, 150.0))):
        at_m = CoverageGrid.of_map(lattice, 0).receivers_m(slice(None), ground_of(city))
        assert at_m[:, 2] == pytest.approx(z_m, abs=0.01)
