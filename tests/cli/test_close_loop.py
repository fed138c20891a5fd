"""`radiotwin close-loop` as a user runs it: a result, on thin data with notes, or one clear message."""

import json
import re

import numpy as np
import pandas as pd
import pytest

from radiotwin.maps.survey import fly_survey
from tests.worlds import fly, measured

pytestmark = pytest.mark.usefixtures("quick_report")


@pytest.fixture
def coarse(monkeypatch):
    """Pictures without the search for room between their parts, which would take longer than all else."""
    monkeypatch.setattr("radiotwin.report.labels.DPI", 30)
    monkeypatch.setattr("matplotlib.layout_engine.ConstrainedLayoutEngine.execute", lambda *_: {})


@pytest.fixture
def close_loop(run, tmp_path, coarse):
    """Run the command on tables of links and devices."""
    def close_loop(links, devices, arguments=""):
        links.to_csv(tmp_path / "measurements.csv", index=False)
        devices.to_csv(tmp_path / "devices.csv", index=False)
        return run(f"close-loop measurements.csv --out result {arguments}", tmp_path)
    return close_loop


def open_ground():
    """384 links of two receivers and four devices in four flights."""
    made = measured(fly(0, flights=4, slots=12, devices=4))
    return made.table.astype(object), made.devices.astype(object)


def in_the_city(scene):
    """Links, devices whose positions are all known, and which links have line of sight."""
    flown = fly_survey(scene, "segmented", flights=1, seed=0)
    every_third = flown.select(np.arange(len(flown)) % 3 == 0)
    seen = scene.city.line_of_sight(scene.device_m[every_third.device_index], every_third.receiver_m)
    devices = scene.devices.assign(role="anchor", frequency_hz=2.4e9)
    return every_third.table.astype(object), devices.astype(object), seen


def refused(folder, done, *parts):
    """Status 2, one message with every part in it, and nothing is written."""
    assert done.returncode == 2, (done.stdout, done.stderr)
    assert done.stderr.count("radiotwin: ") == 1 and len(done.stderr.strip().splitlines()) == 1, done.stderr
    assert all(part in done.stderr for part in parts), done.stderr
    assert {path.name for path in folder.iterdir()} <= {"measurements.csv", "devices.csv", "mine"}


def test_a_file_and_a_table_of_devices_are_enough(run, tmp_path):
    world = fly(0, flights=4, slots=40, devices=4)
    world.gain_db += 6.0 * world.receiver  # one receiver reads too much
    measured(world).save(tmp_path / "measurements.csv")
    (tmp_path / "result").mkdir()
    (tmp_path / "result" / "notes.txt").write_text("mine")
    done = run("close-loop measurements.csv --out result", tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "result" / "notes.txt").read_text() == "mine"
    assert "receiver_gain_offset" in done.stdout and "closeloop.html" in done.stdout
    report = json.loads((tmp_path / "result" / "closeloop.json").read_text())
    assert report["schema"] == "radiotwin.closeloop/3" and report["verdict"] == "effect"
    assert report["effects"][0]["name"] == "receiver_gain_offset"
    assert report["error"]["after"]["rmse_db"] < 0.8 * report["error"]["before"]["rmse_db"]
    links = pd.read_csv(tmp_path / "result" / "residuals.csv.gz")
    for when in ("before", "after"):
        rmse_db = np.sqrt((links[f"{when}_db"] ** 2).mean())
        assert rmse_db == pytest.approx(report["error"][when]["rmse_db"], abs=1e-3)
    page = (tmp_path / "result" / "closeloop.html").read_text()
    assert page.count("data:image/png;base64,") >= 5 and "Receiver gain offset" in page
    shown = run("report result", tmp_path)
    assert shown.returncode == 0 and "no scene" in shown.stdout, shown.stderr
    whole = (tmp_path / "result" / "report.html").read_text()
    assert "Receiver gain offset" in whole
    assert not re.search(r'<[^>]*(?:src|href)="(?!data:)', page + whole), "nothing from a network"


def put(column, value, rows=slice(None), table=0):
    """An edit: cells of a column (of the links, or of table 1, the devices) become a value."""
    def edit(*tables):
        tables[table].loc[tables[table].index[rows], column] = value
        return tables
    return edit


def to_links(change):
    return lambda links, devices: (change(links), devices)


def drop(column, table=0):
    return lambda *tables: [each.drop(columns=column) if i == table else each for i, each in enumerate(tables)]


