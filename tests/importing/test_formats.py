"""Known formats, on files made up after their descriptions: which column is which, units and cautions."""

import json

import numpy as np
import pandas as pd
import pytest

from docs.made_tables import with_tables
from radiotwin.errors import BadInput
from radiotwin.importing.formats import FORMATS, find_format

WIGLE = ("WigleWifi-1.6,appRelease=2.78,model=X,release=11,device=d,display=1,board=b,brand=B,star=Sol,body=4,subBody=0\n"
         "MAC,SSID,AuthMode,FirstSeen,Channel,Frequency,RSSI,CurrentLatitude,CurrentLongitude,AltitudeMeters,"
         "AccuracyMeters,RCOIs,MfgrId,Type\n"
         "aa:bb,\"cafe, west\",[ESS],2024-03-01 10:00:00,6,2437,-61,48.1,11.5,520,4,,,WIFI\n"
         "310260_1_2,tower,LTE;us,2024-03-01 10:00:01,0,,-101,48.1001,11.5,520,4,,,LTE\n")
TOWER = ("mcc,mnc,lac,cell_id,psc,asu,dbm,ta,lat,lon,accuracy,speed,bearing,altitude,measured_at,net_type,neighboring,device\r\n"
         "262,1,100,777,12,40,-95,,48.1,11.5,5,0,0,520.5,\"2024-03-01T10:00:00.250Z\",LTE,false,\"Phone 1\"\r\n"
         "262,1,100,778,13,,,,48.1,11.5,5,0,0,520.5,\"2024-03-01T10:00:00.250Z\",UMTS,true,\"Phone 1\"\r\n")
CELLMAPPER = "48.100000,11.500000,520,262,1,100,777,-95,LTE,LTE-A,1300,12\n48.100100,11.500000,520,262,1,100,9,-70,GSM,EDGE,50,-1\n"
GNETTRACK = ("Timestamp\tLongitude\tLatitude\tSpeed\tOperator\tCGI\tNode\tCellID\tLAC\tNetworkTech\tNetworkMode\tLevel\tQual\tSNR\t"
             "Altitude\t\n"
             "2024.03.01_10.00.00\t11.5\t48.1\t0\t26201\t262011007\t7\t1\t100\t4G\tLTE\t-95\t-10\t5\t520\t\n"
             "2024.03.01_10.00.01.500\t11.5\t48.1001\t0\t26201\t262011007\t7\t1\t100\t4G\tLTE\t-96\t-10\t5\t520\t\n")
NETMONITOR = ("report;sys_time;sim_state;net_type;tech;mcc;mnc;lac_tac;node_id;cid;psc_pci;rssi;rsrq;rssnr;gps;accuracy;lat;long;band;arfcn;\n"
              "0;20240301100000;READY;LTE;LTE;262;1;100;7;1;12;-95;-9;100;1;3;48.1;11.5;1800;1300;\n"
              "1;20240301100001;READY;LTE;LTE;262;1;100;7;1;12;0;0;2147483647;1;3;48.1001;11.5;1800;1300;\n")
GMON = ("BSSID;LAT;LON;SSID;Crypt;Beacon Interval;Connection Mode;Channel;RXL;Date;Time\n"
        "00:01:E3:A8:1B:A8;48.10000;11.50000;cafe;?;-88;Infra;6;-86;2014/01/12;16:39:58\n"
        "00:02:6F:5F:EA:76;NaN;NaN;bnet;WpaPsk;-5089;Infra;4;-90;2012/09/23;20:15:00\n"
        "00:14:A9:74:FA:40;48.10010;11.50000;((o)) city;Open;-70;Infra;6;-68;2014/01/04;15:12:53\n")
TEMS = ("Time\tMS\tAll-Latitude Decimal Degree (Text)\tAll-Longitude Decimal Degree (Text)\tServing Cell RSRP (dBm)[1]\t"
        "Serving Cell DL EARFCN[1]\tServing Physical Cell ID[1]\n"
        "10:00:00\tMS1\t48.1\t11.5\t-95\t1300\t12\n10:00:01\tMS1\t48.1001\t11.5\t\t1300\t12\n")
QUALIPOC = ("Time,Data technology,DL EARFCN,RSSI,PCI,RSRP\u200b,----------,RSRP,PCI,----------,Latitude,Longitude,Altitude\n"
            "2024-03-01 10:00:00.5,LTE,1300,-65,12,-95,,-95.2,12,,48.1,11.5,520\n")
