"""Pack arrays into a page as base64 of typed arrays, which a browser reads without parsing."""

import base64

import numpy as np
from numpy.typing import ArrayLike

NOT_DETECTED = -32768
"""Stands for NaN among levels, which are kept in hundredths of a decibel."""


def pack(values: np.ndarray) -> dict:
    """Return an array as JSON can hold it.

    Args:
        values: array of type float32, int32, int16 or uint8, of any shape.
    """
    values = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"))
    return {"type": values.dtype.name, "shape": list(values.shape),
            "data": base64.b64encode(values.tobytes()).decode()}


def pack_db(level_db: np.ndarray) -> dict:
    """Pack levels [dB] as 16-bit integers in hundredths, within ±327 dB; NaN as `NOT_DETECTED`."""
    hundredths = np.round(100 * np.nan_to_num(np.asarray(level_db, dtype=float), nan=0.0))
    clipped = np.clip(hundredths, -32767, 32767)
    return pack(np.where(np.isnan(level_db), NOT_DETECTED, clipped).astype(np.int16))


def pack_m(values: ArrayLike) -> dict:
    """Pack coordinates or times in single precision."""
    return pack(np.asarray(values).astype(np.float32))
