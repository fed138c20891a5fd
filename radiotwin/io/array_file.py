"""Arrays and one text in a safetensors file, which runs no code when it is read."""

import json

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from radiotwin.errors import BadInput


def pack_arrays(arrays: dict[str, np.ndarray], key: str, text: str) -> bytes:
    """Encode arrays of numbers or booleans, and a text under a metadata key, as safetensors."""
    # One key only: safetensors writes several in a random order.
    return save({name: np.asarray(array, order="C") for name, array in arrays.items()}, {key: text})


def parse_arrays(data: bytes, key: str, source: object) -> tuple[dict[str, np.ndarray], str]:
    """Decode the arrays, and the text under a metadata key, from safetensors data.

    Raises:
        BadInput: the data is damaged, or in another format; the message begins with `source`.
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
