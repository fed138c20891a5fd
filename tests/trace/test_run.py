"""The orchestration of a trace: cache, resumption, censoring, attributes. Gains come from a law here."""

import shutil

import numpy as np
import pytest

from radiotwin.errors import BadInput, RunFailed
from radiotwin.io.forms import Origin
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import read_truth
from radiotwin.scene import Scene
from radiotwin.scene.config import write_config
from radiotwin.scene.ply import read_ply, write_ply
from radiotwin.trace import SolverSettings, trace_map
from radiotwin.trace.run import truth_path

SETTINGS = SolverSettings(batch_receivers=100)
BATCHES = 6  # of 2 x 16 x 16 positions
DEVICES = 7
COUNTS = ("detected", "without_path", "below_sensitivity", "inside_building")


def with_radio(scene, **changes):
    radio = scene.config.radio.model_copy(update=changes)
    write_config(scene.config.model_copy(update={"radio": radio}), scene.folder / "scene.toml")
    return Scene.load(scene.folder)


def batch_files(scene):
    return sorted((scene.folder / "cache").glob("trace-*/device-*-batch-*.npy"))


def test_map_holds_the_gains_of_every_link_and_says_what_was_done(own_scene, law, tmp_path):
    scene = with_radio(own_scene, sensitivity_dbm=-110.0)
    returned = trace_map(scene, SETTINGS, tmp_path / "truth.nc")
    read = RadioMap.load(tmp_path / "truth.nc")
    assert np.array_equal(read.gain_db, returned.gain_db, equal_nan=True)
    assert read.devices == [device.device for device in scene.config.devices]
    raw_db = np.stack([law(None, 2.4e9, SETTINGS).solve(device_m, scene.lattice.positions_m)
                       for device_m in scene.device_m]).reshape(read.gain_db.shape)
    detected = raw_db >= scene.config.gain_limit_db
    assert np.array_equal(np.isfinite(read.gain_db), detected)
    assert read.gain_db[detected] == pytest.approx(raw_db[detected], abs=1e-4)
    attributes = returned.dataset.attrs
    expected = {"source": "raytrace", "frequency_hz": 2.4e9, "scene_hash": scene.content_hash(), "combining": "power",
                "max_depth": SETTINGS.max_depth, "noise_floor_db": 0}  # the law has no noise
    assert {name: attributes[name] for name in expected} == expected and attributes["sionna_rt_version"]
    counts = [attributes[f"links_{name}"] for name in COUNTS]
    assert sum(counts) == DEVICES * 512 and min(counts[:3]) > 0
    part = trace_map(scene, SETTINGS, tmp_path / "part.nc", devices=["d4", "d1"])
    assert part.devices == ["d4", "d1"] and np.array_equal(part.gain_db, returned.gain_db[[4, 1]], equal_nan=True)
    with pytest.raises(BadInput, match="'d99' is not in .*it has d0, d1"):
        trace_map(scene, SETTINGS, tmp_path / "truth.nc", devices=["d99"])


def test_only_what_is_missing_damaged_or_asked_otherwise_is_solved(own_scene, law, tmp_path):
    """A finished map needs no cache; a part of the cache is enough; other settings, devices or geometry are solved anew."""
    path = tmp_path / "truth.nc"

    def calls(target, settings=SETTINGS, devices=None):
        law.calls = 0
        made = trace_map(Scene.load(own_scene.folder), settings, target, devices)
        return law.calls, made

    solved, first = calls(path)
    files = batch_files(own_scene)
    assert solved >= len(files) == DEVICES * BATCHES
    assert calls(tmp_path / "again.nc")[0] == 0 and (tmp_path / "again.nc").read_bytes() == path.read_bytes()
    files[3].unlink()
    files[8].write_bytes(files[8].read_bytes()[:100])
    np.save(files[11], np.zeros(3))
    solved, again = calls(tmp_path / "repaired.nc")
    assert solved == 3 and again.gain_db.tobytes() == first.gain_db.tobytes()
    assert calls(path, SolverSettings(batch_receivers=100, seed=2))[0] >= DEVICES * BATCHES
    assert set(files) < set(batch_files(own_scene))
    shutil.rmtree(own_scene.folder / "cache")
    solved, kept = calls(tmp_path / "again.nc")
    assert solved == 0 and kept.gain_db.tobytes() == first.gain_db.tobytes()
    assert calls(tmp_path / "again.nc", devices=["d1"])[0] > 0
    with open(own_scene.xml_path, "a") as xml:
        xml.write("<!-- changed -->")
    assert calls(tmp_path / "again.nc")[0] >= DEVICES * BATCHES


def test_a_map_that_physics_does_not_allow_is_not_written(own_scene, law, tmp_path):
    law.offset_db = 5.0
    with pytest.raises(RunFailed, match="from free space"):
        trace_map(own_scene, SETTINGS, tmp_path / "truth.nc")
    assert not list(tmp_path.glob("*.nc"))


