"""The loop with a 3D map that has a building too many or too few, in worlds made of two plain laws."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from radiotwin.closeloop.output.corrected_twin import corrected_twin
from radiotwin.closeloop.output.result_file import make_report
from radiotwin.closeloop.run import close_loop
from radiotwin.links.measurements import Measurements
from radiotwin.report.closeloop_data import collect
from radiotwin.twin import Twin
from radiotwin.twin.model.model import FittedModel

LAWS = {True: (-30.0, -2.5, 1.4), False: (-35.0, -3.04, 2.2)}  # with line of sight, and without: level, slope, noise


def hits(corner_m, size_m, a_m, b_m):
    """Return whether segments pass through an upright box on the ground: points along them, one by one."""
    share = np.linspace(0, 1, 400)[:, None, None]
    points_m = a_m + share * (b_m - a_m)
    low, high = np.array([*corner_m, 0.0]), np.array([*corner_m, 0.0]) + size_m
    return ((points_m >= low) & (points_m <= high)).all(axis=2).any(axis=0)


def survey(scene, seed, blocked):
    """Four flights of two receivers over a scene; all devices are anchors. `blocked(device_m, receiver_m)` decides."""
    rng = np.random.default_rng(seed)
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    rows = []
    for flight in range(4):
        for receiver in range(2):
            position_m = rng.uniform((x_min + 20, y_min + 20), (x_max - 20, y_max - 20))
            heading = rng.uniform(0, 2 * np.pi)
            for slot in range(70):
                heading += rng.normal(0, 0.3)
                position_m = position_m + 8 * np.array([np.cos(heading), np.sin(heading)])
                position_m = np.clip(position_m, (x_min, y_min), (x_max, y_max))
                rows.append((flight, receiver, 100 * flight + slot, *position_m, 55.0 + 10 * receiver))
    flight, receiver, time_s, x, y, z = np.repeat(np.array(rows), len(scene.device_m), axis=0).T
    device = np.tile(np.arange(len(scene.device_m)), len(rows))
    receiver_m, device_m = np.column_stack([x, y, z]), scene.device_m[device]
    hidden = blocked(device_m, receiver_m)
    distance_m = np.linalg.norm(receiver_m - device_m, axis=1)
    gain_db = np.empty(len(device))
    for los, (level, slope, noise) in LAWS.items():
        mine = hidden != los
        gain_db[mine] = (level + 10 * slope * np.log10(distance_m) + rng.normal(0, noise, len(device)))[mine]
    gain_db[gain_db < scene.config.gain_limit_db] = np.nan
    names = [d.device for d in scene.config.devices]
    table = pd.DataFrame({
        "time_s": time_s, "flight": [f"f{int(i)}" for i in flight], "receiver": [f"r{int(i)}" for i in receiver],
        "receiver_x_m": x, "receiver_y_m": y, "receiver_z_m": z, "device": np.array(names)[device], "gain_db": gain_db})
    devices = pd.DataFrame({"device": names, "x_m": scene.device_m[:, 0], "y_m": scene.device_m[:, 1],
                            "z_m": scene.device_m[:, 2], "role": "anchor"})
    return Measurements(table, devices)


def run(measurements, scene):
    return make_report(close_loop(measurements, scene, "twin"))


def error_db(radio_map, scene, blocked):
    """Return the RMSE of a map against the two laws."""
    receiver_m = np.tile(scene.lattice.positions_m, (len(scene.device_m), 1))
    device_m = np.repeat(scene.device_m, len(scene.lattice.positions_m), axis=0)
    hidden, distance_m = blocked(device_m, receiver_m), np.linalg.norm(receiver_m - device_m, axis=1)
    truth_db = np.where(hidden, LAWS[False][0] + 10 * LAWS[False][1] * np.log10(distance_m),
                        LAWS[True][0] + 10 * LAWS[True][1] * np.log10(distance_m))
    error = radio_map.gain_db.reshape(-1) - truth_db
    return float(np.sqrt(np.nanmean(error**2)))


@pytest.mark.usefixtures("short_report")
def test_a_correct_map_is_left_alone(small_scene):
    report = run(survey(small_scene, 0, lambda a, b: ~small_scene.city.line_of_sight(a, b)), small_scene)
    assert report["verdict"] == "none", [effect["name"] for effect in report["effects"]]


@pytest.mark.usefixtures("quick_report")
def test_a_building_that_the_map_lacks_is_found_and_goes_into_the_twin(small_scene, tmp_path):
    middle_m = free_position(small_scene)
    box = (middle_m - 9.0, np.array([18.0, 18.0, 60.0]))
    measurements = survey(small_scene, 1, lambda a, b: ~small_scene.city.line_of_sight(a, b) | hits(*box, a, b))
    loop = close_loop(measurements, small_scene, "twin")
    report = make_report(loop)
    assert report["effects"][0]["name"] == "missing_obstacle"
    parameters = report["effects"][0]["parameters"]
    found_m = np.array([parameters["x_m"]["value"], parameters["y_m"]["value"]])
    assert np.linalg.norm(found_m - middle_m) < 8
    assert report["error"]["after"]["rmse_db"] < 0.85 * report["error"]["before"]["rmse_db"]
    corrected_twin(loop, small_scene).save(tmp_path / "twin")
    corrected = Twin.load(tmp_path / "twin")
    plain = replace(corrected, fitted=FittedModel.of_channel(corrected.channel))

    def blocked(a, b):
        return ~small_scene.city.line_of_sight(a, b) | hits(*box, a, b)

    before = error_db(plain.radio_map(small_scene), small_scene, blocked)
    assert error_db(corrected.radio_map(small_scene), small_scene, blocked) < 0.75 * before


@pytest.mark.slow
@pytest.mark.usefixtures("short_report")
def test_a_building_that_is_gone_is_named(small_scene):
    from radiotwin.effects.boxes import buildings
    from radiotwin.scene.citymap import CityMap

    label, centres_m = buildings(small_scene.city)
    seen = [(~small_scene.city.line_of_sight(a, b)).sum() for a, b in [samples(small_scene)]][0]
    most, gone = 0, 0
    for building in range(len(centres_m)):
        city = CityMap(small_scene.city.vertices, small_scene.city.faces[label != building])
        freed = seen - (~city.line_of_sight(*samples(small_scene))).sum()
        if freed > most:
            most, gone = freed, building
    city = CityMap(small_scene.city.vertices, small_scene.city.faces[label != gone])
    report = run(survey(small_scene, 2, lambda a, b: ~city.line_of_sight(a, b)), small_scene)
    assert report["effects"][0]["name"] == "removed_obstacle"
    parameters = report["effects"][0]["parameters"]
    assert (parameters["x_m"]["value"], parameters["y_m"]["value"]) == pytest.approx(tuple(centres_m[gone, :2]))


@pytest.mark.slow
@pytest.mark.usefixtures("quick_report")
def test_walls_that_are_off_are_no_cause_but_part_of_the_base(small_scene, tmp_path):
    moved = small_scene.city.with_vertices(small_scene.city.vertices + [1.5, -1.0, 0.0])

    def blocked(a, b):
        return ~moved.line_of_sight(a, b)

    measured = survey(small_scene, 0, blocked)
    loop = close_loop(measured, small_scene, "twin")
    assert [each.name for each in loop.before.whole.effects] == ["uncertain_sight"]
    report = make_report(loop)
    assert report["verdict"] != "effect" and report["effects"][0]["is_declared"]
    assert "uncertain_sight" not in collect(loop).added
    corrected_twin(loop, small_scene).save(tmp_path / "twin")
    twin = Twin.load(tmp_path / "twin")
    assert [each.name for each in twin.fitted.effects] == ["uncertain_sight"]
    plain = replace(twin, fitted=FittedModel.of_channel(twin.channel))
    before = error_db(plain.radio_map(small_scene), small_scene, blocked)
    assert error_db(twin.radio_map(small_scene), small_scene, blocked) < 0.98 * before


def samples(scene):
    rng = np.random.default_rng(0)
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    receiver_m = np.column_stack([rng.uniform(x_min, x_max, 400), rng.uniform(y_min, y_max, 400), np.full(400, 60.0)])
    return np.tile(scene.device_m, (400, 1)), np.repeat(receiver_m, len(scene.device_m), axis=0)


def free_position(scene):
    """Return the middle of the largest gap between buildings and devices, where a tower has room."""
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    x_m, y_m = (axis.ravel() for axis in np.meshgrid(np.arange(x_min + 40, x_max - 40, 4),
                                                     np.arange(y_min + 40, y_max - 40, 4)))
    built_x, built_y = (axis.ravel() for axis in np.meshgrid(np.arange(x_min, x_max, 3), np.arange(y_min, y_max, 3)))
    built = scene.city.height_at(built_x, built_y) > 2
    taken_m = np.vstack([np.column_stack([built_x, built_y])[built], scene.device_m[:, :2]])
    gap_m = np.array([np.hypot(*(taken_m - each).T).min() for each in np.column_stack([x_m, y_m])])
    best = int(gap_m.argmax())
    return np.array([x_m[best], y_m[best]])
