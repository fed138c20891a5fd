"""Reflection of a ray's field at a surface."""

import numpy as np
from numba import njit

from radiotwin.paths.coefficients import Slabs, reflection
from radiotwin.paths.vectors import cross, dot


@njit(cache=True, error_model="numpy")
def reflect(
    normal: np.ndarray, material: int, direction_in: np.ndarray, slabs: Slabs, field: np.ndarray
) -> np.ndarray:
    """Reflect the field of a ray, in place, and return the direction of the reflected ray.

    Args:
        normal: (3,) unit normal of the surface, on either side.
        material: row of `slabs`.
        direction_in: (3,) unit vector of the ray.
        slabs: materials of the city.
        field: (3,) complex, changed in place.
    """
    cosine = dot(direction_in, normal)
    direction = direction_in - 2.0 * cosine * normal
    across = cross(direction_in, normal)
    size2 = dot(across, across)
    if size2 < 1e-12:  # normal incidence: any direction in the plane is across
        other = np.array([1.0, 0.0, 0.0]) if abs(normal[0]) < 0.7 else np.array([0.0, 1.0, 0.0])
        across = cross(direction_in, other)
        size2 = dot(across, across)
    across /= np.sqrt(size2)
    within_in, within = cross(across, direction_in), cross(across, direction)
    te, tm = reflection(abs(cosine), slabs, material)
    field_te = te * dot(field, across)
    field_tm = tm * dot(field, within_in)
    for i in range(3):
        field[i] = field_te * across[i] + field_tm * within[i]
    return direction
