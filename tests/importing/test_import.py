"""From rows to links: mapping, positions, filters, and counts of what was left out."""

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.importing import import_measurements, parse_columns, read_settings
from radiotwin.links.declared import radios_of

HEAD = "device,x,y,level\n"


def reasons(result):
    return {item["reason"]: item["readings"] for item in result.report["left_out"]}


def test_repeated_rows_count_once(bring_in, local):
    result = bring_in(HEAD + "a,0,0,-80\na,0,0,-81\na,0,0,-80\na,0,0,-80\n", columns=local, length_unit="m")
    assert list(result.table["rssi_dbm"]) == [-80, -81]
    assert reasons(result) == {"repeats an earlier row exactly": 2}


def test_feet_become_metres(bring_in, local):
    result = bring_in("device,x,y,z,level\na,1000,2000,10,-80\n", columns=local | {"z": "z"}, length_unit="ft")
    assert result.table[["receiver_x_m", "receiver_y_m", "receiver_z_m"]].values.tolist() == [[304.8, 609.6, 3.048]]


def test_constants_and_all_other_columns(bring_in, local):
    text = "device,x,y,level,h,p,r,q,t\na,1,2,-80,370,3,-4,9,100.5\n"
    result = bring_in(text, length_unit="m", time_format="epoch s", columns=local | {
        "z": "always 1.5", "receiver": "always phone", "flight": "by day", "time": "t", "heading": "h", "pitch": "p",
        "roll": "r", "quality": "q"})
    assert result.table.iloc[0].to_dict() == {
        "time_s": 100.5, "flight": "1970-01-01", "receiver": "phone", "receiver_x_m": 1, "receiver_y_m": 2,
        "receiver_z_m": 1.5, "device": "a", "rssi_dbm": -80, "heading_deg": 370, "pitch_deg": 3, "roll_deg": -4,
        "quality": 9}
    assert any("since 1970" in text for text in result.report["warnings"])


def test_positions_of_devices_from_columns(bring_in, local):
    text = "device,x,y,level,dx,dy,dz\na,1,2,-80,30,40,5\nb,1,2,-80,,,\na,9,9,-80,30,40,5\n"
    result = bring_in(text, length_unit="m", columns=local | {"device_x": "dx", "device_y": "dy", "device_z": "dz"})
    assert result.devices.set_index("device").loc["a"].tolist() == [30, 40, 5, "anchor"]
    assert result.devices["role"].tolist() == ["anchor", "unknown"] and result.devices["x_m"].isna().tolist() == [0, 1]


def test_positions_of_devices_from_a_table(bring_in, local, tmp_path):
    (tmp_path / "sites.csv").write_text("device,x_ft,y_ft,z_m,frequency_hz,azimuth_deg\n"
                                        "b,100,0,24,9e8,120\nc,1,1,1,9e8,0\n")
    result = bring_in(HEAD + "a,0,0,-80\nb,0,0,-81\n", columns=local, length_unit="m",
                      devices=str(tmp_path / "sites.csv"))
    devices = result.devices.set_index("device")
    assert devices.index.tolist() == ["a", "b"] and devices["role"].tolist() == ["unknown", "anchor"]
    assert devices.loc["b"].tolist() == [30.48, 0, 24, "anchor", 9e8, 120]


def test_carriers_of_several_bands_are_told_apart_and_channels_are_not(bring_in, local, tmp_path):
    """Cell 12 is read on 800 and 1800 MHz, node n hops between channels; both stay where the table has them."""
    (tmp_path / "sites.csv").write_text("device,x,y,above_ground_m,azimuth_deg\n12,10,20,30,120\nn,5,5,2,\n")
    text = ("device,x,y,level,f\n12,0,0,-80,8e8\n12,1,0,-70,1.8e9\n12,2,0,-81,8.02e8\nn,0,0,-90,868.1e6\n"
            "n,1,1,-91,869.5e6\n")
    result = bring_in(text, columns=local | {"frequency_hz": "f"}, length_unit="m", devices=str(tmp_path / "sites.csv"))
    assert list(result.table["device"]) == ["12 801 MHz", "12 1800 MHz", "12 801 MHz", "n", "n"]
    devices = result.devices.set_index("device")
    assert devices.loc["12 1800 MHz", ["x_m", "above_ground_m", "azimuth_deg", "frequency_hz"]].tolist() == [10, 30, 120, 1.8e9]
    assert any("1 device read on carriers of several bands (12)" in text for text in result.report["warnings"])


