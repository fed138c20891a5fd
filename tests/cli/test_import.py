"""`radiotwin import` as a user runs it: the worked examples, round trips, and input that cannot be used."""

import json
import os
import re
import shlex
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from radiotwin.cli.importing import _tables
from radiotwin.importing.settings import Settings
from radiotwin.links.measurements import read_measurements

EXAMPLES = Path(__file__).parents[2] / "examples" / "import"
SAMPLES = Path(__file__).parents[1] / "importing" / "samples"
FILES = ["devices.csv", "frame.toml", "import.json", "import.toml", "measurements.csv"]


EXAMPLE = {  # options, what is left out and why, devices and levels of the links
    "duke_cbrs": ("--devices {}/duke_cbrs_sectors.csv", {"repeats an earlier row exactly": 1}, "C A C A", [-112, -98, -107, -121]),
    "powder_frs": ("--receivers {}/powder_frs_receivers.csv", {"not measured": 4}, "p1 p1 p2 p2 p2 p1 p1 p1", None),
    "drive_test": ("--devices {}/drive_test_sites.csv", {"impossible level": 1, "no device": 1, "nearer than 100.0 m": 1},
                   "111 111 222", [10 * np.log10(1.1e-9 / 3), -95, np.nan]),
    "uav_log": ("", {}, None, [-71.5, np.nan, -73])}


@pytest.mark.parametrize("name", EXAMPLE)
def test_a_worked_example_and_again_with_what_was_saved(run, tmp_path, name):
    options, left_out, devices, level_dbm = EXAMPLE[name]
    file = shlex.quote(str(SAMPLES / f"{name}.csv"))
    first = run(f"import {file} --columns {shlex.quote(str(EXAMPLES / name))}.toml {options.format(SAMPLES)} -o out", tmp_path)
    assert first.returncode == 0, first.stderr
    assert run(f"import {file} --columns out/import.toml -o again", tmp_path).returncode == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES
    for each in FILES:
        assert (tmp_path / "out" / each).read_bytes() == (tmp_path / "again" / each).read_bytes(), each
    report = json.loads((tmp_path / "out" / "import.json").read_text())
    found = Counter()
    for item in report["left_out"]:
        found[item["reason"]] += item["readings"]
    assert found == left_out and report["readings"] == report["kept"] + sum(left_out.values())
    measurements = read_measurements(tmp_path / "out" / "measurements.csv")
    assert devices is None or list(measurements.table["device"]) == devices.split()
    if level_dbm is not None:
        np.testing.assert_allclose(measurements.level_db, level_dbm, atol=1e-4)
    assert f"{len(measurements)} links, " in first.stdout and all(reason in first.stdout for reason in left_out)


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


@pytest.mark.parametrize("options", [
    "t.csv --columns pipe -o out", f"pipe.csv {LOCAL}", "t.csv --columns deep.toml -o out", f"t.csv {LOCAL} --devices pipe.csv"])
def test_pipes_and_deep_nesting_are_one_message(run, tmp_path, options):
    for name in ("pipe", "pipe.csv"):
        os.mkfifo(tmp_path / name)
    (tmp_path / "t.csv").write_text("d,x,y,l\na,0,0,-80\n")
    (tmp_path / "deep.toml").write_text("a." * 20_000 + "b = 1")
    done = run(f"import {options}", tmp_path)
    assert done.returncode == 2 and re.search("not a regular file|RADIOTWIN_MAX_NESTING", " ".join(done.stderr.split())), done.stderr
    assert len(done.stderr) < 4000 and not (tmp_path / "out").exists()


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
    for name, level in (("a.csv", -80), ("b.csv", -90)):
        (tmp_path / name).write_text(f"t,l\n1709287200,{level}\n1709287201,{level - 1}\n")
    (tmp_path / "flight.csv").write_text("time_s,latitude,longitude\n1709287199,48.1,11.5\n1709287202,48.2,11.5\n")
    (tmp_path / "own.toml").write_text('level_unit = "dBm"\ntime_format = "epoch s"\nlength_unit = "m"\n[columns]\nlevel = "l"\n'
                                       'time = "t"\ndevice = "always x"\n[[track]]\nfile = "flight.csv"\n')
    done = run("import a.csv b.csv --columns own.toml -o out", tmp_path)
    assert done.returncode == 0 and "Readings of 2 files" in done.stdout, done.stderr
    assert read_measurements(tmp_path / "out" / "measurements.csv").flights == ["a", "b"]
