"""Tracks of aircraft and of maps: exports as tables, KML, GeoJSON, ArduPilot (all made up); the file's own arithmetic."""

import json
import struct

import numpy as np
import pandas as pd
import pytest

from radiotwin.errors import BadInput
from radiotwin.importing.settings import TrackFile
from radiotwin.importing.tracks.autopilots import read_dataflash, read_tlog
from radiotwin.importing.tracks.tables import read_track_table
from radiotwin.importing.tracks.texts import read_kml

START = pd.Timestamp("2024-05-01 10:00:00Z").timestamp()
LOG = "t,id,rssi\n" + "".join(f"{START + i},b,{-80 - i}\n" for i in range(4))
SECONDS = range(6)


@pytest.fixture
def fly(bring_in, tmp_path):
    """Import a log with a track; returns the measurements."""
    def fly(content, name="track.csv", given=None, **settings):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        origin = {"latitude_deg": 48.1, "longitude_deg": 11.5, "altitude_m": 500.0}
        return bring_in(LOG, columns={"level": "rssi", "device": "id", "time": "t"}, time_format="epoch s",
                        origin=origin, track=[{"file": str(path), **(given or {})}], **settings)
    return fly


def check(result, heading=None):
    """The track goes north by 0.0001 degrees (11.12 m) and up by 1 m in a second, from 550 m above the sea."""
    table = result.table
    np.testing.assert_allclose(table["receiver_y_m"], [11.12 * i for i in range(4)], atol=0.05)
    np.testing.assert_allclose(table["receiver_z_m"], [50 + i for i in range(4)], atol=0.01)
    if heading is not None:
        np.testing.assert_allclose(table["heading_deg"], heading, atol=0.01)


def rows(head, make):
    return head + "\n" + "".join(make(i) + "\n" for i in SECONDS)


def feet(metres):
    return f"{metres / 0.3048:.4f}"


def test_airdata_has_milliseconds_beside_whole_seconds(fly):
    text = "time(millisecond),datetime(utc),latitude,longitude,height_above_takeoff(feet),altitude_above_seaLevel(feet)," \
           " compass_heading(degrees),speed(mph)\n"
    for i in range(50):
        text += f"{700 + 100 * i},2024-05-01 {pd.Timestamp(START + i / 10, unit='s'):%H:%M:%S},{48.1 + i * 1e-5:.7f},11.5,{i}," \
                f"{feet(550 + i / 10)},{i * 2},5\n"
    result = fly(text)
    check(result, [0, 20, 40, 60])
    assert any("time is datetime(utc)" in note and "altitude altitude_above_seaLevel(feet)" in note
               for note in result.report["warnings"])


@pytest.mark.parametrize(("head", "make", "given"), [
    ("latitude,longitude,altitude(feet),ascent(feet),time(millisecond),datetime(utc),datetime(local)",
     lambda i: f"{48.1 + i * 1e-4:.6f},11.5,{feet(550 + i)},10,{1000 * i},2024-05-01 10:00:0{i}.000000,2024-05-01 12:00:0{i}.000000", {}),
    ("sep=,\nCUSTOM.date [local],CUSTOM.updateTime [local],OSD.latitude,OSD.longitude,OSD.height [ft],OSD.altitude [ft],OSD.yaw [360]",
     lambda i: f"5/1/2024,12:00:0{i}.00 PM,{48.1 + i * 1e-4:.6f},11.5,10,{feet(550 + i)},90", {"time_zone": "Europe/Berlin"}),
    ("timestamp,lat,lng,alt_m", lambda i: f"{1000 * (START + i):.0f},{48.1 + i * 1e-4:.6f},11.5,{550 + i}", {}),
    ("Date,Time,Latitude,Longitude,Elevation",
     lambda i: f"01.05.2024,12:00:0{i},{48.1 + i * 1e-4:.6f},11.5,{550 + i}", {"time_zone": "Europe/Berlin"}),
    ("UTC Time;Lat;Lon;GPS Altitude (m)", lambda i: f"2024-05-01T10:00:0{i}Z;{48.1 + i * 1e-4:.6f};11.5;{550 + i}", {})])
def test_tables_with_the_usual_names(fly, head, make, given):
    check(fly(rows(head, make), **given))


def test_columns_of_a_track_can_be_declared(fly):
    text = rows("w,n,e,h", lambda i: f"10:00:0{i} 01.05.24,{48.1 + i * 1e-4:.6f},11.5,{feet(550 + i)}")
    with pytest.raises(BadInput, match="no column is known as latitude or longitude or time.*--track-columns.*the file has w, n, e, h"):
        fly(text)
    given = {"columns": {"time": "w", "latitude": "n", "longitude": "e", "altitude": "h"}, "time_format": "%H:%M:%S %d.%m.%y",
             "length_unit": "ft"}
    check(fly(text, given=given))
    with pytest.raises(BadInput, match="a track has no speed; allowed"):
        fly(text, given=given | {"columns": {"speed": "w"}})