def test_a_moving_device_is_named_by_its_position(bring_in, local):
    """Hand-held transmitters heard by a fixed receiver."""
    text = "device,x,y,level,tx,ty\n_,1,2,-80,30,40\n_,1,2,-81,50,60\n_,1,2,-82,30,40\n_,1,2,-83,,60\n"
    by_position = local | {"device_x": "tx", "device_y": "ty", "device": "by position"}
    result = bring_in(text, columns=by_position, length_unit="m")
    assert list(result.table["device"]) == ["p1", "p2", "p1"] and reasons(result) == {"no device": 1}
    assert result.measurements.device_m[:, :2].tolist() == [[30, 40], [50, 60]] and result.measurements.is_anchor.all()
    with pytest.raises(BadInput, match=r"device '_' has positions 20 m apart.*by position"):
        bring_in(text, columns=by_position | {"device": "device"}, length_unit="m")


def test_a_column_for_each_device(bring_in, tmp_path):
    (tmp_path / "sites.csv").write_text("device,x,y,z\nA,5,6,7\n")
    result = bring_in("x,y,rssi A,rssi B\n1,2,-80,-81\n3,4,-101,-83\n", length_unit="m", columns={"x": "x", "y": "y"},
                      wide=[{"level": "rssi *", "device": "*"}], not_measured=[-101.0],
                      devices=str(tmp_path / "sites.csv"))
    assert result.table[["device", "receiver_x_m", "rssi_dbm"]].values.tolist() == [
        ["A", 1, -80], ["B", 1, -81], ["B", 3, -83]]
    assert result.devices["role"].tolist() == ["anchor", "unknown"]
    assert result.report["readings"] == 4 and result.report["rows"] == 2


def test_a_column_for_each_receiver(bring_in, tmp_path):
    """Two fixed ones with positions in a table, listed by name; one that moves and has columns of its own."""
    (tmp_path / "fixed.csv").write_text("receiver,x,y\nroof,100,0\n")
    result = bring_in("roof,yard,bus_l,bus_x,bus_y,id\n-70,-75,-80,7,8,d\n", length_unit="m", columns={"device": "id"},
                      receivers=str(tmp_path / "fixed.csv"), wide=[
                          {"level": ["roof", "yard"], "receiver": "*"},
                          {"level": "*_l", "receiver": "*", "x": "*_x", "y": "*_y"}])
    assert result.table[["receiver", "receiver_x_m", "receiver_y_m", "rssi_dbm"]].values.tolist() == [
        ["roof", 100, 0, -70], ["bus", 7, 8, -80]]
    assert reasons(result) == {"no position of receiver 'yard'": 1}


def test_a_height_in_the_file_holds_for_positions_of_a_table(bring_in, tmp_path):
    (tmp_path / "fixed.csv").write_text("receiver,latitude,longitude\nroof,48,11\n")
    result = bring_in("who,l,id\nroof,-70,d\n", length_unit="m", receivers=str(tmp_path / "fixed.csv"), columns={
        "receiver": "who", "level": "l", "device": "id", "height": "always 12"})
    assert result.table["receiver_z_m"].tolist() == [12]


def test_altitudes_of_projected_positions(bring_in, local):
    result = bring_in("device,x,y,a,level\na,500000,5300000,530,-80\n", columns=local | {"altitude": "a"},
                      length_unit="m", crs="EPSG:32632", origin={"latitude_deg": 47.8, "longitude_deg": 9,
                                                                 "altitude_m": 500})
    assert result.table["receiver_z_m"].tolist() == [30] and abs(result.table["receiver_x_m"][0]) < 1e-3


