"""From rows to links: mapping, positions, filters, and counts of what was left out."""

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.importing import import_measurements, parse_columns, read_settings
from radiotwin.links.declared import radios_of

HEAD = "device,x,y,level\n"


@pytest.mark.parametrize(("cells", "value"), [(("1234567", "7654321"), 1234567), (("868100000", "868300000"), 868_100_000),
                                              (("868.10", "868.30"), 868.1), (("868.10", "868.30"), "868.10")])
def test_rows_are_chosen_by_numbers_of_any_length(bring_in, cells, value):
    columns = {"x": "x", "y": "y", "device": "d", "level": "l"}
    text = f"x,y,d,l,c\n0,0,a,-80,{cells[0]}\n1,0,b,-81,{cells[1]}\n2,0,c,-82,\n"
    result = bring_in(text, length_unit="m", columns=columns, only={"c": [value]})
    assert list(result.table["device"]) == ["a"]
    with pytest.raises(BadInput, match="column c never is 1234568 or 1234568.5 or none of them .only.; it is"):
        bring_in(text, length_unit="m", columns=columns, only={"c": [1234568, 1234568.5, "none of them"]})


@pytest.mark.parametrize("setting", [{"thin_m": 2.0}, {"average_m": 4.0}])
def test_a_climb_is_a_way(bring_in, local, setting):
    log = "time,x,y,h,device,level\n0,0,0,5,a,-80\n1,0,0,6,a,-81\n2,0,0,9.5,a,-82\n"
    result = bring_in(log, columns=local | {"above_ground": "h", "time": "time"}, length_unit="m", time_format="epoch s", **setting)
    assert len(result.table) == 2


def test_implausible_heights_and_headings(bring_in):
    rows = "".join(f"a,48.1,11.5,{z},{0.2 * i},-{80 + i}\n" for i, z in enumerate([1400] * 25))
    columns = {"device": "d", "latitude": "la", "longitude": "lo", "altitude": "z", "heading": "h", "level": "l"}
    result = bring_in("d,la,lo,z,h,l\n" + rows, columns=columns, length_unit="m")
    notes = "\n".join(result.report["warnings"])
    assert "lowest receiver is at 1400 m" in notes and "radians" in notes
    zero = bring_in("d,la,lo,z,h,l\n" + rows.replace("1400", "0"), columns=columns, length_unit="m")
    assert any("height of every receiver is 0" in note for note in zero.report["warnings"])


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


@pytest.mark.parametrize(("latitude", "longitude", "left_out"), [
    (-48.1, 11.5, 1), (4.81, 11.5, 1), (48.1, -150, 1), (49.3, 11.5, 1), (48.2, 11.5, 1), (48.104, 11.5, 0), (-677.7, 11.5, 1)])
def test_one_fix_that_is_none(bring_in, latitude, longitude, left_out):
    """The others go north by 11 m in a second; one lies 11 km off, or farther."""
    places = [(48.1 + i * 1e-4, 11.5) for i in range(40)]
    places[20] = (latitude, longitude)
    text = "t,lat,lon,l,d\n" + "".join(f"2024-05-01T10:00:{i:02}Z,{lat},{lon},{-80 - i % 9},a\n" for i, (lat, lon) in enumerate(places))
    columns = {"time": "t", "latitude": "lat", "longitude": "lon", "level": "l", "device": "d"}
    report = bring_in(text, columns=columns, time_format="ISO 8601").report
    assert report["kept"] == 40 - left_out and [each["first"] for each in report["left_out"]] == ["row 22"] * left_out