def test_a_clock_that_begins_with_the_flight_is_refused(fly):
    text = rows("time,latitude,longitude", lambda i: f"{i},48.1,11.5")
    with pytest.raises(BadInput, match="is no time since 1970.*time_offset_s.*--track-time-format"):
        fly(text)
    given = {"columns": {"time": "time"}, "time_format": "epoch s", "time_offset_s": START}
    assert len(fly(text, given=given).table) == 4


@pytest.mark.parametrize("mode", ["", "<altitudeMode>absolute</altitudeMode>", "<altitudeMode>relativeToGround</altitudeMode>"])
def test_kml(fly, mode):
    whens = "".join(f"<when>2024-05-01T10:00:0{i}Z</when>" for i in SECONDS)
    places = "".join(f"<gx:coord>11.5 {48.1 + i * 1e-4:.6f} {550 + i}</gx:coord><gx:angles>{10 * i} 0 0</gx:angles>" for i in SECONDS)
    text = (f'<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"><Document>'
            f"<Placemark><gx:Track>{mode}{whens}{places}</gx:Track></Placemark></Document></kml>")
    result = fly(text, "track.kml")
    if "relative" in mode:
        assert result.table["receiver_z_m"].isna().all() and any("altitudeMode" in note for note in result.report["warnings"])
    else:
        check(result, [0, 10, 20, 30])
    with pytest.raises(BadInput, match="has 5 times and 6 places"):
        fly(text.replace("<when>2024-05-01T10:00:05Z</when>", ""), "track.kml")


def test_placemarks_of_kml_and_a_line_without_times(fly):
    marks = "".join(f"<Placemark><TimeStamp><when>2024-05-01T10:00:0{i}Z</when></TimeStamp><Point><coordinates>"
                    f"11.5,{48.1 + i * 1e-4:.6f},{550 + i}</coordinates></Point></Placemark>" for i in SECONDS)
    check(fly(f"<kml><Document>{marks}</Document></kml>", "track.kml"))
    with pytest.raises(BadInput, match="has no track with times"):
        fly("<kml><Placemark><LineString><coordinates>11.5,48.1,550 11.5,48.2,551</coordinates></LineString></Placemark></kml>", "t.kml")


def test_lines_of_geojson(fly):
    line = {"type": "Feature", "geometry": {"type": "LineString", "coordinates": [[11.5, 48.1 + i * 1e-4, 550 + i] for i in SECONDS]},
            "properties": {"coordTimes": [f"2024-05-01T10:00:0{i}Z" for i in SECONDS]}}
    check(fly(json.dumps({"type": "FeatureCollection", "features": [line]}), "track.geojson"))
    line["properties"]["coordTimes"].pop()
    with pytest.raises(BadInput, match="has not as many times"):
        fly(json.dumps(line), "track.geojson")


# 2024-05-01 is a Wednesday, in week 2312 since the Sunday 1980-01-06; GPS is 18 s ahead of UTC.
WEEK, WEEK_MS = 2312, (3 * 86_400 + 36_018) * 1000
GPS_LABELS = "TimeUS,I,Status,GMS,GWk,Lat,Lng,Alt"


def format_message(number, name, letters, labels):
    length = 3 + struct.calcsize("<" + "".join({"L": "i", "c": "h", "C": "H"}.get(each, each) for each in letters))
    return b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", number, length, name, letters.encode(), labels.encode())


def dataflash():
    log = format_message(130, b"GPS", "QBBIHLLf", GPS_LABELS) + format_message(131, b"ATT", "QccC", "TimeUS,Roll,Pitch,Yaw") \
        + format_message(132, b"XKF1", "Qf", "TimeUS,A")
    for i in SECONDS:
        log += b"\xa3\x95\x83" + struct.pack("<QhhH", 500_000 + i * 1_000_000, 100, -200, 1000 * i)
        log += b"\xa3\x95\x84" + struct.pack("<Qf", 500_000, 1.0)
        log += b"\xa3\x95\x82" + struct.pack("<QBBIHiif", 500_000 + i * 1_000_000, 0, 3 if i else 4, WEEK_MS + 1000 * i, WEEK,
                                             481_000_000 + 1000 * i, 115_000_000, 550.0 + i)
    return log


def test_dataflash(fly):
    result = fly(dataflash(), "flight.bin")
    check(result, [0, 10, 20, 30])
    np.testing.assert_allclose(result.table[["roll_deg", "pitch_deg"]], [[1, -2]] * 4, atol=1e-6)
    damaged = dataflash()[:300] + b"\0\0\xa3\x95\xff" + dataflash()[300:-5]
    assert len(fly(damaged, "flight.bin").table) > 2
    with pytest.raises(BadInput, match="has no message GPS"):
        fly(bytes(1000), "flight.bin")


