import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.importer import import_city
from radiotwin.scene.meshes import clean, load_shape, read_obj_groups
from radiotwin.scene.mitsuba_xml import read_mitsuba_xml

TRANSFORM = '<shape type="{}" id="a"><transform name="to_world">{}</transform></shape>'
OBJ = '<shape type="obj"><string name="filename" value="a.obj"/></shape>'


def loaded(city, shape):
    """The mesh of a file's only shape."""
    return load_shape(read_mitsuba_xml(city.add_xml(shape).write()).shapes[0])


def area_vector(mesh):
    corners = mesh.vertices[mesh.faces]
    return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)


def test_cube_is_baked_exactly(empty_city):
    mesh = loaded(empty_city, TRANSFORM.format("cube", '<scale x="5" y="2" z="10"/><rotate z="1" angle="90"/>'
                                               '<translate x="100" y="50" z="10"/>'))
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [98, 45, 0], atol=1e-12)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [102, 55, 20], atol=1e-12)
    corners = mesh.vertices[mesh.faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(4 * 10 * 20)  # positive: outward


@pytest.mark.parametrize(("steps", "half_m"), [("", 1), ('<scale x="-3"/>', 3)], ids=["plain", "mirrored"])
def test_a_rectangle_is_two_units_wide_and_looks_up(empty_city, steps, half_m):
    mesh = loaded(empty_city, TRANSFORM.format("rectangle", steps))
    np.testing.assert_array_equal(np.sort(mesh.vertices, axis=0)[[0, -1]], [[-half_m, -1, 0], [half_m, 1, 0]])
    np.testing.assert_allclose(area_vector(mesh), [0, 0, 4 * half_m])


def test_sphere_becomes_triangles(empty_city):
    mesh = loaded(empty_city, '<shape type="sphere" id="a"><float name="radius" value="3"/>'
                              '<point name="center" x="1" y="2" z="4"/></shape>')
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - [1, 2, 4], axis=1), 3.0)


def test_obj_with_quads_negative_indices_and_objects(empty_city):
    (empty_city.folder / "a.obj").write_text(
        "o one\nv 0 0 0\nv 2 0 0\nv 2 3 0\nv 0 3 0\nvt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1 4/1/1\n"
        "o two\nv 0 0 5\nv 1 0 5\nv 0 1 5\nf -3//1 -2//1 -1//1\n")
    mesh = loaded(empty_city, OBJ)
    assert mesh.polygons == 1 and len(mesh.faces) == 3
    np.testing.assert_allclose(area_vector(mesh), [0, 0, 6.5])


@pytest.mark.parametrize("rotation", [np.eye(3), np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0.0]])])
def test_concave_polygon_keeps_its_area_and_sense(empty_city, rotation):
    outline = np.array([[0, 0, 0], [4, 0, 0], [4, 1, 0], [1, 1, 0], [1, 4, 0], [0, 4, 0.0]]) @ rotation.T
    lines = "".join(f"v {x} {y} {z}\n" for x, y, z in outline)
    for order, sense in ((range(1, 7), 1), (range(6, 0, -1), -1)):
        (empty_city.folder / "a.obj").write_text(lines + "f " + " ".join(map(str, order)) + "\n")
        empty_city.shapes.clear()
        mesh = loaded(empty_city, OBJ)
        np.testing.assert_allclose(area_vector(mesh), sense * rotation @ [0, 0, 7.0], atol=1e-12)
        corners = mesh.vertices[mesh.faces]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        assert areas.sum() == pytest.approx(7.0)  # no overlap


def test_clean_welds_and_drops_slivers():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 1e-6], [1, 1, 0], [0, 1, 0], [0.5, 0, 0], [9, 9, 9]])
    faces = np.array([[0, 1, 2], [3, 4, 5], [0, 6, 1], [1, 3, 2]])
    welded, kept, dropped = clean(vertices, faces)
    assert len(welded) == 4 and dropped == 2
    corners = welded[kept]
    assert np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    ) == pytest.approx([1, 1])
    assert len({tuple(sorted(pair)) for face in kept for pair in zip(face, np.roll(face, 1))}) == 5  # one shared


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("vertex", "last", "message"), [
    ("nan", 2, "vertex 2 is not finite"), ("1e400", 2, "vertex 2 is not finite"),
    ("1e300", 2, "vertex 2 is 1e[+]300 from the origin"), ("0", -1, "names vertex -1, there are 3"), ("0", 3, "names vertex 3")])
def test_what_no_mesh_may_say(empty_city, vertex, last, message):
    text = empty_city.ply([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, last)]).replace("1 0 0", f"1 {vertex} 0")
    empty_city.add("a", None, text=text)
    with pytest.raises(BadInput, match=message):
        load_shape(read_mitsuba_xml(empty_city.write()).shapes[0])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("shape", "message"), [
    ('<shape type="hair" id="a"/>', "line 3.*'hair'.*ply, obj, cube"),
    ('<shape type="cube"><transform><scale value="1e300"/></transform></shape>', "line 3, after the transform"),
    ('<shape type="sphere"><float name="radius" value="1e308"/></shape>', "line 3: a radius of 1e[+]308"),
    ('<shape type="sphere"><point name="center" x="east"/></shape>', "line 3: <point> has 'east'"),
    ('<shape type="ply"><string name="filename" value="%s"/></shape>' % ("a" * 300), "leads out of|does not exist")])
def test_what_no_shape_may_say(empty_city, shape, message):
    with pytest.raises(BadInput, match=message):
        loaded(empty_city, shape)


@pytest.mark.parametrize(("text", "row"), [
    ("v 0 0\n", 1), ("v 0 0 0\nf 1 2 x\n", 2), ("v 0 0 0 \nf 1 1 " + "9" * 30, 2), ("v 0 0 0\nf 1 1 " + "9" * 5000, 2),
    ("f 1\nf 1 1 1/x\nf x", 3)])
def test_a_bad_obj_file_names_the_row(tmp_path, text, row):
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(BadInput, match=f"row {row}"):
        read_obj_groups(tmp_path / "a.obj")


def test_one_mesh_named_many_times_has_one_budget(empty_city, monkeypatch):
    for number in range(4):
        empty_city.add(f"a{number}", ([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)]))
    import_city(empty_city.write(), {})
    monkeypatch.setenv("RADIOTWIN_MAX_VERTICES", "10")
    with pytest.raises(BadInput, match="town.xml with its meshes: 12 vertices; at most 10"):
        import_city(empty_city.path, {})
    monkeypatch.setenv("RADIOTWIN_MAX_SHAPES", "3")
    with pytest.raises(BadInput, match="4 shapes; at most 3"):
        read_mitsuba_xml(empty_city.path)
