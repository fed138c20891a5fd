"""Damage to files: bytes, texts, numbers, and the parts of containers; each is decided by three numbers."""

import gzip
import io
import json
import re
import sqlite3
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

NUMBERS = ("nan", "inf", "-inf", "-1", "0", "-0", "1e308", "-1e308", "1e-308", "1" * 400, "1" * 5000, "1e999", "2147483648",
           "-2147483649", "18446744073709551616", "0.1", "1e9", "1e7", "1e18", "0x10", "1_0", "١", "", "null", "true")
TEXTS = ("", " ", "'", '"', "null", "[]", "{}", "../../../etc/passwd", "/etc/passwd", "/dev/zero", "file:///etc/passwd",
         "http://127.0.0.1:{port}/x", "/vsicurl/http://127.0.0.1:{port}/x", "<img src=x onerror=alert(1)>", "</script>",
         "=cmd|' /C calc'!A0", "\x1b[31m\x1b]0;owned\x07", "‮evil", "a\x00b", "é" * 300, "a" * 5000, "$x", "%n%s%x",
         "{{7*7}}", "CON", "canary", "../canary", "\ud800".encode("utf-8", "surrogatepass").decode("latin-1"), "default",
         "\u2028", "\t", ",", ";", "a.b.c", ".", "..", "/", "-h", "--out=/tmp/x", "evil", "../evil")
# What may stand where an output's name is expected by mistake
SAFE_TEXTS = tuple(text for text in TEXTS if not set(text) & set("/\0") and text != "..")
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][A-Za-z0-9_]*")


@dataclass(frozen=True)
class Mutation:
    """One change of a file.

    `where` in [0, 1) is where in the file, or which of its parts; `what` chooses the new value.
    """

    name: str
    where: float
    what: int


def apply(mutation: Mutation, data: bytes, suffix: str, port: int) -> bytes:
    """Return the changed content of a file; one that cannot be so changed is returned as it is."""
    change = _of(suffix).get(mutation.name) or BYTES[mutation.name]
    try:
        changed = change(data, mutation.where, mutation.what)
    except (ValueError, KeyError, IndexError, OSError, EOFError, sqlite3.Error, UnicodeError, RuntimeError, TypeError,
            AttributeError, zlib.error):
        return data  # an earlier change has left nothing to take apart
    return changed.replace(b"{port}", str(port).encode())


def names(suffix: str) -> list[str]:
    """Return the names of the mutations of a kind of file."""
    return [*_of(suffix)] if suffix == ".args" else [*_of(suffix), *BYTES]


def _at(where: float, count: int) -> int:
    return min(int(where * count), count - 1)


def _number(what: int) -> str:
    return NUMBERS[what % len(NUMBERS)]


def _text(what: int) -> str:
    return TEXTS[what % len(TEXTS)]


def _spliced(data: bytes, where: float, removed: int, added: bytes) -> bytes:
    """Replace some bytes at a place."""
    index = _at(where, len(data))
    return data[:index] + added + data[index + removed:]


Change = Callable[[bytes, float, int], bytes]
EMPTY = (b"", b"\n", b"\x00" * 1000, b"\xff\xfe" + b"a\x00" * 20, b"[" * 50_000, b"PK\x03\x04")
BYTES: dict[str, Change] = {
    "flip": lambda data, where, what: _spliced(data, where, 1, bytes([data[_at(where, len(data))] ^ (1 << what % 8)])),
    "byte": lambda data, where, what: _spliced(data, where, 1, bytes([(0, 255, 127, 128, 10, 34)[what % 6]])),
    "cut": lambda data, where, what: data[:int(where * len(data))],
    "drop": lambda data, where, what: _spliced(data, where, 1 + what % 64, b""),
    "repeat": lambda data, where, what: _spliced(data, where, 0, data[_at(where, len(data)):][:1 + what % 256] * (1 + what % 500)),
    "insert": lambda data, where, what: _spliced(data, where, 0, _text(what).encode("utf-8", "replace")),
    "empty": lambda data, where, what: EMPTY[what % 6],
    "zeros": lambda data, where, what: data + bytes(10 * 2**20)}


def _replaced(pattern: re.Pattern, data: bytes, where: float, new: str) -> bytes:
    found = list(pattern.finditer(data))
    match = found[_at(where, len(found))]
    return data[:match.start()] + new.encode("utf-8", "replace") + data[match.end():]


