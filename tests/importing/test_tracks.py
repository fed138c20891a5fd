"""Positions joined with a log in time: GPX, NMEA, PX4 ULog (all made up), tables; clocks and zones that do not fit."""

import struct
from functools import reduce

import numpy as np
import pandas as pd
import pytest

from radiotwin.errors import BadInput
from radiotwin.importing.tracks.autopilots import read_ulog
from radiotwin.importing.tracks.fixes import make_fixes
from radiotwin.importing.tracks.texts import read_gpx, read_nmea

START = pd.Timestamp("2024-03-01 10:00:00Z").timestamp()
COLUMNS = {"level": "rssi", "device": "id", "time": "t"}
LOG = "t,id,rssi\n" + "".join(f"{START + second},b,-8{i}\n" for i, second in enumerate((0.5, 2, 3)))


def gpx(points):
    return ('<?xml version="1.0"?><gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
            + "".join(f'<trkpt lat="{lat}" lon="{lon}"><ele>{ele}</ele><time>{time}</time></trkpt>\n' for lat, lon, ele, time in points)
            + "</trkseg></trk></gpx>")


POINTS = [(48.1, 11.5, 500, "2024-03-01T10:00:00Z"), (48.2, 11.5, 510, "2024-03-01T10:00:01Z"),
          (48.4, 11.6, 530, "2024-03-01T12:00:03+02:00")]


def nmea(*sentences):
    return "".join(f"${text}*{reduce(lambda a, b: a ^ ord(b), text, 0):02X}\r\n" for text in sentences)


def dm(degrees, width):
    return f"{int(degrees):0{width}d}{(degrees % 1) * 60:08.5f}"


def gga(time, lat, lon, height, quality=1):
    return f"GPGGA,{time},{dm(lat, 2)},N,{dm(lon, 3)},E,{quality},08,1.0,{height},M,47.0,M,,"


def rmc(time, lat, lon, date, status="A"):
    return f"GNRMC,{time},{status},{dm(lat, 2)},N,{dm(lon, 3)},E,10,90,{date},,,A"


@pytest.fixture
def track(tmp_path):
    def track(name, content):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path
    return track


def test_a_log_gets_positions_of_a_track(bring_in, track):
    path = track("flight.gpx", gpx(POINTS))
    result = bring_in(LOG, columns=COLUMNS, time_format="epoch s", track=[{"file": str(path)}],
                      origin={"latitude_deg": 48.15, "longitude_deg": 11.5, "altitude_m": 500})
    table = result.table
    np.testing.assert_allclose(table["receiver_z_m"], [5, 20, 30])
    assert abs(table["receiver_x_m"][0]) < 1e-3 and abs(table["receiver_y_m"][0]) < 0.1
    assert list(table["time_s"] - START) == [0.5, 2, 3]


def test_readings_beyond_the_track_and_its_gaps_are_counted(bring_in, track):
    path = track("flight.gpx", gpx(POINTS))
    log = LOG + f"{START + 60},b,-90\n"
    given = {"columns": COLUMNS, "time_format": "epoch s", "track": [{"file": str(path)}]}
    for gap_s, number in ((5.0, 1), (1.5, 2)):
        result = bring_in(log, track_max_gap_s=gap_s, **given)
        assert result.report["left_out"] == [{
            "reason": f"no position of the track within {gap_s:g} s", "column": "time", "readings": number,
            "first": "row 5" if number == 1 else "row 3"}]


def test_another_time_zone_is_told_with_both_times(bring_in, track):
    path = track("flight.gpx", gpx(POINTS))
    log = "t,id,rssi\n2024-03-01 11:00:00,b,-80\n"
    with pytest.raises(BadInput, match=r"flight.gpx runs from 2024-03-01 10:00:00 to 2024-03-01 10:00:03 UTC, .*the log begins "
                                       r"\+1.00 h later. Is time_zone right"):
        bring_in(log, columns=COLUMNS, time_format="ISO 8601", time_zone="UTC", track=[{"file": str(path)}])
    right = bring_in(log, columns=COLUMNS, time_format="ISO 8601", time_zone="Europe/Berlin", track=[{"file": str(path)}])
    shifted = bring_in(log, columns=COLUMNS, time_format="ISO 8601", time_zone="UTC",
                       track=[{"file": str(path), "time_offset_s": 3600.0}])
    assert right.report["origin"] == shifted.report["origin"] == {"latitude_deg": 48.1, "longitude_deg": 11.5, "altitude_m": 0}


