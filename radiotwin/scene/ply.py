"""PLY files: reader of polygons from ASCII and binary files, writer of triangles.

trimesh's reader silently accepts a truncated ASCII file, or a face that names a missing vertex, and
refuses binary files that mix triangles with quadrilaterals.
"""

import re
import struct
from array import array
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.io.budgets import COLUMNS, CORNERS, DOCUMENT_BYTES, FACES, VERTICES
from radiotwin.io.inputs import read_bytes

_TYPES = {"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
          "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
          "float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
_STRUCT_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f",
                 "f8": "d"}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_INDICES = ("vertex_indices", "vertex_index")  # usual names of a face's list of corners
_LINE_END = re.compile("\r\n|\n|\r")
_BUDGETS = {"vertex": VERTICES, "face": FACES}


@dataclass
class _Element:
    """An element of a PLY header, such as `vertex`: its number of rows and its properties."""

    name: str
    count: int
    # Name, type, and type of the list's length (None: not a list)
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)

    def dtype(self, order: str, lengths: dict[str, int]) -> np.dtype:
        """Return NumPy's type of a binary row (`order`: byte order), given its lists' lengths."""
        fields: list[tuple] = []
        for name, kind, length_kind in self.properties:
            if length_kind is None:
                fields.append((name, order + kind))
            else:
                fields += [(f"{name} length", order + length_kind),
                           (name, order + kind, (lengths[name],))]
        return np.dtype(fields)

    def is_read(self, name: str) -> bool:
        """Return whether a property holds positions or faces; others are skipped."""
        return name in {"vertex": tuple("xyz"), "face": _INDICES}.get(self.name, ())

    def add(self, name: str, kind: str, length_kind: str | None) -> None:
        """Add a property, a list if `length_kind` is given; KeyError, ValueError if impossible."""
        integers = {length_kind, kind if self.name == "face" and self.is_read(name) else None}
        if (any(one is not None and _TYPES[one].startswith("f") for one in integers)
                or self.is_read(name) and (length_kind is None) != (self.name == "vertex")):
            raise ValueError
        self.properties.append((name, _TYPES[kind],
                                None if length_kind is None else _TYPES[length_kind]))


@dataclass
class _Lists:
    """Lists of integers of different lengths, stored one after the other."""

    lengths: array = field(default_factory=lambda: array("q"))
    values: array = field(default_factory=lambda: array("q"))

    def append(self, values: tuple | list) -> None:
        """Add a list."""
        self.lengths.append(len(values))
        self.values.extend(values)


def read_ply(path: Path) -> tuple[np.ndarray, list[np.ndarray]]:
    """Read vertices and polygons of a PLY file.

    Returns:
        (v, 3) vertices, and polygons: for each number of corners k, (n, k) indices of vertices.

    Raises:
        BadInput: No such file, not a PLY file, truncated, too large, a header without vertices or
            faces, or a text or number that is impossible in a mesh.
    """
    data = read_bytes(path, "PLY mesh")
    order, elements, start = _read_header(path, data)
    if order == "":
        DOCUMENT_BYTES.check(len(data), f"{path} (ASCII; the binary form takes less memory)")
    columns = (_read_ascii(path, data[start:], elements) if order == "" else
               _read_binary(path, data, start, order, elements))
    try:
        vertices = np.stack([np.asarray(columns["vertex", axis], dtype=float) for axis in "xyz"],
                            axis=1)
    except KeyError as missing:
        raise BadInput(f"{path}: the PLY header declares no vertex {missing.args[0][1]}; export "
                       "the mesh again") from None
    polygons = next((columns["face", name] for name in _INDICES if ("face", name) in columns), None)
    if polygons is None:
        raise BadInput(f"{path}: the PLY header declares no face vertex_indices; export the mesh "
                       "with faces")
    return vertices, _by_corners(path, polygons)


def _by_corners(path: Path, polygons: np.ndarray | _Lists) -> list[np.ndarray]:
    """Group polygons by their number of corners k into arrays (n, k)."""
    if isinstance(polygons, np.ndarray):
        CORNERS.check(polygons.shape[1], path)
        return [polygons.astype(np.int64)]
    lengths, values = (np.frombuffer(numbers, dtype=np.int64) if numbers else
                       np.zeros(0, dtype=np.int64) for numbers in (polygons.lengths,
                                                                   polygons.values))
    CORNERS.check(lengths.max(initial=0), path)
    starts = np.cumsum(lengths) - lengths
    return [values[starts[lengths == k][:, None] + np.arange(k)] for k in np.unique(lengths)]


def _read_header(path: Path, data: bytes) -> tuple[str, list[_Element], int]:
    """Parse a PLY header: byte order ("": ASCII), elements, and where the data begin."""
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise BadInput(f"{path} is not a PLY file, or it was cut off within its header; export "
                       "the mesh again")
    start = data.find(b"\n", end) + 1 or len(data)
    order, elements = None, []
    for number, line in enumerate(_lines(data[:end]), start=1):
        words = line.split()
        try:
            match words:
                case ["format", kind, _]:
                    order = _ORDERS[kind]
                case ["element", name, count] if int(count) >= 0:
                    elements.append(_Element(name, int(count)))
                case ["property", "list", length_kind, kind, name]:
                    elements[-1].add(name, kind, length_kind)
                case ["property", kind, name]:
                    elements[-1].add(name, kind, None)
                case ["ply"] | ["comment", *_] | ["obj_info", *_] | []:
                    pass
                case _:
                    raise ValueError
        except (KeyError, IndexError, ValueError):
            raise BadInput(f"{path}, line {number}: {line.strip()[:60]!r} is not a PLY header "
                           "line; export the mesh again") from None
    if order is None:
        raise BadInput(f"{path}: the PLY header has no format line; export the mesh again")
    _check_elements(path, elements, len(data) - start)
    return order, elements, start


