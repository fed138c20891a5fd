"""Lengths in a declared unit -> metres."""

import numpy as np

from radiotwin.errors import BadInput

METRES = {"m": 1.0, "ft": 0.3048}
"""International foot, exact since 1959."""


def in_metres(numbers: np.ndarray, unit: str | None, what: str) -> np.ndarray:
    """(n,) numbers [m]; raises BadInput about `what` if the unit is not declared."""
    if unit is None:
        known = numbers[np.isfinite(numbers)]
        looks = f"run from {known.min():g} to {known.max():g}" if len(known) else "are all empty"
        raise BadInput(f"{what}: length_unit is not given; allowed are {' and '.join(METRES)}. The values {looks}")
    return numbers * METRES[unit]