def test_tracks_of_two_receivers(bring_in, track):
    one, two = track("one.gpx", gpx(POINTS)), track("two.csv", "time,latitude,longitude,altitude_ft\n"
                                                    "2024-03-01T10:00:00Z,48.5,11.5,100\n2024-03-01T10:00:04Z,48.5,11.7,100\n")
    log = "t,id,rssi,who\n" + "".join(f"{START + 2},b,-8{i},{who}\n" for i, who in enumerate("xy"))
    tracks = [{"file": str(one), "receiver": "x"}, {"file": str(two), "receiver": "y"}]
    result = bring_in(log, columns=COLUMNS | {"receiver": "who"}, time_format="epoch s", track=tracks,
                      origin={"latitude_deg": 48.5, "longitude_deg": 11.6, "altitude_m": 0})
    y = result.table.set_index("receiver").loc["y"]
    assert abs(y["receiver_x_m"]) < 1 and abs(y["receiver_y_m"]) < 1 and y["receiver_z_m"] == pytest.approx(30.48)
    with pytest.raises(BadInput, match="receiver 'z' is none of x, y"):
        bring_in(log, columns=COLUMNS | {"receiver": "who"}, time_format="epoch s", track=[{"file": str(one), "receiver": "z"}])


def test_a_track_needs_times_and_readings_without_a_position(bring_in, track):
    path = track("flight.gpx", gpx(POINTS))
    with pytest.raises(BadInput, match="a track is joined by time; give the column"):
        bring_in(LOG, columns={"level": "rssi", "device": "id"}, track=[{"file": str(path)}])
    with pytest.raises(BadInput, match="the log has positions of its own"):
        bring_in("t,id,rssi,x\n1,b,-80,5\n", columns=COLUMNS | {"x": "x", "y": "x"}, length_unit="m", time_format="epoch s",
                 track=[{"file": str(path)}])


def test_own_positions_come_first(bring_in, track):
    path = track("flight.gpx", gpx(POINTS))
    log = f"t,id,rssi,lat,lon\n{START},b,-80,48.3,11.5\n{START + 1},b,-80,,\n"
    result = bring_in(log, columns=COLUMNS | {"latitude": "lat", "longitude": "lon"}, time_format="epoch s",
                      track=[{"file": str(path)}], origin={"latitude_deg": 48.2, "longitude_deg": 11.5})
    np.testing.assert_allclose(result.table["receiver_y_m"] / 111_200, [0.1, 0], atol=1e-4)


def test_few_places_and_heights_of_a_track_that_are_none_are_left_out():
    time_s, lat = np.arange(40.0), np.full(40, 48.1)
    lat[3], altitude = 677.7, np.full(40, 500.0)
    altitude[[7, 8]] = -9999, 99999
    fixes = make_fixes("a.csv", time_s, {"latitude": lat, "longitude": lat * 0 + 11, "altitude": altitude})
    assert fixes.time_s.tolist() == [*range(3), *range(4, 40)]
    assert np.flatnonzero(np.isnan(fixes.values["altitude"])).tolist() == [6, 7]
    assert fixes.notes == ("a.csv: 1 positions left out: 677.7 is no latitude", "a.csv: 2 altitudes left out, such as -9999 m")
    with pytest.raises(BadInput, match="1 positions with a time; at least two are needed; 3 damaged"):
        make_fixes("a.csv", time_s[:1], {"latitude": lat[:1], "longitude": lat[:1]}, ("3 damaged",))


