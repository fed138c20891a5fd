"""Check that an HDF5 file or a Zarr folder only holds plain arrays of bounded size.

HDF5 files can refer to other files (external links, raw data, virtual datasets), require filters
that are loaded as plug-ins, and expand to far more values than they have bytes. Zarr folders can do
the same by links and codecs. All of this is refused from the metadata, before any value is read.
The Zarr format is version 3, https://zarr-specs.readthedocs.io/en/latest/v3/core/index.html.
"""

import math
import os
import stat
import zlib
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import h5py  # type: ignore[import-untyped]
import numpy as np

from radiotwin.errors import BadInput
from radiotwin.io.budgets import (
    DOCUMENT_BYTES,
    FILE_BYTES,
    MAP_ATTRIBUTES,
    MAP_CHUNKS,
    MAP_PIECE_BYTES,
    MAP_VALUES,
    SETTINGS_BYTES,
    Budget,
)
from radiotwin.io.inputs import parse_json, read_text

_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
_LAYOUTS = {h5py.h5d.COMPACT, h5py.h5d.CONTIGUOUS, h5py.h5d.CHUNKED}
_TYPES = {h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.ENUM, h5py.h5t.STRING}
_REFERRING = {"DIMENSION_LIST", "REFERENCE_LIST"}  # attributes that link dimensions and axes
_MAX_OBJECTS = 1_000  # in a file; a radio map has eight
_MAX_CHUNK_VALUES = 2**24  # in a chunk that is larger than its array
_MAX_INFLATED = 2**28  # excess bytes of a chunk that are accepted without decompressing it
_DEFLATE_RATIO = 1032  # highest compression ratio of deflate
_HEAP, _HEAP_HEADER = b"GCOL", 16
_BLOCK_BYTES = 2**22
METADATA = "zarr.json"
_PIECES = "c"  # folder of an array's chunks, by the default chunk key encoding
_FORMAT_2 = (".zgroup", ".zarray", ".zattrs", ".zmetadata")
_ITEM_BYTES = {"bool": 1, "int8": 1, "int16": 2, "int32": 4, "int64": 8, "uint8": 1, "uint16": 2,
               "uint32": 4, "uint64": 8, "float16": 2, "float32": 4, "float64": 8}
_TEXT = "fixed_length_utf32"
_COMPRESSORS = ("zstd", "gzip")
_CRC_BYTES = 4
_MAX_DIMS = 4
_MAX_DIGITS = 9  # in the number of a chunk
_HEAD_BYTES = 18  # longest header of a Zstandard frame
_ADVICE = "a radio map is one file with plain arrays: make it again"
_ZARR_ADVICE = ("write it again with radiotwin, or with xarray's to_zarr(…, zarr_format=3) and its "
                "standard codecs")


def check_hdf5(file: IO[bytes], path: Path) -> None:
    """Check that reading an HDF5 file's root group can neither harm nor fill memory.

    Args:
        file: open for reading; its position changes.
        path: of the file, for messages.

    Raises:
        BadInput: the file refers to another one, has groups, links, filters or types that radio
            maps do not have, or is too large.
        Exception: from h5py, of many classes: the file is damaged, or not HDF5.
    """
    heap_bytes = _largest_heap(file)
    with h5py.File(file, "r") as opened:
        root = opened.id
        if root.links is None or len(opened) > _MAX_OBJECTS:
            raise BadInput(f"{path} holds more than {_MAX_OBJECTS} objects; {_ADVICE}")
        texts = _check_attributes(root, path, "the file")
        for name in list(opened):
            if root.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
                raise BadInput(f"{path}: {name!r} is a link to another place or file; {_ADVICE}")
            each = h5py.h5o.open(root, name.encode())
            if not isinstance(each, h5py.h5d.DatasetID):
                raise BadInput(f"{path}: {name!r} is not an array; {_ADVICE}")
            texts += _check_attributes(each, path, repr(name))
            _check_array(each, path, name, heap_bytes)
        DOCUMENT_BYTES.check(texts * heap_bytes, f"{path}: its attributes")