def test_filters(bring_in, local, tmp_path):
    (tmp_path / "sites.csv").write_text("device,x,y,z\na,0,0,40\n")
    text = ("device,x,y,z,level\na,30,0,0,-60\na,300,0,0,-70\na,3000,0,0,-80\nb,1,0,0,-70\na,300,0,0,-99\n"
            "a,301,0,0,-41\na,302,0,0,none\n")
    result = bring_in(text, columns=local | {"z": "z"}, length_unit="m", min_distance_m=51.0, max_distance_m=1000.0,
                      min_level=-90.0, max_level=-50.0, not_detected=["empty"], devices=str(tmp_path / "sites.csv"))
    assert list(result.table["receiver_x_m"]) == [300, 1, 302]  # a device without a position and a blank level pass
    assert reasons(result) == {"nearer than 51.0 m": 1, "further than 1000.0 m": 1, "level below -90.0": 1,
                               "level above -50.0": 1}
    near = bring_in(text, columns=local | {"z": "z"}, length_unit="m", min_distance_m=49.0, not_detected=["empty"],
                    devices=str(tmp_path / "sites.csv"))
    assert list(near.table["receiver_x_m"])[0] == 30  # 50 m away: in three dimensions


def test_read_is_kept_and_left_out(bring_in):
    text = "cell,lat,lon,level\na,48,11,-80\na,0,0,-80\na,,,-80\n,48,11,-80\na,48,11,0\na,48,11,-80\n"
    result = bring_in(text, columns={"device": "cell", "latitude": "lat", "longitude": "lon", "level": "level"})
    assert reasons(result) == {"impossible level": 1, "no device": 1, "latitude, longitude 0, 0 (no fix)": 1,
                               "no position of receiver 'receiver'": 1, "repeats an earlier row exactly": 1}
    assert result.report["readings"] == result.report["kept"] + sum(reasons(result).values())


def test_local_means_say_how_many_readings(bring_in, local):
    result = bring_in(HEAD + "a,0,0,-80\na,1,0,-80\na,10,0,-90\n", columns=local | {"frequency_hz": "always 1e9"},
                      length_unit="m", average_m=5.0)
    assert list(result.table["quality"]) == [2, 1] and list(result.table["receiver_x_m"]) == [0.5, 10]
    assert result.report["kept"] == 3 and result.report["written"] == 2
    assert any("17 wavelengths; 20 to 40 (Lee 1985) are 6.0 to 12.0 m" in text for text in result.report["warnings"])


@pytest.mark.parametrize(("text", "given", "message"), [
    ("a,0,0,-80\nb,300000,0,-80\n", {}, "300 km apart"),
    ("a,0,0,none\na,0,1,none\na,0,2,-80\n", {"not_detected": ["empty"]}, "67% of the levels are not detected"),
    ("".join(f"a,{i},0,{-90 - i % 5}\n" for i in range(30)), {}, "20% of the levels are -94, the smallest"),
    ("a,0,0,-80\n", {}, "1 of 1 devices have no position"),
])
def test_implausible_data_give_a_warning(bring_in, local, text, given, message):
    result = bring_in(HEAD + text, columns=local, length_unit="m", **given)
    assert any(message in note for note in result.report["warnings"])


def test_implausible_heights_and_headings(bring_in):
    rows = "".join(f"a,48.1,11.5,{z},{0.2 * i},-{80 + i}\n" for i, z in enumerate([1400] * 25))
    columns = {"device": "d", "latitude": "la", "longitude": "lo", "altitude": "z", "heading": "h", "level": "l"}
    result = bring_in("d,la,lo,z,h,l\n" + rows, columns=columns, length_unit="m")
    notes = "\n".join(result.report["warnings"])
    assert "lowest receiver is at 1400 m" in notes and "radians" in notes
    zero = bring_in("d,la,lo,z,h,l\n" + rows.replace("1400", "0"), columns=columns, length_unit="m")
    assert any("height of every receiver is 0" in note for note in zero.report["warnings"])


