"""Products of vectors of shape (3,) for compiled code."""

from typing import Any

import numpy as np

from radiotwin.runtime.compiled import njit


@njit(cache=True)
def dot(a: np.ndarray, b: np.ndarray) -> Any:
    """Return the product a · b without conjugation, complex where one of the vectors is."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the product a × b of real vectors."""
    out = np.empty(3)
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out
