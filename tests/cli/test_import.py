"""`radiotwin import` as a user runs it: the worked examples, round trips, and input that cannot be used."""

import json
import shlex
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from radiotwin.cli.importing import _tables
from radiotwin.importing.settings import Settings
from radiotwin.links.measurements import read_measurements

EXAMPLES = Path(__file__).parents[2] / "examples" / "import"
SAMPLES = Path(__file__).parents[1] / "importing" / "samples"
FILES = ["devices.csv", "frame.toml", "import.json", "import.toml", "measurements.csv"]


@pytest.fixture
def example(run, tmp_path):
    """Import a sample with its worked mapping, twice: with the example, and with what the first import has saved."""
    def example(name: str, options: str = ""):
        file = shlex.quote(str(SAMPLES / f"{name}.csv"))
        first = run(f"import {file} --columns {shlex.quote(str(EXAMPLES / name))}.toml {options} -o out", tmp_path)
        assert first.returncode == 0, first.stderr
        again = run(f"import {file} --columns out/import.toml -o again", tmp_path)
        assert again.returncode == 0, again.stderr
        assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES
        for name in FILES:
            assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "again" / name).read_bytes(), name
        report = json.loads((tmp_path / "out" / "import.json").read_text())
        left_out = Counter()
        for item in report["left_out"]:
            left_out[item["reason"]] += item["readings"]
        assert report["readings"] == report["kept"] + sum(left_out.values())
        return read_measurements(tmp_path / "out" / "measurements.csv"), report, left_out, first.stdout
    return example


def test_duke_cbrs(example):
    measurements, report, left_out, printed = example(
        "duke_cbrs", f"--devices {shlex.quote(str(SAMPLES / 'duke_cbrs_sectors.csv'))}")
    table, devices = measurements.table, measurements.devices.set_index("device")
    assert list(table["rssi_dbm"]) == [-112, -98, -107, -121] and list(table["device"]) == ["C", "A", "C", "A"]
    assert list(table["receiver"]) == list(table["flight"]) == ["Samsung", "Samsung", "Pixel", "Pixel"]
    assert set(table["receiver_z_m"]) == {1.5} and left_out == {"repeats an earlier row exactly": 1}
    assert devices.loc["C", ["z_m", "role", "frequency_hz"]].tolist() == [24, "anchor", 3.58e9]
    apart_m = measurements.receiver_m - measurements.device_m[measurements.device_index]
    assert np.allclose(apart_m[0, :2], [1e-3 * 90_165, 2e-3 * 110_960], rtol=1e-3)  # metres a degree at 36° north
    assert "4 links, 0 not detected; 2 devices (2 anchors), 2 receivers, 2 flights" in printed
    assert "origin: latitude 36.0015" in printed


def test_powder_frs(example):
    measurements, report, left_out, printed = example(
        "powder_frs", f"--receivers {shlex.quote(str(SAMPLES / 'powder_frs_receivers.csv'))}")
    table = measurements.table
    assert report["rows"] == 3 and report["readings"] == 12 and left_out == {"not measured": 4}
    assert list(table["device"]) == ["p1", "p1", "p2", "p2", "p2", "p1", "p1", "p1"]
    assert sorted(set(table["receiver"])) == ["bus-4407", "cbrssdr1-hill-comp", "cnode-yard-dd-b210", "roof-nuc1-b210"]
    assert measurements.flights == ["2022-11-23", "2022-07-11"]
    assert table["time_s"].iloc[0] == pd.Timestamp("2022-11-23 13:24:40-07:00").timestamp()
    assert table["time_s"].iloc[-1] == pd.Timestamp("2022-07-11 08:49:44-06:00").timestamp()
    assert measurements.is_anchor.all() and set(measurements.devices["frequency_hz"]) == {462.7e6}
    bus = table[table["receiver"] == "bus-4407"]
    assert np.diff(bus["receiver_y_m"])[0] == pytest.approx(111.05, abs=0.1) and len(bus) == 2
    assert table["receiver_z_m"].isna().all()


def test_drive_test(example):
    measurements, report, left_out, printed = example(
        "drive_test", f"--devices {shlex.quote(str(SAMPLES / 'drive_test_sites.csv'))}")
    table = measurements.table
    assert left_out == {"impossible level": 1, "no device": 1, "nearer than 100.0 m": 1}
    assert list(table["device"]) == ["111", "111", "222"] and list(table["quality"]) == [3, 1, 1]
    power = np.array([1e-9, 1e-10, 0]).mean()
    np.testing.assert_allclose(table["rssi_dbm"], [10 * np.log10(power), -95, np.nan], atol=1e-4)
    assert set(table["receiver_z_m"]) == {2.5} and set(table["flight"]) == {"2023-07-04"}
    assert table["time_s"].iloc[0] == pd.Timestamp("2023-07-04 07:00:01Z").timestamp()
    assert measurements.devices[["role", "z_m"]].values.tolist()[0] == ["anchor", 30.48]
    assert measurements.devices["role"].tolist() == ["anchor", "unknown"]
    assert "impossible level" in printed and "row 9" in printed