TTN_MAPPER = ("id,time,nodeaddr,appeui,gwaddr,modulation,datarate,snr,rssi,freq,lat,lon,alt,accuracy,hdop,sats,provider,user_id\n"
              "1,2024-03-01 10:00:00,node1,app,GW1,LORA,SF7BW125,9.00,-84.00,868.1,48.1,11.5,0.0,null,null,null,gps,u\n"
              "2,2024-03-01 10:01:00,node1,app,GW2,LORA,SF12BW125,-7.50,-119.00,868.1,48.11,11.5,0.0,null,null,null,gps,u\n")
STACK = {"end_device_ids": {"device_id": "node1"}, "received_at": "2024-03-01T10:00:00.5Z", "uplink_message": {
    "received_at": "2024-03-01T10:00:00.25Z", "rx_metadata": [
        {"gateway_ids": {"gateway_id": "gw1"}, "rssi": -84, "snr": 9,
         "location": {"latitude": 48.2, "longitude": 11.6, "altitude": 560}},
        {"gateway_ids": {"gateway_id": "gw2"}, "rssi": -119, "snr": -7.5,
         "location": {"latitude": 48.3, "longitude": 11.6, "altitude": 570}},
        {"gateway_ids": {"gateway_id": "gw3"}, "rssi": -110, "location": {"latitude": 48.3, "longitude": 11.7}}]}}
CHIRPSTACK = {"time": "2024-03-01T10:00:00.25+00:00", "deviceInfo": {"devEui": "node1", "tags": {}}, "rxInfo": [
    {"gatewayId": "gw1", "rssi": -84, "snr": 9.0, "location": {"latitude": 48.2, "longitude": 11.6, "altitude": 560.0}},
    {"gatewayId": "gw2", "rssi": -119, "snr": -7.5, "location": {"latitude": 48.3, "longitude": 11.6, "altitude": 570.0}},
    {"gatewayId": "gw3", "rssi": -110, "snr": 0.0, "location": {"latitude": 48.3, "longitude": 11.7}}]}
RXPK = {"rxpk": [{"tmst": 1, "time": "2024-03-01T10:00:00.25Z", "freq": 868.1, "datr": "SF7BW125", "rssi": -84, "lsnr": 9.0},
                 {"tmst": 2, "time": "2024-03-01T10:00:01.25Z", "freq": 868.1, "datr": "SF12BW125", "rssi": -119, "lsnr": -7.5}]}
UTC, BERLIN = {"time_zone": "UTC"}, {"time_zone": "Europe/Berlin"}
HERE = {"latitude": 48.1, "longitude": 11.5, "altitude": 520}


def with_position(message, *path):
    """Return a copy of a message whose payload says where the node is."""
    copy = json.loads(json.dumps(message))
    at = copy
    for key in path:
        at = at.setdefault(key, {})
    at.update(HERE)
    return copy


def imported(bring_in, text, name="data.csv", **given):
    result = bring_in(text, name, **({"level_unit": None} | given))
    return result, result.table, [each["format"] for each in result.report["files"]]


TABLES = {  # text, settings, devices, levels, first time, words in the warnings, readings left out
    "wigle": (WIGLE, {}, ["aa:bb", "310260_1_2"], [-61, -101], "2024-03-01 10:00:00Z", "--only Type=WIFI", 0),
    "tower-collector": (TOWER, {}, ["LTE 262-1-100-777"], [-95], "2024-03-01 10:00:00.25Z", "--only net_type=LTE", 1),
    "cellmapper": (CELLMAPPER, {}, ["LTE 262-1-100-777", "GSM 262-1-100-9"], [-95, -70], None, "no header", 0),
    "g-nettrack": (GNETTRACK, BERLIN, ["4G 262011007"] * 2, [-95, -96], "2024-03-01 09:00:00Z", "--only NetworkTech=4G", 0),
    "netmonitor": (NETMONITOR, UTC, ["LTE 262-1-100-7-1"], [-95], "2024-03-01 10:00:00Z", "--only gps=1", 1),
    "g-mon": (GMON, BERLIN, ["00:01:E3:A8:1B:A8", "00:14:A9:74:FA:40"], [-86, -68], "2014-01-12 15:39:58Z", "few rows", 1),
    "tems": (TEMS.replace("10:00:0", "2024-03-01 10:00:0"), UTC | {"time_format": "ISO 8601"}, ["1300 12"], [-95],
             "2024-03-01 10:00:00Z", "--time-format", 1),
    "qualipoc": (QUALIPOC, UTC, ["1300 12"], [-95], "2024-03-01 10:00:00.5Z", "occurs more than once", 0),
    "ttn-mapper": (TTN_MAPPER, {}, ["GW1", "GW2"], [-84, -119 - 7.5], "2024-03-01 10:00:00Z", "5.5.5", 0)}