def scaled(factor, x_m=0.0, y_m=0.0, devices_too=False):
    """All horizontal positions in another unit or frame."""
    def edit(links, devices):
        for axis, start in (("x", x_m), ("y", y_m)):
            links[f"receiver_{axis}_m"] = start + factor * links[f"receiver_{axis}_m"]
            if devices_too:
                devices[f"{axis}_m"] = start + factor * devices[f"{axis}_m"]
        return links, devices
    return edit


def shouted(links, devices):
    links.loc[::2, "receiver"] = links["receiver"][::2].str.upper()
    return links, devices


HALF, TENTH = slice(None, None, 2), slice(0, 48)
NAMES = {"r0": "<b>$x^{$ & [/red]", "r1": "%s {0} $y$ é"}
THIN = {
    "little is told": ([drop("heading_deg"), drop("time_s"), drop("frequency_hz", 1), put("receiver", "r0"), put("z_m", "", table=1)], [
        "body_shadowing not looked for: there is no heading_deg", "receiver_drift not looked for: there is no time_s",
        "missing_obstacle not looked for: the frequency is not known", "receiver_gain_offset not looked for: needs two receivers",
        "removed_obstacle not looked for: there is no 3D map", "heights of devices are empty in 4 rows, and taken for 1.5 m"]),
    "cells are empty": ([put("heading_deg", ""), put("time_s", ""), put("receiver_z_m", ""), put("gain_db", "", slice(1, None, 4))], [
        "body_shadowing not looked for: there is no heading_deg", "receiver_drift not looked for: there is no time_s",
        "heights of receivers are empty in 384 rows, and taken for 1.5 m", "96 of 384 links left out: device d1 was never detected"]),
    "half of the cells are empty": ([put("heading_deg", "", HALF), put("time_s", "", HALF), put("flight", "f0")], []),
    "little was measured": ([put("heading_deg", 90), put("receiver", "r9", TENTH), put("gain_db", "", TENTH),
                             to_links(lambda links: links[links["device"] != "d2"])], [
        "body_shadowing not looked for: the heading never", "receiver r9 never detected anything", "no link is to device d2"]),
    "odd clocks and headings": ([to_links(lambda links: links.assign(heading_deg=links["heading_deg"] * 100, flight=np.arange(384))),
                                 put("time_s", 0), to_links(lambda links: links.sample(frac=1, random_state=0))], [
        "headings lie beyond 360°"]),
    "odd places and names": ([put("receiver_x_m", 7.0, HALF), put("receiver_y_m", 7.0, HALF), put("receiver_z_m", 1.5, HALF),
                              put("x_m", 7.0, table=1), put("y_m", 7.0, table=1), scaled(1.0, 690e3, 5334e3, devices_too=True),
                              to_links(lambda links: links.assign(receiver=links["receiver"].map(NAMES))
                                       .rename(columns={"gain_db": "rssi_dbm"}))], []),
    "few links": ([to_links(lambda links: links[:66]), put("receiver", "r9", [3, 50, 60])], [
        "3 of 66 links", "receiver r9 has 3 only"]),
    "one device": ([to_links(lambda links: links[links["device"] == "d0"])], [
        "no link is to devices d1, d2, d3", "device_gain_offset not looked for: needs two"]),
    "a stuck receiver": ([put("receiver", "r9", TENTH), put("gain_db", -77, TENTH)], ["receiver r9 always reads -77"]),
    "rows twice": ([to_links(lambda links: pd.concat([links, links]))], ["384 of 768 links", "twice"]),
    "names differ in case only": ([shouted], ["receivers R0, r0, R1, r1 differ in upper and lower case only"]),
    "receivers in degrees": ([scaled(1e-5, 11.5, 48.0)], ["positions of receivers lie within 0.00", "degrees"]),
    "unknown devices without a scene": ([put("role", "unknown", slice(2, 4), 1), put("x_m", "", slice(2, 4), 1)], [
        "192 of 384 links left out: without a scene"]),
}


@pytest.mark.parametrize(("edits", "parts"), THIN.values(), ids=THIN)
def test_thin_data_gives_a_result_that_says_so(close_loop, tmp_path, edits, parts):
    """Every part is in a note, which is printed, too, or is the reason why an effect was not looked for."""
    tables = open_ground()
    for edit in edits:
        tables = edit(*tables)
    done = close_loop(*tables)
    assert done.returncode == 0, done.stderr
    assert {path.name for path in (tmp_path / "result").iterdir()} >= {"closeloop.html", "closeloop.json"}
    report = json.loads((tmp_path / "result" / "closeloop.json").read_text())
    assert all(f"note: {remark}" in done.stdout for remark in report["notes"])
    notes = report["notes"] + [f"{candidate['name']} {candidate['reason']}" for candidate in report["candidates"]]
    for part in parts:
        assert any(part in each for each in notes), (part, notes)


