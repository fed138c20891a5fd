"""Correlation of a map's errors, and spread of devices' levels, estimated from drawn residuals."""

import numpy as np
import pytest

from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import fly_survey, segmented_truth
from radiotwin.twin import fit_twin
from radiotwin.twin.shadowing import ErrorCorrelation, with_shadowing


def test_the_correlation_of_an_interpolating_twin_is_that_of_its_own_field(small_scene, tmp_path):
    truth = segmented_truth(small_scene)
    measurements = fly_survey(small_scene, truth, flights=1, pattern="random-waypoint", seed=0)
    for model in ("kriging", "segmented_log_distance"):
        twin = fit_twin(measurements, small_scene, model=model, seed=0)
        radio_map = twin.radio_map(small_scene)
        found = with_shadowing(radio_map, twin).dataset.attrs
        share, length_m = found["shadowing_share"], found["shadowing_length_m"]
        # The statistical truth draws all of it anew in every slot.
        assert share * np.exp(-small_scene.lattice.step_m / length_m) < 0.1
        assert share == 0 or length_m >= small_scene.lattice.step_m
        assert "shadowing_share" not in radio_map.dataset.attrs
        if model == "kriging":
            twin.channel.field.share, twin.channel.field.length_m = 0.7, 70.0
            with_shadowing(radio_map, twin).save(tmp_path / "map.nc")
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
        found.append(ErrorCorrelation.of_residuals(device, receiver_m, residual_db, np.full(len(device), 5.0), seed))
    assert all(each.devices == 20 for each in found)
    assert 0.5 < np.mean([each.share for each in found]) < 0.85
    assert 30.0 < np.mean([each.length_m for each in found]) < 120.0
    mean_db = np.mean([each.level_sd_db for each in found])
    assert 0.7 * level_sd_db < mean_db < 1.3 * level_sd_db + 0.8
