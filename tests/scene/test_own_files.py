"""A scene may read files of its own folder only."""

import os
import shutil
import warnings

import pytest

from radiotwin.errors import BadInput
from radiotwin.scene import Scene
from radiotwin.scene.build import build_scene
from radiotwin.scene.mitsuba_xml import read_mitsuba_xml
from radiotwin.scene.presets import build_preset
from radiotwin.trace import SolverSettings, trace_map


def with_mesh(city, name, to):
    """The file, its first mesh named `name`, which stands for the link or path `to`."""
    path = city.write()
    path.write_text(path.read_text().replace('value="mesh0.ply"', f'value="{name}"'))
    return path


@pytest.fixture
def outside(town, tmp_path):
    shutil.copy(town.write().parent / "mesh0.ply", tmp_path / "secret.ply")
    return tmp_path / "secret.ply"


@pytest.mark.parametrize("name", ["../secret.ply", "a/../../secret.ply", "{absolute}", "link.ply", "folder/secret.ply"])
def test_no_way_leads_out_of_a_foreign_city(town, outside, tmp_path, name):
    (town.folder / "link.ply").symlink_to(outside)
    (town.folder / "folder").symlink_to(tmp_path)
    path = with_mesh(town, name.format(absolute=outside), outside)
    with pytest.raises(BadInput, match=r"line \d+: .*leads out of"):
        build_scene(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_includes_and_folders_stay_inside(town, outside, tmp_path):
    (tmp_path / "part.xml").write_text("<scene/>")
    town.add_xml('<include filename="../part.xml"/>')
    with pytest.raises(BadInput, match="leads out of"):
        read_mitsuba_xml(town.write())
    town.shapes[-1] = '<path value=".."/><shape type="ply"><string name="filename" value="secret.ply"/></shape>'
    with pytest.raises(BadInput, match="leads out of"):
        read_mitsuba_xml(town.write())


def test_links_within_the_folder_are_fine(town, tmp_path):
    (town.folder / "link.ply").symlink_to(town.folder / "mesh0.ply")
    assert not build_scene(with_mesh(town, "link.ply", None), tmp_path / "out").tracing_would_fail


@pytest.mark.parametrize("name", ["scene.toml", "city.xml"])
def test_a_scene_is_in_its_folder(scene_folder, tmp_path, name):
    shutil.move(scene_folder / name, tmp_path / name)
    (scene_folder / name).symlink_to(tmp_path / name)
    with pytest.raises(BadInput, match="leads out of"):
        Scene.load(scene_folder)


@pytest.mark.parametrize(("old", "new"), [
    ("meshes/ground.ply", "../x.ply"), ("</scene>", '<include filename="../more.xml"/></scene>'), ("", "")])
def test_no_way_leads_out_of_a_scene_folder(scene_folder, tmp_path, old, new):
    mesh, path = scene_folder / "meshes" / "ground.ply", scene_folder / "city.xml"
    shutil.copy(mesh, tmp_path / "x.ply")
    (tmp_path / "more.xml").write_text("<scene/>")
    if old:
        path.write_text(path.read_text().replace(old, new))
    else:
        mesh.unlink()
        mesh.symlink_to(tmp_path / "x.ply")
    with pytest.raises(BadInput, match="leads out of|not allowed"):
        Scene.load(scene_folder)


def test_a_file_without_an_end_that_nothing_names_is_not_read(small_scene, scene_folder):
    (scene_folder / "meshes" / "zero").symlink_to("/dev/urandom")
    assert Scene.load(scene_folder).content_hash() == small_scene.content_hash()


@pytest.mark.parametrize("what", ["city.xml", "scene.toml", "meshes/ground.ply"])
@pytest.mark.parametrize("spoil", ["pipe", "device", "folder"])
def test_every_file_of_a_scene_is_a_regular_one(scene_folder, what, spoil):
    (scene_folder / what).unlink()
    if spoil == "pipe":
        os.mkfifo(scene_folder / what)
    elif spoil == "device":
        (scene_folder / what).symlink_to("/dev/zero")
    else:
        (scene_folder / what).mkdir()
    with pytest.raises(BadInput, match="not a regular file|is a folder|leads out of"):
        Scene.load(scene_folder)


def test_a_trace_writes_nothing_outside(scene_folder, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (scene_folder / "cache").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(BadInput, match="cache.trace-.* leads out of"):
        trace_map(Scene.load(scene_folder), SolverSettings(), tmp_path / "truth.nc")
    assert not list((tmp_path / "elsewhere").iterdir())


@pytest.mark.seconds
def test_declarations_that_a_user_has_edited_are_kept_beside_a_new_scene(tmp_path):
    build_preset("small", tmp_path / "scene")
    declared = tmp_path / "scene" / "scene.toml"
    edited = declared.read_text(encoding="utf-8").replace("battery = ", "battery = 1")
    declared.write_text(edited, encoding="utf-8")
    with pytest.warns(UserWarning, match="scene.toml is kept as scene.toml.old"):
        build_preset("small", tmp_path / "scene")
    assert (tmp_path / "scene" / "scene.toml.old").read_text(encoding="utf-8") == edited
    assert declared.read_text(encoding="utf-8") != edited
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        build_preset("small", tmp_path / "scene")  # nothing has been edited since
    assert (tmp_path / "scene" / "scene.toml.old").read_text(encoding="utf-8") == edited
