"""`radiotwin close-loop` on sparse, implausible and wrong data: a result with notes, or one clear message."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest

DEVICES, RECEIVERS, FLIGHTS, SLOTS = 4, 2, 4, 12
WHOLE = ["closeloop.html", "closeloop.json"]


def survey(device_m, blocked=None, seed=0):
    """Links over [0, 300] m of which nothing is missing, a table of devices, and which links are blocked (n,)."""
    rng = np.random.default_rng(seed)
    place_m = 150 + np.cumsum(rng.normal(0, 20, (FLIGHTS, RECEIVERS, SLOTS, 2)), axis=2)
    flight, receiver, slot, device = (
        index.ravel() for index in np.indices((FLIGHTS, RECEIVERS, SLOTS, len(device_m))))
    receiver_m = np.column_stack([np.clip(place_m[flight, receiver, slot], 2, 298), 55.0 + 5 * receiver])
    hidden = np.zeros(len(flight), bool) if blocked is None else blocked(device_m[device], receiver_m)
    distance_m = np.linalg.norm(receiver_m - device_m[device], axis=1)
    gain_db = np.where(hidden, -35 - 30 * np.log10(distance_m), -32 - 22 * np.log10(distance_m))
    links = pd.DataFrame({
        "time_s": 100.0 * flight + slot, "flight": [f"f{i}" for i in flight], "receiver": [f"r{i}" for i in receiver],
        **{f"receiver_{axis}_m": receiver_m[:, i] for i, axis in enumerate("xyz")},
        "device": [f"d{i}" for i in device], "gain_db": gain_db + rng.normal(0, 2, len(flight)),
        "heading_deg": rng.uniform(0, 360, len(flight))})
    devices = pd.DataFrame({
        "device": [f"d{i}" for i in range(len(device_m))], "x_m": device_m[:, 0], "y_m": device_m[:, 1],
        "z_m": device_m[:, 2], "role": "anchor", "frequency_hz": 2.4e9})
    return links.astype(object), devices.astype(object), hidden


@pytest.fixture
def close_loop(run, tmp_path, monkeypatch, quick_report):
    """Run the command on tables: exit status, standard output and error. Pictures are drawn coarsely, and without the
    search for room between their parts, which would take longer than all else."""
    monkeypatch.setattr("radiotwin.report.labels.DPI", 30)
    monkeypatch.setattr("matplotlib.layout_engine.ConstrainedLayoutEngine.execute", lambda *_: {})

    def close_loop(links, devices, arguments="", prepare=None):
        links.to_csv(tmp_path / "measurements.csv", index=False)
        devices.to_csv(tmp_path / "devices.csv", index=False)
        if prepare:
            prepare(tmp_path)
        done = run(f"close-loop measurements.csv --out result {arguments}", tmp_path)
        return done.returncode, done.stdout, done.stderr
    return close_loop


def open_ground():
    return survey(np.column_stack([np.random.default_rng(1).uniform(0, 300, (DEVICES, 2)), np.full(DEVICES, 1.5)]))


def in_the_city(scene):
    return survey(scene.device_m[:DEVICES], lambda a, b: ~scene.city.line_of_sight(a, b))


def went_on(folder, done, *parts):
    """Status 0, all files whole, and every part is reported: in a note, which is printed, too, or as the reason why an
    effect was not looked for."""
    status, out, err = done
    assert status == 0, err
    names = sorted(path.name for path in (folder / "result").iterdir())
    assert set(WHOLE) <= set(names) and not any(name.startswith(".") for name in names)
    report = json.loads((folder / "result" / "closeloop.json").read_text())
    assert all(f"note: {remark}" in out for remark in report["notes"])
    notes = report["notes"] + [f"{candidate['name']} {candidate['reason']}" for candidate in report["candidates"]]
    for part in parts:
        assert any(part in each for each in notes), (part, notes)
    return report


def refused(folder, done, *parts):
    """Status 2, one message with every part in it, and nothing is written."""
    status, out, err = done
    assert status == 2, (status, out, err)
    assert err.count("radiotwin: ") == 1 and len(err.strip().splitlines()) == 1, err
    for part in parts:
        assert part in err
    assert not (folder / "result").exists() or list((folder / "result").iterdir()) == []
    assert not [path for path in folder.rglob(".*")]


def put(column, value, rows=slice(None), table=0):
    """An edit: cells of a column (of the links, or of table 1, the devices) become a value."""
    def edit(*tables):
        tables[table].loc[tables[table].index[rows], column] = value
        return tables
    return edit


def drop(column):
    return lambda links, devices: (links.drop(columns=column), devices)


def only(condition):
    return lambda links, devices: (links[condition(links)], devices)


def each(*edits):
    def edit(links, devices):
        for one in edits:
            links, devices = one(links, devices)
        return links, devices
    return edit


def scaled(factor, x_m=0.0, y_m=0.0, devices_too=False):
    """All horizontal positions in another unit or frame."""
    def edit(links, devices):
        for axis, start in (("x", x_m), ("y", y_m)):
            links[f"receiver_{axis}_m"] = start + factor * links[f"receiver_{axis}_m"]
            if devices_too:
                devices[f"{axis}_m"] = start + factor * devices[f"{axis}_m"]
        return links, devices
    return edit


def never_detected(links, devices):
    links.loc[links["device"] == "d1", "gain_db"] = ""
    return links, devices


def shouted(links, devices):
    links.loc[::2, "receiver"] = links["receiver"][::2].str.upper()
    return links, devices


NO_FRAME = "there is no heading_deg"
THIN = {
    "no heading column": (drop("heading_deg"), [f"body_shadowing not looked for: {NO_FRAME}",
                                                f"antenna_pattern not looked for: {NO_FRAME}"]),
    "empty headings": (put("heading_deg", ""), [f"body_shadowing not looked for: {NO_FRAME}"]),
    "half of the headings empty": (put("heading_deg", "", slice(None, None, 2)), []),
    "a heading that never changes": (put("heading_deg", 90), ["body_shadowing not looked for: the heading never"]),
    "headings from -180 to 180": (lambda links, devices: (links.assign(heading_deg=links["heading_deg"] - 180),
                                                          devices), []),
    "headings in hundredths": (lambda links, devices: (links.assign(heading_deg=links["heading_deg"] * 100), devices),
                               ["headings lie beyond 360°"]),
    "one flight": (put("flight", "f0"), []),
    "a flight for each row": (lambda links, devices: (links.assign(flight=np.arange(len(links))), devices), []),
    "a receiver with three rows": (put("receiver", "r9", [3, 50, 90]), ["3 of 384 links", "receiver r9 has 3 only"]),
    "a flight without a detected link of a receiver": (put("gain_db", "", slice(0, 48)), []),
    "a dead receiver": (each(put("receiver", "r9", slice(0, 48)), put("gain_db", "", slice(0, 48))),
                        ["receiver r9 never detected anything"]),
    "a stuck receiver": (each(put("receiver", "r9", slice(0, 48)), put("gain_db", -77, slice(0, 48))),
                         ["receiver r9 always reads -77"]),
    "one receiver": (put("receiver", "r0"), ["receiver_gain_offset not looked for: needs two receivers"]),
    "a device never detected": (never_detected, ["96 of 384 links left out: device d1 was never detected"]),
    "a device never measured": (only(lambda links: links["device"] != "d2"), ["no link is to device d2"]),
    "one device": (only(lambda links: links["device"] == "d0"), ["no link is to devices d1, d2, d3",
                                                                  "device_gain_offset not looked for: needs two"]),
    "times out of order": (lambda links, devices: (links.sample(frac=1, random_state=0), devices), []),
    "no time column": (drop("time_s"), ["receiver_drift not looked for: there is no time_s"]),
    "empty times": (put("time_s", ""), ["receiver_drift not looked for: there is no time_s"]),
    "half of the times empty": (put("time_s", "", slice(None, None, 2)), []),
    "one time for all": (put("time_s", 0), []),
    "no frequency": (lambda links, devices: (links, devices.drop(columns="frequency_hz")),
                     ["missing_obstacle not looked for: the frequency is not known"]),
    "no scene": (lambda links, devices: (links, devices), ["removed_obstacle not looked for: there is no 3D map"]),
    "empty receiver heights": (put("receiver_z_m", ""), ["heights of receivers are empty in 384 rows, and taken for 1.5 m"]),
    "empty device heights": (put("z_m", "", table=1), ["heights of devices are empty in 4 rows, and taken for 1.5 m"]),
    "receivers that stand still": (each(put("receiver_x_m", 10), put("receiver_y_m", 20)), []),
    "a receiver at a device": (each(put("receiver_x_m", 7.0), put("receiver_y_m", 7.0), put("receiver_z_m", 1.5),
                                    put("x_m", 7.0, table=1), put("y_m", 7.0, table=1)), []),
    "receivers in degrees": (scaled(1e-5, 11.5, 48.0), ["positions of receivers lie within 0.00", "degrees"]),
    "all in a far frame": (scaled(1.0, 690e3, 5334e3, devices_too=True), []),
    "rows twice": (lambda links, devices: (pd.concat([links, links]), devices), ["384 of 768 links", "twice"]),
    "names that differ in case only": (shouted, ["receivers R0, r0, R1, r1 differ in upper and lower case only"]),
    "names that mean something elsewhere": (lambda links, devices: (links.assign(
        receiver=links["receiver"].map({"r0": "<b>$x^{$ & [/red]", "r1": "%s {0} $y$ é"})), devices), []),
    "unknown devices without a scene": (each(put("role", "unknown", slice(2, 4), 1), put("x_m", "", slice(2, 4), 1)),
                                        ["192 of 384 links left out: without a scene"]),
    "sixty links": (lambda links, devices: (links[:60], devices), []),
    "received power": (lambda links, devices: (links.rename(columns={"gain_db": "rssi_dbm"}), devices), []),
}


TOGETHER = {
    "little is told": ("no heading column", "no time column", "no frequency", "one receiver", "no scene", "empty device heights"),
    "cells are empty": ("empty headings", "empty times", "empty receiver heights", "a device never detected"),
    "little was measured": ("a heading that never changes", "a dead receiver", "a device never measured"),
    "there are few links": ("sixty links",), "one device": ("one device",), "a stuck receiver": ("a stuck receiver",),
    "rows twice": ("rows twice",), "names differ in case only": ("names that differ in case only",),
    "receivers in degrees": ("receivers in degrees",),
    "unknown devices without a scene": ("unknown devices without a scene",)}
"""Each loop takes seconds."""


@pytest.mark.parametrize("names", TOGETHER.values(), ids=TOGETHER)
def test_thin_data_gives_a_result_that_says_all_of_it(close_loop, tmp_path, names):
    links, devices, _ = open_ground()
    links, devices = each(*(THIN[name][0] for name in names))(links, devices)
    went_on(tmp_path, close_loop(links, devices), *(part for name in names for part in THIN[name][1]))


@pytest.mark.slow
@pytest.mark.parametrize(("edit", "parts"), THIN.values(), ids=THIN)
def test_thin_data_gives_a_result_that_says_so(close_loop, tmp_path, edit, parts):
    links, devices, _ = open_ground()
    went_on(tmp_path, close_loop(*edit(links, devices)), *parts)


WRONG = {
    "all gains equal": (put("gain_db", -80), ["all levels are -80", "nothing to explain", "column gain_db"]),
    "nothing detected": (put("gain_db", ""), ["nothing was detected", "gain_db is empty in all 384 rows", "Check"]),
    "one link detected": (put("gain_db", "", slice(1, None)), ["all levels are", "gain_db"]),
    "too few links": (lambda links, devices: (links[:30], devices), ["30 links can be used", "at least 60 are needed"]),
    "too few links of each receiver": (lambda links, devices: (links.assign(receiver=np.arange(len(links))), devices),
                                       ["at least 60", "0, 1, 10, 100, 101, … (384 in all) have 1 at most; 5 are needed"]),
    "no number for a position": (put("receiver_x_m", "nan", [5]), ["row 7, column receiver_x_m", "'nan' is not a",
                                                                   "fill it in, or leave the row out"]),
    "no anchor": (put("role", "unknown", table=1), ["at least 60", "without a scene", "cannot be located"]),
    "a frequency in megahertz": (put("frequency_hz", 2400, table=1), ["frequency_hz", "'2400'", "the unit is Hz"]),
    "no frequency at all": (put("frequency_hz", 0, table=1), ["frequency_hz", "'0' is no frequency", "allowed"]),
    "all in degrees": (scaled(1e-5, 11.5, 48.0, devices_too=True), ["within 0.00", "in metres", "degrees"]),
    "receivers in another frame": (scaled(1.0, 690e3, 5334e3), ["384 of 384 links left out", "100 km from the device",
                                                                "one frame, in metres"]),
    "no devices": (lambda links, devices: (links, devices[:0]), ["devices.csv: has no rows", "one for each device"]),
}


@pytest.mark.parametrize(("edit", "parts"), WRONG.values(), ids=WRONG)
def test_wrong_data_is_one_message(close_loop, tmp_path, edit, parts):
    links, devices, _ = open_ground()
    refused(tmp_path, close_loop(*edit(links, devices)), *parts)


@pytest.mark.parametrize(("name", "content", "parts"), [
    ("measurements.csv", b"", ["measurements.csv is empty", "names of the columns"]),
    ("measurements.csv", b"\x89PNG\r\n\x1a\n\x00\xff", ["measurements.csv", "not text"]),
    ("result", b"a file", ["result is a file", "give the name of a folder"]),
    ("result/closeloop.json/x", b"", ["result/closeloop.json is a folder"]),
])
def test_files_that_cannot_be_are_one_message(close_loop, tmp_path, name, content, parts):
    links, devices, _ = open_ground()

    def prepare(folder):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    status, _, err = close_loop(links, devices, prepare=prepare)
    assert status == 2 and len(err.strip().splitlines()) == 1
    assert all(part in err for part in parts), err
    assert {path.name for path in tmp_path.iterdir()} <= {"devices.csv", "measurements.csv", "result"}


def test_what_else_is_in_the_output_folder_stays(close_loop, tmp_path):
    links, devices, _ = open_ground()

    def prepare(folder):
        (folder / "result").mkdir()
        (folder / "result" / "notes.txt").write_text("mine")
    went_on(tmp_path, close_loop(links, devices, prepare=prepare))
    assert (tmp_path / "result" / "notes.txt").read_text() == "mine"


IN_THE_CITY = {
    "nothing implausible": (lambda links, devices, hidden: (links, devices), []),
    "all links with line of sight": (lambda links, devices, hidden: (links[~hidden], devices), []),
    "receivers in degrees": (lambda links, devices, hidden: scaled(1e-5, 11.5, 48.0)(links, devices), ["degrees"]),
    "a device never detected": (lambda links, devices, hidden: never_detected(links, devices),
                                ["device d1 was never detected"]),
}


@pytest.mark.parametrize(("edit", "parts"), [
    pytest.param(*given, id=name, marks=[pytest.mark.slow] * (name != "all links with line of sight"))
    for name, given in IN_THE_CITY.items()])
def test_thin_data_with_a_map_gives_a_result_that_says_so(close_loop, small_scene, tmp_path, edit, parts):
    links, devices = edit(*in_the_city(small_scene))
    done = close_loop(links, devices, f"--scene {small_scene.folder} --base log-distance")
    went_on(tmp_path, done, *parts)


@pytest.mark.parametrize(("edit", "parts"), [
    (lambda links, devices, hidden: (links[hidden], devices), ["all links NLoS", "one frame and unit", "log_distance"]),
    (lambda links, devices, hidden: (links.assign(receiver_z_m=""), devices), ["height is empty", "the 3D map needs"]),
    (lambda links, devices, hidden: put("role", "unknown", table=1)(links, devices), ["no anchor", "devices.csv"]),
    (lambda links, devices, hidden: put("z_m", 0.5, [0], 1)(*put("x_m", 130, [0], 1)(*put("y_m", 170, [0], 1)(
        links, devices))), ["devices, row 2", "'d0'", "inside a building"]),
    (lambda links, devices, hidden: scaled(1 / 0.3048)(links, devices), ["outside the 3D map", "feet"]),
    (lambda links, devices, hidden: (links.assign(receiver_z_m=2.0), devices), ["not in one frame", "--shift=0,0"]),
], ids=["all links without line of sight", "empty heights", "no anchor", "an anchor in a building", "feet",
        "receivers in buildings"])
def test_wrong_data_with_a_map_is_one_message(close_loop, small_scene, tmp_path, edit, parts):
    links, devices = edit(*in_the_city(small_scene))
    refused(tmp_path, close_loop(links, devices, f"--scene {small_scene.folder} --base twin"), *parts)


def test_a_corrected_scene_needs_a_scene_and_something_to_correct(close_loop, small_scene, tmp_path):
    links, devices, _ = open_ground()
    refused(tmp_path, close_loop(links, devices, "--write-scene corrected"), "--write-scene", "give it with --scene")
    links, devices, _ = in_the_city(small_scene)
    scene = f"--scene {small_scene.folder} --base log-distance"
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("")
    refused(tmp_path, close_loop(links, devices, f"{scene} --write-scene mine"), "thesis.tex", "would erase")
    refused(tmp_path, close_loop(links, devices, f"{scene} --write-scene result"), "the report", "another folder")
    done = close_loop(links, devices, f"{scene} --write-scene corrected")
    went_on(tmp_path, done)
    assert "corrected is not written: no building, roof, anchor or antenna was found" in done[1]
    assert not (tmp_path / "corrected").exists()


def test_a_moved_anchor_stands_in_the_corrected_scene_where_it_was_found(small_scene, tmp_path):
    """Named here whatever its probability, which is low: these few flights have been at 11 places only."""
    from radiotwin import Measurements, close_loop
    from radiotwin.closeloop.output.corrected_scene import write_corrected_scene
    from radiotwin.closeloop.verdict.criteria import SelectionCriteria
    from radiotwin.scene import Scene

    shutil.copytree(small_scene.folder, tmp_path / "declared")
    links, devices, _ = in_the_city(small_scene)
    path = tmp_path / "declared" / "scene.toml"
    path.write_text(path.read_text().replace("x_m = 160.0\ny_m = 120.0", "x_m = 110.0\ny_m = 120.0"))
    devices.loc[3, "x_m"] = 110.0
    declared = Scene.load(tmp_path / "declared")
    loop = close_loop(Measurements(links, devices), declared, "twin", criteria=SelectionCriteria(min_probability=0.0))
    assert loop.after.whole.effects[0].name == "device_position_error"
    (said,) = write_corrected_scene(loop, declared, tmp_path / "corrected")
    assert said.startswith("d3 is moved from (110, 120)")
    found_m = Scene.load(tmp_path / "corrected").device_m[3]
    assert np.linalg.norm(found_m - small_scene.device_m[3]) < 15