def test_dataflash_as_text(fly):
    text = f"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\nFMT, 130, 45, GPS, QBBIHLLf, {GPS_LABELS}\n"
    text += "".join(f"GPS, {1000000 * i}, 0, 3, {WEEK_MS + 1000 * i}, {WEEK}, {48.1 + i * 1e-4:.7f}, 11.5, {550 + i}\n" for i in SECONDS)
    check(fly(text, "flight.log"))


def crc(data):
    """CRC-16/MCRF4XX bit by bit: polynomial 0x8408 (0x1021 reflected), from 0xFFFF."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value >> 1) ^ (0x8408 if value & 1 else 0)
    return value


def packet(i, number, body, extra, system=1):
    if i % 2:
        head = struct.pack("<BBBBB", len(body), 0, system, 1, number)
        magic = b"\xfe"
    else:
        body = body.rstrip(b"\0")
        head = struct.pack("<BBBBBB3s", len(body), 0, 0, 0, system, 1, number.to_bytes(3, "little"))
        magic = b"\xfd"
    return (struct.pack(">Q", round((START + i) * 1e6)) + magic + head + body
            + struct.pack("<H", crc(head + body + bytes([extra]))))


def telemetry():
    log = b""
    for i in SECONDS:
        log += packet(i, 0, bytes(9), 50)
        log += packet(i, 30, struct.pack("<Iffffff", i, 0.0, 0.0, np.radians(10 * i), 0, 0, 0), 39)
        log += packet(i, 33, struct.pack("<IiiiihhhH", i, 481_000_000 + 1000 * i, 115_000_000, 550_000 + 1000 * i, 0, 0, 0, 0, 0), 104)
    return log


def test_tlog(fly):
    log = telemetry()
    check(fly(log, "flight.tlog"), [0, 10, 20, 30])
    spoilt = bytearray(log)
    spoilt[-20] ^= 1
    result = fly(bytes(spoilt), "flight.tlog")
    assert any("1 damaged messages" in note for note in result.report["warnings"])
    with pytest.raises(BadInput, match="has no message GLOBAL_POSITION_INT"):
        fly(b"\xfe" * 500, "flight.tlog")


def test_formats_of_tracks_are_named(fly):
    with pytest.raises(BadInput, match=r"unknown format of a track; allowed are .gpx, .kml, .nmea.*\.ulg.*\.bag"):
        fly("", "track.xyz")


def test_nmea_of_any_name_and_heights_above_the_start(fly):
    sentences = [f"GPRMC,10000{i}.00,A,480{6 + i * 0.006:.4f},N,01130.0000,E,10,90,010524,,,A" for i in SECONDS]
    lines = "".join(f"${each}\r\n" for each in sentences)
    assert len(fly(lines, "gps.log").table) == 4
    text = rows("datetime(utc),latitude,longitude,height_above_takeoff(feet)", lambda i: f"2024-05-01 10:00:0{i}.5,48.1,11.5,{i}")
    notes = fly(text.replace(":00.5", ":00.0")).report["warnings"]
    assert any("no altitude above the sea is known (height_above_takeoff(feet)" in note for note in notes)


KML = ("<kml><gx:Track>" + "".join(f"<when>2024-05-01T10:00:0{i}Z</when>" for i in SECONDS)
       + "".join(f"<gx:coord>11.5 {48.1 + i * 1e-4:.6f} {550 + i}</gx:coord>" for i in SECONDS) + "</gx:Track></kml>").encode()
TABLE = rows("datetime(utc),latitude,longitude,altitude(feet)", lambda i: f"2024-05-01 10:00:0{i},{48.1 + i * 1e-4:.6f},11.5,1800").encode()


@pytest.mark.parametrize(("name", "content"), [("a.bin", dataflash()), ("a.tlog", telemetry()), ("a.kml", KML), ("a.csv", TABLE)])
def test_damaged_tracks_end_in_a_message(tmp_path, name, content):
    """Bytes are changed, left out and written twice, 150 times."""
    rng = np.random.default_rng(5)
    path = tmp_path / name
    readers = {".bin": read_dataflash, ".tlog": read_tlog, ".kml": read_kml,
               ".csv": lambda path: read_track_table(path, TrackFile(file=str(path)), "UTC")}
    read = 0
    for _ in range(150):
        damaged = bytearray(content)
        for _ in range(rng.integers(1, 4)):
            at, end = np.sort(rng.integers(0, len(damaged), size=2))
            end = min(end, at + 20)
            damaged[at:end] = (bytes(rng.integers(0, 256, size=end - at, dtype=np.uint8)), b"", bytes(damaged[at:end]) * 2,
                               b"nan", b"1e999", b"-")[rng.integers(6)]
        path.write_bytes(bytes(damaged))
        try:
            fixes = readers[path.suffix](path)
            assert (np.diff(fixes.time_s) > 0).all() and np.isfinite(fixes.values["latitude"]).all()
            read += 1
        except BadInput as error:
            assert str(path) in str(error)
    assert read