def _line_in_text(data: bytes, where: float, what: int) -> bytes:
    lines = data.split(b"\n")
    index, other = _at(where, len(lines)), what % len(lines)
    if what % 3 == 0:
        lines[index:index] = [lines[index]] * (1 + what % 50)
    elif what % 3 == 1:
        del lines[index]
    else:
        lines[index], lines[other] = lines[other], lines[index]
    return b"\n".join(lines)


TEXT: dict[str, Change] = {
    "number": lambda data, where, what: _replaced(_NUMBER, data, where, _number(what)),
    "word": lambda data, where, what: _replaced(_WORD, data, where, _text(what)), "line": _line_in_text}


def _json_node(data: bytes, where: float, what: int) -> bytes:
    """Replace a node of the document by a value of another type, or a subtree by another one."""
    root = json.loads(data)
    places: list[tuple] = []

    def walk(node):
        for key in (node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()):
            places.append((node, key))
            walk(node[key])

    walk(root)
    node, key = places[_at(where, len(places))]
    values = [None, True, -1, 0, 1e308, float("nan"), float("inf"), 10**30, [], {}, [[]], [None], _text(what), "1",
              [node[key]] * 20, {"a": node[key]}, node]
    value = values[what % len(values)]
    if value is node:  # a copy of its own parent inside it
        value = json.loads(json.dumps(node))
    if what % 7 == 0:
        del node[key]
    elif what % 11 == 0 and isinstance(node, dict):
        node[_text(what)] = node[key]
    else:
        node[key] = value
    return json.dumps(root).encode()


def _json_deep(data: bytes, where: float, what: int) -> bytes:
    text, depth = data.decode(), (500, 5_000, 100_000)[what % 3]
    index = text.find(":", int(where * len(text))) + 1
    return (text[:index] + "[" * depth + "]" * depth + text[index:].lstrip("0123456789.-e")).encode()


def _value_of_option(data: bytes, where: float, what: int) -> bytes:
    """Change the value of an option, or a part of it; never where outputs go, nor what the command is."""
    arguments = data.split(b"\0")
    first = 1 if arguments[0].startswith(b"marl") else 3
    places = [index for index in range(first, len(arguments)) if arguments[index - 1] not in (b"-o", b"--out")
              and not arguments[index].startswith(b"-")] or [len(arguments) - 1]
    index = places[_at(where, len(places))]
    new = (*NUMBERS, *SAFE_TEXTS)[what % (len(NUMBERS) + len(SAFE_TEXTS))].encode("utf-8", "replace")
    parts = arguments[index].split(b",")
    if what // 97 % 7 == 0:
        del arguments[index]
    elif what // 97 % 7 == 1:
        arguments += arguments[index - 1:index + 1]
    elif what // 97 % 7 == 2 and len(parts) > 1:
        parts[what % len(parts)] = new
        arguments[index] = b",".join(parts)
    elif what // 97 % 7 == 3:
        arguments[index] = b",".join(parts * (2 + what % 50))
    else:
        arguments[index] = new
    return b"\0".join(arguments)


