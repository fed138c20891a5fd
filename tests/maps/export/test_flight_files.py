"""Files that fly: waypoints, times, and the forms that other programs read."""

import json
import xml.etree.ElementTree as ET

import numpy as np
import pandas as pd
import pytest

from radiotwin.io.forms import Origin
from radiotwin.maps.export.flight_files import Route, write_flight_files

HELSINKI = Origin(latitude_deg=60.17, longitude_deg=24.94, altitude_m=20.0)
TRACK_M = np.array([(0, 0, 50), (0, 20, 50), (0, 40, 50), (0, 40, 50), (0, 40, 50), (20, 40, 50), (0, 40, 50),
                    (0, 20, 50), (0, 0, 50)], dtype=float)


def haversine_m(one, other):
    (lon_1, lat_1), (lon_2, lat_2) = np.radians(one), np.radians(other)
    h = np.sin((lat_2 - lat_1) / 2)**2 + np.cos(lat_1) * np.cos(lat_2) * np.sin((lon_2 - lon_1) / 2)**2
    return 2 * 6371008.8 * np.arcsin(np.sqrt(h))


@pytest.fixture
def route():
    return Route.along("uav0", TRACK_M, 2.0, 10.0, 5.0)


def test_a_waypoint_for_each_turn_with_the_time_to_hover(route):
    np.testing.assert_array_equal(route.position_m[:, :2], [(0, 0), (0, 40), (20, 40), (0, 40), (0, 0)])
    np.testing.assert_allclose(route.hold_s, [0, 4, 0, 0, 0])
    np.testing.assert_allclose(route.arrival_s, [0, 4, 10, 12, 16])
    np.testing.assert_allclose(route.above_start_m, 45.0)


def test_a_uav_that_hovers_only_is_one_waypoint():
    alone = Route.along("u", np.tile([1.0, 2.0, 30.0], (4, 1)), 2.0, 10.0)
    assert len(alone.position_m) == 1 and alone.hold_s.tolist() == [6.0] and alone.arrival_s.tolist() == [0.0]


def test_qgroundcontrol_takes_off_flies_waypoints_and_returns(route, tmp_path):
    names = write_flight_files([route], HELSINKI, tmp_path)
    assert sorted(names) == sorted(path.name for path in tmp_path.iterdir())
    content = json.loads((tmp_path / "uav0.plan").read_text())
    assert content["fileType"] == "Plan" and content["version"] == 1 and content["mission"]["version"] == 2
    items = content["mission"]["items"]
    assert [item["command"] for item in items] == [22, 178, 16, 16, 16, 16, 16, 20]
    assert [item["doJumpId"] for item in items] == list(range(1, 9))
    assert all(len(item["params"]) == 7 for item in items)
    flown = [item for item in items if item["command"] == 16]
    assert [item["params"][0] for item in flown] == [0, 4, 0, 0, 0]
    assert all(item["params"][6] == item["Altitude"] == 45.0 and item["frame"] == 3 for item in flown)
    assert content["mission"]["plannedHomePosition"][2] == 25.0
    places = [(item["params"][5], item["params"][4]) for item in flown]
    away_m = [haversine_m(places[0], place) for place in places]
    np.testing.assert_allclose(away_m, [0, 40, np.hypot(20, 40), 40, 0], atol=0.3)


def test_kml_geojson_and_csv_have_the_same_places(route, tmp_path):
    write_flight_files([route], HELSINKI, tmp_path)
    table = pd.read_csv(tmp_path / "flights.csv")
    lines = [each["geometry"]["coordinates"] for each in
             json.loads((tmp_path / "flights.geojson").read_text())["features"]
             if each["geometry"]["type"] == "LineString"]
    text = ET.parse(tmp_path / "flights.kml").find(".//{*}coordinates").text
    kml = [tuple(map(float, place.split(","))) for place in text.split()]
    expected = table[["longitude_deg", "latitude_deg", "altitude_m"]]
    np.testing.assert_allclose(lines[0], expected, atol=1e-9)
    np.testing.assert_allclose(kml, expected, atol=1e-5)
    assert (table["altitude_m"] == 70.0).all()


def test_without_an_origin_there_is_the_table_alone(route, tmp_path):
    assert write_flight_files([route], None, tmp_path) == ["flights.csv"]
    assert "latitude_deg" not in pd.read_csv(tmp_path / "flights.csv").columns
