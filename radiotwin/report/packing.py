"""Arrays in the page: base64 of typed arrays, which the browser reads without parsing numbers."""

import base64

import numpy as np

NOTHING = -32768
"""Stands for NaN in levels, which are kept in hundredths of a decibel."""


def pack(values: np.ndarray) -> dict:
    """An array as JSON takes it.

    Args:
        values: float32, int32, int16 or uint8, of any shape.
    """
    values = np.ascontiguousarray(values).astype(values.dtype.newbyteorder("<"))
    return {"type": values.dtype.name, "shape": list(values.shape), "data": base64.b64encode(values.tobytes()).decode()}


def pack_db(level_db: np.ndarray) -> dict:
    """Levels [dB] to within 0.005 dB, as 16-bit integers; NaN as `NOTHING`. Beyond ±327 dB they are cut."""
    hundredths = np.clip(np.round(np.nan_to_num(np.asarray(level_db, dtype=float), nan=0.0) * 100), -32767, 32767)
    return pack(np.where(np.isnan(level_db), NOTHING, hundredths).astype(np.int16))


def pack_m(place_m: np.ndarray) -> dict:
    """Coordinates or times in single precision."""
    return pack(np.asarray(place_m).astype(np.float32))
