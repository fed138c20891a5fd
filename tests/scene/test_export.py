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
from radiotwin.scene.folder import CityShape, read_city, write_city

POINTS_M = np.array([[x, y, z] for x in (10.0, 130.0, 250.0) for y in (20.0, 170.0, 290.0) for z in (2.0, 55.0)])


def read_model(path):
    """Meshes and names of materials by the name of the shape, z up; glTF by trimesh, OBJ (whose objects trimesh joins
    by material) line by line."""
    if path.suffix == ".obj":
        return read_obj_objects(path)
    model = trimesh.load(path, process=False)
    meshes = {name: mesh.copy().apply_transform(np.linalg.inv(Y_UP)) for name, mesh in model.geometry.items()}
    return meshes, {name: mesh.visual.material.name for name, mesh in meshes.items()}


def read_obj_objects(path):
    vertices, faces, materials = [], {}, {}
    for kind, *words in (line.split() for line in path.read_text().splitlines()):
        if kind == "o":
            name = words[0]
            faces[name] = []
        elif kind == "usemtl":
            materials[name] = words[0]
        elif kind == "v":
            vertices.append([float(word) for word in words])
        elif kind == "f":
            faces[name].append([int(word) - 1 for word in words])
    meshes = {}
    for name, corners in faces.items():
        used = np.unique(corners)
        meshes[name] = trimesh.Trimesh(np.array(vertices)[used], np.array(corners) - used[0], process=False)
    library = path.with_suffix(".mtl").read_text().split()
    assert {word for before, word in zip(library, library[1:]) if before == "newmtl"} == set(materials.values())
    return meshes, materials


def test_the_folder_holds_the_same_bytes(small_scene, tmp_path):
    for _ in range(2):  # an export can be repeated
        export_scene(small_scene, tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"city.xml", "meshes", "devices.csv"}
    for path in (small_scene.xml_path, *small_scene.folder.glob("meshes/*")):
        assert (tmp_path / "out" / path.relative_to(small_scene.folder)).read_bytes() == path.read_bytes()
    devices = pd.read_csv(tmp_path / "out" / "devices.csv")
    assert devices[["x_m", "y_m", "z_m"]].to_numpy() == pytest.approx(small_scene.device_m)


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".obj"])
def test_models_hold_the_same_triangles_and_materials(small_scene, tmp_path, suffix):
    path = tmp_path / f"city{suffix}"
    export_scene(small_scene, path)
    shapes = read_city(small_scene.xml_path)
    meshes, materials = read_model(path)
    for shape in shapes:
        assert np.array_equal(np.float32(shape.mesh.triangles), np.float32(meshes[shape.name].triangles))
    assert materials == {shape.name: shape.material.name for shape in shapes}


def test_gltf_is_one_file_with_y_up(small_scene, tmp_path):
    export_scene(small_scene, tmp_path / "city.gltf")
    assert [path.name for path in tmp_path.iterdir()] == ["city.gltf"]
    data = json.loads((tmp_path / "city.gltf").read_text())
    assert data["asset"]["version"] == "2.0" and all(b["uri"].startswith("data:") for b in data["buffers"])
    highest = max(accessor["max"][1] for accessor in data["accessors"] if accessor["type"] == "VEC3")
    assert highest == pytest.approx(small_scene.city.vertices[:, 2].max())


@pytest.mark.llvm
def test_traced_gains_agree_before_and_after(small_scene, tmp_path):
    """Rationale: a city that leaves and comes back must be the same one for radio waves. Expected: gains of Sionna RT
    in the exported XML, and in cities put together again from glTF and OBJ, equal those of the scene."""
    from radiotwin.trace import SolverSettings
    from radiotwin.trace.solver import PathGains, import_sionna

    settings = SolverSettings(samples_per_src=10_000, batch_receivers=len(POINTS_M), max_num_paths_per_src=100_000)
    frequency_hz, device_m = small_scene.config.radio.frequency_hz, small_scene.device_m[0]
    before_db = PathGains(small_scene.xml_path, frequency_hz, settings).solve(device_m, POINTS_M)
    assert np.isfinite(before_db).sum() >= 9
    export_scene(small_scene, tmp_path / "out")
    assert len(import_sionna().load_scene(str(tmp_path / "out" / "city.xml")).objects) > 0  # plain, with no help
    folders = [tmp_path / "out"]
    for suffix in (".glb", ".obj"):
        export_scene(small_scene, tmp_path / f"city{suffix}")
        meshes, _ = read_model(tmp_path / f"city{suffix}")
        folders.append(tmp_path / suffix[1:])
        folders[-1].mkdir()
        write_city(folders[-1], [CityShape(shape.name, meshes[shape.name], shape.material)
                                 for shape in read_city(small_scene.xml_path)])
    for folder in folders:
        after_db = PathGains(folder / "city.xml", frequency_hz, settings).solve(device_m, POINTS_M)
        assert after_db == pytest.approx(before_db, abs=1e-9, nan_ok=True), folder


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
