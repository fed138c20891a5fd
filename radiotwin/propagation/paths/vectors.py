"""Products of vectors of three numbers for compiled code.

They return tuples: to allocate an array takes longer than to compute what is in it.
"""

from typing import Any

import numpy as np

from radiotwin.runtime.compiled import njit

Triple = tuple[float, float, float]
Vector = np.ndarray | Triple


@njit(cache=True)
def dot(a: Vector, b: Vector) -> Any:
    """Return the product a · b without conjugation, complex where one of the vectors is."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def cross(a: Vector, b: Vector) -> Triple:
    """Return the product a × b of real vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def divided(a: Vector, by: float) -> Triple:
    """Return a vector divided by a number."""
    return a[0] / by, a[1] / by, a[2] / by
