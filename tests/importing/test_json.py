"""Shapes of JSON: records, lists of receptions, documents of pandas and of GIS, and what is in none of them."""

import json
import tracemalloc

import pytest

from radiotwin.errors import BadInput

COLUMNS = {"latitude": "lat", "longitude": "lon", "level": "rssi", "device": "cell"}
RECORDS = [{"lat": 48.1 + i / 1000, "lon": 11.5, "rssi": -80 - i, "cell": "A"} for i in range(4)]


def lines(records):
    return "\n".join(map(json.dumps, records)) + "\n"


AT_POINTS = COLUMNS | {"latitude": "latitude", "longitude": "longitude"}


def features(*geometries):
    """A map with a feature for each geometry; a number is a point so many degrees east of 11."""
    made = [{"type": "Feature", "properties": {"cell": "A", "rssi": -80 - i}, "geometry":
             each if isinstance(each, dict) else {"type": "Point", "coordinates": [11 + each, 48.1]}}
            for i, each in enumerate(geometries)]
    return {"type": "FeatureCollection", "features": made}


@pytest.mark.parametrize("content", [
    lines(RECORDS), json.dumps(RECORDS), json.dumps(RECORDS, indent=1), "\n".join(json.dumps(each, indent=4) for each in RECORDS),
    json.dumps({name: [each[name] for each in RECORDS] for name in COLUMNS.values()}),
    json.dumps({name: {str(i): each[name] for i, each in enumerate(RECORDS)} for name in COLUMNS.values()}),
    json.dumps({"columns": list(RECORDS[0]), "index": [0, 1, 2, 3], "data": [list(each.values()) for each in RECORDS]}),
    lines(RECORDS) + '{"lat": 48.2, "lo'])
@pytest.mark.parametrize("name", ["log.json", "log.jsonl", "log.txt"])
def test_records_in_any_arrangement(bring_in, content, name):
    assert list(bring_in(content, name, columns=COLUMNS).table["rssi_dbm"]) == [-80, -81, -82, -83]


def uplink(gateways, **more):
    return {"time": "2024-05-01T10:00:00Z", "node": {"eui": "1"}, "more": {**more, "gws": [
        {"id": f"g{i}", "rssi": -80 - i} for i in range(gateways)]}}


GATEWAYS = {"columns": {"level": "more.gws.rssi", "receiver": "more.gws.id", "device": "node.eui", "x": "always 0", "y": "always 0"},
            "length_unit": "m"}


def test_lists_of_any_name_are_rows_where_a_column_is_used(bring_in):
    sensors = [{"t": 1}, {"t": 2}]
    result = bring_in(lines([uplink(2, sensors=sensors), uplink(3, sensors=sensors)]), "log.jsonl", **GATEWAYS)
    assert result.report["rows"] == 5
    assert any("lists that are not read: more.sensors (4 values)" in note for note in result.report["warnings"])


def test_a_refusal_names_the_columns_of_lists(bring_in):
    with pytest.raises(BadInput, match=r"columns.level is missing.*more\.gws\.rssi"):
        bring_in(lines([uplink(2)]), "log.jsonl")
    with pytest.raises(BadInput, match=r"'more\.gw\.rssi' .level. is missing; the file has .*more\.gws\.rssi"):
        bring_in(lines([uplink(2)]), "log.jsonl", columns=GATEWAYS["columns"] | {"level": "more.gw.rssi"}, length_unit="m")


def test_a_list_can_be_named(bring_in):
    given = {"columns": {"level": "b.rssi", "device": "always A", "x": "b.x", "y": "always 0"}, "length_unit": "m"}
    record = {"a": [{"rssi": 1}], "b": [{"rssi": -80, "x": 1}, {"rssi": -81, "x": 2}]}
    assert list(bring_in(lines([record]), "log.jsonl", list="b", **given).table["rssi_dbm"]) == [-80, -81]