def test_nmea_has_its_date_from_rmc_and_its_height_from_gga(track):
    text = nmea(gga("100000.00", 48.1, 11.5, 500.0), rmc("100000.00", 48.1, 11.5, "010324"),
                rmc("100001.50", 48.2, 11.5, "010324"), gga("100001.50", 48.2, 11.5, 510.5), "GPGSV,1,1,00",
                gga("100002.00", 10, 10, 0, quality=0)).replace("A*", "A*", 1)
    fixes = read_nmea(track("a.nmea", text + "$GPGGA,broken*00\r\nnoise\r\n"))
    np.testing.assert_allclose(fixes.time_s - START, [0, 1.5], atol=1e-6)
    np.testing.assert_allclose(fixes.values["latitude"], [48.1, 48.2], atol=1e-7)
    np.testing.assert_allclose(fixes.values["altitude"], [500, 510.5])
    assert fixes.notes == ("a.nmea: 1 damaged sentences are left out",)


def test_nmea_over_midnight(track):
    """The date comes once, before midnight; and once only after it."""
    times = [("235959.00", 86_399), ("000000.00", 86_400), ("000001.00", 86_401)]
    sentences = [gga(time, 48 + i / 10, 11.5, 500) for i, (time, _) in enumerate(times)]
    day = pd.Timestamp("2024-02-29", tz="UTC").timestamp()
    before = read_nmea(track("a.nmea", nmea("GPZDA,235958.00,29,02,2024,00,00", *sentences)))
    after = read_nmea(track("b.nmea", nmea(*sentences, rmc("000002.00", 48.3, 11.5, "010324"))))
    np.testing.assert_allclose(before.time_s - day, [seconds for _, seconds in times])
    np.testing.assert_allclose(after.time_s - day, [86_399, 86_400, 86_401, 86_402])


@pytest.mark.parametrize("dated", [lambda time, lat, date: rmc(time, lat, 11.5, date),
                                   lambda time, _, date: f"GPZDA,{time},{date[:2]},{date[2:4]},2024,00,00"])
def test_nmea_that_goes_on_another_day_with_gga_first(track, dated):
    times = [("100000.00", "010324"), ("100001.00", "010324"), ("110000.00", "020324"), ("110001.00", "020324")]
    sentences = [sentence for time, date in times for sentence in (gga(time, 48.1, 11.5, 500.0), dated(time, 48.1, date))]
    fixes = read_nmea(track("a.nmea", nmea(*sentences)))
    np.testing.assert_allclose(fixes.time_s - START, [0, 1, 90_000, 90_001])


def ulog(topics):
    """Return a ULog file (docs.px4.io/main/en/dev_log/ulog_file_format): definitions, then data."""
    def message(kind, body):
        return struct.pack("<HB", len(body), ord(kind)) + body

    data = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    codes = {"uint64_t": "Q", "double": "d", "float": "f", "int32_t": "i"}
    for name, (fields, _) in topics.items():
        data += message("F", f"{name}:{';'.join(f'{kind} {field}' for kind, field in fields)};".encode())
    for number, name in enumerate(topics):
        data += message("A", struct.pack("<BH", 0, number) + name.encode())
    for number, (fields, rows) in enumerate(topics.values()):
        code = "<" + "".join(codes.get(kind.partition("[")[0], "") * int((kind.partition("[")[2] or "1]")[:-1]) for kind, _ in fields)
        for row in rows:
            data += message("D", struct.pack("<H", number) + struct.pack(code, *row))
    return data


GPS = ([("uint64_t", "timestamp"), ("uint64_t", "time_utc_usec"), ("int32_t", "lat"), ("int32_t", "lon"), ("int32_t", "alt")],
       [(1_000_000 * i, int((START + i) * 1e6) if i else 0, 481_000_000 + 1_000_000 * i, 115_000_000, 500_000 + 1000 * i)
        for i in range(3)])
GLOBAL = ([("uint64_t", "timestamp"), ("double", "lat"), ("double", "lon"), ("float", "alt")],
          [(500_000 * i, 48.1 + i / 20, 11.5, 500 + i / 2) for i in range(5)])
HALF = np.sqrt(0.5)
ATTITUDE = ([("uint64_t", "timestamp"), ("float[4]", "q")],
            [(0, 1, 0, 0, 0), (900_000, HALF, 0, 0, HALF), (1_900_000, HALF, HALF, 0, 0)])


