"""The list of a scene's paths: its file, its figures, and what cannot be listed."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scipy.constants import speed_of_light

from radiotwin.errors import BadInput
from radiotwin.propagation.paths.listing import list_paths
from radiotwin.scene.antennas import Antenna, Pattern

pytestmark = pytest.mark.seconds

POINTS_M = np.array([[40.0, 40, 55], [10, 30, 30], [80, 20, 55]])


@pytest.fixture(scope="module")
def listed(small_scene, tmp_path_factory):
    path = tmp_path_factory.mktemp("paths") / "paths.nc"
    made = list_paths(small_scene, POINTS_M, path, velocity_m_s=[10, 0, 0], bandwidth_hz=20e6)
    return made, path


def test_the_file_holds_what_was_returned(listed):
    made, path = listed
    with xr.open_dataset(path) as read:
        xr.testing.assert_equal(read.load(), made)
        assert read.attrs["Conventions"] == "CF-1.11" and read["path_count"].attrs["sample_dimension"] == "path"
        assert read["delay_s"].attrs["units"] == "s" and read["interactions"].attrs["flag_meanings"]


def test_figures_are_those_of_the_paths_of_each_link(listed, small_scene):
    made, _ = listed
    links = len(POINTS_M) * len(small_scene.device_m)
    assert made.sizes["link"] == links
    ends = np.cumsum(made["path_count"].to_numpy())
    frequency_hz = small_scene.config.radio.frequency_hz
    for row in range(links):
        paths = made.isel(path=slice(ends[row] - int(made["path_count"][row]), ends[row]), link=row)
        if paths["reason"].item():
            assert paths.sizes["path"] == 0 and np.isnan(paths["gain_db"])
            continue
        assert (paths["link_of_path"] == row).all()
        power = 10 ** (paths["path_gain_db"] / 10)
        field = np.sqrt(power) * np.exp(1j * paths["phase_rad"])
        assert paths["gain_db"] == pytest.approx(10 * np.log10(power.sum().item()))
        assert paths["coherent_gain_db"] == pytest.approx(20 * np.log10(abs(field.sum().item())))
        assert paths["first_delay_s"] == paths["delay_s"].min()
        mean_s = (power * paths["delay_s"]).sum() / power.sum()
        rms_s = np.sqrt((power * (paths["delay_s"] - mean_s) ** 2).sum() / power.sum())
        assert paths["rms_delay_spread_s"] == pytest.approx(rms_s.item())
        # Flown eastwards: the shift of a path is that of its azimuth and elevation of arrival
        east = np.sin(np.radians(paths["arrival_azimuth_deg"])) * np.cos(np.radians(paths["arrival_elevation_deg"]))
        assert np.allclose(paths["doppler_hz"], 10 * east * frequency_hz / speed_of_light)
        first = paths.isel(path=0)
        if not first["interactions"].any():
            way_m = POINTS_M[row % len(POINTS_M)] - small_scene.device_m[row // len(POINTS_M)]
            assert first["departure_azimuth_deg"] == pytest.approx(np.degrees(np.arctan2(way_m[0], way_m[1])) % 360)
            assert first["departure_elevation_deg"] == pytest.approx(
                np.degrees(np.arcsin(way_m[2] / np.linalg.norm(way_m))))


def test_antennas_act_in_the_directions_of_each_path(small_scene):
    """Both ends 3 and 5 dB in all directions above the horizon, nothing below it."""
    def upper(gain_dbi):
        return Antenna(Pattern(np.array([0.0]), np.array([-90.0, -1e-3, 0.0, 90.0]),
                               np.array([[-200.0], [-200], [gain_dbi], [gain_dbi]])))

    plain = list_paths(small_scene, POINTS_M[:1])
    scene = replace(small_scene)
    scene.__dict__["device_antennas"] = [upper(3.0)] * len(small_scene.device_m)
    scene.__dict__["uav_antenna"] = None
    with_antennas = list_paths(scene, POINTS_M[:1])
    up = plain["departure_elevation_deg"] > 0
    difference_db = with_antennas["path_gain_db"] - plain["path_gain_db"]
    assert np.allclose(difference_db[up], 3) and (difference_db[~up] < -100).all() and up.any() and (~up).any()


@pytest.mark.parametrize(("settings", "message"), [
    ({"velocity_m_s": [1, 2]}, "three numbers"), ({"velocity_m_s": [4e6, 0, 0]}, "1 % of the speed of light"),
    ({"bandwidth_hz": 0.0}, "must be positive"), ({"out_path": "paths.csv"}, "allowed is .nc"),
    ({"devices": ["nobody"]}, "'nobody' is not in"), ({}, "RADIOTWIN_MAX_PATHS"), ({"points_m": np.zeros((0, 3))}, r"shape \(n, 3\)")])
def test_what_cannot_be_listed(small_scene, settings, message, monkeypatch):
    monkeypatch.setenv("RADIOTWIN_MAX_PATHS", "3")
    with pytest.raises(BadInput, match=message):
        list_paths(small_scene, **({"points_m": POINTS_M} | settings))


def test_a_point_inside_a_building_has_a_reason_and_no_path(small_scene):
    lattice_m = small_scene.lattice.positions_m * [1, 1, 0] + [0, 0, 3.0]
    inside_m = lattice_m[small_scene.city.inside(lattice_m)][:1]
    made = list_paths(small_scene, inside_m, bandwidth_hz=1e6)
    assert set(made["reason"].to_numpy()) == {"inside a building"} and made.sizes["path"] == 0
    assert np.isnan(made["gain_db"]).all() and (made["response_real"] == 0).all()
