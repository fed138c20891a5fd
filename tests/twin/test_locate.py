"""Devices in a file: few links of many receivers and blanks count, and bad input is one message."""

import json

import numpy as np
import pandas as pd
import pytest

from radiotwin.closeloop.output.corrected_twin import corrected_twin
from radiotwin.closeloop.run import close_loop
from radiotwin.errors import BadInput
from radiotwin.inference.gaussian import LogDistanceLine
from radiotwin.io.forms import Origin
from radiotwin.links.measurements import Measurements, read_measurements
from radiotwin.maps.survey import fly_survey, segmented_truth
from radiotwin.propagation.laws.image_paths import ImagePaths
from radiotwin.propagation.laws.log_distance import LogDistance, SegmentedLogDistance
from radiotwin.twin import Twin, TwinDevice
from radiotwin.twin import locate as module
from radiotwin.twin.model.model import FittedModel

LIMIT_DB, GATEWAYS, PACKETS = -115.0, 30, 3


def test_a_device_is_found_by_three_packets_of_each_gateway_and_by_the_silence_of_others(monkeypatch):
    rng = np.random.default_rng(0)
    gateway_m, there_m = rng.uniform(0, 3000, (GATEWAYS, 2)), np.array([1400.0, 1600.0])
    gateway = np.repeat(np.arange(GATEWAYS), PACKETS)
    distance_m = np.hypot(*(gateway_m[gateway] - there_m).T)
    gain_db = -40 - 25 * np.log10(distance_m) + rng.normal(0, 2, len(gateway))
    gain_db[gain_db < LIMIT_DB] = np.nan
    table = pd.DataFrame({
        "time_s": np.arange(len(gateway), dtype=float), "flight": "f", "receiver": [f"g{i}" for i in gateway],
        "receiver_x_m": gateway_m[gateway, 0], "receiver_y_m": gateway_m[gateway, 1], "receiver_z_m": 1.5,
        "device": "x", "gain_db": gain_db})
    devices = pd.DataFrame({"device": ["x"], "x_m": np.nan, "y_m": np.nan, "z_m": 1.5, "role": "unknown"})
    channel = LogDistance(LogDistanceLine(-40.0, 2.5, 2.0))
    fitted = FittedModel(channel, (), (), np.zeros(2), np.array([2.0]), 30.0, np.array([[100.0, 100.0, 1.5]]), ("g0",),
                         np.nan, 0.0)
    twin = Twin(fitted, [TwinDevice.anchor("a", 100.0, 100.0, 1.5)], "gain_db", LIMIT_DB)
    used, plain = [], module.locate

    def locate(model, links, *others):
        used.append(links)
        return plain(model, links, *others)
    monkeypatch.setattr(module, "locate", locate)
    found, _ = module.locate_devices(Measurements(table, devices), twin)
    silent = np.isnan(gain_db)
    assert 20 < silent.sum() < 70 and np.isnan(used[0].level_db).sum() == silent.sum()
    assert np.all(used[0].limit_db == LIMIT_DB) and found["links"].tolist() == [GATEWAYS * PACKETS]
    assert np.hypot(found["x_m"][0] - there_m[0], found["y_m"][0] - there_m[1]) < 100


@pytest.mark.usefixtures("quick_report")
def test_the_command_finds_an_unknown_device_and_says_how_far_off_it_is(run, tmp_path, open_ground, only_effects):
    only_effects("device_gain_offset", "receiver_drift", "receiver_gain_offset")
    world = open_ground.fly(12)
    world.gain_db[world.receiver == 0] -= 6.0
    data = open_ground.measured(world)
    hidden = data.devices.copy()
    hidden.loc[4, ["x_m", "y_m"]] = np.nan
    hidden.loc[4, "role"] = "unknown"
    Measurements(data.table, hidden).save(tmp_path / "flight" / "measurements.csv")
    data.devices.to_csv(tmp_path / "truth.csv", index=False)
    done = run("close-loop flight/measurements.csv -o loop", tmp_path)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "loop" / "closeloop.json").read_text())
    assert report["effects"][0]["name"] == "receiver_gain_offset"
    done = run("locate flight/measurements.csv --twin loop/twin --truth truth.csv -o located.csv", tmp_path)
    assert done.returncode == 0, done.stderr
    located = pd.read_csv(tmp_path / "located.csv").iloc[0]
    assert located["device"] == "d4" and located["links"] == 720
    assert np.hypot(located["x_m"] - world.device_m[4, 0], located["y_m"] - world.device_m[4, 1]) < 15.0
    assert "wrote" in done.stdout and "How far off" in done.stdout


@pytest.mark.parametrize("role, twin, message", [
    ("anchor", "loop/twin", "role unknown"), ("unknown", "nowhere", "not a twin")])
