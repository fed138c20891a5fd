"""Check that an HDF5 file holds plain arrays in the file itself, of bounded size.

HDF5 files can name other files (external links, raw data, virtual datasets), call for filters that
are loaded as plug-ins, and stand for far more values than they have bytes. All of that is refused
by its description, before any value is read.
"""

import zlib
from pathlib import Path
from typing import IO

import h5py  # type: ignore[import-untyped]
import numpy as np

from radiotwin.errors import BadInput
from radiotwin.io.budgets import (
    DOCUMENT_BYTES,
    FILE_BYTES,
    MAP_ATTRIBUTES,
    MAP_CHUNKS,
    MAP_VALUES,
    SETTINGS_BYTES,
)

_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32}
_LAYOUTS = {h5py.h5d.COMPACT, h5py.h5d.CONTIGUOUS, h5py.h5d.CHUNKED}
_TYPES = {h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.ENUM, h5py.h5t.STRING}
_REFERRING = {"DIMENSION_LIST", "REFERENCE_LIST"}  # of which axis a dimension is
_MAX_OBJECTS = 1_000  # of a file; a radio map has eight
_MAX_CHUNK_VALUES = 2**24  # of a chunk that is larger than its array
_MAX_INFLATED = 2**28  # bytes that one chunk may become without being tried
_DEFLATE_RATIO = 1032  # the most that a byte can stand for
_HEAP, _HEAP_HEADER = b"GCOL", 16
_BLOCK_BYTES = 2**22


def check_hdf5(file: IO[bytes], path: Path) -> None:
    """Check that reading the root group of an HDF5 file is safe.

    Args:
        file: open for reading; its position changes.
        path: of it, for messages.

    Raises:
        BadInput: it refers to another file, has groups, links, filters or types that radio maps do
            not have, or is too large.
        Exception: h5py's, of many classes: it is damaged, or not HDF5.
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


_ADVICE = "a radio map is one file with plain arrays: make it again"


def _check_array(array: h5py.h5d.DatasetID, path: Path, name: str, heap_bytes: int) -> None:
    """Check where the values of an array are, in which form, and how many."""
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
    """Check that no chunk becomes far larger than it should: HDF5 inflates it to its end."""
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
    """Check attributes by their descriptions; return how many texts of unknown length they have."""
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
    """Return whether values lie in a heap, each as long as it likes."""
    return isinstance(kind, h5py.h5t.TypeStringID) and bool(kind.is_variable_str())


def _largest_heap(file: IO[bytes]) -> int:
    """Return the bytes of the largest heap of a file: no text in it is longer.

    HDF5 has the length of a text only after reading it. A heap begins with `GCOL`, a version, three
    zeros and its size (HDF5 File Format Specification 3.0, III.E); chance makes the same eight
    bytes once in 10^19.
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