def _check_array(array: h5py.h5d.DatasetID, path: Path, name: str, heap_bytes: int) -> None:
    """Check storage, filters, type and number of values of an HDF5 array."""
    plan, what = array.get_create_plist(), f"{path}: {name!r}"
    if plan.get_layout() not in _LAYOUTS or plan.get_external_count():
        raise BadInput(f"{what} takes its values from other files or arrays; {_ADVICE}")
    filters = [plan.get_filter(i)[0] for i in range(plan.get_nfilters())]
    if not set(filters) <= _FILTERS or len(set(filters)) < len(filters):
        raise BadInput(f"{what} is compressed by other filters ({filters}) than gzip, shuffle and "
                       f"fletcher32, each once; {_ADVICE}")
    kind = array.get_type()
    if kind.get_class() not in _TYPES:
        raise BadInput(f"{what} holds neither numbers nor texts; {_ADVICE}")
    values = int(np.prod(array.shape, dtype=float))
    MAP_VALUES.check(values, what)
    FILE_BYTES.check(values * (heap_bytes if _is_text(kind) else 1), what)
    if not _is_text(kind):
        FILE_BYTES.check(max(values, 1) * kind.get_size() if kind.get_size() > 8 else 0, what)
    if plan.get_layout() == h5py.h5d.CHUNKED:
        chunk = int(np.prod(plan.get_chunk(), dtype=float))
        if chunk > max(values, _MAX_CHUNK_VALUES):
            MAP_VALUES.refuse(what, f"pieces of {chunk:,} values for {values:,} in all")
        pieces = np.prod([-(-size // part) for size, part in
                          zip(array.shape, plan.get_chunk(), strict=True)], dtype=float)
        MAP_CHUNKS.check(pieces, what)
        if filters:
            _check_inflation(array, chunk * kind.get_size(), what)


def _check_inflation(array: h5py.h5d.DatasetID, chunk_bytes: int, what: str) -> None:
    """Check that no compressed chunk becomes far larger than declared; HDF5 would inflate it."""
    stored: list[tuple[tuple[int, ...], int]] = []
    array.chunk_iter(lambda info: stored.append((info.chunk_offset, info.size)))
    for offset, size in stored:
        if size > 2 * chunk_bytes + 1024:
            raise BadInput(f"{what} has a compressed piece larger than it is; {_ADVICE}")
        if size * _DEFLATE_RATIO > chunk_bytes + _MAX_INFLATED:
            mask, data = array.read_direct_chunk(offset)
            inflater = zlib.decompressobj()
            try:
                inflater.decompress(data, chunk_bytes + 64)
            except zlib.error:
                continue  # not compressed, or damaged: HDF5 says so
            if inflater.unconsumed_tail:
                FILE_BYTES.refuse(what, f"a piece of more than {chunk_bytes:,} bytes when "
                                        "decompressed")


def _check_attributes(owner: h5py.h5g.GroupID | h5py.h5d.DatasetID, path: Path, what: str) -> int:
    """Check an HDF5 object's attributes by type and size; count their texts of unknown length."""
    count = h5py.h5a.get_num_attrs(owner)
    MAP_ATTRIBUTES.check(count, f"{path}: {what}")
    texts = size = 0
    for index in range(count):
        attribute = h5py.h5a.open(owner, index=index)
        kind, refers = attribute.get_type(), attribute.name.decode("utf-8", "replace") in _REFERRING
        if kind.get_class() not in _TYPES and not refers:
            raise BadInput(f"{path}: an attribute of {what} is neither a number nor a text; "
                           f"{_ADVICE}")
        size += attribute.get_storage_size()
        if kind.get_class() == h5py.h5t.VLEN or _is_text(kind):
            texts += int(np.prod(attribute.shape, dtype=float))
    SETTINGS_BYTES.check(size, f"{path}: the attributes of {what}")
    return texts


def _is_text(kind: h5py.h5t.TypeID) -> bool:
    """Return whether values are texts of variable length, which HDF5 keeps in a heap."""
    return isinstance(kind, h5py.h5t.TypeStringID) and bool(kind.is_variable_str())


def _largest_heap(file: IO[bytes]) -> int:
    """Return the size [bytes] of the largest heap in an HDF5 file: no text in it is longer.

    HDF5 knows the length of a text only after reading it. A heap begins with `GCOL`, a version,
    three zeros and its size (HDF5 File Format Specification 3.0, III.E); the same eight bytes occur
    by chance once in 10^19.
    """
    file.seek(0)
    largest, tail = 0, b""
    while block := file.read(_BLOCK_BYTES):
        data = tail + block
        at = data.find(_HEAP + b"\1\0\0\0")
        while 0 <= at <= len(data) - _HEAP_HEADER:
            largest = max(largest, int.from_bytes(data[at + 8:at + _HEAP_HEADER], "little"))
            at = data.find(_HEAP + b"\1\0\0\0", at + 1)
        tail = data[1 - _HEAP_HEADER:]
    file.seek(0)
    return largest


@dataclass(frozen=True)
class _Array:
    """Chunks of a Zarr array, from its metadata."""

    grid: tuple[int, ...]  # number of chunks along each axis
    piece_bytes: int  # of one chunk, decompressed
    compressor: str | None
    has_crc: bool
    missing_is_nothing: bool  # whether a missing chunk means "not detected"


def check_zarr(folder: Path, known: Collection[str], streamed: Budget) -> dict[str, int]:
    """Check that opening a Zarr folder and reading its arrays can neither harm nor fill memory.

    Args:
        folder: to check.
        known: names of the arrays that are allowed.
        streamed: budget of an array of four dimensions, which is read in parts.

    Returns:
        array -> number of missing chunks, which have the fill value.

    Raises:
        BadInput: the folder is no Zarr of format 3; it has links, arrays, codecs or types that
            radio maps do not have; or it is too large.
    """
    entries = _listed(folder, [METADATA, *known])
    if METADATA not in entries:
        raise BadInput(f"{folder} has no {METADATA}, so it is no radio map in Zarr; `radiotwin map "
                       "… --out NAME.zarr` makes one")
    group = _metadata(folder, "group")
    MAP_ATTRIBUTES.check(len(group.get("attributes", {})), f"{folder}: its attributes")
    return {name: _check_zarr_array(folder / name, streamed)
            for name in sorted(entries - {METADATA})}


def _listed(folder: Path, allowed: Collection[str]) -> set[str]:
    """Return the names in a folder; BadInput if one is not allowed, or a link."""
    names = set()
    for entry in os.scandir(folder):
        if entry.name in _FORMAT_2:
            raise BadInput(f"{folder} is of Zarr format 2; {_ZARR_ADVICE}")
        if entry.name not in allowed:
            raise BadInput(f"{folder} holds {entry.name[:60]!r}, which is no part of a radio map "
                           "in Zarr: remove it")
        if not (entry.is_dir(follow_symlinks=False) or entry.is_file(follow_symlinks=False)):
            _refuse_kind(entry.path)
        names.add(entry.name)
    return names


def _refuse_kind(path: Path | str) -> None:
    raise BadInput(f"{path} is a link, a pipe or a device; a radio map in Zarr is one folder with "
                   "regular files: copy what it stands for")


def _metadata(folder: Path, kind: str) -> dict[str, Any]:
    """Read and check `zarr.json` of a group or an array."""
    path = folder / METADATA
    found = parse_json(read_text(path, "description of a Zarr map", SETTINGS_BYTES), path,
                       allow_nan=True)
    if not isinstance(found, dict) or found.get("zarr_format") != 3 \
            or found.get("node_type") != kind \
            or not isinstance(found.get("attributes", {}), dict):
        raise BadInput(f"{path} does not describe a Zarr {kind} of format 3; {_ZARR_ADVICE}")
    return found


def _check_zarr_array(folder: Path, streamed: Budget) -> int:
    """Check a Zarr array; return the number of its missing chunks."""
    names = _listed(folder, (METADATA, _PIECES))
    described = _metadata(folder, "array")
    try:
        array = _described(folder, described, streamed)
    except (LookupError, TypeError, AttributeError, ValueError) as error:
        raise BadInput(f"{folder / METADATA} is damaged ({type(error).__name__}: "
                       f"{str(error)[:200]}); {_ZARR_ADVICE}") from None
    found = _check_pieces(folder / _PIECES, array.grid, array) if _PIECES in names else 0
    missing = math.prod(array.grid) - found
    if missing and not array.missing_is_nothing:
        raise BadInput(f"{folder} lacks {missing:,} of {math.prod(array.grid):,} pieces, which "
                       "would stand for a number; copy the folder again, as a whole")
    return missing


def _described(folder: Path, described: dict[str, Any], streamed: Budget) -> _Array:
    """Check the metadata of a Zarr array against the budgets; return how it is cut into chunks."""
    MAP_ATTRIBUTES.check(len(described.get("attributes", {})), f"{folder}: its attributes")
    shape = _sizes(described["shape"], 0)
    if described["chunk_grid"]["name"] != "regular" or described.get("storage_transformers"):
        raise BadInput(f"{folder} is not cut into equal pieces; {_ZARR_ADVICE}")
    keys = described["chunk_key_encoding"]
    if keys["name"] != "default" or keys.get("configuration", {}).get("separator", "/") != "/":
        raise BadInput(f"{folder} names its pieces otherwise than c/0/0; {_ZARR_ADVICE}")
    chunk = _sizes(described["chunk_grid"]["configuration"]["chunk_shape"], 1)
    if len(chunk) != len(shape) or len(shape) > _MAX_DIMS:
        raise ValueError(f"{len(shape)} dims, in pieces of {len(chunk)}")
    kind, item_bytes = _kind(folder, described["data_type"])
    values = math.prod(shape)
    (streamed if len(shape) == _MAX_DIMS else MAP_VALUES).check(values, folder)
    if len(shape) < _MAX_DIMS:
        FILE_BYTES.check(values * item_bytes, folder)
    piece_bytes = math.prod(chunk) * item_bytes
    MAP_PIECE_BYTES.check(piece_bytes, f"{folder}: each piece")
    grid = tuple(-(-size // part) for size, part in zip(shape, chunk))
    MAP_CHUNKS.check(math.prod(grid), folder)
    compressor, has_crc = _codecs(folder, described["codecs"])
    is_nothing = described["fill_value"] == "NaN" if kind.startswith("float") else kind == "bool"
    is_read = len(shape) > 0  # of the grid mapping only attributes are
    return _Array(grid, piece_bytes, compressor, has_crc, is_nothing or not is_read)


def _sizes(values: Any, least: int) -> tuple[int, ...]:
    """Return sizes as a tuple; ValueError unless all are integers of at least `least`."""
    if not all(type(value) is int and value >= least for value in list(values)):
        raise ValueError(f"sizes {str(values)[:60]} are not whole numbers from {least} on")
    return tuple(values)


def _kind(folder: Path, data_type: Any) -> tuple[str, int]:
    """Return the name of a Zarr data type, and the bytes of one value; BadInput on others."""
    if isinstance(data_type, str) and data_type in _ITEM_BYTES:
        return data_type, _ITEM_BYTES[data_type]
    if isinstance(data_type, dict) and data_type.get("name") == _TEXT:
        (item_bytes,) = _sizes([data_type["configuration"]["length_bytes"]], 4)
        return _TEXT, item_bytes
    raise BadInput(f"{folder} holds values of the type {str(data_type)[:60]!r}; allowed are "
                   f"numbers, bool and {_TEXT}: {_ZARR_ADVICE}")


def _codecs(folder: Path, codecs: Any) -> tuple[str | None, bool]:
    """Return the compressor of a list of Zarr codecs, if any, and whether a checksum follows."""
    names = [codec["name"] for codec in codecs]
    rest = names[1:]
    compressor = rest.pop(0) if rest and rest[0] in _COMPRESSORS else None
    if names[:1] != ["bytes"] or rest not in ([], ["crc32c"]):
        raise BadInput(f"{folder} is stored by the codecs {str(names)[:100]}; allowed are bytes, "
                       f"then zstd or gzip or neither, then crc32c or not: {_ZARR_ADVICE}")
    return compressor, bool(rest)


def _check_pieces(path: Path, grid: tuple[int, ...], array: _Array) -> int:
    """Check the chunk files below a path, with a level of folders for each side of the grid."""
    if not grid:
        _check_piece(path, array)
        return 1
    count = 0
    for entry in os.scandir(path):
        name = entry.name
        if not (name.isascii() and name.isdigit() and len(name) <= _MAX_DIGITS
                and str(int(name)) == name and int(name) < grid[0]):
            raise BadInput(f"{path} holds {name[:60]!r}, which is no piece of the array: remove it")
        if not (entry.is_dir(follow_symlinks=False) if grid[1:]
                else entry.is_file(follow_symlinks=False)):
            _refuse_kind(entry.path)
        count += _check_pieces(Path(entry.path), grid[1:], array)
    return count


def _check_piece(path: Path, array: _Array) -> None:
    """Check that a chunk decompresses to exactly the size of the array's chunks."""
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with open(handle, "rb") as file:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            _refuse_kind(path)
        size = status.st_size - _CRC_BYTES * array.has_crc
        if array.compressor is None:
            becomes: int | None = size
        elif size > 2 * array.piece_bytes + 1024:
            becomes = None
        elif array.compressor == "zstd":
            becomes = _zstd_bytes(file.read(_HEAD_BYTES))
        else:
            becomes = _gzip_bytes(file.read(max(size, 0)), array.piece_bytes)
    if becomes != array.piece_bytes:
        raise BadInput(f"{path} is damaged, or another size than its array needs "
                       f"({array.piece_bytes:,} bytes when decompressed); copy the folder again, "
                       "as a whole")


def _zstd_bytes(head: bytes) -> int | None:
    """Return the decompressed size in the header of a Zstandard frame (RFC 8878, 3.1.1.1).

    The decompressor writes no more than that. None: the header is damaged, or declares none.
    """
    if len(head) < 6 or head[:4] != b"\x28\xb5\x2f\xfd":
        return None
    flags = head[4]
    is_single = flags >> 5 & 1
    size = {0: is_single, 1: 2, 2: 4, 3: 8}[flags >> 6]
    start = 5 + (1 - is_single) + (0, 1, 2, 4)[flags & 3]
    if not size or len(head) < start + size:
        return None
    return int.from_bytes(head[start:start + size], "little") + (256 if size == 2 else 0)


def _gzip_bytes(data: bytes, expected: int) -> int | None:
    """Return the decompressed size of gzip data; None if it is damaged, or above `expected`."""
    inflater = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        size = len(inflater.decompress(data, expected + 1))
    except zlib.error:
        return None
    return size if inflater.eof and not inflater.unused_data else None
