"""The city of a scene folder is read by one reader; the ray tracer gets only what it read."""


import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.scene import Scene
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.folder import read_city, write_city

FOREIGN = """
  <integrator type="no-such-plugin"/>
  <emitter type="envmap"><string name="filename" value="/etc/passwd"/></emitter>
  <sensor type="no-such-plugin"><film type="hdrfilm"><include filename="/etc/passwd"/></film></sensor>
</scene>"""


def change(folder, old, new):
    text = (folder / "city.xml").read_text()
    assert old in text
    (folder / "city.xml").write_text(text.replace(old, new, 1))
    return folder / "city.xml"


def written(xml_path, folder):
    folder.mkdir()
    write_city(folder, read_city(xml_path))
    return (folder / "city.xml").read_text()


def test_nothing_foreign_is_passed_on(scene_folder, tmp_path):
    before = (scene_folder / "city.xml").read_text()
    assert written(change(scene_folder, "\n</scene>", FOREIGN), tmp_path / "copy") == before


@pytest.mark.llvm
def test_mitsuba_does_not_read_the_file_of_the_scene(scene_folder, small_scene):
    """Rationale: Mitsuba loads plugins and files that an XML file names. Expected: it gets none of them."""
    from radiotwin.trace.solver import load_city

    city = load_city(change(scene_folder, "\n</scene>", FOREIGN), 2.4e9)
    assert len(city.objects) == len(load_city(small_scene.xml_path, 2.4e9).objects)


def test_a_transform_moves_the_shape_in_the_map_and_in_the_copy(scene_folder, small_scene, tmp_path):
    moved = '<transform name="to_world"><translate z="7"/></transform>'
    xml_path = change(scene_folder, '<boolean name="face_normals"', moved + '<boolean name="face_normals"')
    text = written(xml_path, tmp_path / "copy")
    assert "transform" not in text
    original, here, copied = (CityMap.from_xml(path / "city.xml").vertices
                              for path in (small_scene.folder, scene_folder, tmp_path / "copy"))
    np.testing.assert_allclose(here, copied, atol=1e-5)
    assert 0 < np.count_nonzero(np.isclose(here - original, [0, 0, 7]).all(axis=1)) < len(here)


@pytest.mark.parametrize("name", ["../../escape", "a/b", "mesh-ground", "GROUND", "__root__", "concrete"])
def test_names_become_safe_and_unique(scene_folder, tmp_path, name):
    xml_path = change(scene_folder, 'id="mesh-building_000"', f'id="{name}"')
    written(xml_path, tmp_path / "copy")
    assert not list(tmp_path.glob("escape*"))
    shapes = read_city(xml_path)
    names = {shape.name.lower() for shape in shapes} | {shape.material.name.lower() for shape in shapes}
    assert len(names) == len(shapes) + len({shape.material for shape in shapes})
    assert len(list((tmp_path / "copy" / "meshes").iterdir())) == len(shapes)


QUAD = ("ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n")


@pytest.mark.parametrize(("old", "new", "message"), [
    ('<string name="type" value="concrete"', '<string name="type" value="kryptonite"', "kryptonite.*does not exist"),
    ('<ref id="mat-concrete"', '<ref id="mat-none"', "'mat-none' is used but not declared"),
    ("meshes/ground.ply", "quad.ply", "not of triangles"), ("<shape", "<!-- <shape", "names no meshes")])
def test_a_city_that_cannot_be_traced_is_bad_input(scene_folder, old, new, message):
    (scene_folder / "quad.ply").write_text(QUAD)
    path = change(scene_folder, old, new)
    if "<!--" in new:
        path.write_text(path.read_text().replace("</scene>", "--></scene>"))
    with pytest.raises(BadInput, match=message):
        read_city(path)


def test_unknown_materials_do_not_matter_for_the_map(scene_folder):
    change(scene_folder, '<ref id="mat-concrete"', '<ref id="mat-none"')
    assert Scene.load(scene_folder).city.inside([[0.0, 0.0, -1.0]]).shape == (1,)
