"""What goes into a page: packed numbers, simplified cities, thinned maps, residuals and flights."""

import base64
import dataclasses

import numpy as np
import pandas as pd
import pytest

from radiotwin.maps.radiomap import RadioMap
from radiotwin.report import Run, read_run
from radiotwin.report import viewer_data as layers
from radiotwin.report.viewer_data import NOT_DETECTED, pack, pack_db
from radiotwin.twin import Twin, TwinDevice
from radiotwin.twin.model.model import FittedModel


def unpacked(packed):
    return np.frombuffer(base64.b64decode(packed["data"]), packed["type"]).reshape(packed["shape"])


def test_levels_are_kept_to_a_hundredth_of_a_decibel():
    level_db = np.array([[-78.126, np.nan], [0.0, -400.0]])
    assert unpacked(pack_db(level_db)).tolist() == [[-7813, NOT_DETECTED], [0, -32767]]
    assert unpacked(pack(np.array([1, 2], dtype=">i4"))).tolist() == [1, 2]


def test_blocks_have_the_citys_volume_and_a_closed_surface():
    height_m = np.array([[0, 5.0, 5.0], [0, 12.0, 0.2], [3.0, 0, 0]])
    vertices_m, faces = layers.blocks(height_m, 10.0, -20.0, 4.0)
    triangles_m = vertices_m[faces]
    area_m2 = 0.5 * np.cross(triangles_m[:, 1] - triangles_m[:, 0], triangles_m[:, 2] - triangles_m[:, 0])
    flat = np.abs(area_m2[:, 2]) > 0
    # Roofs: each cell once. Walls: every step in height between neighbours once, over a side of 4 m.
    assert np.abs(area_m2[flat, 2]).sum() == pytest.approx(4 * 16)
    assert (triangles_m[flat, :, 2].mean(axis=1) * np.abs(area_m2[flat, 2])).sum() == pytest.approx(25 * 16)
    padded = np.pad(np.where(height_m > 0.5, height_m, 0), 1)
    steps_m = sum(np.abs(np.diff(padded, axis=axis)).sum() for axis in (0, 1))
    assert np.linalg.norm(area_m2[~flat], axis=1).sum() == pytest.approx(4 * steps_m)
    assert triangles_m[..., 0].min() == 10 and triangles_m[..., 0].max() == 22 and triangles_m[..., 1].min() == -20


def test_a_city_with_too_many_triangles_is_drawn_as_blocks(small_scene, monkeypatch):
    whole, note = layers.city_mesh(small_scene)
    assert note == "" and unpacked(whole["i"]).size < len(small_scene.city.faces)  # without the ground
    monkeypatch.setattr(layers, "MAX_FACES", 20)
    blocks, note = layers.city_mesh(small_scene)
    assert "blocks" in note
    assert unpacked(blocks["z"]).max() == pytest.approx(small_scene.city.vertices[:, 2].max(), abs=0.01)


def test_large_maps_are_thinned_and_the_page_says_so(run_folder, monkeypatch):
    run = read_run(run_folder)
    assert layers.map_layers(run)[0]["step_m"] == 20 and run.notes == []
    monkeypatch.setattr(layers, "MAX_VALUES", 3000)
    thinned = layers.map_layers(run)[0]
    step = int(thinned["step_m"] / 20)
    assert step > 1 and f"every {step}th" in run.notes[0]
    expected_db = np.nan_to_num(run.maps["truth"].gain_db[..., ::step, ::step], nan=NOT_DETECTED / 100)
    np.testing.assert_allclose(unpacked(thinned["fields"][0]["values"]) / 100, expected_db, atol=0.006)


def test_the_error_counts_only_what_the_truth_detects(run_folder):
    run = read_run(run_folder)
    truth, twin = run.maps["truth"], run.maps["twin"]
    fields = {field["label"]: field for field in layers.map_layers(run)[1]["fields"]}
    error = unpacked(fields["twin: error (model − truth)"]["values"])
    np.testing.assert_array_equal(error == NOT_DETECTED, np.isnan(truth.gain_db))
    assert fields["twin: error (model − truth)"]["low"] == -fields["twin: error (model − truth)"]["high"]
    stranger = RadioMap(twin.dataset.assign_coords(device=[f"x{n}" for n in range(len(twin.devices))]))
    assert np.isnan(layers._error_db(stranger, truth, step=1)).all()


