"""Frames of tables: where on the earth they lie, kept beside them, and exact conversion between two."""

import numpy as np
import pandas as pd
import pytest
from pyproj import Geod

from radiotwin.errors import BadInput
from radiotwin.geo import FRAME_FILE, between_frames, is_same_frame, read_frame
from radiotwin.io.forms import Origin
from radiotwin.links.measurements import Measurements, read_measurements

HERE = Origin(latitude_deg=36.0001, longitude_deg=-78.93575)
THERE = Origin(latitude_deg=35.999274, longitude_deg=-78.935964)
GEOD = Geod(ellps="WGS84")


def by_geodesic(position_m, one, other):
    """Distance and bearing from each origin on the ellipsoid, by geodesics instead of a projection."""
    x_m, y_m = np.asarray(position_m)[:, :2].T
    starts = np.full(len(x_m), one.longitude_deg), np.full(len(x_m), one.latitude_deg)
    longitude, latitude, _ = GEOD.fwd(*starts, np.degrees(np.arctan2(x_m, y_m)), np.hypot(x_m, y_m))
    ends = np.full(len(x_m), other.longitude_deg), np.full(len(x_m), other.latitude_deg)
    bearing, _, distance = GEOD.inv(*ends, longitude, latitude)
    return np.column_stack([distance * np.sin(np.radians(bearing)), distance * np.cos(np.radians(bearing))])


@pytest.mark.parametrize("other", [THERE, Origin(latitude_deg=36.4, longitude_deg=-79.5),
                                   Origin(latitude_deg=36.0001, longitude_deg=-78.93675)])
def test_conversion_is_exact(other):
    position_m = np.random.default_rng(0).uniform(-3e3, 3e3, (200, 3))
    moved_m = between_frames(position_m, HERE, other)
    np.testing.assert_allclose(moved_m[:, :2], by_geodesic(position_m, HERE, other), atol=1e-5)
    np.testing.assert_array_equal(moved_m[:, 2], position_m[:, 2])
    np.testing.assert_allclose(between_frames(moved_m, other, HERE), position_m, atol=1e-6)


def test_heights_move_only_between_two_known_grounds():
    position_m = np.array([[1.0, 2.0, 30.0], [np.nan, np.nan, 5.0]])
    low, high = (HERE.model_copy(update={"altitude_m": value}) for value in (100.0, 140.0))
    assert between_frames(position_m, high, low)[:, 2].tolist() == [70.0, 45.0]
    assert between_frames(position_m, high, HERE)[:, 2].tolist() == [30.0, 5.0]
    assert np.isnan(between_frames(position_m, high, low)[1, :2]).all()


def test_same_frame_on_both_sides_of_the_date_line():
    east, west = (Origin(latitude_deg=-17, longitude_deg=degrees) for degrees in (180, -180))
    assert is_same_frame(east, west) and is_same_frame(HERE, HERE)
    assert not is_same_frame(HERE, THERE)


@pytest.fixture
def measured():
    table = pd.DataFrame({"flight": "f", "receiver": "r", "receiver_x_m": [1.0, 2.0], "receiver_y_m": [3.0, 4.0],
                          "receiver_z_m": 1.5, "device": "a", "rssi_dbm": [-90.0, np.nan]})
    devices = pd.DataFrame({"device": ["a", "b"], "x_m": [10.0, np.nan], "y_m": [20.0, np.nan], "z_m": [24.0, 1.0],
                            "role": ["anchor", "unknown"]})
    return Measurements(table, devices, HERE)


def test_a_table_keeps_its_origin(measured, tmp_path):
    measured.save(tmp_path / "m" / "measurements.csv")
    again = read_measurements(tmp_path / "m" / "measurements.csv")
    assert again.origin == HERE and again.select([True, False]).origin == HERE
    moved = again.in_frame(THERE)
    assert moved.origin == THERE
    np.testing.assert_allclose(moved.receiver_m[:, :2], by_geodesic(measured.receiver_m, HERE, THERE), atol=1e-5)
    np.testing.assert_allclose(moved.device_m[:1, :2], by_geodesic(measured.device_m[:1], HERE, THERE), atol=1e-5)
    assert np.isnan(moved.device_m[1, :2]).all()


def test_devices_of_another_folder_are_converted(measured, tmp_path):
    measured.save(tmp_path / "here" / "measurements.csv")
    measured.in_frame(THERE).save(tmp_path / "there" / "measurements.csv")
    both = read_measurements(tmp_path / "here" / "measurements.csv", tmp_path / "there" / "devices.csv")
    np.testing.assert_allclose(both.device_m, measured.device_m, atol=1e-5)


def test_a_folder_is_of_one_frame(measured, tmp_path):
    measured.save(tmp_path / "measurements.csv")
    measured.save(tmp_path / "more.csv")
    for other in (measured.in_frame(THERE), Measurements(measured.table, measured.devices)):
        with pytest.raises(BadInput, match="choose another output folder"):
            other.save(tmp_path / "other.csv")
    assert not (tmp_path / "other.csv").exists()


BAD = {"nonsense": "x", "another schema": 'schema = "radiotwin.scene/1"\n[origin]\nlatitude_deg=1\nlongitude_deg=2\n',
       "no origin": 'schema = "radiotwin.frame/1"\n', "off the earth": "[origin]\nlatitude_deg=95\nlongitude_deg=2\n",
       "another crs": 'crs = "EPSG:4326"\n[origin]\nlatitude_deg=1\nlongitude_deg=2\n',
       "infinite": "[origin]\nlatitude_deg=inf\nlongitude_deg=2\n"}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_frame_is_refused(tmp_path, what):
    (tmp_path / FRAME_FILE).write_text(BAD[what])
    with pytest.raises(BadInput, match=FRAME_FILE):
        read_frame(tmp_path)


def test_a_frame_that_leads_out_of_its_folder_is_refused(tmp_path, measured):
    measured.save(tmp_path / "secret" / "measurements.csv")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / FRAME_FILE).symlink_to(tmp_path / "secret" / FRAME_FILE)
    with pytest.raises(BadInput, match="out of its folder"):
        read_frame(tmp_path / "mine")
