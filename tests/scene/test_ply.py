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


def ply(form, body, vertices=3, faces=1, indices="property list uchar int vertex_indices"):
    return header(form, vertices, faces).replace(b"property list uchar int vertex_indices", indices.encode()) + body


CORNERS = b"0 0 0\n1 0 0\n0 1 0\n"
BINARY = "binary_little_endian"


@pytest.mark.parametrize(("data", "message"), [
    (b"", "not a PLY"), (b"solid box\n" * 20, "not a PLY"), (header("binary_middle_endian", 1, 1), "line 2"),
    (header("ascii", 1, 1).replace(b"property float x", b"property fload x"), "line 5"),
    (header("ascii", 1, 1).replace(b"float z", b"float w") + b"0 0 0\n3 0 0 0\n", "no vertex z"),
    (header("ascii", 1, 1).replace(b"vertex_indices", b"colours") + b"0 0 0\n3 0 0 0\n", "no face vertex_indices"),
    (header("ascii", 1, 0) + b"0 0 zero\n", "row 1 of 'vertex'"),
    (ply("ascii", CORNERS + b"3 0 1 2\n3 0", faces=2), "truncated.*2 rows of 'face'.*row 2"),
    (ply("ascii", CORNERS + b"nan 0 1 2\n"), "row 1 of 'face'"),
    (ply("ascii", CORNERS + b"-1 0 1 2\n"), "row 1 of 'face'"),
    (ply("ascii", CORNERS + b"3 0 1 " + b"9" * 30 + b"\n"), "row 1 of 'face'"),
    (ply("ascii", CORNERS + b"3 0 1 " + b"9" * 5000 + b"\n"), "row 1 of 'face'"),
    (ply("ascii", CORNERS + b"9" * 30 + b" 0 1 2\n"), "truncated"),
    (ply("ascii", b"", indices="property list float int vertex_indices"), "line 9: .* not a PLY header line"),
    (ply("ascii", b"", indices="property list uchar float vertex_indices"), "line 9: .* not a PLY header line"),
    (ply("ascii", b"", indices="property int vertex_indices"), "line 9: .* not a PLY header line"),
    (ply("ascii", b"", indices="property list uchar int x\nproperty list uchar int x"), "declares .* twice"),
    (ply(BINARY, bytes(36) + struct.pack("<b3i", -1, 0, 1, 2), indices="property list char int vertex_indices"), "truncated"),
    (ply(BINARY, bytes(36), vertices=10**12), "truncated: its header promises 1000000000000"),
    (ply("ascii", b"", vertices="9" * 5000), "line 4"),
    (ply("ascii", b"", vertices=-1), "line 4: .* not a PLY header line"),
    (b"ply\nformat ascii 1.0\nelement vertex 1000000000000\nend_header\n1", "truncated"),  # rows without properties
])
def test_what_is_no_mesh(tmp_path, data, message):
    (tmp_path / "a.ply").write_bytes(data)
    with pytest.raises(BadInput, match=message) as error:
        read_ply(tmp_path / "a.ply")
    assert len(str(error.value)) < 400 + len(str(tmp_path))


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize(("variable", "message"), [
    ("VERTICES", "3 vertices; at most 2"), ("CORNERS", "3 corners in one face; at most 2"),
    ("FILE_BYTES", "bytes; at most 2"), ("COLUMNS", "columns; at most 2")])
def test_budgets(tmp_path, monkeypatch, form, variable, message):
    binary = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype="<f4").tobytes() + struct.pack("<B3i", 3, 0, 1, 2)
    (tmp_path / "a.ply").write_bytes(ply(form, CORNERS + b"3 0 1 2\n" if form == "ascii" else binary))
    read_ply(tmp_path / "a.ply")
    monkeypatch.setenv(f"RADIOTWIN_MAX_{variable}", "2")
    with pytest.raises(BadInput, match=f"{message} .*RADIOTWIN_MAX_{variable}"):
        read_ply(tmp_path / "a.ply")


def test_a_long_ragged_face_is_refused_before_it_is_unpacked(tmp_path):
    body = bytes(36) + struct.pack("<I3iI", 3, 0, 1, 2, 20_000) + bytes(80_000)
    (tmp_path / "a.ply").write_bytes(ply("binary_little_endian", body, faces=2,
                                         indices="property list uint int vertex_indices"))
    with pytest.raises(BadInput, match="20,000 corners in one face; at most 10,000"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_lines_end_at_line_ends_only_whatever_language_a_comment_is_in(tmp_path, ends):
    """In UTF-8, Å is the bytes C3 85; the second is a line end in Latin-1."""
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in VERTICES).encode() + b"3 0 1 2\n"
    data = header("ascii", 5, 1).replace(b"made by hand", "Åsa х م".encode()) + rows
    (tmp_path / "a.ply").write_bytes(data.replace(b"\n", ends.encode()))
    assert np.array_equal(read_ply(tmp_path / "a.ply")[0], VERTICES)