@pytest.mark.parametrize("name", TABLES)
def test_tables_of_programs(bring_in, name):
    text, given, devices, levels, start, said, left_out = TABLES[name]
    result, table, formats = imported(bring_in, text, **given)
    assert formats == [name] and list(table["device"]) == devices and list(table["rssi_dbm"]) == levels
    assert table["time_s"].iloc[0] == pd.Timestamp(start).timestamp() if start else "time_s" not in table
    assert said in "\n".join(result.report["warnings"])
    assert sum(each["readings"] for each in result.report["left_out"]) == left_out


def test_rows_are_chosen_by_a_column(bring_in):
    only, table, _ = imported(bring_in, WIGLE, only={"Type": ["WIFI"]})
    assert list(table["device"]) == ["aa:bb"] and list(table["receiver_z_m"]) == [520]
    assert only.report["left_out"] == [{"reason": "is not one of only", "column": "Type", "readings": 1, "first": "line 4"}]
    with pytest.raises(BadInput, match=r"column Type never is NR \(only\); it is LTE, WIFI"):
        imported(bring_in, WIGLE, only={"Type": ["NR"]})


@pytest.mark.parametrize(("text", "missing"), [(GNETTRACK, "time_zone"), (TEMS, "time_format")])
def test_a_format_may_leave_the_clock_open(bring_in, text, missing):
    with pytest.raises(BadInput, match=f"{missing} is not given"):
        imported(bring_in, text)


@pytest.mark.parametrize(("message", "name", "payload"), [
    (STACK, "things-stack", ["uplink_message", "decoded_payload"]),
    ({"result": STACK}, "things-stack-storage", ["result", "uplink_message", "decoded_payload"]), (CHIRPSTACK, "chirpstack", ["object"])])
def test_gateways_are_the_receivers_of_a_node_but_of_one_with_a_position_the_devices(bring_in, message, name, payload):
    result, table, formats = imported(bring_in, json.dumps(message) + "\n", "uplinks.jsonl")
    assert formats == [name] and list(table["receiver"]) == ["gw1", "gw2", "gw3"] and set(table["device"]) == {"node1"}
    assert list(table["rssi_dbm"]) == [-84, -126.5, -110] and list(result.devices["role"]) == ["unknown"]
    np.testing.assert_array_equal(table["receiver_z_m"], [560, 570, np.nan])
    assert table["time_s"].iloc[0] == pd.Timestamp("2024-03-01 10:00:00.25Z").timestamp()
    result, table, formats = imported(bring_in, json.dumps(with_position(message, *payload)) + "\n", "uplinks.json")
    assert formats == [f"{name}-mapper"] and list(table["device"]) == ["gw1", "gw2", "gw3"]
    assert set(table["receiver"]) == {"node1"} and set(table["receiver_z_m"]) == {520} and list(result.devices["reads_levels"]) == [1] * 3
    assert list(table["rssi_dbm"]) == [-84, -126.5, -110] and list(result.devices["z_m"][:2]) == [560, 570]


def test_packet_forwarder_needs_a_name_and_a_place(bring_in, tmp_path):
    text = json.dumps(RXPK) + "\n"
    with pytest.raises(BadInput, match="columns.device is missing"):
        imported(bring_in, text, "rx.log")
    (tmp_path / "gateways.csv").write_text("receiver,latitude,longitude\nreceiver,48.1,11.5\n")
    _, table, formats = imported(bring_in, text, "rx.log", format="semtech-udp", columns={"device": "always node"},
                                 receivers=str(tmp_path / "gateways.csv"))
    assert formats == ["semtech-udp"] and list(table["rssi_dbm"]) == [-84, -126.5]


SWEPT = UTC | {"columns": {"x": "always 1", "y": "always 2"}, "length_unit": "m"}