def test_bad_input_is_one_message(run, tmp_path, open_ground, role, twin, message, monkeypatch, quick_report):
    data = open_ground.measured(open_ground.fly(13))
    data.save(tmp_path / "flight" / "measurements.csv")
    if role == "anchor":
        monkeypatch.setattr("radiotwin.closeloop.run.catalogue", list)  # whatever the loop would find
        loop = close_loop(data, base="log-distance")
        corrected_twin(loop, None).save(tmp_path / "loop" / "twin")
    done = run(f"locate flight/measurements.csv --twin {twin} -o located.csv", tmp_path)
    assert done.returncode == 2 and message in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "located.csv").exists()


@pytest.mark.parametrize("model", ["segmented_log_distance", "kriging", "paths"])
def test_a_twin_of_fit_locates_a_device_that_it_has_not_seen(run, tmp_path, small_scene, model):
    truth = segmented_truth(small_scene)
    fly_survey(small_scene, truth, flights=2, pattern="random-waypoint", seed=0).save(tmp_path / "all" / "measurements.csv")
    data = read_measurements(tmp_path / "all" / "measurements.csv")
    anchors = np.flatnonzero(data.is_anchor)
    lost = data.devices["device"][anchors[-1]]
    data.select(data.table["device"].to_numpy() != lost).save(tmp_path / "known" / "measurements.csv")
    hidden = data.devices.copy()
    hidden.loc[anchors[-1], ["x_m", "y_m"]] = np.nan
    hidden.loc[anchors[-1], "role"] = "unknown"
    Measurements(data.select(data.table["device"].to_numpy() == lost).table, hidden).save(tmp_path / "new" / "measurements.csv")
    done = run(f"fit known/measurements.csv --scene {small_scene.folder} --model {model} -o twin", tmp_path)
    assert done.returncode == 0, done.stderr
    done = run(f"locate new/measurements.csv --scene {small_scene.folder} --twin twin -o located.csv", tmp_path)
    assert done.returncode == 0, done.stderr
    located, true_m = pd.read_csv(tmp_path / "located.csv"), data.device_m[anchors[-1]]
    said = "the twin follows paths" if model == "paths" else "may be farther away than their radii say"
    assert located["device"].tolist() == [lost] and said in done.stdout and "no link is to devices d1, d2, d3, d4\n" in done.stdout
    assert np.hypot(located["x_m"][0] - true_m[0], located["y_m"][0] - true_m[1]) < 20.0


@pytest.mark.parametrize("channel", [SegmentedLogDistance(), ImagePaths()], ids=["law", "paths"])
def test_what_lacks_its_map_does_not_locate(channel):
    with pytest.raises(BadInput, match="made with a 3D map"):
        Twin(FittedModel.of_channel(channel), [], "gain_db", None).require_map(None)


ORIGIN = Origin(latitude_deg=48.0, longitude_deg=11.0, altitude_m=0.0)


def test_true_positions_are_metres_or_degrees(tmp_path):
    table = pd.DataFrame({"device": ["a", "b", "c"], "x_m": [0.0, 100.0, np.nan], "y_m": [0.0, -50.0, np.nan], "note": "kept"})
    table.to_csv(tmp_path / "metres.csv", index=False)
    found = module.read_truth(tmp_path / "metres.csv", None)
    pd.testing.assert_frame_equal(found, table[["device", "x_m", "y_m"]])
    # A degree of latitude is 111.2 km here, one of longitude 74.6 km (WGS84, by its radii of curvature).
    degrees = pd.DataFrame({"device": ["a", "b", "c"], "latitude": [48.0, 48.0 - 50 / 111_199, np.nan],
                            "longitude": [11.0, 11.0 + 100 / 74_625, np.nan]})
    degrees.to_csv(tmp_path / "degrees.csv", index=False)
    there = module.read_truth(tmp_path / "degrees.csv", ORIGIN)
    np.testing.assert_allclose(there[["x_m", "y_m"]], table[["x_m", "y_m"]], atol=0.2)


@pytest.mark.parametrize("text, message", [
    ("device,x\na,1\n", "column 'x': the unit of its numbers from 1 to 1 is not known"),
    ("device,x_m,y_m\na,1,2\na,3,4\n", "row 3, column device: 'a' occurs twice"),
    ("device,x_m,y_m\na,1,two\n", "row 2, column y_m: 'two' is not a number"),
    ("device,latitude,longitude\na,48,11\n", "need the origin of the frame of the twin")])
def test_a_table_of_true_positions_that_is_none_is_one_message(tmp_path, text, message):
    (tmp_path / "truth.csv").write_text(text)
    with pytest.raises(BadInput, match=message):
        module.read_truth(tmp_path / "truth.csv", None)
