"""Hash values by their content, equally in every process and on every machine."""

from __future__ import annotations

import hashlib
import struct
from dataclasses import fields, is_dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from pydantic import BaseModel

HASH_BYTES = 20


class Unhashable(TypeError):
    """Raised for a value without a known content, such as an object of another package."""


_hashed: WeakKeyDictionary[Any, bytes] = WeakKeyDictionary()


def content_hash(value: Any) -> str:
    """Return the BLAKE2b hash of a value's content, in hexadecimal digits.

    A value is a number, text, bytes, None, array, tuple, list, set, dictionary, or an object of
    this package: pydantic models and dataclasses count by their fields, others by `state()` or
    their attributes. The hash of an immutable object (a frozen dataclass, or a class with
    `never_changes`) is cached.

    Raises:
        Unhashable: a part of the value is anything else.
    """
    digest = hashlib.blake2b(digest_size=HASH_BYTES)
    _add(digest, value)
    return digest.hexdigest()


def _add(digest: Any, value: Any) -> None:
    """Add a value to a hash, in place: a letter for its kind, its length, its content."""
    if value is None or isinstance(value, bool | np.bool_):
        digest.update(f"b{value}".encode())
    elif isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise Unhashable(f"array of {value.dtype}")
        digest.update(f"a{value.dtype.str}{value.shape}".encode())
        if value.size:
            digest.update(np.ascontiguousarray(value).view(np.uint8).data)
    elif isinstance(value, int | np.integer):
        digest.update(f"i{int(value)};".encode())
    elif isinstance(value, float | np.floating):
        digest.update(b"f" + struct.pack("<d", float(value)))
    elif isinstance(value, str):
        _add_bytes(digest, b"s", value.encode("utf-8", "surrogatepass"))
    elif isinstance(value, bytes):
        _add_bytes(digest, b"y", value)
    elif isinstance(value, tuple | list):
        digest.update(f"l{len(value)};".encode())
        for each in value:
            _add(digest, each)
    elif isinstance(value, dict):
        digest.update(f"d{len(value)};".encode())
        for pair in sorted(content_hash(pair) for pair in value.items()):  # in any order
            digest.update(pair.encode())
    elif isinstance(value, set | frozenset):
        digest.update(f"e{len(value)};".encode())
        for each in sorted(map(content_hash, value)):
            digest.update(each.encode())
    elif isinstance(value, type):
        _add_class(digest, value)
    else:
        digest.update(_object_hash(value))


def _add_bytes(digest: Any, kind: bytes, data: bytes) -> None:
    digest.update(kind + struct.pack("<q", len(data)) + data)


def _add_class(digest: Any, kind: type) -> None:
    # A class of another package may change with its version.
    if kind.__module__.partition(".")[0] != "radiotwin":
        raise Unhashable(f"{kind.__module__}.{kind.__qualname__}")
    _add_bytes(digest, b"c", f"{kind.__module__}.{kind.__qualname__}".encode())


def _object_hash(value: Any) -> bytes:
    """Return the hash of a class and its fields or attributes; cached for immutable objects."""
    kind = type(value)
    parameters = getattr(kind, "__dataclass_params__", None)
    is_immutable = kind.__hash__ is object.__hash__ and (
        getattr(kind, "never_changes", False) or (parameters is not None and parameters.frozen))
    if is_immutable and value in _hashed:
        return _hashed[value]
    digest = hashlib.blake2b(digest_size=HASH_BYTES)
    _add_class(digest, kind)
    if isinstance(value, BaseModel):
        _add(digest, value.model_dump())
    elif is_dataclass(value):
        for each in fields(value):
            _add(digest, getattr(value, each.name))
    elif hasattr(value, "state"):
        _add(digest, value.state())
    else:
        _add(digest, vars(value))
    if is_immutable:
        _hashed[value] = digest.digest()
    return digest.digest()