def test_rtl_power_integrates_a_band(bring_in):
    """Two tunings a sweep; bins of 100 kHz at 1 to 2 MHz; the last bin of each line is written twice."""
    lines = []
    for second, db in ((0, -30.0), (10, -40.0)):
        for low in (1_000_000, 1_500_000):
            values = [db + 10 * np.log10(i + 1) for i in range(5)]
            lines.append(f"2024-03-01, 10:00:{second:02d}, {low}, {low + 500_000}, 100000.00, 7, "
                         + ", ".join(f"{value:.4f}" for value in [*values, values[-1]]))
    text = "\n".join(lines) + "\n"
    _, table, formats = imported(bring_in, text, **SWEPT)
    assert formats == ["rtl-power"] and list(table["device"]) == ["1-2 MHz"] * 2
    np.testing.assert_allclose(table["rssi_dbm"], np.array([-30, -40]) + 10 * np.log10(30), atol=2e-4)
    assert np.diff(table["time_s"]) == 10
    _, table, _ = imported(bring_in, text, band_hz=[1.3e6, 1.7e6], level_offset_db=-5.0, **SWEPT)
    np.testing.assert_allclose(table["rssi_dbm"], np.array([-35, -45]) + 10 * np.log10(4 + 5 + 1 + 2), atol=2e-4)
    with pytest.raises(BadInput, match="no bin lies in the band 5-6 MHz .band_hz.; the file has 1 to 2 MHz"):
        imported(bring_in, text, band_hz=[5e6, 6e6], **SWEPT)
    with pytest.raises(BadInput, match="line 2 is none of rtl_power"):
        imported(bring_in, lines[0] + "\n1,2,3\n", **SWEPT)


def test_a_sweep_that_does_not_cover_the_band_is_not_measured(bring_in):
    text = ("2024-03-01, 10:00:00, 1000000, 1200000, 100000.00, 7, -30, -30\n"
            "2024-03-01, 10:00:10, 1000000, 1100000, 100000.00, 7, -30\n")
    result, table, _ = imported(bring_in, text, band_hz=[1.0e6, 1.2e6], **SWEPT)
    np.testing.assert_allclose(table["rssi_dbm"], [-30 + 10 * np.log10(2)], atol=1e-4)
    assert result.report["left_out"][0]["reason"] == "not measured"


def test_what_is_declared_overrules_the_format(bring_in):
    result, table, formats = imported(bring_in, TTN_MAPPER, format="ttn-mapper",
                                      columns={"device": "nodeaddr", "snr": "always 0"})
    assert "reads_levels" not in result.devices  # the ends are exchanged
    assert formats == ["ttn-mapper"] and set(table["device"]) == {"node1"} and list(table["rssi_dbm"]) == [-84, -119]
    with pytest.raises(BadInput, match=r"is not of format ttn-mapper, which has the columns .*; it has MAC"):
        imported(bring_in, WIGLE, format="ttn-mapper")
    with pytest.raises(BadInput, match="format 'nemo' is unknown; allowed are wigle, "):
        imported(bring_in, WIGLE, format="nemo")


@pytest.mark.parametrize("each", FORMATS, ids=lambda each: each.name)
def test_no_format_takes_the_files_of_another(each):
    """Those of a node with a position extend those without one."""
    needed = [each.columns[name] for name in each.needs]
    found = find_format([*each.signature, *(name if isinstance(name, str) else name[0] for name in needed)])
    assert found is each or found.name.endswith("-mapper")


def test_the_documented_table_is_that_of_the_code():
    made = with_tables("::: made formats")
    assert all(f"| `{each.name}` | {each.title} | " in made and each.source in made for each in FORMATS)


@pytest.mark.parametrize("head", [
    "2024-03-01, 10:00:{}.123456, 868000000, 868300000, 100000.00, 8192", "2024-03-01, 10:00:{}, 868000000.0, 868300000.0, 100000.0, 20"])
def test_sweeps_of_other_programs(bring_in, head):
    """A bin of Windows without power spoils a sweep where it is in the band."""
    text = "".join(head.format(f"1{i}") + f", -30, {'-1.#J' if i == 2 else -40}, -1.#IND\n" for i in range(4))
    assert len(imported(bring_in, text, band_hz=[868.1e6, 868.2e6], format="rtl-power", **SWEPT)[1]) == 3
    assert list(imported(bring_in, text, band_hz=[868.0e6, 868.1e6], **SWEPT)[1]["rssi_dbm"]) == [-30] * 4


def test_a_band_within_a_bin_has_its_power_and_its_name(bring_in):
    text = "".join(f"2024-03-01, 10:00:1{i}, 860000000, 870000000, 5000000.00, 8192, -50, -30\n" for i in range(2))
    _, table, _ = imported(bring_in, text, band_hz=[868.0e6, 868.2e6], **SWEPT)
    assert list(table["rssi_dbm"]) == [-30, -30] and set(table["device"]) == {"865-870 MHz"}
