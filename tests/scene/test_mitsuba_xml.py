import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.mitsuba_xml import Node, read_mitsuba_xml, read_numbers


def write(tmp_path, body, name="a.xml"):
    (tmp_path / name).write_text(f'<scene version="2.1.0">\n{body}\n</scene>')
    return tmp_path / name


@pytest.mark.parametrize(("text", "message"), [
    *((text, "line 1, column") for text in (
        "", "just text", "<scene>", '<scene><a b="1" b="2"/></scene>', "\x00\x01")),
    ('<scene>\n  <shape type="cube">\n  </shap>\n</scene>', r"a\.xml, line 3, column \d+: malformed XML \(mismatched tag\)"),
    ("<html><body/></html>", "begins with <html>"), (None, "a.xml")])
def test_anything_but_a_scene(tmp_path, text, message):
    if text is not None:
        (tmp_path / "a.xml").write_text(text)
    with pytest.raises(BadInput, match=message):
        read_mitsuba_xml(tmp_path / "a.xml")


STEP = '<shape type="cube"><transform>\n{}</transform></shape>'


@pytest.mark.parametrize(("body", "message"), [
    *((STEP.format(step), f"line 3.*{message}") for step, message in (
        ('<lookat origin="0,0,0" target="1,0,0" up="0,0,1"/>', "<lookat>.*translate, rotate, scale, matrix"),
        ('<translate x="two"/>', "'two'"), ('<translate value="1 2"/>', "1 or 3 finite"), ('<matrix value="1 2 3"/>', "9 or 16"),
        ('<rotate angle="30"/>', "no axis"), ('<scale value="nan"/>', "'nan'"),
        ('<scale z="$height"/>', r"'\$height'.*not declared"))),
    ('<include filename="a.xml"/>', "include each other"),
    ("".join(f'<path value="p{i}"/>' for i in range(200)), "101 folders to search; at most 100"),
    (f'<shape type="ply"><string name="filename" value="{"a" * 5000}"/></shape>', "is not the name of a file: it has 5,000 char")])
def test_what_no_scene_may_say(tmp_path, body, message):
    with pytest.raises(BadInput, match=message):
        read_mitsuba_xml(write(tmp_path, body))


def test_operations_apply_one_after_the_other(tmp_path):
    path = write(tmp_path, '<shape type="cube"><transform name="to_world"><translate value="1, 2, 3"/>'
                 '<scale value="2"/><rotate value="0 0 1" angle="90"/><rotate x="1" y="1" z="1" angle="120"/>'
                 '<matrix value="1 0 0 7  0 1 0 0  0 0 1 0  0 0 0 1"/></transform></shape>')
    matrix = read_mitsuba_xml(path).shapes[0].to_world
    # (1, 0, 0) -> (2, 2, 3) -> (4, 4, 6) -> (-4, 4, 6) -> (6, -4, 4) -> (13, -4, 4)
    np.testing.assert_allclose(matrix @ [1, 0, 0, 1], [13, -4, 4, 1], atol=1e-12)


def test_parameters_and_their_prefixes(tmp_path):
    path = write(
        tmp_path,
        '<default name="h" value="5"/><default name="height" value="$h"/><default name="h" value="9"/>'
        '<shape type="cube"><transform><scale z="$height"/><translate x="$h"/></transform></shape>',
    )
    matrix = read_mitsuba_xml(path).shapes[0].to_world
    assert matrix[2, 2] == 5 and matrix[0, 3] == 5


def test_included_file_finds_its_own_meshes(tmp_path):
    (tmp_path / "part").mkdir()
    (tmp_path / "part" / "m.ply").write_text("")
    write(tmp_path / "part", '<shape type="ply" id="inner"><string name="filename" value="m.ply"/></shape>', "p.xml")
    path = write(tmp_path, '<include filename="part/p.xml"/><shape type="cube" id="outer"/>')
    shapes = read_mitsuba_xml(path).shapes
    assert [shape.name for shape in shapes] == ["inner", "outer"]
    assert shapes[0].mesh_path == tmp_path / "part" / "m.ply"


def test_merged_shapes_are_opened_and_cameras_passed_over(tmp_path):
    path = write(
        tmp_path,
        '<sensor type="perspective"><film type="hdrfilm"/></sensor><integrator type="path"/>'
        '<shape type="merge"><shape type="cube" id="a"/><shape type="cube" id="b"/></shape>',
    )
    assert [shape.name for shape in read_mitsuba_xml(path).shapes] == ["a", "b"]


@pytest.mark.parametrize(("deep", "allowed"), [(90, True), (5_000, False)])
def test_deeply_nested_merges(tmp_path, deep, allowed):
    merge = '<shape type="merge">' * deep + '<shape type="cube" id="a"/>' + "</shape>" * deep
    path = write(tmp_path, merge)
    if allowed:
        assert [shape.name for shape in read_mitsuba_xml(path).shapes] == ["a"]
        return
    with pytest.raises(BadInput, match="levels of nesting; at most 100 .* RADIOTWIN_MAX_NESTING"):
        read_mitsuba_xml(path)


def test_parameters_that_double(tmp_path):
    """Seen: 60 lines stood for 10^18 characters."""
    doubles = "".join(f'<default name="a{i}" value="{f"$a{i - 1}" * 2}"/>' for i in range(1, 60))
    path = write(tmp_path, f'<default name="a0" value="{"x" * 1000}"/>{doubles}<shape type="cube" id="$a59"/>')
    with pytest.raises(BadInput, match="with its parameters: .* bytes; at most 134,217,728"):
        read_mitsuba_xml(path)


def test_files_that_include_many_times(tmp_path, monkeypatch):
    for depth in range(12):
        write(tmp_path, f'<include filename="a{depth + 1}.xml"/>' * 9, f"a{depth}.xml")
    write(tmp_path, '<shape type="cube"/>', "a12.xml")
    assert len(read_mitsuba_xml(tmp_path / "a11.xml").shapes) == 9
    with pytest.raises(BadInput, match="1,001 files that include each other; at most 1,000"):
        read_mitsuba_xml(tmp_path / "a0.xml")


@pytest.mark.parametrize("text", ["", "1 2", "nan", "inf", "1e400", "1_000", "\u0663", "0x10", "1" * 5000, "1 " * 10**6])
def test_what_is_no_number(tmp_path, text):
    with pytest.raises(BadInput, match=r"a\.xml, line 3: <scale> has '.{0,70}' where 1 finite") as error:
        read_numbers(Node("scale", {}, tmp_path / "a.xml", 3), text, (1,))
    assert len(str(error.value)) < 300 + len(str(tmp_path))


def test_files_that_include_others_have_one_budget(tmp_path, monkeypatch):
    write(tmp_path, '<shape type="cube"/><shape type="cube"/>', "b.xml")
    path = write(tmp_path, '<include filename="b.xml"/>')
    assert len(read_mitsuba_xml(path).shapes) == 2
    monkeypatch.setenv("RADIOTWIN_MAX_ELEMENTS", "4")
    with pytest.raises(BadInput, match=r"a\.xml: 5 XML elements; at most 4 .* RADIOTWIN_MAX_ELEMENTS"):
        read_mitsuba_xml(path)
