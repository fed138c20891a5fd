"""Conversion of lengths to metres."""

import numpy as np

from radiotwin.errors import BadInput

METRES = {"m": 1.0, "ft": 0.3048}  # the international foot, exact since 1959


def in_metres(numbers: np.ndarray, unit: str | None, column: str) -> np.ndarray:
    """Convert lengths to metres.

    Args:
        numbers: (n,) in `unit`.
        unit: of `METRES`; None if it is not declared.
        column: file and column, for the message.

    Returns:
        lengths [m], (n,).

    Raises:
        BadInput: the unit is not declared.
    """
    if unit is None:
        known = numbers[np.isfinite(numbers)]
        values = f"run from {known.min():g} to {known.max():g}" if len(known) else "are all empty"
        raise BadInput(f"{column}: length_unit is not given; allowed are {' and '.join(METRES)}. "
                       f"The values {values}")
    return numbers * METRES[unit]
