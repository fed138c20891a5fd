"""Checks of what a channel model is stored as: names, shapes, and numbers within wide bounds.

The bounds are far beyond what is measured; within them, predictions are finite.
"""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

MAX_DB = 1e4  # of a level, a residual or an intercept
MAX_SD_DB = 1e3
MAX_POSITION_M = 1e8  # ten times what a measurement may have
_LINE = np.array([MAX_DB, 100.0, MAX_SD_DB])  # intercept [dB], exponent, standard deviation [dB]


def require_names(what: str, given: Collection[str], expected: Collection[str]) -> None:
    """Refuse names that are missing, and those that nobody asked for.

    Args:
        what: has the names, for the message.
        given: names that are there.
        expected: names that must be there.

    Raises:
        ValueError: they differ.
    """
    wrong = sorted(set(given) ^ set(expected))
    if wrong:
        state = "missing" if wrong[0] in expected else "unknown"
        raise ValueError(f"{what}: {wrong[0][:60]!r} is {state}")


def require_array(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int | None, ...],
                  low: float, high: float) -> np.ndarray:
    """Return an array of numbers after a check.

    Args:
        arrays: by name.
        name: of the array.
        shape: None for any length but zero.
        low: least number.
        high: greatest number.

    Raises:
        KeyError: there is none of that name.
        ValueError: it has another shape, or a number outside the bounds.
    """
    array = arrays[name]
    if array.ndim != len(shape) or 0 in array.shape or any(
            side not in (None, given) for side, given in zip(shape, array.shape, strict=True)):
        raise ValueError(f"{name} has the shape {array.shape}")
    if array.dtype.kind not in "fiu" or not ((array >= low) & (array <= high)).all():
        raise ValueError(f"{name} holds something else than numbers from {low:g} to {high:g}")
    return array


def require_lines(array: np.ndarray) -> np.ndarray:
    """Return log-distance lines (…, 3) after a check: intercept [dB], exponent, sd [dB].

    Raises:
        ValueError: one is impossible.
    """
    if not (array.dtype.kind == "f" and (np.abs(array) <= _LINE).all()
            and (array[..., 2] > 0).all()):
        raise ValueError("a line's intercept, exponent or standard deviation is impossible")
    return array


def require_number(settings: Mapping[str, Any], name: str, low: float, high: float) -> float:
    """Return a number of some settings after a check.

    Raises:
        KeyError: there is none of that name.
        ValueError: it is no number, or outside the bounds.
    """
    value = settings[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise ValueError(f"{name} is {str(value)[:60]}; allowed are numbers from {low:g} to "
                         f"{high:g}")
    return float(value)
