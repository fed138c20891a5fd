"""Diffraction of a ray at an edge: the position along it, and the field after it.

By Keller's law the angle between ray and edge stays the same. The ray is therefore straight once
the half planes before and after the edge are folded into one.
"""

import numpy as np
from numba import njit

from radiotwin.paths.coefficients import Slabs, face_sines, reflection, wedge_coefficients
from radiotwin.paths.surfaces import (
    ALONG,
    EXTERIOR,
    MATERIAL_0,
    MATERIAL_N,
    NORMAL_0,
    NORMAL_N,
    START,
    TANGENT,
)
from radiotwin.paths.vectors import cross, dot

MIN_SINE = 1e-4  # of the angle between ray and face; rays closer to a face are not followed


@njit(cache=True, error_model="numpy")
def around_edge(
    edges: np.ndarray, edge: int, x: float, y: float, z: float
) -> tuple[bool, float, float]:
    """Return whether a point is in an edge's open space, and its cylindrical coordinates.

    Args:
        edges: of `Surfaces`.
        edge: row of `edges`.
        x: position of the point, east [m].
        y: north [m].
        z: up [m].

    Returns:
        Whether it is in the open space, its distance along the edge from the start [m], and its
        distance from the edge's line [m].
    """
    x, y, z = x - edges[edge, START], y - edges[edge, START + 1], z - edges[edge, START + 2]
    along_m = x * edges[edge, ALONG] + y * edges[edge, ALONG + 1] + z * edges[edge, ALONG + 2]
    across_m = np.sqrt(max(x * x + y * y + z * z - along_m * along_m, 1e-12))
    min_m = MIN_SINE * across_m
    is_open = x * edges[edge, NORMAL_0] + y * edges[edge, NORMAL_0 + 1] \
        + z * edges[edge, NORMAL_0 + 2] > min_m \
        or x * edges[edge, NORMAL_N] + y * edges[edge, NORMAL_N + 1] \
        + z * edges[edge, NORMAL_N + 2] > min_m
    return is_open, along_m, across_m


@njit(cache=True, error_model="numpy")
def diffract(
    edges: np.ndarray, edge: int, direction_in: np.ndarray, direction: np.ndarray, before_m: float,
    after_m: float, wave_number: float, slabs: Slabs, field: np.ndarray,
) -> None:
    """Diffract the field of a ray at an edge (Kouyoumjian and Pathak, eq. 9-13), without spreading.

    Args:
        edges: of `Surfaces`.
        edge: row of `edges`.
        direction_in: (3,) unit vector of the ray before the edge.
        direction: (3,) unit vector of the ray after the edge.
        before_m: length of the path before the edge [m].
        after_m: length of the path after the edge [m].
        wave_number: 2 π / wavelength [1/m].
        slabs: materials of the city.
        field: (3,) complex, changed in place.
    """
    along, tangent = edges[edge, ALONG:ALONG + 3], edges[edge, TANGENT:TANGENT + 3]
    normal = edges[edge, NORMAL_0:NORMAL_0 + 3]
    phi_in = np.arctan2(-dot(direction_in, normal), -dot(direction_in, tangent)) % (2.0 * np.pi)
    phi = np.arctan2(dot(direction, normal), dot(direction, tangent)) % (2.0 * np.pi)
    across_in, across = cross(along, direction_in), cross(along, direction)
    sine = np.sqrt(dot(across, across))
    distance_m = before_m * after_m / (before_m + after_m) * sine * sine
    n = edges[edge, EXTERIOR] / np.pi
    sine_0, sine_n = face_sines(phi, phi_in, sine, n)
    soft, hard = wedge_coefficients(
        phi, phi_in, sine, distance_m, wave_number, n,
        reflection(sine_0, slabs, int(edges[edge, MATERIAL_0])),
        reflection(sine_n, slabs, int(edges[edge, MATERIAL_N])))
    across_in = -across_in / np.sqrt(dot(across_in, across_in))
    across = across / sine
    upright_in, upright = cross(across_in, direction_in), cross(across, direction)
    field_soft, field_hard = -soft * dot(field, upright_in), -hard * dot(field, across_in)
    for i in range(3):
        field[i] = field_soft * upright[i] + field_hard * across[i]
