import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.meshes import clean, load_shape, read_obj
from radiotwin.scene.mitsuba_xml import read_mitsuba_xml


def only_shape(city, shape):
    return read_mitsuba_xml(city.add_xml(shape).write()).shapes[0]


def area_vector(mesh):
    corners = mesh.vertices[mesh.faces]
    return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)


def test_cube_is_baked_exactly(empty_city):
    mesh = load_shape(
        only_shape(
            empty_city,
            '<shape type="cube" id="a"><transform name="to_world">'
            '<scale x="5" y="2" z="10"/><rotate z="1" angle="90"/>'
            '<translate x="100" y="50" z="10"/></transform></shape>',
        )
    )
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [98, 45, 0], atol=1e-12)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [102, 55, 20], atol=1e-12)
    corners = mesh.vertices[mesh.faces]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(4 * 10 * 20)  # positive: outward


def test_rectangle_is_two_units_wide_and_looks_up(empty_city):
    mesh = load_shape(only_shape(empty_city, '<shape type="rectangle" id="a"/>'))
    np.testing.assert_array_equal(np.sort(mesh.vertices, axis=0)[[0, -1]], [[-1, -1, 0], [1, 1, 0]])
    np.testing.assert_allclose(area_vector(mesh), [0, 0, 4])


def test_a_mirrored_rectangle_still_looks_up(empty_city):
    mesh = load_shape(
        only_shape(
            empty_city,
            '<shape type="rectangle" id="a"><transform name="to_world"><scale x="-3"/></transform></shape>',
        )
    )
    np.testing.assert_allclose(area_vector(mesh), [0, 0, 12])


def test_sphere_becomes_triangles(empty_city):
    mesh = load_shape(
        only_shape(
            empty_city,
            '<shape type="sphere" id="a"><float name="radius" value="3"/>'
            '<point name="center" x="1" y="2" z="4"/></shape>',
        )
    )
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - [1, 2, 4], axis=1), 3.0)


def test_unread_kind_says_what_is_read(empty_city):
    with pytest.raises(BadInput, match="line 3.*'hair'.*ply, obj, cube"):
        load_shape(only_shape(empty_city, '<shape type="hair" id="a"/>'))


def test_obj_with_quads_negative_indices_and_objects(empty_city):
    (empty_city.folder / "a.obj").write_text(
        "o one\nv 0 0 0\nv 2 0 0\nv 2 3 0\nv 0 3 0\nvt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1 4/1/1\n"
        "o two\nv 0 0 5\nv 1 0 5\nv 0 1 5\nf -3//1 -2//1 -1//1\n"
    )
    mesh = load_shape(
        only_shape(empty_city, '<shape type="obj"><string name="filename" value="a.obj"/></shape>')
    )
    assert mesh.polygons == 1 and len(mesh.faces) == 3
    np.testing.assert_allclose(area_vector(mesh), [0, 0, 6.5])


@pytest.mark.parametrize("text, row", [("v 0 0\n", 1), ("v 0 0 0\nf 1 2 x\n", 2)])
def test_bad_obj_names_the_row(tmp_path, text, row):
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(BadInput, match=f"row {row}"):
        read_obj(tmp_path / "a.obj")


@pytest.mark.parametrize("rotation", [np.eye(3), np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0.0]])])
def test_concave_polygon_keeps_its_area_and_sense(empty_city, rotation):
    outline = np.array([[0, 0, 0], [4, 0, 0], [4, 1, 0], [1, 1, 0], [1, 4, 0], [0, 4, 0.0]]) @ rotation.T
    lines = "".join(f"v {x} {y} {z}\n" for x, y, z in outline)
    for order, sense in ((range(1, 7), 1), (range(6, 0, -1), -1)):
        (empty_city.folder / "a.obj").write_text(lines + "f " + " ".join(map(str, order)) + "\n")
        empty_city.shapes.clear()
        mesh = load_shape(
            only_shape(empty_city, '<shape type="obj"><string name="filename" value="a.obj"/></shape>')
        )
        np.testing.assert_allclose(area_vector(mesh), sense * rotation @ [0, 0, 7.0], atol=1e-12)
        corners = mesh.vertices[mesh.faces]
        areas = (
            np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        )
        assert areas.sum() == pytest.approx(7.0)  # no overlap


def test_face_that_names_a_missing_vertex(empty_city):
    (empty_city.folder / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 7\n")
    with pytest.raises(BadInput, match="names vertex 6, there are 3"):
        load_shape(
            only_shape(empty_city, '<shape type="obj"><string name="filename" value="a.obj"/></shape>')
        )


def test_clean_welds_and_drops_slivers():
    vertices = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 1e-6], [1, 1, 0], [0, 1, 0], [0.5, 0, 0], [9, 9, 9]]
    )
    faces = np.array([[0, 1, 2], [3, 4, 5], [0, 6, 1], [1, 3, 2]])
    welded, kept, dropped = clean(vertices, faces)
    assert len(welded) == 4 and dropped == 2
    corners = welded[kept]
    assert np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    ) == pytest.approx([1, 1])
    assert (
        len({tuple(sorted(pair)) for face in kept for pair in zip(face, np.roll(face, 1))}) == 5
    )  # one shared