def _inside(data: bytes, where: float, what: int) -> bytes:
    """Change what is compressed."""
    inner = gzip.decompress(data)
    changes = list((TEXT | BYTES).values())
    return gzip.compress(changes[what % len(changes)](inner, where, what // 7), 1)


def _bomb(data: bytes, where: float, what: int) -> bytes:
    packed = gzip.compress(bytes(2**20), 9)
    return data + packed * (16, 256, 4096)[what % 3]


def _header(data: bytes, where: float, what: int) -> bytes:
    """Change the JSON header of a safetensors file."""
    length = int.from_bytes(data[:8], "little")
    header = data[8:8 + length]
    if what % 5 == 0:
        return (2**(20 + what % 40)).to_bytes(8, "little") + data[8:]
    changed = _json_node(header, where, what) if what % 2 else TEXT["number"](header, where, what)
    return len(changed).to_bytes(8, "little") + changed + data[8 + length:]


def _hdf5(data: bytes, where: float, what: int) -> bytes:
    """Change an object of an HDF5 file: values, types, shapes, attributes, links out of it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.h5"
        path.write_bytes(data)
        with h5py.File(path, "r+") as file:
            name = sorted(file)[_at(where, len(file))]
            _change_dataset(file, name, what)
        return path.read_bytes()


def _change_dataset(file: h5py.File, name: str, what: int) -> None:
    dataset = file[name]
    values, attributes = dataset[()], dict(dataset.attrs)
    choice, text = what % 12, _text(what).replace("\x00", "")
    if choice not in (7, 9):
        del file[name]
    if choice == 1:
        file[name] = h5py.ExternalLink(("/etc/passwd", "../canary", "canary.h5")[what % 3], "/" + name)
    elif choice == 2:
        file.create_dataset(name, (100,), "u1", external=[("../canary", 0, 100)])
    elif choice == 3:
        size = (60_000, 2**40)[what % 2]
        file.create_dataset(name, (size, size), "f4", chunks=(64, 64), compression="gzip")
    elif choice == 4:
        file[name] = h5py.SoftLink("/" + sorted(file)[0])
    elif choice == 5:
        file.create_group(name)
    elif choice == 6:
        file[name] = np.array([text] * max(values.size, 1), dtype=h5py.string_dtype())
    elif choice == 7:
        file[name].attrs[sorted(attributes)[what % len(attributes)]] = (np.nan, "x" * 50_000, 0, np.zeros(10), text)[what % 5]
    elif choice == 8:
        layout = h5py.VirtualLayout(values.shape or (1,), "f4")
        layout[:] = h5py.VirtualSource("../canary.h5", name, values.shape or (1,))
        file.create_virtual_dataset(name, layout)
    elif choice == 9:
        file.attrs[sorted(file.attrs)[what % len(file.attrs)]] = (text, np.nan, -1)[what % 3]
    elif choice > 9 and values.dtype.kind in "fiu" and values.size:
        values = values.astype("f8")
        values.flat[what % values.size] = float(("nan", "inf", "1e308", "-1e308", "1e9", "0", "-1")[what % 7])
        file[name] = values[:max(1, len(values) - what % 2)] if values.ndim else values


def _sqlite(data: bytes, where: float, what: int) -> bytes:
    """Run a statement in a GeoPackage."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.gpkg"
        path.write_bytes(data)
        with sqlite3.connect(path) as database:
            tables = [row[0] for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
            table = tables[_at(where, len(tables))]
            columns = [row[1] for row in database.execute(f"PRAGMA table_info({table})")]
            column = columns[what % len(columns)]
            for trigger in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
                database.execute(f"DROP TRIGGER {trigger[0]}")
            statements = (
                f"UPDATE sqlite_master SET sql = CAST(replace(CAST(sql AS BLOB), '{column}', x'ff' || '{column}') AS TEXT)",
                f"UPDATE {table} SET {column} = NULL", f"UPDATE {table} SET {column} = '{_number(what)}'",
                f"UPDATE {table} SET {column} = zeroblob({10 ** (what % 7)})", f"DROP TABLE {table}",
                f"DELETE FROM {table}", f"ALTER TABLE {table} RENAME TO other",
                f"CREATE VIEW evil AS SELECT load_extension('../evil'), readfile('/etc/passwd') FROM {table}",
                f"UPDATE {table} SET {column} = (SELECT {column} FROM {table}) || 'x'")
            database.execute("PRAGMA writable_schema = ON")
            database.execute(statements[what % len(statements)])
            database.commit()
        database.close()
        return path.read_bytes()


def _parquet(data: bytes, where: float, what: int) -> bytes:
    """Change the values or the type of a column."""
    import pyarrow as pa
    from pyarrow import parquet

    table = parquet.read_table(io.BytesIO(data))
    index, count = _at(where, table.num_columns), table.num_rows
    columns = (
        pa.nulls(count), pa.array([_text(what).encode("utf-8", "replace")] * count), pa.array([float(10 ** (what % 300))] * count),
        pa.array([[1.0]] * count), pa.array([{"a": 1}] * count), pa.array([True] * count), pa.array([10**18] * count),
        pa.array(["a"] * count).dictionary_encode(), pa.array([0] * count, pa.timestamp("us")),
        pa.array([None, *["a"] * (count - 1)]), pa.array([b"\xff", *[b"a"] * (count - 1)]),
        pa.StringArray.from_buffers(count, *pa.array([b"\xff"] * count).buffers()[1:]))
    name = table.column_names[index] if what % 3 else _text(what)
    out = io.BytesIO()
    table = table.set_column(index, name, columns[what % len(columns)]).replace_schema_metadata(table.schema.metadata)
    if what % 5 == 0:
        table = pa.concat_tables([table] * 50)
    parquet.write_table(table, out)
    return out.getvalue()


def _of(suffix: str) -> dict[str, Change]:
    return {
        **dict.fromkeys((".json", ".geojson", ".city.json", ".gltf"), TEXT | {"node": _json_node, "deep": _json_deep}),
        ".gz": {"inside": _inside, "bomb": _bomb}, ".safetensors": {"header": _header},
        ".nc": {"object": _hdf5}, ".args": {"value": _value_of_option}, ".gpkg": {"statement": _sqlite}, ".parquet": {"column": _parquet},
    }.get(suffix, TEXT)
