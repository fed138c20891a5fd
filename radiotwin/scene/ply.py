"""PLY files: read polygons from the ASCII and binary forms, write triangles as binary.

trimesh reads PLY, too, but silently accepts a truncated ASCII file or a face that names a missing
vertex, and refuses binary files that mix triangles with quadrilaterals.
"""

import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from radiotwin.errors import BadInput

_TYPES = {"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
          "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
          "float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
_STRUCT_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f",
                 "f8": "d"}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    name: str
    count: int
    # Name, type, and type of the list's length (None: not a list)
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)

    def dtype(self, order: str, lengths: dict[str, int]) -> np.dtype:
        """Return the type of one row whose lists have the given lengths."""
        fields: list[tuple] = []
        for name, kind, length_kind in self.properties:
            if length_kind is None:
                fields.append((name, order + kind))
            else:
                fields += [(f"{name} length", order + length_kind),
                           (name, order + kind, (lengths[name],))]
        return np.dtype(fields)


def read_ply(path: Path) -> tuple[np.ndarray, list[np.ndarray]]:
    """Read vertices and polygons.

    Args:
        path: PLY file.

    Returns:
        (v, 3) vertices, and an (n, k) array of vertex indices for each number of corners k.

    Raises:
        BadInput: No such file, not a PLY file, truncated, or a header without vertices or faces.
    """
    try:
        if path.exists() and not path.is_file():  # reading a pipe would block
            raise OSError(0, "it is not an ordinary file")
        data = path.read_bytes()
    except OSError as error:
        raise BadInput(f"{path} cannot be read: {error.strerror}; export the mesh again") from None
    order, elements, start = _read_header(path, data)
    columns = (_read_ascii(path, data[start:], elements) if order == "" else
               _read_binary(path, data, start, order, elements))
    try:
        vertices = np.stack([np.asarray(columns["vertex", axis], dtype=float) for axis in "xyz"],
                            axis=1)
    except KeyError as missing:
        raise BadInput(f"{path}: the PLY header declares no vertex {missing.args[0][1]}; export "
                       "the mesh again") from None
    polygons = columns.get(("face", "vertex_indices"), columns.get(("face", "vertex_index")))
    if polygons is None:
        raise BadInput(f"{path}: the PLY header declares no face vertex_indices; export the mesh "
                       "with faces")
    return vertices, _by_corners(polygons)


def _by_corners(polygons: np.ndarray | list) -> list[np.ndarray]:
    if isinstance(polygons, np.ndarray):
        return [polygons.astype(np.int64)]
    corners = np.array([len(polygon) for polygon in polygons])
    return [np.array([polygons[row] for row in np.flatnonzero(corners == k)], dtype=np.int64)
            for k in np.unique(corners)]


def _read_header(path: Path, data: bytes) -> tuple[str, list[_Element], int]:
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise BadInput(f"{path} is not a PLY file, or it was cut off within its header; export "
                       "the mesh again")
    start = data.find(b"\n", end) + 1 or len(data)
    order, elements = None, []
    for number, line in enumerate(data[:end].decode("latin-1").splitlines(), start=1):
        words = line.split()
        try:
            match words:
                case ["format", kind, _]:
                    order = _ORDERS[kind]
                case ["element", name, count] if int(count) >= 0:
                    elements.append(_Element(name, int(count)))
                case ["property", "list", length_kind, kind, name]:
                    elements[-1].properties.append((name, _TYPES[kind], _TYPES[length_kind]))
                case ["property", kind, name]:
                    elements[-1].properties.append((name, _TYPES[kind], None))
                case ["ply"] | ["comment", *_] | ["obj_info", *_] | []:
                    pass
                case _:
                    raise ValueError
        except (KeyError, IndexError, ValueError):
            raise BadInput(f"{path}, line {number}: {line.strip()[:60]!r} is not a PLY header "
                           "line; export the mesh again") from None
    if order is None:
        raise BadInput(f"{path}: the PLY header has no format line; export the mesh again")
    # Every row takes at least a byte: compare the header's counts with the file's size before any
    # memory is reserved
    for element in elements:
        if element.count and not element.properties or element.count > len(data) - start:
            raise _truncated(path, element, 0)
    return order, elements, start


