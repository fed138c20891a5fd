import struct

import numpy as np
import pytest

from radiotwin.errors import BadInput
from radiotwin.scene.ply import read_ply, write_ply

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 2, 0.5]])


def header(form, vertices, faces, extra=""):
    return (
        f"ply\nformat {form} 1.0\ncomment made by hand\nelement vertex {vertices}\nproperty float x\n"
        f"property float y\nproperty float z\n{extra}element face {faces}\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode()


def test_written_file_reads_back(tmp_path):
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    write_ply(tmp_path / "a.ply", VERTICES, faces)
    vertices, (read,) = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(vertices, VERTICES)
    np.testing.assert_array_equal(read, faces)


def test_written_file_is_readable_by_others(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    write_ply(tmp_path / "a.ply", VERTICES, np.array([[0, 1, 2], [0, 2, 4]]))
    mesh = trimesh.load(tmp_path / "a.ply", process=False)
    np.testing.assert_allclose(mesh.vertices, VERTICES)
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 4]])


@pytest.mark.parametrize("form, order", [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_binary_with_triangles_and_quads(tmp_path, form, order):
    data = header(form, 5, 2) + VERTICES.astype(order + "f4").tobytes()
    data += struct.pack(f"{order}B4iB3i", 4, 0, 1, 2, 3, 3, 0, 2, 4)
    (tmp_path / "a.ply").write_bytes(data)
    vertices, polygons = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(vertices, VERTICES)
    assert [group.tolist() for group in polygons] == [[[0, 2, 4]], [[0, 1, 2, 3]]]


def test_other_properties_are_passed_over(tmp_path):
    extra = "property float s\nproperty uchar red\n"
    rows = "".join(f"{x} {y} {z} 0.5 255\n" for x, y, z in VERTICES)
    (tmp_path / "a.ply").write_bytes(header("ascii", 5, 1, extra) + rows.encode() + b"3 0 1 2\n")
    vertices, polygons = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(vertices, VERTICES)
    assert polygons[0].tolist() == [[0, 1, 2]]


def test_every_truncation_is_noticed(tmp_path):
    write_ply(tmp_path / "whole.ply", VERTICES, np.array([[0, 1, 2], [0, 2, 3]]))
    whole = (tmp_path / "whole.ply").read_bytes()
    for length in range(len(whole)):
        (tmp_path / "cut.ply").write_bytes(whole[:length])
        with pytest.raises(BadInput, match="cut.ply"):
            read_ply(tmp_path / "cut.ply")


def test_truncated_ascii_says_where(tmp_path):
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in VERTICES)
    (tmp_path / "a.ply").write_bytes(header("ascii", 5, 2) + rows.encode() + b"3 0 1 2\n3 0")
    with pytest.raises(BadInput, match="truncated.*2 rows of 'face'.*row 2"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize(
    "data, message",
    [
        (b"", "not a PLY"),
        (b"solid box\n" * 20, "not a PLY"),
        (header("binary_middle_endian", 1, 1), "line 2"),
        (header("ascii", 1, 1).replace(b"property float x", b"property fload x"), "line 5"),
        (header("ascii", 1, 1).replace(b"float z", b"float w") + b"0 0 0\n3 0 0 0\n", "no vertex z"),
        (
            header("ascii", 1, 1).replace(b"vertex_indices", b"colours") + b"0 0 0\n3 0 0 0\n",
            "no face vertex_indices",
        ),
        (header("ascii", 1, 0) + b"0 0 zero\n", "row 1 of 'vertex'"),
    ],
)
def test_what_is_no_ply(tmp_path, data, message):
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(BadInput, match=message):
        read_ply(tmp_path / "a.ply")