def _check_elements(path: Path, elements: list[_Element], size: int) -> None:
    """Check the header's counts against the size of the data, before any memory is reserved."""
    COLUMNS.check(sum(len(element.properties) for element in elements), path)
    names = [(element.name, name) for element in elements for name, *_ in element.properties]
    if len(set(names)) < len(names) or len({element.name for element in elements}) < len(elements):
        raise BadInput(f"{path}: the PLY header declares an element or a property twice; export "
                       "the mesh again")
    for element in elements:  # every row takes at least a byte
        if element.count and not element.properties or element.count > size:
            raise _truncated(path, element, 0)
        if element.name in _BUDGETS:
            _BUDGETS[element.name].check(element.count, path)


def _lines(data: bytes) -> list[str]:
    """Split ASCII data into lines; `splitlines` would also split within UTF-8 characters."""
    return _LINE_END.split(data.decode("latin-1"))


def _truncated(path: Path, element: _Element, row: int) -> BadInput:
    """Return the error that the file ends before the header's count of rows."""
    return BadInput(f"{path} is truncated: its header promises {element.count} rows of "
                    f"{element.name[:60]!r}, the file ends in row {row + 1}; copy or export the "
                    "mesh again")


def _read_ascii(path: Path, data: bytes, elements: list[_Element]) -> dict:
    """Return (element, property) -> values of an ASCII file; only vertices and faces are kept."""
    lines = [line for line in _lines(data) if line.strip()]
    columns: dict[tuple[str, str], array | _Lists] = {}
    first = 0
    for element in elements:
        rows = lines[first : first + element.count]
        first += element.count
        if len(rows) < element.count:
            raise _truncated(path, element, len(rows))
        found = _containers(element)
        for number, line in enumerate(rows):
            words = line.split()
            try:
                _read_words(words, element, found)
            except IndexError:
                raise _truncated(path, element, number) from None
            except (ValueError, OverflowError):
                raise BadInput(f"{path}: row {number + 1} of {element.name[:60]!r} has a text or "
                               f"a number that cannot be one of a mesh where a number should be: "
                               f"{line.strip()[:60]!r}; export the mesh again") from None
        columns |= {(element.name, name): values for name, values in found.items()}
    return columns


def _containers(element: _Element) -> dict[str, array | _Lists]:
    """Return an empty container for each needed property of an element."""
    return {name: array("d") if length_kind is None else _Lists()
            for name, _, length_kind in element.properties if element.is_read(name)}


def _read_words(words: list[str], element: _Element, found: dict) -> None:
    """Append the values of an ASCII row to the lists in `found`, one for each needed property."""
    at = 0
    for name, kind, length_kind in element.properties:
        cast = float if kind.startswith("f") else int
        if length_kind is None:
            value = cast(words[at])
            at += 1
            if name in found:
                found[name].append(value)
        else:
            length = int(words[at])
            if length < 0:
                raise ValueError
            values = [cast(word) for word in words[at + 1 : at + 1 + length]]
            if len(values) < length:
                raise IndexError
            if name in found:
                found[name].append(values)
            at += 1 + length


def _read_binary(path: Path, data: bytes, start: int, order: str, elements: list[_Element]
                 ) -> dict:
    """Return (element, property) -> values of a binary file; only vertices and faces are kept."""
    columns: dict[tuple[str, str], np.ndarray | array | _Lists] = {}
    for element in elements:
        found, start = (_read_uniform(data, start, order, element)
                        or _read_ragged(path, data, start, order, element))
        columns |= {(element.name, name): values for name, values in found.items()}
    return columns


def _read_uniform(data: bytes, start: int, order: str, element: _Element
                  ) -> tuple[dict, int] | None:
    """Read all binary rows of an element at once: its values by property, and where they end.

    None if its lists differ in length, so that each row has to be read by itself.
    """
    if element.count == 0:
        return None
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
    if (at - start) * element.count > len(data) - start or at - start >= 2**31:
        return None
    dtype = element.dtype(order, lengths)
    rows = np.frombuffer(data, dtype, count=element.count, offset=start)
    if any((rows[f"{name} length"] != length).any() for name, length in lengths.items()):
        return None
    end = start + dtype.itemsize * element.count
    return {name: rows[name] for name, *_ in element.properties if element.is_read(name)}, end


def _read_ragged(path: Path, data: bytes, at: int, order: str, element: _Element
                 ) -> tuple[dict, int]:
    """Read rows whose lists differ in length one by one; returns the same as `_read_uniform`."""
    found = _containers(element)
    for row in range(element.count):
        try:
            for name, kind, length_kind in element.properties:
                length = 1
                if length_kind is not None:
                    (length,) = struct.unpack_from(order + _STRUCT_CODES[length_kind], data, at)
                    at += struct.calcsize(_STRUCT_CODES[length_kind])
                size = length * struct.calcsize(_STRUCT_CODES[kind])
                if length < 0 or at + size > len(data):
                    raise struct.error
                if name in found:
                    CORNERS.check(length, path)
                    values = struct.unpack_from(f"{order}{length}{_STRUCT_CODES[kind]}", data, at)
                    found[name].append(values if length_kind is not None else values[0])
                at += size
        except struct.error:
            raise _truncated(path, element, row) from None
    return found, at


def write_ply(path: Path, vertices_m: np.ndarray, faces: np.ndarray) -> None:
    """Write triangles as a binary little-endian PLY file; equal meshes give equal bytes.

    Positions (v, 3) [m] are stored in single precision.
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