@pytest.mark.parametrize(("columns", "text", "given", "message"), [
    ({"level": "rsrp"}, "a,0,0,-80\n", {}, r"column 'rsrp' \(level\) is missing; the file has device, x, y, level"),
    ({"x": "device"}, "a,0,0,-80\n", {}, "row 2, column device: 'a' is not a number"),
    ({}, "a,0,0,-80\na,east,0,-80\nb,west,0,-80\n", {}, r"row 3, column x: 'east' is not a number \(2 such rows\)"),
    ({}, "a,5,7,-80\n", {"length_unit": None}, "column x: length_unit is not given; allowed are m and ft.*5 to 5"),
    ({"height": "x", "z": "y"}, "a,0,0,-80\n", {}, "with one of altitude, height, z, above_ground; given are height, x, y, z"),
    ({"z": 1.5}, "a,0,0,-80\n", {}, 'columns.z: 1.5: give the name of a column, or "always 1.5"'),
    ({}, "a,0,0,-80\na,1e9,0,-80\n", {}, "row 3: the receiver lies 1000000 km from the origin .1 such rows"),
    ({}, "a,0,0,-80\n", {"average_m": True}, "average_m: True: Input should be a valid number"),
    ({"y": None}, "a,0,0,-80\n", {}, "x and y are given together"),
    ({"latitude": "x", "longitude": "y"}, "a,0,0,-80\n", {}, "a position is either"),
    ({"device": None}, "a,0,0,-80\n", {}, "columns.device is missing"),
    ({"level": None}, "a,0,0,-80\n", {}, "columns.level is missing"),
    ({"colour": "x"}, "a,0,0,-80\n", {}, "columns.colour: unknown; allowed are .*level, device"),
    ({"device": "by position"}, "a,0,0,-80\n", {}, "by position.*needs"),
    ({"flight": "by day"}, "a,0,0,-80\n", {}, "by day.*needs"),
    ({"frequency_hz": "always 3"}, "a,0,0,-80\n", {}, "'3' is no frequency"),
    ({}, "a,0,0,-80\n", {"min_level": -50.0, "max_level": -90.0}, "min_level = -50 must be less than max_level"),
    ({}, "a,0,0,-80\n", {"average_m": -1.0}, "average_m"),
    ({}, "a,0,0,-80\n", {"min_level": -70.0}, "nothing is left of 1 readings: 1 level below -70"),
    ({"x": None, "y": None}, "a,0,0,-80\n", {}, "nothing is left.*no position of receiver"),
    ({}, "a,0,0,-80\n", {"devices": "nowhere.csv"}, "nowhere.csv does not exist"),
    ({}, "a,0,0,-80\n", {"wide": [{"level": "x", "receiver": "*"}]}, "cannot both be given"),
    ({"level": None}, "a,0,0,-80\n", {"wide": [{"level": "no*", "receiver": "*"}]}, "no column fits 'no\\*'"),
    ({"level": None}, "a,0,0,-80\n", {"wide": [{"level": ["x", "*"], "receiver": "*"}]}, "'x' fits two"),
    ({"level": None}, "a,0,0,-80\n", {"wide": [{"level": "x"}]}, "needs either receiver or device"),
])
def test_what_cannot_be_imported(bring_in, local, tmp_path, columns, text, given, message):
    mapping = {name: spec for name, spec in (local | columns).items() if spec}
    with pytest.raises(BadInput, match=message):
        bring_in(HEAD + text, **{"columns": mapping, "length_unit": "m"} | given)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("text", "message"), [
    ("48,11\n1000,11\n", r"row 3, column lat: '1000' is no latitude; allowed are -90 to 90"),
    ("48,11\n48,400\n", r"row 3, column lon: '400' is no longitude"),
    ("-111.8,40.7\n-111.9,40.8\n", r"row 2, column lat.*swapped"),
])
def test_degrees_that_are_none(bring_in, text, message):
    rows = "".join(f"a,-80,{line}\n" for line in text.split())
    with pytest.raises(BadInput, match=message):
        bring_in("cell,level,lat,lon\n" + rows,
                 columns={"device": "cell", "latitude": "lat", "longitude": "lon", "level": "level"})


