"""Correlation of a map's errors, estimated from fields that are drawn with a Cholesky factor."""

import numpy as np
import pandas as pd
import pytest

from radiotwin.links.measurements import Measurements
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import fly_survey, segmented_truth
from radiotwin.scene.lattice import Lattice
from radiotwin.twin import fit_twin
from radiotwin.twin.shadowing import MapErrors, fit_shadowing, with_shadowing

LIMIT_DB = -115.0


def walks(lattice, rng, flights=6, slots=80):
    """Cells (row, column) of random walks over the lattice."""
    most = np.array([len(lattice.y_m), len(lattice.x_m)]) - 1
    steps = rng.integers(-1, 2, (flights, slots, 2))
    return np.clip(rng.integers(0, most + 1, (flights, 1, 2)) + steps.cumsum(axis=1), 0, most).reshape(-1, 2)


def measured(share, length_m, seed):
    """A map of two devices, and measurements off it by shadowing made with a Cholesky factor, point by point."""
    rng = np.random.default_rng(seed)
    lattice = Lattice(np.arange(0, 500, 20.0), np.arange(0, 600, 20.0), np.array([50.0]))
    gain_db = np.broadcast_to(np.linspace(-90, -110, 2)[:, None, None, None], (2, *lattice.shape))
    sigma_db = np.broadcast_to(np.array([3.0, 9.0])[:, None, None, None], gain_db.shape)
    radio_map = RadioMap.build(["a", "b"], lattice, gain_db, np.zeros(gain_db.shape), sigma_db)
    cell = walks(lattice, rng)
    x_m, y_m = lattice.x_m[cell[:, 1]], lattice.y_m[cell[:, 0]]
    apart_m = np.hypot(x_m[:, None] - x_m, y_m[:, None] - y_m)
    factor = np.linalg.cholesky(share * np.exp(-apart_m / length_m) + 1e-6 * np.eye(len(cell)))
    tables = []
    for number, name in enumerate("ab"):
        unit = factor @ rng.standard_normal(len(cell)) + np.sqrt(1 - share) * rng.standard_normal(len(cell))
        level_db = gain_db[number, 0, 0, 0] + sigma_db[number, 0, 0, 0] * unit
        tables.append(pd.DataFrame({"receiver_x_m": x_m, "receiver_y_m": y_m, "receiver_z_m": 50.0, "device": name,
                                    "gain_db": np.where(level_db < LIMIT_DB, np.nan, level_db)}))
    return radio_map, Measurements(pd.concat(tables, ignore_index=True), pd.DataFrame({"device": ["b", "c", "a"], "x_m": 0.0, "y_m": 0.0}))


@pytest.mark.parametrize("seed", range(3))
def test_share_and_length_are_estimated_from_the_residuals(seed):
    lasting = fit_shadowing(*measured(0.8, 80.0, seed), LIMIT_DB, 0)
    assert lasting.share == pytest.approx(0.8, abs=0.15)
    assert 40 < lasting.length_m < 160
    of_a_slot = fit_shadowing(*measured(0.0, 80.0, seed), LIMIT_DB, 0)
    assert of_a_slot.share < 0.15


def test_the_correlation_of_an_interpolating_twin_is_that_of_its_own_field(small_scene, tmp_path):
    truth = segmented_truth(small_scene)
    measurements = fly_survey(small_scene, truth, flights=1, pattern="random-waypoint", seed=0)
    for model in ("kriging", "segmented_log_distance"):
        twin = fit_twin(measurements, small_scene, model=model, seed=0)
        radio_map = twin.radio_map(small_scene)
        found = with_shadowing(radio_map, twin, measurements, small_scene.config.gain_limit_db, 0).dataset.attrs
        share, length_m = found["shadowing_share"], found["shadowing_length_m"]
        # The statistical truth draws all of it anew in every slot.
        assert share * np.exp(-small_scene.lattice.step_m / length_m) < 0.1
        assert share == 0 or length_m >= small_scene.lattice.step_m
        assert "shadowing_share" not in radio_map.dataset.attrs
        if model == "kriging":
            twin.channel.field.share, twin.channel.field.length_m = 0.7, 70.0
            with_shadowing(radio_map, twin, measurements, -120.0, 0).save(tmp_path / "map.nc")
            attributes = RadioMap.load(tmp_path / "map.nc").dataset.attrs
            assert (attributes["shadowing_share"], attributes["shadowing_length_m"]) == (0.7, 70.0)


@pytest.mark.parametrize("level_sd_db", [0.5, 4.0])
def test_levels_of_devices_and_errors_that_last_are_told_apart(level_sd_db):
    """Residuals drawn here: a level for each device, and an error with a correlation of 60 m along a street."""
    found = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        device = np.repeat(np.arange(20), 150)
        along_m = np.tile(np.arange(150) * 10.0, 20)
        kept, error = np.exp(-10.0 / 60.0), np.empty(len(device))
        for row in range(len(device)):
            new = rng.normal()
            error[row] = new if along_m[row] == 0 else kept * error[row - 1] + np.sqrt(1 - kept**2) * new
        residual_db = level_sd_db * rng.normal(size=20)[device] + 5.0 * (
            np.sqrt(0.7) * error + np.sqrt(0.3) * rng.normal(size=len(device)))
        receiver_m = np.column_stack([along_m, np.zeros((len(device), 2))])
        found.append(MapErrors.of_residuals(device, receiver_m, residual_db, np.full(len(device), 5.0), seed))
    assert all(each.devices == 20 for each in found)
    assert 0.5 < np.mean([each.share for each in found]) < 0.85
    assert 30.0 < np.mean([each.length_m for each in found]) < 120.0
    mean_db = np.mean([each.level_sd_db for each in found])
    assert 0.7 * level_sd_db < mean_db < 1.3 * level_sd_db + 0.8