def test_an_impossible_link_is_left_out_counted_and_told(own_scene, law, tmp_path):
    whole = trace_map(own_scene, SETTINGS, tmp_path / "whole.nc")
    shutil.rmtree(own_scene.folder / "cache")
    index = np.flatnonzero(np.isfinite(whole.gain_db.reshape(DEVICES, -1)).all(axis=0))[:3]
    law.impossible_m = own_scene.lattice.positions_m[index].tolist()
    for name in ("map.nc", "again.nc"):
        with pytest.warns(UserWarning, match=f"{3 * DEVICES} of {DEVICES * 512} links carry more power than their paths"):
            trace_map(own_scene, SETTINGS, tmp_path / name)
    assert (tmp_path / "again.nc").read_bytes() == (tmp_path / "map.nc").read_bytes()
    read = RadioMap.load(tmp_path / "map.nc")
    found, before = read.dataset.attrs, whole.dataset.attrs
    assert [found[f"links_{name}"] - before[f"links_{name}"] for name in (*COUNTS, "impossible")] \
        == [-3 * DEVICES, 0, 0, 0, 3 * DEVICES]
    expected_db = whole.gain_db.copy().reshape(DEVICES, -1)
    expected_db[:, index] = np.nan
    assert np.array_equal(read.gain_db.reshape(DEVICES, -1), expected_db, equal_nan=True)
    assert np.isfinite(found["noise_floor_db"])


def test_a_place_on_the_globe_that_is_given_later_is_written_into_the_map(own_scene, law, tmp_path):
    path = tmp_path / "truth.nc"
    trace_map(own_scene, SETTINGS, path)
    solved, plain = law.calls, RadioMap.load(path)
    config = own_scene.config
    for latitude_deg in (48.1, 48.2):
        origin = Origin(latitude_deg=latitude_deg, longitude_deg=11.5)
        write_config(config.model_copy(update={"origin": origin}), own_scene.folder / "scene.toml")
        trace_map(Scene.load(own_scene.folder), SETTINGS, path)
        assert RadioMap.load(path).dataset.attrs["origin_latitude_deg"] == latitude_deg
    write_config(config, own_scene.folder / "scene.toml")
    trace_map(Scene.load(own_scene.folder), SETTINGS, path)
    assert law.calls == solved and RadioMap.load(path).dataset.identical(plain.dataset)


def test_positions_inside_buildings_have_no_gain(own_scene, law, tmp_path):
    lattice = own_scene.config.lattice.model_copy(update={"altitudes_m": [5.0]})
    write_config(own_scene.config.model_copy(update={"lattice": lattice, "uavs": []}), own_scene.folder / "scene.toml")
    scene = Scene.load(own_scene.folder)
    inside = scene.city.inside(scene.lattice.positions_m)
    assert inside.sum() > 20
    radio_map = trace_map(scene, SETTINGS, tmp_path / "truth.nc")
    assert np.isnan(radio_map.gain_db.reshape(DEVICES, -1)[:, inside]).all()
    assert radio_map.dataset.attrs["links_inside_building"] == DEVICES * inside.sum()


def test_a_truth_that_leads_out_of_the_scene_is_neither_read_nor_replaced(own_scene, law, tmp_path):
    trace_map(own_scene, SETTINGS, tmp_path / "elsewhere.nc")
    (own_scene.folder / "truth.nc").symlink_to(tmp_path / "elsewhere.nc")
    with pytest.raises(BadInput, match="leads out of"):
        read_truth(own_scene)
    with pytest.raises(BadInput, match="leads out of"):
        trace_map(own_scene, SETTINGS)


def test_long_lists_of_devices_have_files_of_their_own(own_scene):
    names = [f"device{number:02d}" for number in range(20)]
    first, other = truth_path(own_scene, names[:12]), truth_path(own_scene, [*names[:11], names[12]])
    assert first != other and first == truth_path(own_scene, names[:12]) and len(first.name) < 130
    assert truth_path(own_scene, ["d0", "d1"]).name == "truth-d0-d1.nc" and truth_path(own_scene).name == "truth.nc"


def test_a_mesh_anywhere_in_the_folder_counts(own_scene):
    """A stranger's city.xml may name meshes outside `meshes`; a changed one is another scene."""
    folder = own_scene.folder
    before = own_scene.content_hash()
    mesh = sorted((folder / "meshes").glob("*.ply"))[0]
    (folder / "geo").mkdir()
    mesh.rename(folder / "geo" / mesh.name)
    xml = (folder / "city.xml").read_text()
    assert f"meshes/{mesh.name}" in xml
    (folder / "city.xml").write_text(xml.replace(f"meshes/{mesh.name}", f"geo/{mesh.name}"))
    moved = Scene.load(folder).content_hash()
    vertices, (faces,) = read_ply(folder / "geo" / mesh.name)
    write_ply(folder / "geo" / mesh.name, vertices * [1, 1, 2], faces)
    assert len({before, moved, Scene.load(folder).content_hash()}) == 3


def test_the_map_solver_needs_cells(own_scene, law):
    lattice = own_scene.config.lattice.model_copy(update={"step_m": 1000.0})
    one = Scene(own_scene.folder, own_scene.config.model_copy(update={"lattice": lattice, "uavs": []}))
    with pytest.raises(BadInput, match="one position only"):
        trace_map(one, SolverSettings(solver="map"), own_scene.folder / "truth.nc")