def test_another_folder_is_not_replaced(bring_in, local, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("years")
    with pytest.raises(BadInput, match="holds thesis.tex, and no import.json of an earlier run"):
        bring_in(HEAD + "a,0,0,-80\n", columns=local, length_unit="m")
    (tmp_path / "out" / "thesis.tex").rename(tmp_path / "out" / "measurements.csv")
    with pytest.raises(BadInput, match="holds measurements.csv, and no import.json"):
        bring_in(HEAD + "a,0,0,-80\n", columns=local, length_unit="m")


def test_pairs_of_the_command_line():
    assert parse_columns("latitude=lat, level=RSRP (dBm)") == {"latitude": "lat", "level": "RSRP (dBm)"}
    for text in ("latitude", "latitude=", "x=a,x=b"):
        with pytest.raises(BadInput, match="NAME=COLUMN"):
            parse_columns(text)


def test_options_overrule_the_file_and_tables_lie_beside_it(tmp_path):
    (tmp_path / "m.toml").write_text('devices = "sites.csv"\naverage_m = 3\n[columns]\nlevel = "l"\ndevice = "d"\n')
    settings = read_settings(tmp_path / "m.toml", {"average_m": 5.0})
    assert settings.average_m == 5 and settings.devices == str(tmp_path / "sites.csv") and np.isscalar(settings.average)
    for text, message in (("devices = [", "is not readable TOML"), ("colour = 1", "m.toml: colour: unknown")):
        (tmp_path / "m.toml").write_text(text)
        with pytest.raises(BadInput, match=message):
            read_settings(tmp_path / "m.toml", {})
    with pytest.raises(BadInput, match="none.toml does not exist"):
        read_settings(tmp_path / "none.toml", {})


def test_a_site_table_declares_the_radios_and_brings_the_files_of_antennas(tmp_path):
    (tmp_path / "patterns").mkdir()
    (tmp_path / "patterns" / "flat.csv").write_text("azimuth_deg,elevation_deg,gain_dbi\n0,-90,7\n0,90,7\n")
    (tmp_path / "sites.csv").write_text("device,x,y,z,eirp_dbm,cable_loss_db,antenna,azimuth_deg,tilt_deg\n"
                                        "a,0,0,20,45,2,patterns/flat.csv,30,-4\nb,50,0,20,,,,,\n")
    (tmp_path / "log.csv").write_text("x,y,h,cell,rsrp\n" + "".join(f"{10 + i},5,1.5,{cell},-80\n" for i in range(3) for cell in "ab"))
    columns = {"receiver": "always r", "x": "x", "y": "y", "height": "h", "device": "cell", "level": "rsrp"}
    for _ in range(2):  # over an earlier import, too
        found = import_measurements(tmp_path / "log.csv", tmp_path / "out", columns, devices=tmp_path / "sites.csv",
                                    level_unit="dBm", length_unit="m")
    assert found.devices["antenna"].tolist() == ["antennas/flat.csv", ""]
    first, second = radios_of(found.devices, found.patterns, None)
    assert (first.tx_power_dbm, first.cable_loss_db) == (40.0, 2.0)  # 45 - 7 + 2
    assert (first.antenna.azimuth_deg, first.antenna.tilt_deg) == (30.0, -4.0) and second.antenna is None


def test_a_dummy_place_is_no_position(bring_in):
    mapping = {"device": "d", "latitude": "lat", "longitude": "lon", "level": "l", "receiver": "r"}
    moving = "".join(f"a,48.10{i},11.50{i},phone,-8{i}\n" for i in range(5))
    dummy, mast = "a,37.751,-97.822,phone,-70\n" * 20, "a,52.5,13.4,mast,-90\n" * 20
    rows = (moving + dummy + mast).splitlines()
    text = "d,lat,lon,r,l,n\n" + "".join(f"{row},{i}\n" for i, row in enumerate(rows))
    result = bring_in(text, columns=mapping)
    assert len(result.table) == 25 and set(result.table["receiver"]) == {"phone", "mast"}
    left_out = result.report["left_out"][0]
    assert left_out["readings"] == 20 and "37.751, -97.822" in left_out["reason"]


def test_devices_without_a_height_are_named(bring_in, local, tmp_path):
    (tmp_path / "sites.csv").write_text("device,x_m,y_m,agl_m\na,1,2,\nb,1,2,30\n")
    result = bring_in(HEAD + "a,0,0,-80\nb,0,0,-80\n", columns=local, length_unit="m", devices=str(tmp_path / "sites.csv"))
    assert any(note.startswith("1 of 2 devices have no height (a): give it in") and "sites.csv" in note
               for note in result.report["warnings"])


def test_tables_of_sites_in_words_of_their_own(bring_in, tmp_path):
    (tmp_path / "sites.csv").write_text("Cell ID;Lat;Long;Antenna Height (ft);Azimuth;Downtilt;EIRP (W);Freq (MHz);Owner\n"
                                        "262-1-9;48,105;11,5;100;120;6;1000;1800;me\n262-1-8;48,1;11,5;90;0;0;100;800;me\n")
    (tmp_path / "roofs.csv").write_text("Station,lat,lng,mast height ft,colour\nr1,48.1,11.5,10,red\n")
    result = bring_in("d,l,r\n262-01-9,-80,r1\n262-1-8,-81,r1\n", columns={"device": "d", "level": "l", "receiver": "r"},
                      devices=str(tmp_path / "sites.csv"), receivers=str(tmp_path / "roofs.csv"))
    devices = result.devices.set_index("device")
    assert devices.loc["262-1-8", ["above_ground_m", "azimuth_deg", "tilt_deg", "eirp_dbm", "frequency_hz"]].tolist() == [
        27.432, 0, 0, 50, 8e8]
    assert result.table["receiver_above_ground_m"].tolist() == [3.048, 3.048]
    notes = "\n".join(result.report["warnings"])
    for text in ("sites.csv: column not used: Owner", "roofs.csv: column not used: colour",
                 "1 of 2 names occur in no row of the log: 262-1-9 (262-01-9 there)"):
        assert text in notes


@pytest.mark.parametrize("place", ["-3.489,-56.16", "34.89,-56.16", "-56.16,-34.89"])
def test_sites_with_a_slip_are_refused(bring_in, tmp_path, place):
    (tmp_path / "sites.csv").write_text(f"device,lat,lon\na,{place}\n")
    with pytest.raises(BadInput, match=r"sites.csv: device 'a' at latitude .* km from the middle .*(slipped|sign|swapped)"):
        bring_in("d,l,la,lo\na,-80,-34.9,-56.2\n", columns={"device": "d", "level": "l", "latitude": "la", "longitude": "lo"},
                 devices=str(tmp_path / "sites.csv"))


def test_heights_frequencies_and_dates_of_a_file_name(bring_in, local):
    columns = local | {"above_ground": "by file", "frequency_hz": "by file", "time": "{file date} {t}"}
    text = "device,x,y,level,t\na,0,0,-80,10:00:00\n"
    for name, metres in (("log_2024-05-01_30m_868MHz.csv", 30.0), ("100ft 868.0mhz 20240501.csv", 30.48)):
        table = bring_in(text, name, columns=columns, time_format="ISO 8601", time_zone="UTC").table
        assert table["receiver_above_ground_m"].tolist() == [metres] and table["time_s"].tolist() == [1714557600]
    assert bring_in(text, "a_01.05.2024_3m_3.5GHz.csv", columns=columns, time_format="ISO 8601",
                    time_zone="UTC").devices["frequency_hz"].tolist() == [3.5e9]
    for name, message in (("30m_868MHz.csv", "{file date} needs one date"), ("20240501_868MHz.csv", "above_ground = 'by file' needs"),
                          ("20240501_30m_5m_868MHz.csv", "it has 2"), ("20240501_30min_868MHz.csv", "it has 0")):
        with pytest.raises(BadInput, match=message):
            bring_in(text, name, columns=columns, time_format="ISO 8601", time_zone="UTC")