def links(n=6):
    rng = np.random.default_rng(1)
    table = pd.DataFrame({f"{end}_{axis}_m": rng.uniform(0, 100, n) if end == "receiver" else 5.0
                          for end in ("receiver", "device") for axis in "xyz"})
    return table.assign(time_s=np.arange(n) * 1.0, flight="f0", receiver="u", device=["b", "a"] * (n // 2), los=1,
                        before_db=[4.0, np.nan, -3.0, 2.0, 1.0, 0.0][:n], after_db=0.5)


def test_residuals_stand_where_the_moving_end_is(tmp_path):
    run = Run(tmp_path, residuals=links())
    layer = layers.link_layer(run)
    np.testing.assert_allclose(unpacked(layer["x"]), run.residuals["receiver_x_m"], rtol=1e-6)
    assert layer["devices"] == ["a", "b"] and unpacked(layer["device"]).tolist() == [1, 0] * 3
    before, after = layer["fields"]
    assert unpacked(before["values"]).tolist() == [400, NOT_DETECTED, -300, 200, 100, 0]
    assert before["high"] == after["high"] == 4.0 and after["interval_db"] == [[0.0, 0.0], [0.5, 0.5]]
    assert layer["flights"] == ["f0"] and unpacked(layer["time"]).tolist() == [0, 1, 2, 3, 4, 5]
    *_, measured = layers.link_layer(Run(tmp_path, residuals=links().assign(measured_db=-80.0)))["fields"]
    assert measured["kind"] == "gain" and unpacked(measured["values"]).tolist() == [-8000] * 6
    x_min, x_max, *_ = layers.bounds_m(run)
    assert x_min <= 5.0 and x_max >= run.residuals["receiver_x_m"].max()


def test_the_strongest_paths_of_the_links_with_the_largest_residuals_join_both_ends(small_scene, monkeypatch):
    table = links().assign(receiver_z_m=60.0, after_db=[np.nan, 9.0, 0, 0, 0, 0])
    table.loc[3, "receiver_x_m"] = np.nan
    monkeypatch.setattr(layers, "MAX_PATH_LINKS", 2)
    found = {name: unpacked(packed) for name, packed in layers.path_layer(small_scene, table).items()}
    assert set(found["link"]) == {0, 1}, "9 dB, of a reading that is predicted afterwards alone, and 4 dB"
    assert np.bincount(found["link"]).max() == layers.MAX_PATHS and found["end"][-1] == len(found["points"])
    starts = found["points"][np.r_[0, found["end"][:-1]]]
    ends = found["points"][found["end"] - 1]
    np.testing.assert_allclose(starts, 5.0)
    np.testing.assert_allclose(ends, table.iloc[found["link"]][[f"receiver_{axis}_m" for axis in "xyz"]], rtol=1e-6)


def test_levels_are_in_the_unit_that_was_measured(run_folder):
    run = read_run(run_folder)
    run.maps = {"twin": run.maps["twin"]}
    run.twin = dataclasses.replace(run.twin, level="rssi_dbm")
    run.maps["twin"].dataset.attrs["tx_power_dbm"] = 20.0
    field = layers.map_layers(run)[0]["fields"][0]
    assert field["title"] == "received power [dBm]" and field["unit"] == "dBm"
    np.testing.assert_allclose(unpacked(field["values"]) / 100, run.maps["twin"].gain_db + 20.0, atol=0.006)


def test_flights_start_at_zero_and_keep_their_order(tmp_path):
    tracks = pd.DataFrame({"flight": ["f0", "f0", "f1", "f1"], "uav": ["a", "a", "a", "b"],
                           "time_s": [12.0, 10, 50, 51], "x_m": [2.0, 1, 3, 4], "y_m": 0.0, "z_m": np.nan})
    first, second = layers.flight_layer(Run(tmp_path, tracks=tracks))
    assert (first["name"], first["start_s"], first["end_s"]) == ("f0", 10, 2) and len(second["uavs"]) == 2
    assert unpacked(first["uavs"][0]["x"]).tolist() == [1, 2] and unpacked(second["uavs"][1]["t"]).tolist() == [1]


def test_devices_and_tracks_beyond_what_can_be_drawn_are_counted(run_folder, monkeypatch):
    run = read_run(run_folder)
    monkeypatch.setattr(layers, "MAX_MAP_DEVICES", 3)
    monkeypatch.setattr(layers, "MAX_TRACKS", 3)
    shown = layers.map_layers(run)
    assert [len(each["devices"]) for each in shown] == [3, 3] and len(shown[1]["fields"]) == 4
    assert unpacked(shown[1]["fields"][-1]["values"]).shape[0] == 3
    assert [len(each["uavs"]) for each in layers.flight_layer(run)] == [2, 1]
    assert [note.split(" are shown")[0] for note in run.notes] == [
        "Of the map truth the first 3 of 7 devices", "Of the map twin the first 3 of 7 devices",
        "Of 4 tracks of UAVs the first 3"]


def test_what_a_close_loop_found_stands_in_the_city(tmp_path):
    outline = [[0, 0], [10, 0], [10, 20], [0, 0]]
    effects = [{"name": "missing_obstacle", "parameters": {"height_m": {"value": 38.0}},
                "places": [{"x_m": 5.0, "y_m": 9.0, "outline_m": outline}]},
               {"name": "device_gain_offset", "parameters": {}, "places": [{"device": "d1", "x_m": 0.0, "y_m": 0.0}]},
               {"name": "mapped_vegetation", "is_declared": True, "parameters": {}, "places": [{"x_m": 0.0, "y_m": 0.0}]}]
    assert layers.found_layer(Run(tmp_path, closeloop={"effects": effects})) == [
        {"text": "missing obstacle", "x": 5.0, "y": 9.0, "outline": outline, "height": 38.0}]
    assert layers.found_layer(Run(tmp_path)) == []


def test_positions_that_no_city_has_are_not_drawn(tmp_path):
    far = [TwinDevice("a", 1e16, 0.0, 1.5, "anchor", True, 0.0, None),
           TwinDevice("b", 5.0, 5.0, 1.5, "anchor", True, 0.0, None)]
    run = Run(tmp_path, twin=Twin(FittedModel.of_channel(None), far, "gain_db", None))
    assert [each["true"] for each in layers.device_layer(run)] == [None, [5.0, 5.0, 1.5]]
    assert layers.bounds_m(run) == [4.0, 6.0, 4.0, 6.0], "a browser would count to 1e16"