def test_records_without_receptions_are_counted(bring_in):
    join = {"time": "2024-05-01T09:00:00Z", "node": {"eui": "1"}, "devAddr": "01"}
    report = bring_in(lines([join, uplink(2), uplink(0), uplink(1)]), "log.jsonl", **GATEWAYS).report
    assert (report["rows"], report["kept"]) == (5, 2)  # and one repeats another
    assert report["left_out"][-1] == {"reason": "no reception: a record without more.gws", "column": "", "readings": 2,
                                      "first": "line 1"}


@pytest.mark.parametrize("payload", [
    {"latitude": 48.1, "longitude": 11.5}, {"location": {"latitude": 48.1, "longitude": 11.5}},
    {"gps_1": {"latitude": 48.1, "longitude": 11.5, "altitude": 3}}, {"lat": 48.1, "lng": 11.5}, {"pos": {"lat": 48.1, "lon": 11.5}}])
def test_a_node_that_moves_is_the_receiver_wherever_its_position_is(bring_in, payload):
    event = {"time": "2024-05-01T10:00:00Z", "deviceInfo": {"devEui": "1"}, "object": payload,
             "rxInfo": [{"gatewayId": "g", "rssi": -80, "snr": 9, "location": {"latitude": 48.2, "longitude": 11.5}}]}
    result = bring_in(lines([event]), "log.json")
    assert result.report["files"][0]["format"] == "chirpstack-mapper" and list(result.devices["device"]) == ["g"]
    stack = {"received_at": "2024-05-01T10:00:00Z", "end_device_ids": {"device_id": "n"}, "uplink_message": {
        "decoded_payload": payload, "rx_metadata": [{"gateway_ids": {"gateway_id": "g"}, "rssi": -80, "snr": 9}]}}
    assert bring_in(lines([stack]), "log.json").report["files"][0]["format"] == "things-stack-mapper"


