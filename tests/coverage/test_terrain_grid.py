"""Coverage over terrain and beyond the horizon."""

import math

import numpy as np
import pytest

from radiotwin.coverage import CoverageSettings, Transmitter, predict_coverage
from radiotwin.coverage.areas import CoverageGrid
from radiotwin.scene.lattice import Lattice
from tests.terrains import incline, terrain_map

MAST = [Transmitter("a", np.array([-300.0, 0, 20]), 30.0)]


def test_receivers_stand_on_the_slope():
    height = incline(0.2, -0.1)
    at_m = CoverageGrid.over((-100, 100, -50, 50), 10.0, 1.5).receivers_m(slice(None), terrain_map(height))
    assert at_m[:, 2] == pytest.approx(height(at_m[:, 0], at_m[:, 1]) + 1.5, abs=0.01)


def test_cells_of_a_map_above_the_ground_are_above_it():
    axis_m = np.arange(-50.0, 51, 10)
    height = incline(0.2, 0.0)
    ground_m = height(*np.meshgrid(axis_m, axis_m))
    city = terrain_map(height)
    for lattice, z_m in ((Lattice(axis_m, axis_m, np.array([30.0]), ground_m), ground_m.ravel() + 30),
                         (Lattice(axis_m, axis_m, np.array([150.0])), np.full(121, 150.0))):
        at_m = CoverageGrid.of_map(lattice, 0).receivers_m(slice(None), city)
        assert at_m[:, 2] == pytest.approx(z_m, abs=0.01)


def test_behind_a_rounded_hill_is_a_loss_along_its_profile(build):
    """A ridge with a crest radius of 500 m, at whose folds no path diffracts: nothing was received, without a word."""
    scene = build(ground_z_m=lambda x, y: 10 + 20 * np.exp(-(x**2) / 2 / 500 / 20) + 0 * y, terrain=True)
    settings = CoverageSettings(step_m=20.0, extent_m=(200, 400, -40, 40))
    coverage = predict_coverage("paths", scene, MAST, settings)
    power_dbm = coverage.dataset["received_power_dbm"].values
    distance_m = np.hypot(coverage.grid.x_m + 300, coverage.grid.y_m[:, None])
    loss_db = 30 - power_dbm - 20 * np.log10(4 * np.pi * distance_m * 2e9 / 299_792_458)
    assert "coverage_probability" not in coverage.dataset and coverage.summary["model"].startswith("paths")
    assert np.isfinite(power_dbm).all() and 25 < loss_db.min() < loss_db.max() < 40
    assert any(each.startswith("100% of the links are behind terrain") for each in coverage.summary["notes"])


def test_cells_behind_a_house_alone_are_counted_not_filled(build, house):
    """Over flat ground only paths count: in a yard between walls of 60 m there is none, and the note says how many cells."""
    walls = [house(-45, -45, 45, -35, 60), house(-45, 35, 45, 45, 60), house(-45, -35, -35, 35, 60), house(35, -35, 45, 35, 60)]
    coverage = predict_coverage("paths", build(*walls), [Transmitter("a", np.array([-300.0, 0, 2]), 30.0)],
                                CoverageSettings(step_m=10.0, extent_m=(-30, 30, -30, 30)))
    missing = int(np.isnan(coverage.dataset["received_power_dbm"]).sum())
    assert missing > 0 and any(f"({missing:,}) receive nothing" in each for each in coverage.summary["notes"])


def test_beyond_5_km_the_earth_is_round(build):
    """20 km at 10 and 1.5 m, 2.4 GHz: 126.1 dB of free space and 31.0 around the Earth (P.526-15, Sec. 3); -123 dB on a flat one."""
    coverage = predict_coverage("paths", build(half_m=25e3, frequency_hz=2.4e9), [Transmitter("a", np.array([0.0, 0, 10]), 30.0)],
                                CoverageSettings(step_m=20.0, extent_m=(4_000, 20_020, -10, 10)))
    gain_db = coverage.dataset["received_power_dbm"].values[0] - 30
    assert gain_db[-1] == pytest.approx(-157.1, abs=0.3)
    near_m = coverage.grid.x_m < 5_000
    free_db = -20 * np.log10(4 * math.pi * np.hypot(coverage.grid.x_m, 8.5) * 2.4e9 / 299_792_458)
    assert ((gain_db - free_db)[near_m] == pytest.approx(3.0, abs=0.3)) and ((gain_db - free_db)[~near_m] < -3).all()
    assert any("are longer than 5 km" in each for each in coverage.summary["notes"])
