"""Exports for other programs: read back, they are the same city with the same gains."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
import trimesh

from radiotwin.errors import BadInput
from radiotwin.scene import Scene
from radiotwin.scene.export import Y_UP, export_scene
from radiotwin.scene.folder import read_city


def test_the_folder_holds_the_same_bytes(small_scene, tmp_path):
    for _ in range(2):  # an export can be repeated
        export_scene(small_scene, tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"city.xml", "meshes", "devices.csv"}
    for path in (small_scene.xml_path, *small_scene.folder.glob("meshes/*")):
        assert (tmp_path / "out" / path.relative_to(small_scene.folder)).read_bytes() == path.read_bytes()
    devices = pd.read_csv(tmp_path / "out" / "devices.csv")
    assert devices[["x_m", "y_m", "z_m"]].to_numpy() == pytest.approx(small_scene.device_m)


@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_models_hold_the_same_triangles_and_materials(small_scene, tmp_path, suffix):
    """As trimesh reads them; OBJ goes through the command line, see tests/cli/test_formats_in.py."""
    export_scene(small_scene, tmp_path / f"city{suffix}")
    shapes = {shape.name: shape for shape in read_city(small_scene.xml_path)}
    model = trimesh.load(tmp_path / f"city{suffix}", process=False)
    assert {name: mesh.visual.material.name for name, mesh in model.geometry.items()} == {
        name: shape.material.name for name, shape in shapes.items()}
    for name, mesh in model.geometry.items():
        z_up = mesh.copy().apply_transform(np.linalg.inv(Y_UP))
        assert np.array_equal(np.float32(shapes[name].mesh.triangles), np.float32(z_up.triangles))


def test_gltf_is_one_file_with_y_up(small_scene, tmp_path):
    export_scene(small_scene, tmp_path / "city.gltf")
    assert [path.name for path in tmp_path.iterdir()] == ["city.gltf"]
    data = json.loads((tmp_path / "city.gltf").read_text())
    assert data["asset"]["version"] == "2.0" and all(b["uri"].startswith("data:") for b in data["buffers"])
    highest = max(accessor["max"][1] for accessor in data["accessors"] if accessor["type"] == "VEC3")
    assert highest == pytest.approx(small_scene.city.vertices[:, 2].max())


@pytest.mark.parametrize(("name", "message"), [("city.stl", "unknown format '.stl'"), ("taken", "holds notes.txt"),
                                               ("scene", "holds .*scene.toml|holds preview.png")])
def test_nothing_else_is_overwritten(small_scene, tmp_path, name, message):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "notes.txt").write_text("mine")
    shutil.copytree(small_scene.folder, tmp_path / "scene", ignore=shutil.ignore_patterns("cache"))
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(BadInput, match=message):
        export_scene(Scene.load(tmp_path / "scene"), tmp_path / name)
    assert sorted(tmp_path.rglob("*")) == before
