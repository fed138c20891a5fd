"""Models of cities as meshes: OBJ, glTF 2.0, STL and PLY, from any program.

Their coordinates are metres, and z points up; in glTF, by its specification, y. Materials are
names; what else they hold (colours, pictures) has no meaning for radio, and no file that they name
is opened, except the buffers of a `.gltf`, in its own folder.
"""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from radiotwin.budgets import DOCUMENT_BYTES, FACES, SHAPES
from radiotwin.errors import BadInput
from radiotwin.inputs import check_input, read_bytes
from radiotwin.scene.gltf import read_gltf
from radiotwin.scene.meshes import (
    MeshBudget,
    RawMesh,
    check_vertices,
    cut_polygons,
    read_obj_groups,
)
from radiotwin.scene.ply import read_ply

UP_AXES = {".obj": "z", ".glb": "y", ".gltf": "y", ".stl": "z", ".ply": "z"}
"""Suffix -> axis that points up where nothing else is said: that of glTF is fixed [1]."""
# [1] https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#coordinate-system-and-units
_STL_HEADER, _STL_FACE = 84, 50  # bytes


@dataclass(frozen=True, eq=False)
class ModelPart:
    """One object of a model.

    Attributes:
        name: of the object.
        material: name of its material; None: it has none.
        mesh: its triangles, in the file's units and axes.
    """

    name: str
    material: str | None
    mesh: RawMesh


def read_model(path: Path) -> list[ModelPart]:
    """Read the objects of a model.

    Args:
        path: file with a suffix of `UP_AXES`.

    Returns:
        Objects of the file, one for each material; of STL and PLY, which have none, the connected
        parts.

    Raises:
        BadInput: no such file, damaged, too large, or without triangles.
    """
    suffix = path.suffix.lower()
    check_input(path, f"model ({', '.join(UP_AXES)})")
    if suffix == ".obj":
        vertices, groups = read_obj_groups(path)
        check_vertices(vertices, str(path))
        parts = [ModelPart(name or path.stem, material, _own_mesh(path, vertices, polygons))
                 for (name, material), polygons in groups.items()]
    elif suffix in (".glb", ".gltf"):
        parts = [ModelPart(name, material, RawMesh(vertices, faces))
                 for name, material, vertices, faces in read_gltf(path)]
    else:
        whole = (cut_polygons(path, *read_ply(path)) if suffix == ".ply" else read_stl(path))
        parts = [ModelPart(f"{path.stem}_{number}", None, mesh)
                 for number, mesh in enumerate(_connected(whole), start=1)]
    if not any(len(part.mesh.faces) for part in parts):
        raise BadInput(f"{path} holds no triangles; export the surfaces of the city")
    SHAPES.check(len(parts), path)
    budget = MeshBudget(path)
    for part in parts:
        budget.add(part.mesh)
        check_vertices(part.mesh.vertices, f"{path}, {part.name}")
    return parts


def read_stl(path: Path) -> RawMesh:
    """Read an STL file, binary or ASCII.

    Args:
        path: STL file.

    Raises:
        BadInput: no such file, too large, cut off, or with what are no numbers.
    """
    data = read_bytes(path, "STL model")
    count = int.from_bytes(data[80:_STL_HEADER], "little") if len(data) >= _STL_HEADER else 0
    if data[:5].lower() == b"solid" and len(data) != _STL_HEADER + _STL_FACE * count:
        corners = _ascii_corners(path, data)
    else:
        if len(data) < _STL_HEADER or len(data) < _STL_HEADER + _STL_FACE * count:
            raise BadInput(f"{path} is not a readable STL file: it is cut off ({len(data):,} bytes "
                           f"for {count:,} triangles); export it again")
        FACES.check(count, path)
        row = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        corners = np.frombuffer(data, row, count, _STL_HEADER)["corners"].astype(float)
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return cut_polygons(path, corners.reshape(-1, 3), [faces])


def _ascii_corners(path: Path, data: bytes) -> np.ndarray:
    """Return the (n, 3, 3) corners of the triangles of an ASCII STL file."""
    DOCUMENT_BYTES.check(len(data), path)
    corners: list[float] = []
    row = 0
    for row, line in enumerate(io.TextIOWrapper(io.BytesIO(data), "utf-8", "replace"), start=1):
        words = line.split()
        if words[:1] != ["vertex"]:
            continue
        try:
            x, y, z = (float(word) for word in words[1:])
        except ValueError:
            raise BadInput(f"{path}, row {row}: {line.strip()[:60]!r} is not a vertex as STL has "
                           "it; export the model again") from None
        corners += (x, y, z)
    if len(corners) % 9 or b"endsolid" not in data[-1000:].lower():
        raise BadInput(f"{path} is not a readable STL file: it is cut off in row {row}; export it "
                       "again")
    return np.array(corners).reshape(-1, 3, 3)


def _own_mesh(path: Path, vertices: np.ndarray, polygons: list[np.ndarray]) -> RawMesh:
    """Return the mesh of one of many objects that share vertices (v, 3)."""
    used = np.unique(np.concatenate([each.ravel() for each in polygons]))
    if len(used) and (used[0] < 0 or used[-1] >= len(vertices)):
        return cut_polygons(path, vertices, polygons)  # which says what is wrong
    own = [np.searchsorted(used, each) for each in polygons]
    return _compact(cut_polygons(path, vertices[used], own))


def _compact(mesh: RawMesh) -> RawMesh:
    """Return a mesh with the vertices that its faces use."""
    used, faces = np.unique(mesh.faces, return_inverse=True)
    return RawMesh(mesh.vertices[used], faces.reshape(-1, 3), mesh.polygons)


def _connected(mesh: RawMesh) -> list[RawMesh]:
    """Return the parts of a mesh that share no corner, in the order of their first faces."""
    if not len(mesh.faces):
        return [mesh]
    vertices, same = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = same.reshape(-1)[mesh.faces]
    starts, ends = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(starts), dtype=bool), (starts, ends)),
                       shape=(len(vertices), len(vertices)))
    label = connected_components(graph, directed=False)[1][faces[:, 0]]
    order = np.argsort(label, kind="stable")
    parts = np.split(faces[order], np.flatnonzero(np.diff(label[order])) + 1)
    polygons = [mesh.polygons, *[0] * (len(parts) - 1)]
    return [_compact(RawMesh(vertices, part, count)) for part, count in zip(parts, polygons)]