def test_geojson_of_another_system(bring_in):
    """In UTM zone 32 the meridian of 9 degrees is at 500 km east, and its points are east of each other by metres."""
    points = features(*({"type": "Point", "coordinates": [500_000 + 100 * i, 5_330_000, 30.0]} for i in (-1, 1)))
    named = points | {"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}}
    for content, given in ((named, {}), (points, {"crs": "EPSG:25832"})):
        result = bring_in(json.dumps(content), "log.geojson", columns=AT_POINTS | {"altitude": "altitude"}, length_unit="m", **given)
        assert result.report["origin"]["longitude_deg"] == pytest.approx(9, abs=1e-6)
        assert list(result.table["receiver_x_m"]) == pytest.approx([-100, 100], abs=0.1)
        assert list(result.table["receiver_z_m"]) == [30, 30]


def test_features_one_a_line(bring_in):
    for name, mark in (("log.geojsonl", ""), ("log.json", "\x1e")):
        content = "".join(f"{mark}{json.dumps(each)}\n" for each in features(0, 0, 0)["features"])
        assert list(bring_in(content, name, columns=AT_POINTS).table["rssi_dbm"]) == [-80, -81, -82]


@pytest.mark.parametrize(("content", "name", "message", "row"), [
    (lines(RECORDS[:2]) + '{"lat": }\n' + lines(RECORDS[2:]), "log.jsonl", "line 3 is not readable JSON", "line 3"),
    (lines(RECORDS) + "[1]\n", "log.jsonl", "line 5 is no JSON object", "line 5"),
    (json.dumps([*RECORDS, 7]), "log.json", "record 5 is '7'; allowed are objects", "record 5"),
    (json.dumps(features(0, {"type": "LineString", "coordinates": [[0, 0], [1, 1]]}, 0.1, 0.2, 0.3)), "log.geojson",
     "feature 2 is LineString", "feature 2")])
def test_records_that_are_none_can_be_skipped(bring_in, content, name, message, row):
    columns = AT_POINTS if "geo" in name else COLUMNS
    with pytest.raises(BadInput, match=f"{message}.*--skip-bad-rows 1"):
        bring_in(content, name, columns=columns)
    report = bring_in(content, name, columns=columns, skip_bad_rows=1).report
    assert report["kept"] == 4 and report["bad_rows"][0]["row"] == row


@pytest.mark.parametrize(("content", "message"), [
    (b'{"a": "\xff"}\n{}\n', "is not text in UTF-8"), ('{"a": ' + "[" * 100_000 + "\n", "levels of nesting"),
    (json.dumps(features(0) | {"crs": {"properties": {"name": "EPSG:1"}}}), "its crs 'EPSG:1' cannot be read.*--crs"),
    (json.dumps(features()), "has no rows"), ('{"type": "FeatureCollection"}', "FeatureCollection without features"),
    (json.dumps(features({"type": "Point", "coordinates": [11.5]})), "feature 1"),
    (json.dumps(features({})), "feature 1 is without a geometry")])
def test_documents_that_cannot_be_read(bring_in, content, message):
    with pytest.raises(BadInput, match=message):
        bring_in(content, "log.json", columns=AT_POINTS)


def test_a_line_of_many_receptions_is_refused_before_it_fills_the_memory(bring_in, monkeypatch):
    """A node's message is repeated for each gateway that heard it."""
    fields = ",".join(f'"key{number}":1' for number in range(1000))
    monkeypatch.setenv("RADIOTWIN_MAX_CELLS", "100_000")
    tracemalloc.start()
    with pytest.raises(BadInput, match="at most 100,000"):
        bring_in('{"rxpk":[' + ",".join(["{}"] * 2000) + "]," + fields + "}", "log.jsonl")
    assert tracemalloc.get_traced_memory()[1] < 40e6
    tracemalloc.stop()


def test_lines_of_an_mqtt_client(bring_in):
    content = "".join(f"2024-05-01T10:00:0{i}Z gateway/{i} {json.dumps(each)}\n" for i, each in enumerate(RECORDS))
    for name in ("log.txt", "log.jsonl", "log.log"):
        result = bring_in(content, name, columns=COLUMNS | {"receiver": "before"})
        assert list(result.table["rssi_dbm"]) == [-80, -81, -82, -83] and result.table["receiver"][1] == "2024-05-01T10:00:01Z gateway/1"


@pytest.mark.parametrize(("payload", "name", "device"), [
    ({"latitude": 48.1, "longitude": 11.5}, "mapper", "g"), ({"temperature": 3}, "", "n")])
def test_networks(bring_in, payload, name, device):
    place = {"latitude": 48.2, "longitude": 11.5, "altitude": 500}
    events = {
        "chirpstack-3": {"devEUI": "n", "publishedAt": "2024-05-01T10:00:00Z", "object": payload,
                         "rxInfo": [{"gatewayID": "g", "rssi": -80, "loRaSNR": -9, "location": place}]},
        "helium": {"dev_eui": "n", "reported_at": 1714557600000, "decoded": {"payload": payload}, "metadata": {"labels": [{"id": "x"}]},
                   "hotspots": [{"name": "g", "lat": 48.2, "long": 11.5, "rssi": -80, "snr": -9}]}}
    for network, event in events.items():
        result = bring_in(json.dumps(event), "log.json")
        assert result.report["files"][0]["format"] == network + f"-{name}" * bool(name)
        assert list(result.table["rssi_dbm"]) == [-89] and list(result.devices["device"]) == [device]
        assert list(result.table["time_s"]) == [1714557600]


def test_numbers_that_are_none(bring_in):
    """Python writes NaN, which is no JSON; of a level its meaning is asked for."""
    content = lines(RECORDS).replace("-81", "NaN")
    for text in (content, "[" + content.strip().replace("\n", ",") + "]", content.replace("}\n", "},\n")):
        with pytest.raises(BadInput, match="'nan' is not a number.*not_detected"):
            bring_in(text, "log.json", columns=COLUMNS)
        assert bring_in(text, "log.json", columns=COLUMNS, not_measured=["nan"]).report["kept"] == 3


def test_arrays_of_arrays_have_a_header(bring_in):
    content = json.dumps([list(RECORDS[0]), *(list(each.values()) for each in RECORDS)])
    assert list(bring_in(content, "log.json", columns=COLUMNS).table["rssi_dbm"]) == [-80, -81, -82, -83]
