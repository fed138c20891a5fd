"""Readers of mesh models of cities: OBJ, STL, PLY and glTF 2.0 [1].

Coordinates are in metres, and z points up; in glTF, by its specification, y. Only triangles, their
positions and the names of objects and materials are read, and checked against the size of the file:
a header can claim any number of vertices, and a graph of objects can contain itself. General
readers, including trimesh's, trust such a header, and open pictures. No file that a model names is
opened, except the buffers of a `.gltf` in its own folder.

[1] https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

import base64
import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.io.budgets import DOCUMENT_BYTES, FACES, FILE_BYTES, FILES, SHAPES, VERTICES
from radiotwin.io.inputs import check_input, parse_json, read_bytes, require_within
from radiotwin.scene.meshes import (
    MeshBudget,
    RawMesh,
    check_vertices,
    connected,
    cut_polygons,
    read_obj_groups,
)
from radiotwin.scene.ply import read_ply

_MAGIC, _JSON, _BINARY = b"glTF", b"JSON", b"BIN\0"
_TYPES: dict[int, np.dtype[Any]] = {5121: np.dtype("<u1"), 5123: np.dtype("<u2"),
                                   5125: np.dtype("<u4"), 5126: np.dtype("<f4")}
_COMPONENTS = {"SCALAR": 1, "VEC3": 3}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression",
               "KHR_mesh_quantization")
UP_AXES = {".obj": "z", ".glb": "y", ".gltf": "y", ".stl": "z", ".ply": "z"}
"""Suffix -> axis that usually points up; that of glTF is fixed [1, section 3.4]."""
_STL_HEADER, _STL_FACE = 84, 50  # bytes


@dataclass(frozen=True, eq=False)
class ModelPart:
    """An object of a model, or its part of one material.

    Attributes:
        name: name of the object.
        material: name of the material; None: it has none.
        mesh: triangles in the file's units and axes.
    """

    name: str
    material: str | None
    mesh: RawMesh


def _read_gltf(path: Path) -> list[ModelPart]:
    """Read the objects of a `.glb` or `.gltf` file, placed by its scene graph, y up."""
    data = read_bytes(path, "glTF model")
    text, binary = _chunks(path, data) if data[:4] == _MAGIC else (data, None)
    DOCUMENT_BYTES.check(len(text), path)
    try:
        document = parse_json(text.decode("utf-8-sig"), path)
        if str(document["asset"]["version"]).partition(".")[0] != "2":
            raise ValueError(f"its version is {document['asset']['version']!r}, not 2.0")
        return list(_Document(path, document, binary).parts())
    except BadInput:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError) as error:
        raise BadInput(f"{path} is not a readable glTF 2.0 model ({error!s:.120}); export it again"
                       ) from None


def _chunks(path: Path, data: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON and the binary chunk (None: absent) of a `.glb` file."""
    chunks: dict[bytes, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<I4s", data, at)
        if at + 8 + length > len(data):
            raise BadInput(f"{path} is not a readable glTF 2.0 model: it is cut off "
                           f"({len(data):,} bytes, {at + 8 + length:,} are announced); export it "
                           "again")
        chunks.setdefault(kind, data[at + 8:at + 8 + length])
        at += 8 + length
    if _JSON not in chunks:
        raise BadInput(f"{path} is not a readable glTF 2.0 model: it has no JSON chunk; export it "
                       "again")
    return chunks[_JSON], chunks.get(_BINARY)


class _Document:
    """A glTF document with its buffers; errors in its structure are ValueError and the like."""

    def __init__(self, path: Path, document: dict[str, Any], binary: bytes | None) -> None:
        self.path, self.document = path, document
        required = [str(name) for name in document.get("extensionsRequired") or []]
        if compressed := [name for name in required if name in _COMPRESSED]:
            raise BadInput(f"{path}: its meshes are compressed ({compressed[0]}), which is not "
                           "read; export it without compression")
        self.buffers = self._buffers(binary)

    def _list(self, key: str) -> list[Any]:
        """Return a top-level list of the document, such as `meshes`; empty if absent."""
        found = self.document.get(key) or []
        if not isinstance(found, list):
            raise ValueError(f"{key} is no list")
        return found

    def _entry(self, key: str, index: Any) -> Any:
        """Return an entry of a top-level list by its index."""
        if isinstance(index, bool) or not isinstance(index, int) or index < 0:
            raise ValueError(f"{index!r:.20} is no index of {key}")
        return self._list(key)[index]

    def _buffers(self, binary: bytes | None) -> list[bytes]:
        """Return each buffer's bytes: the binary chunk, base64 text, or a file beside the model."""
        buffers, size = [], 0
        FILES.check(len(self._list("buffers")), self.path)
        for number, buffer in enumerate(self._list("buffers")):
            uri = buffer.get("uri")
            if uri is None:
                if number or binary is None:
                    raise ValueError(f"buffer {number} has no content")
                buffers.append(binary)
            elif uri.startswith("data:"):
                head, comma, content = uri.partition(",")
                if not comma or not head.endswith(";base64"):
                    raise ValueError("a buffer is not in base64")
                buffers.append(base64.b64decode(content, validate=True))
            else:
                name = unquote(uri)
                if ":" in name or "\\" in name:
                    raise BadInput(f"{self.path}: its buffer {uri[:60]!r} is no file beside it; "
                                   "export it with everything in one file (.glb)")
                beside = require_within(self.path.absolute().parent, self.path.parent / name,
                                        str(self.path))
                buffers.append(read_bytes(beside, "buffer of a glTF model"))
            size += len(buffers[-1])
            FILE_BYTES.check(size, f"{self.path} with its buffers")
        return buffers

    def parts(self) -> Iterator[ModelPart]:
        """Yield the triangles of each object of a glTF model, one mesh per material."""
        vertices = parts = 0
        for name, mesh, to_world in self._placed():
            for primitive in self._entry("meshes", mesh)["primitives"]:
                parts += 1
                SHAPES.check(parts, self.path)
                points = self._accessor(primitive["attributes"]["POSITION"], "VEC3")
                vertices += len(points)
                VERTICES.check(vertices, self.path)
                faces = self._faces(primitive, len(points))
                if faces is None:
                    continue
                if not np.isfinite(points).all():
                    raise ValueError(f"{name!r:.60} has a corner that is not finite")
                moved = points @ to_world[:3, :3].T + to_world[:3, 3]
                mirrored = np.linalg.det(to_world[:3, :3]) < 0
                material = primitive.get("material")
                yield ModelPart(
                    name, None if material is None else self._name("materials", material),
                    RawMesh(moved, faces[:, ::-1] if mirrored else faces))

    def _placed(self) -> Iterator[tuple[str, int, np.ndarray]]:
        """Yield name, mesh index and (4, 4) transform of each node of the glTF scene with a mesh.

        A node that occurs twice in the scene's graph is an error. Without scenes, all nodes count.
        """
        scenes = self._list("scenes")
        roots = self._entry("scenes", self.document.get("scene", 0)).get("nodes") or [] \
            if scenes else list(range(len(self._list("nodes"))))
        waiting = [(node, np.eye(4)) for node in reversed(roots)]
        seen: set[int] = set()
        while waiting:
            index, above = waiting.pop()
            node = self._entry("nodes", index)
            if index in seen:
                if not scenes:
                    continue
                raise ValueError(f"node {index} stands in its graph twice")
            seen.add(index)
            to_world = above @ _transform(node)
            if not np.isfinite(to_world).all():
                raise ValueError(f"node {index} has a transform that is not finite")
            if node.get("mesh") is not None:
                name = node.get("name") or self._name("meshes", node["mesh"])
                yield str(name)[:200], node["mesh"], to_world
            waiting += [(child, to_world) for child in reversed(node.get("children") or [])]

    def _name(self, key: str, index: Any) -> str:
        """Return the name of an entry of a top-level list, or one made from its index."""
        return str(self._entry(key, index).get("name") or f"{key}_{index}")[:200]

    def _faces(self, primitive: dict[str, Any], points: int) -> np.ndarray | None:
        """Return the triangles (f, 3) of a primitive of some points; None if it has no areas."""
        mode = primitive.get("mode", _TRIANGLES)
        if mode not in (_TRIANGLES, _STRIP, _FAN):
            return None
        if primitive.get("indices") is None:
            index = np.arange(points)
        else:
            index = self._accessor(primitive["indices"], "SCALAR").astype(np.int64).reshape(-1)
        if len(index) and not 0 <= index.min() <= index.max() < points:
            raise ValueError(f"a face names corner {index.max()}, there are {points} (counted from "
                             "0)")
        if mode == _TRIANGLES:
            if len(index) % 3:
                raise ValueError("its triangles have not three corners each")
            return index.reshape(-1, 3)
        if mode == _FAN:
            first = np.broadcast_to(index[:1], len(index[2:]))
            return np.stack([first, index[1:-1], index[2:]], axis=1)
        strip = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
        strip[1::2] = strip[1::2, [1, 0, 2]]
        return strip

    def _accessor(self, index: Any, kind: str) -> np.ndarray:
        """Return the (n, components) values of an accessor: `SCALAR` integers or `VEC3` reals."""
        accessor = self._entry("accessors", index)
        if accessor["type"] != kind or "sparse" in accessor or accessor.get("bufferView") is None:
            raise ValueError(f"accessor {index} is sparse, empty, or not of type {kind}")
        dtype = _TYPES[accessor["componentType"]]
        if (dtype.kind == "f") != (kind == "VEC3"):
            raise ValueError(f"accessor {index} is of component type {accessor['componentType']}")
        view = self._entry("bufferViews", accessor["bufferView"])
        buffer = self.buffers[view["buffer"]]
        width = _COMPONENTS[kind] * dtype.itemsize
        stride = view.get("byteStride") or width
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        count = accessor["count"]
        if not all(isinstance(value, int) and value >= 0 for value in (start, count)) \
                or not (isinstance(stride, int) and width <= stride <= 252) \
                or count and start + stride * (count - 1) + width > len(buffer):
            raise ValueError(f"accessor {index} claims {count!r:.20} values, more than the buffer "
                             "holds")
        found: np.ndarray = np.ndarray((count, _COMPONENTS[kind]), dtype, buffer, start,
                                       (stride, dtype.itemsize)) if count else \
            np.zeros((0, _COMPONENTS[kind]), dtype)
        return found.astype(float) if dtype.kind == "f" else found


def _transform(node: dict[str, Any]) -> np.ndarray:
    """Return a glTF node's (4, 4) transform: a matrix, or translation × rotation × scale [1]."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=float).reshape(4, 4).T
    transform = np.eye(4)
    if "rotation" in node:
        x, y, z, w = np.array(node["rotation"], dtype=float).reshape(4)
        transform[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
    if "scale" in node:
        transform[:3, :3] *= np.array(node["scale"], dtype=float).reshape(3)
    if "translation" in node:
        transform[:3, 3] = np.array(node["translation"], dtype=float).reshape(3)
    return transform


def read_model(path: Path) -> list[ModelPart]:
    """Read a mesh model: its objects by material; of STL and PLY, the connected parts.

    Raises:
        BadInput: no such file, damaged, too large, or without triangles.
    """
    suffix = path.suffix.lower()
    check_input(path, f"model ({', '.join(UP_AXES)})")
    if suffix == ".obj":
        vertices, groups = read_obj_groups(path)
        check_vertices(vertices, str(path))
        parts = [ModelPart(name or path.stem, material, _submesh(path, vertices, polygons))
                 for (name, material), polygons in groups.items()]
    elif suffix in (".glb", ".gltf"):
        parts = _read_gltf(path)
    else:
        model = cut_polygons(path, *read_ply(path)) if suffix == ".ply" else _read_stl(path)
        parts = [ModelPart(f"{path.stem}_{number}", None, mesh)
                 for number, mesh in enumerate(_connected_parts(model), start=1)]
    if not any(len(part.mesh.faces) for part in parts):
        raise BadInput(f"{path} holds no triangles; export the surfaces of the city")
    SHAPES.check(len(parts), path)
    budget = MeshBudget(path)
    for part in parts:
        budget.add(part.mesh)
        check_vertices(part.mesh.vertices, f"{path}, {part.name}")
    return parts


def _read_stl(path: Path) -> RawMesh:
    """Read an STL file, binary or ASCII."""
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


def _submesh(path: Path, vertices: np.ndarray, polygons: list[np.ndarray]) -> RawMesh:
    """Return the mesh of one object: of the model's vertices (v, 3), only those it uses."""
    used = np.unique(np.concatenate([group.ravel() for group in polygons]))
    if len(used) and (used[0] < 0 or used[-1] >= len(vertices)):
        return cut_polygons(path, vertices, polygons)  # raises the error
    renumbered = [np.searchsorted(used, group) for group in polygons]
    return _compact(cut_polygons(path, vertices[used], renumbered))


def _compact(mesh: RawMesh) -> RawMesh:
    """Drop the vertices of a mesh that no face uses."""
    used, faces = np.unique(mesh.faces, return_inverse=True)
    return RawMesh(mesh.vertices[used], faces.reshape(-1, 3), mesh.polygons)


def _connected_parts(mesh: RawMesh) -> list[RawMesh]:
    """Split a mesh into parts that share no corner, in the order of their first faces."""
    if not len(mesh.faces):
        return [mesh]
    vertices, same = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces = same.reshape(-1)[mesh.faces]
    label = connected(faces[:, [[0, 1], [1, 2]]].reshape(-1, 2), len(vertices))[faces[:, 0]]
    order = np.argsort(label, kind="stable")
    parts = np.split(faces[order], np.flatnonzero(np.diff(label[order])) + 1)
    polygons = [mesh.polygons, *[0] * (len(parts) - 1)]
    return [_compact(RawMesh(vertices, part, count)) for part, count in zip(parts, polygons)]