def test_px4_flight_log(track):
    pytest.importorskip("pyulog")
    path = track("a.ulg", ulog({"vehicle_gps_position": GPS, "vehicle_global_position": GLOBAL, "vehicle_attitude": ATTITUDE}))
    fixes = read_ulog(path)
    np.testing.assert_allclose(fixes.time_s - START, [0, 0.5, 1, 1.5, 2], atol=1e-5)
    np.testing.assert_allclose(fixes.values["latitude"], 48.1 + np.arange(5) / 20)
    np.testing.assert_allclose(fixes.values["heading_deg"], [0, 0, 90, 90, 0], atol=1e-4)  # to the right is clockwise
    np.testing.assert_allclose(fixes.values["roll_deg"], [0, 0, 0, 0, 90], atol=1e-4)
    cut = ulog({"other": ([("float[9999999]", "a")], []), "vehicle_gps_position": GPS})[:-5]
    np.testing.assert_allclose(read_ulog(track("c.ulg", cut)).values["altitude"], [500, 501])
    only = read_ulog(track("b.ulg", ulog({"vehicle_gps_position": GPS})))
    np.testing.assert_allclose(only.values["latitude"], [48.1, 48.2, 48.3])
    np.testing.assert_allclose(only.values["altitude"], [500, 501, 502])


def test_positions_across_the_date_line_and_north():
    fixes = make_fixes("a", np.array([0.0, 2.0]), {"latitude": np.array([1.0, 1.0]), "longitude": np.array([179.9, -179.9]),
                                                   "heading_deg": np.array([350.0, 10.0])})
    at = fixes.at(np.array([0.0, 0.5, 2.0]), 5.0)
    np.testing.assert_allclose(at["longitude"], [179.9, 179.95, -179.9])
    np.testing.assert_allclose(at["heading_deg"], [350, 355, 10])


def test_a_height_that_is_given_is_not_that_of_the_track(bring_in, track):
    """A car's antenna is 1.5 m above the road; its receiver's fixes put it 500 m above the datum."""
    path = track("drive.gpx", gpx(POINTS))
    result = bring_in(LOG, columns=COLUMNS | {"above_ground": "always 1.5"}, time_format="epoch s", length_unit="m",
                      track=[{"file": str(path)}])
    assert (result.table["receiver_above_ground_m"] == 1.5).all()
    assert "receiver_z_m" not in result.table or result.table["receiver_z_m"].isna().all()


def test_an_offset_beyond_all_calendars_is_told(bring_in, track):
    path = track("flight.gpx", gpx(POINTS))
    with pytest.raises(BadInput, match="they have no time in common"):
        bring_in(LOG, columns=COLUMNS, time_format="epoch s", track=[{"file": str(path), "time_offset_s": 1e12}])


@pytest.mark.parametrize(("read", "content", "message"), [
    *((read_gpx, content, message) for content, message in (
        (gpx(POINTS[:1]), "has 1 positions with a time; at least two"), ("<gpx", "malformed XML"),
        (gpx(POINTS).replace("48.1", "north"), "line 1: lat = 'north' is not a number"),
        (gpx(POINTS).replace("2024-03-01T10:00:01Z", "ten"), "line 2: time 'ten' is not ISO 8601"),
        (gpx(POINTS).replace("48.1", "480"), "480 is no latitude"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><gpx/>', "declares the entity 'b'"))),
    (read_nmea, nmea(gga("100000.00", 48.1, 11.5, 500.0)), "has no date: it needs sentences RMC or ZDA"),
    (read_nmea, "nothing\n", "has 0 positions"),
    *((read_ulog, content, message) for content, message in (
        (b"no log", "is no PX4 flight log"), (ulog({"vehicle_gps_position": GPS}) + bytes(100), "byte [0-9]+ is none of a ULog"),
        (ulog({"vehicle_gps_position": ([("float[65000]", "a"), ("double[65000]", "b")], [])}),
         "vehicle_gps_position has an unusual format"),
        (ulog({"vehicle_attitude": ([("other", "a")], [])}), "vehicle_attitude has an unusual format"),
        (ulog({"vehicle_global_position": GLOBAL}), "has no GNSS position"),
        (ulog({"vehicle_gps_position": (GPS[0], [(0, 0, 1, 1, 1)])}), "never had a date")))])
def test_tracks_that_cannot_be_used(track, read, content, message):
    if read is read_ulog:
        pytest.importorskip("pyulog")
    with pytest.raises(BadInput, match=message):
        read(track("a.track", content))