def test_uav_log(example):
    measurements, report, left_out, printed = example("uav_log")
    table = measurements.table
    assert left_out == {} and report["not_detected"] == 1
    np.testing.assert_array_equal(table["rssi_dbm"], [-71.5, np.nan, -73])
    np.testing.assert_allclose(table["receiver_z_m"], [60, 60, 60.12], atol=1e-3)
    np.testing.assert_allclose(table["receiver_y_m"], [0, 11.12, 22.24], atol=0.01)
    assert list(table["heading_deg"]) == [350, 10, 20] and list(table["roll_deg"]) == [-1, -1, 0]
    assert list(table["time_s"]) == [1688461200, 1688461200.5, 1688461201]
    assert measurements.devices["role"].tolist() == ["unknown"]


GOOD = "time,lat,lon,cell,rsrp\n2022-10-30 12:00:00,48.1,11.5,a,-80\n2022-10-30 12:00:01,48.2,11.6,a,-99\n"
MAPPING = "--columns 'time=time,latitude=lat,longitude=lon,device=cell,level=rsrp'"
WORDS = f"import data.csv {MAPPING} --level-unit dBm --time-format 'ISO 8601' --time-zone Europe/Berlin -o out"


def test_options_alone_are_enough_and_gzip_is_read_by_all(run, tmp_path):
    (tmp_path / "data.csv").write_text(GOOD)
    done = run(WORDS + " --gzip --origin 48.1,11.5,100 --not-detected -99,empty", tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.rstrip().endswith("--gzip")  # of the line that repeats it
    measurements = read_measurements(tmp_path / "out" / "measurements.csv.gz")
    np.testing.assert_array_equal(measurements.level_db, [-80, np.nan])
    np.testing.assert_allclose(measurements.receiver_m[0, :2], 0, atol=1e-3)
    saved = (tmp_path / "out" / "import.toml").read_text()
    assert "altitude_m = 100.0" in saved and 'not_detected = [\n    -99.0,\n    "empty",\n]' in saved
    assert run(WORDS, tmp_path).returncode == 0, "an earlier import may be replaced"
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES


def test_many_columns_of_levels_by_options(run, tmp_path):
    (tmp_path / "data.csv").write_text("x,y,rx1_rss,rx2_rss\n1,2,-80,-81\n")
    done = run("import data.csv --columns device_x=x,device_y=y,device='by position',x='always 0',y='always 0' --wide "
               "level=*_rss,receiver=* --level-unit dBm --length-unit m -o out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert list(read_measurements(tmp_path / "out" / "measurements.csv").table["receiver"]) == ["rx1", "rx2"]


LOCAL = "--columns level=l,device=d,x=x,y=y --level-unit dBm --length-unit m -o out"


def test_formulas_are_written_as_texts_and_read_as_they_were(run, tmp_path):
    (tmp_path / "t.csv").write_text("d,x,y,l\n=cmd|' /C calc'!A0,0,0,-80\n-5,1,1,-81\n=cmd|' /C calc'!A0,0,0,-80\n")
    assert run(f"import t.csv {LOCAL}", tmp_path).returncode == 0
    for name in ("devices.csv", "measurements.csv"):
        assert "'=cmd" in (tmp_path / "out" / name).read_text() and "'-5" not in (tmp_path / "out" / name).read_text()
    back = read_measurements(tmp_path / "out" / "measurements.csv")
    assert list(back.table["device"]) == ["=cmd|' /C calc'!A0", "-5"], "and the repeated row was found"


def test_the_command_that_is_printed_repeats_the_import(run, tmp_path):
    """Tables and tracks lie in none of the folders in which a file of settings may name them."""
    for name in ("logs", "other", "work"):
        (tmp_path / name).mkdir()
    (tmp_path / "logs" / "a.csv").write_text("t,id,who,rssi\n" + "".join(f"{1709287200 + i},b,{who},-80\n" for i, who in enumerate(("x", "roof 1"))))
    (tmp_path / "other" / "sites.csv").write_text("device,latitude,longitude,height\nb,48.1,11.5,5\n")
    (tmp_path / "other" / "roofs.csv").write_text("receiver,latitude,longitude,height\nroof 1,48.2,11.5,9\n")
    (tmp_path / "other" / "flight.csv").write_text("time_s,latitude,longitude\n1709287199,48.1,11.5\n1709287202,48.2,11.5\n")
    (tmp_path / "other" / "own.toml").write_text('devices = "sites.csv"\nlevel_unit = "dBm"\ntime_format = "epoch s"\nlength_unit = "m"\n'
                                                 '[columns]\nlevel = "rssi"\ndevice = "id"\ntime = "t"\nreceiver = "who"\n')
    done = run("import ../logs/a.csv --columns ../other/own.toml --receivers ../other/roofs.csv --track x=../other/flight.csv -o out --gzip",
               tmp_path / "work")
    assert done.returncode == 0, done.stderr
    printed = " ".join((done.stdout + done.stderr).split()).partition("again: radiotwin ")[2]
    assert printed.startswith("import ../logs/a.csv --columns out/import.toml --devices ../other/sites.csv --receivers ../other/roofs.csv "
                              "--track x=../other/flight.csv -o out --gzip")
    first = {path.name: path.read_bytes() for path in (tmp_path / "work" / "out").iterdir()}
    again = run(printed, tmp_path / "work")
    assert again.returncode == 0, again.stderr
    assert first == {path.name: path.read_bytes() for path in (tmp_path / "work" / "out").iterdir()}


@pytest.mark.parametrize(("tracks", "options"), [
    ([{"file": "a.gpx", "time_offset_s": 3600.0}], []), ([{"file": "a=b.gpx"}], []),
    ([{"file": "a.bag", "topic": "/a"}, {"file": "b.bag", "topic": "/b", "receiver": "x"}], []),
    ([{"file": "a.bag", "topic": "/a"}, {"file": "b.bag", "topic": "/a", "receiver": "x=y"}],
     ["--track", "a.bag", "--track", "x=y=b.bag", "--track-topic", "/a"])])
def test_tracks_that_options_cannot_say_are_left_to_the_file(tracks, options):
    settings = Settings(track=tracks, devices="d.csv")
    assert _tables(settings) == ["--devices", "d.csv", *options]


def test_a_known_format_needs_no_mapping(run, tmp_path):
    (tmp_path / "w.csv").write_text(
        "WigleWifi-1.6,appRelease=2\nMAC,SSID,FirstSeen,RSSI,CurrentLatitude,CurrentLongitude,AltitudeMeters,Type\n"
        "aa,b,2024-03-01 10:00:00,-60,48.1,11.5,500,WIFI\ncc,d,2024-03-01 10:00:01,-90,48.1,11.5,500,LTE\n")
    done = run("import w.csv --only 'Type=WIFI|BLE' --level-offset-db -2 -o out", tmp_path)
    assert done.returncode == 0, done.stderr
    table = read_measurements(tmp_path / "out" / "measurements.csv").table
    assert list(table["device"]) == ["aa"] and list(table["rssi_dbm"]) == [-62]
    assert 'format = "wigle"' in (tmp_path / "out" / "import.toml").read_text()
    assert run("import w.csv --columns out/import.toml -o again", tmp_path).returncode == 0
    assert (tmp_path / "again" / "measurements.csv").read_bytes() == (tmp_path / "out" / "measurements.csv").read_bytes()


def test_a_spectrum_scan_in_a_band(run, tmp_path):
    (tmp_path / "s.csv").write_text("2024-03-01, 10:00:00, 1000000, 1200000, 100000.00, 7, -30.0, -30.0, -30.0\n")
    words = "import s.csv --time-zone UTC --columns x='always 1',y='always 2' --length-unit m -o out"
    assert run(f"{words} --band-hz 1e6,1.2e6", tmp_path).returncode == 0
    assert read_measurements(tmp_path / "out" / "measurements.csv").table["rssi_dbm"].tolist() == pytest.approx([-26.9897], abs=1e-3)


def test_two_files_with_the_track_that_their_settings_name(run, tmp_path):
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_text("t,l\n1709287200,-80\n1709287201,-81\n")
    (tmp_path / "flight.csv").write_text("time_s,latitude,longitude\n1709287199,48.1,11.5\n1709287202,48.2,11.5\n")
    (tmp_path / "own.toml").write_text('level_unit = "dBm"\ntime_format = "epoch s"\nlength_unit = "m"\n[columns]\nlevel = "l"\n'
                                       'time = "t"\ndevice = "always x"\n[[track]]\nfile = "flight.csv"\n')
    done = run("import a.csv b.csv --columns own.toml -o out", tmp_path)
    assert done.returncode == 0 and "Readings of 2 files" in done.stdout, done.stderr
    assert read_measurements(tmp_path / "out" / "measurements.csv").flights == ["a", "b"]
