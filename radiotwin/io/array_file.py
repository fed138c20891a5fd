"""Arrays and one text in the format of safetensors: data only, so that reading runs no code."""

import json

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from radiotwin.errors import BadInput


def pack_arrays(arrays: dict[str, np.ndarray], key: str, text: str) -> bytes:
    """Return the content of a file with arrays of numbers or booleans, and a text under a key."""
    # One key, because safetensors writes several in an order that changes from run to run.
    return save({name: np.asarray(array, order="C") for name, array in arrays.items()}, {key: text})


def parse_arrays(data: bytes, key: str, source: object) -> tuple[dict[str, np.ndarray], str]:
    """Return the arrays of a file, and the text that it has under a key.

    Raises:
        BadInput: it is not whole, or not such a file; the message begins with `source`.
    """
    try:
        arrays = load(data)
        size = int.from_bytes(data[:8], "little")
        text = json.loads(data[8:8 + size])["__metadata__"][key]
        if any(array.view(np.uint8).max(initial=0) > 1 for array in arrays.values()
               if array.dtype == bool):
            raise ValueError("a boolean is neither 0 nor 1")
        return arrays, text
    except (SafetensorError, LookupError, TypeError, ValueError) as error:
        raise BadInput(f"{source} is damaged ({type(error).__name__}: {str(error)[:200]}); make it "
                       "again") from None
