"""Arrays and one text in the format of safetensors: data only, so that reading runs no code.

A header in JSON gives the type, shape and place of each array; the arrays' bytes follow. What a
header claims is checked against the file before any memory is taken.
"""

import json
import math
from typing import IO, Any

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.io.budgets import DOCUMENT_BYTES
from radiotwin.io.inputs import parse_json

_TYPES = {"BOOL": "?", "U8": "u1", "I8": "i1", "U16": "<u2", "I16": "<i2", "U32": "<u4",
          "I32": "<i4", "U64": "<u8", "I64": "<i8", "F16": "<f2", "F32": "<f4", "F64": "<f8"}
_NAMES = {np.dtype(code): name for name, code in _TYPES.items()}
_MAX_DIMENSIONS = 8


def write_arrays(file: IO[bytes], arrays: dict[str, np.ndarray], key: str, text: str) -> None:
    """Write arrays one after the other, so that no second copy of all is in memory.

    Args:
        file: open for writing.
        arrays: of numbers or booleans, by name.
        key: under which the text is stored.
        text: such as a JSON document about the arrays.
    """
    header: dict[str, Any] = {"__metadata__": {key: text}}
    end = 0
    for name, array in arrays.items():
        start, end = end, end + array.nbytes
        header[name] = {"dtype": _NAMES[array.dtype], "shape": list(array.shape),
                        "data_offsets": [start, end]}
    encoded = json.dumps(header, separators=(",", ":")).encode()
    encoded += b" " * (-len(encoded) % 8)  # the arrays are aligned
    file.write(len(encoded).to_bytes(8, "little") + encoded)
    for array in arrays.values():
        file.write(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)


def parse_arrays(data: bytes, key: str, source: object) -> tuple[dict[str, np.ndarray], str]:
    """Return the arrays and the text of a file.

    Args:
        data: content of the file.
        key: under which the text is stored.
        source: where it is from; messages begin with it.

    Returns:
        read-only views of `data`, by name; and the text.

    Raises:
        BadInput: it is not whole, or not such a file.
    """
    try:
        size = int.from_bytes(data[:8], "little")
        if len(data) < 8 or size > len(data) - 8:
            raise ValueError("it is cut off")
        DOCUMENT_BYTES.check(size, f"{source}: its header")
        header = parse_json(data[8:8 + size].decode("utf-8"), f"{source}: its header")
        content = memoryview(data)[8 + size:]
        text = header.pop("__metadata__")[key]
        if not isinstance(text, str):
            raise TypeError(f"{key} is not a text")
        arrays, end = {}, 0
        for name, entry in sorted(header.items(), key=_start):
            arrays[name] = array = _array(entry, content, end)
            end += array.nbytes
        if end != len(content):
            raise ValueError(f"{len(content) - end} bytes belong to no array")
        return arrays, text
    except (LookupError, TypeError, AttributeError, ValueError, OverflowError) as error:
        raise BadInput(f"{source} is damaged ({type(error).__name__}: {str(error)[:200]}); make it "
                       "again") from None


def _start(item: tuple[str, Any]) -> list[int]:
    return [int(number) for number in item[1]["data_offsets"]]


def _array(entry: dict, content: memoryview, start: int) -> np.ndarray:
    """Return the array that an entry of the header describes; it must begin at `start`."""
    shape, dtype = entry["shape"], np.dtype(_TYPES[entry["dtype"]])
    if set(entry) != {"dtype", "shape", "data_offsets"} or len(shape) > _MAX_DIMENSIONS or not all(
            type(side) is int and 0 <= side <= len(content) for side in shape):
        raise ValueError("an array has an impossible shape")
    end = start + math.prod(shape) * dtype.itemsize
    if entry["data_offsets"] != [start, end] or end > len(content):
        raise ValueError("an array is not where its size puts it")
    array = np.frombuffer(content[start:end], dtype)
    if dtype.kind == "b" and array.view(np.uint8).max(initial=0) > 1:
        raise ValueError("a boolean is neither 0 nor 1")
    return array.reshape(shape)