def _truncated(path: Path, element: _Element, row: int) -> BadInput:
    return BadInput(f"{path} is truncated: its header promises {element.count} rows of "
                    f"'{element.name}', the file ends in row {row + 1}; copy or export the mesh "
                    "again")


def _read_ascii(path: Path, data: bytes, elements: list[_Element]) -> dict:
    lines = [line for line in data.decode("latin-1").splitlines() if line.strip()]
    columns: dict[tuple[str, str], list] = {}
    first = 0
    for element in elements:
        rows = [line.split() for line in lines[first : first + element.count]]
        first += element.count
        if len(rows) < element.count:
            raise _truncated(path, element, len(rows))
        for name, *_ in element.properties:
            columns[element.name, name] = []
        for number, words in enumerate(rows):
            at = 0
            try:
                for name, kind, length_kind in element.properties:
                    cast = float if kind.startswith("f") else int
                    if length_kind is None:
                        columns[element.name, name].append(cast(words[at]))
                        at += 1
                    else:
                        length = int(words[at])
                        values = [cast(word) for word in words[at + 1 : at + 1 + length]]
                        if len(values) < length:
                            raise IndexError
                        columns[element.name, name].append(values)
                        at += 1 + length
            except IndexError:
                raise _truncated(path, element, number) from None
            except ValueError:
                raise BadInput(f"{path}: row {number + 1} of '{element.name}' has a text where a "
                               f"number should be: {' '.join(words)[:60]!r}; export the mesh "
                               "again") from None
    return columns


def _read_binary(path: Path, data: bytes, start: int, order: str, elements: list[_Element]
                 ) -> dict:
    columns: dict[str, dict] = {}
    for element in elements:
        found, start = (_read_uniform(data, start, order, element)
                        or _read_ragged(path, data, start, order, element))
        columns |= {(element.name, name): values for name, values in found.items()}
    return columns


def _read_uniform(data: bytes, start: int, order: str, element: _Element
                  ) -> tuple[dict, int] | None:
    """Read all rows at once if every row's lists are as long as the first row's; else None."""
    lengths, at = {}, start
    for name, kind, length_kind in element.properties:
        size = np.dtype(kind).itemsize
        if length_kind is not None:
            length_size = np.dtype(length_kind).itemsize
            length = np.frombuffer(data[at : at + length_size], order + length_kind)
            lengths[name] = int(length[0]) if len(length) else 0
            at += length_size + size * lengths[name]
        else:
            at += size
        if at > len(data) or min(lengths.values(), default=0) < 0:
            return None
    dtype = element.dtype(order, lengths)
    if start + dtype.itemsize * element.count > len(data):
        return None
    rows = np.frombuffer(data, dtype, count=element.count, offset=start)
    if any((rows[f"{name} length"] != length).any() for name, length in lengths.items()):
        return None
    end = start + dtype.itemsize * element.count
    return {name: rows[name] for name, *_ in element.properties}, end


def _read_ragged(path: Path, data: bytes, at: int, order: str, element: _Element
                 ) -> tuple[dict, int]:
    """Read row by row."""
    found: dict[str, list] = {name: [] for name, *_ in element.properties}
    for row in range(element.count):
        try:
            for name, kind, length_kind in element.properties:
                length = 1
                if length_kind is not None:
                    (length,) = struct.unpack_from(order + _STRUCT_CODES[length_kind], data, at)
                    at += struct.calcsize(_STRUCT_CODES[length_kind])
                values = struct.unpack_from(f"{order}{length}{_STRUCT_CODES[kind]}", data, at)
                at += struct.calcsize(f"{order}{length}{_STRUCT_CODES[kind]}")
                found[name].append(values if length_kind is not None else values[0])
        except struct.error:
            raise _truncated(path, element, row) from None
    return found, at


def write_ply(path: Path, vertices_m: np.ndarray, faces: np.ndarray) -> None:
    """Write triangles as a binary little-endian PLY file; equal meshes give equal bytes.

    Args:
        path: File to write.
        vertices_m: (v, 3) positions [m], stored in single precision.
        faces: (f, 3) indices of vertices.
    """
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices_m)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    rows["count"] = 3
    rows["index"] = faces
    with open(path, "wb") as file:
        file.write(header.encode("ascii"))
        file.write(np.ascontiguousarray(vertices_m, dtype="<f4").tobytes())
        file.write(rows.tobytes())