WRONG = {
    "all gains equal": (put("gain_db", -80), "", ["all levels are -80", "nothing to explain", "column gain_db"]),
    "nothing detected": (put("gain_db", ""), "", ["nothing was detected", "gain_db is empty in all 384 rows"]),
    "too few links": (to_links(lambda links: links[:30]), "", ["30 links can be used", "at least 60 are needed"]),
    "too few of each receiver": (to_links(lambda links: links.assign(receiver=np.arange(384))), "", [
        "at least 60 are needed", "0, 1, 10, 100, 101, … (", "in all) have 1 at most; 5 are needed"]),
    "no number": (put("receiver_x_m", "nan", [5]), "", ["row 7, column receiver_x_m", "'nan' is not a"]),
    "no anchor": (put("role", "unknown", table=1), "", ["at least 60", "without a scene", "cannot be located"]),
    "megahertz": (put("frequency_hz", 2400, table=1), "", ["frequency_hz", "'2400'", "the unit is Hz"]),
    "all in degrees": (scaled(1e-5, 11.5, 48.0, devices_too=True), "", ["within 0.00", "in metres", "degrees"]),
    "another frame": (scaled(1.0, 690e3, 5334e3), "", ["384 of 384 links left out", "100 km from the device"]),
    "no devices": (lambda links, devices: (links, devices[:0]), "", ["devices.csv: has no rows"]),
    "no base": (put("flight", "f"), "--base oracle", ["oracle", "twin, raytrace, log-distance"]),
    "a corrected map of none": (put("flight", "f"), "--write-scene corrected", ["--write-scene", "give it with --scene"]),
}


@pytest.mark.parametrize(("edit", "arguments", "parts"), WRONG.values(), ids=WRONG)
def test_wrong_data_is_one_message(close_loop, tmp_path, edit, arguments, parts):
    refused(tmp_path, close_loop(*edit(*open_ground()), arguments), *parts)


def test_paths_need_a_map(close_loop):
    done = close_loop(*open_ground(), "--base raytrace")
    assert done.returncode == 2 and "raytrace" in done.stderr and "--scene" in done.stderr


@pytest.mark.parametrize(("edit", "parts"), [
    (lambda links, devices, seen: (links[~seen], devices), ["all links NLoS", "one frame and unit", "log_distance"]),
    (lambda links, devices, seen: (links.assign(receiver_z_m=""), devices), ["height is empty", "the 3D map needs"]),
    (lambda links, devices, seen: put("role", "unknown", table=1)(links, devices), ["no anchor", "devices.csv"]),
    (lambda links, devices, seen: (links, devices.assign(x_m=130, y_m=170, z_m=0.5)), ["devices, row 2", "'d0'", "inside a building"]),
    (lambda links, devices, seen: scaled(1 / 0.3048)(links, devices), ["outside the 3D map", "feet"]),
    (lambda links, devices, seen: (links.assign(receiver_z_m=2.0), devices), ["not in one frame", "--shift=0,0"]),
], ids=["all links without line of sight", "empty heights", "no anchor", "an anchor in a building", "feet", "receivers in buildings"])
def test_wrong_data_with_a_map_is_one_message(close_loop, small_scene, tmp_path, edit, parts):
    tables = edit(*in_the_city(small_scene))
    refused(tmp_path, close_loop(*tables, f"--scene {small_scene.folder} --base twin"), *parts)


def test_a_corrected_scene_needs_something_to_correct(close_loop, small_scene, tmp_path):
    links, devices, seen = in_the_city(small_scene)
    scene = f"--scene {small_scene.folder} --base log-distance"
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("")
    refused(tmp_path, close_loop(links, devices, f"{scene} --write-scene mine"), "thesis.tex", "would erase")
    refused(tmp_path, close_loop(links, devices, f"{scene} --write-scene result"), "the report", "another folder")
    done = close_loop(links[seen], devices, f"{scene} --write-scene corrected")
    assert done.returncode == 0, done.stderr
    assert "corrected is not written: no building, roof, anchor or antenna was found" in done.stdout
    assert not (tmp_path / "corrected").exists()
