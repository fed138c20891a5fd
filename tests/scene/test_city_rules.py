"""What city.xml of a scene folder may say: all else is refused, with file and line."""

import shutil

import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.folder import read_city, read_triangles
from radiotwin.scene.mitsuba_xml import read_mitsuba_xml

GROUND = '<shape type="rectangle" id="g"><transform><scale value="50"/></transform><ref id="mat-concrete"/></shape>'


def add(folder, text, before="</scene>"):
    """city.xml with a text before its end."""
    path = folder / "city.xml"
    path.write_text(path.read_text().replace(before, text + before, 1))
    return path


@pytest.mark.parametrize(("text", "message"), [
    ('<default name="x" value="meshes"/>', "<default> is not allowed"),
    ('<include filename="city.xml"/>', "<include> is not allowed"),
    ('<path value="meshes"/>', "<path> is not allowed"),
    ('<alias id="a" as="b"/>', "<alias> is not allowed"),
    ('<texture type="bitmap"/>', "<texture> is not allowed"),
    ('<plugin type="evil"/>', "<plugin> is not allowed"),
    ('<medium type="evil"/>', "<medium> is not allowed"),
    ('<bsdf type="evil" id="e"/>', "a bsdf of type 'evil' is not read"),
    ('<bsdf type="../../x/evil" id="e"/>', "a bsdf of type '../../x/evil' is not read"),
    ('<bsdf type="diffuse" id="e"><texture name="reflectance" type="bitmap"/></bsdf>', "<texture> is not allowed"),
    ('<bsdf type="radio-material" id="e"><float name="thickness" value="thick"/></bsdf>', "1 finite number"),
    ('<bsdf type="radio-material" id="e"><float name="conductivity" value="1_0"/></bsdf>', "1 finite number"),
    ('<bsdf type="radio-material" id="e"><rgb name="color" value="1 2"/></bsdf>', "1 or 3 finite number"),
    ('<shape type="evil" id="e"/>', "a shape of type 'evil' is not read; allowed are ply, obj"),
    ('<shape id="e"/>', "a shape of type '' is not read"),
    ('<shape type="cube" id="e"><emitter type="area"/></shape>', "<emitter> is not allowed in <shape>"),
    ('<shape type="sphere"><point name="center" x="1" y="two"/></shape>', "'two' where 1 finite"),
    ('<shape type="cube"><transform><animation/></transform></shape>', "<animation> is not allowed"),
    ('<shape type="ply"><string name="filename" value="$x/ground.ply"/></shape>', "has a \\$, which is not allowed"),
    ('<shape type="cube" id="$x"/>', "has a \\$"), ('<shape type="cube" to_world="1"/>', "'to_world', which is not"),
])
def test_what_is_refused(scene_folder, text, message):
    with pytest.raises(BadInput, match=rf"city\.xml, line \d+: .*{message}"):
        read_city(add(scene_folder, "\n" + text + "\n"))


def test_a_file_name_is_checked_as_it_is_used(scene_folder, tmp_path):
    """Seen: a decoy in the folder satisfied the check, and a parameter led elsewhere."""
    shutil.copy(scene_folder / "meshes" / "ground.ply", tmp_path / "secret.ply")
    (scene_folder / "$x").mkdir()
    shutil.copy(scene_folder / "meshes" / "ground.ply", scene_folder / "$x" / "secret.ply")
    declared = '<default name="x" value=".."/><shape type="ply"><string name="filename" value="$x/secret.ply"/></shape>'
    with pytest.raises(BadInput, match="<default> is not allowed"):
        read_triangles(add(scene_folder, declared))
    with pytest.raises(BadInput, match="leads out of"):  # as a foreign file, for build-scene
        read_mitsuba_xml(scene_folder / "city.xml")


def test_what_is_read_by_hand(scene_folder):
    """Every element and type that the rules allow."""
    before = len(read_city(scene_folder / "city.xml"))
    add(scene_folder, GROUND + '''
      <bsdf type="twosided" id="mat-itu_brick"><bsdf type="diffuse"><rgb name="reflectance" value="0.1, 0.2, 0.3"/></bsdf></bsdf>
      <bsdf type="radio-material" id="own"><float name="relative_permittivity" value="5"/><integer name="n" value="1"/></bsdf>
      <shape type="merge"><shape type="cube" id="c"><transform name="to_world"><rotate z="1" angle="20"/>
        <matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/><translate x="5"/></transform>
        <ref id="mat-itu_brick" name="bsdf"/></shape></shape>
      <shape type="sphere" id="s"><float name="radius" value="3"/><point name="center" value="1 2 40"/>
        <boolean name="flip" value="false"/><ref id="own" name="bsdf"/></shape>''')
    shapes = read_city(scene_folder / "city.xml")
    assert [shape.name for shape in shapes[before:]] == ["g", "c", "s"]
    assert [shape.material.itu for shape in shapes[before:]] == ["concrete", "brick", None]
