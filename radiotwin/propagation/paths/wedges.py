"""Diffraction of a ray at an edge: the position along it, and the field after it.

By Keller's law the angle between ray and edge stays the same. The ray is therefore straight once
the half planes before and after the edge are folded into one.

Reflection of a ray's field at a surface.
"""

import numpy as np

from radiotwin.propagation.paths.coefficients import (
    Slabs,
    face_sines,
    reflection,
    wedge_coefficients,
    wedge_terms,
)
from radiotwin.propagation.paths.surfaces import (
    ALONG,
    EXTERIOR,
    MATERIAL_0,
    MATERIAL_N,
    NORMAL_0,
    NORMAL_N,
    START,
    TANGENT,
)
from radiotwin.propagation.paths.vectors import cross, dot
from radiotwin.runtime.compiled import njit

LUEBBERS, SIONNA = 0, 1
MIN_SINE = 1e-4  # of the angle between ray and face; rays closer to a face are not followed


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
    after_m: float, wave_number: float, slabs: Slabs, wedge: int, field: np.ndarray,
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
        wedge: LUEBBERS or SIONNA, see `radiotwin.propagation.paths.coefficients`.
        field: (3,) complex, changed in place.
    """
    row = edges[edge]
    along, tangent = row[ALONG:ALONG + 3], row[TANGENT:TANGENT + 3]
    normal_0, normal_n = row[NORMAL_0:NORMAL_0 + 3], row[NORMAL_N:NORMAL_N + 3]
    material_0, material_n = int(row[MATERIAL_0]), int(row[MATERIAL_N])
    exterior = row[EXTERIOR]
    phi_in = np.arctan2(-dot(direction_in, normal_0), -dot(direction_in, tangent)) % (2.0 * np.pi)
    phi = np.arctan2(dot(direction, normal_0), dot(direction, tangent)) % (2.0 * np.pi)
    if dot(direction_in, normal_0) >= 0.0:  # face 0 is one that the source sees
        phi_in, phi = exterior - phi_in, exterior - phi
        normal_0, normal_n = normal_n, normal_0
        material_0, material_n = material_n, material_0
    across_in, across = cross(direction_in, along), cross(along, direction)
    sine = np.sqrt(dot(across, across))
    across_in, across = across_in / np.sqrt(dot(across_in, across_in)), across / sine
    upright_in, upright = cross(direction_in, across_in), cross(direction, across)
    distance_m = before_m * after_m / (before_m + after_m) * sine * sine
    if wedge == LUEBBERS:
        sine_0, sine_n = face_sines(phi, phi_in, sine, exterior / np.pi)
        soft, hard = wedge_coefficients(
            phi, phi_in, sine, distance_m, wave_number, exterior / np.pi,
            reflection(sine_0, slabs, material_0), reflection(sine_n, slabs, material_n))
        field_soft, field_hard = -soft * dot(field, upright_in), -hard * dot(field, across_in)
    else:
        at_0, at_n = wedge_terms(phi, phi_in, sine, distance_m, wave_number, exterior / np.pi)
        soft, hard = _reflected(normal_0, material_0, direction_in, along, slabs, field)
        field_soft, field_hard = at_0 * soft, at_0 * hard
        if exterior > np.pi + phi_in:  # face n lies in the shadow
            soft, hard = -dot(field, upright_in), -dot(field, across_in)
        else:
            soft, hard = _reflected(normal_n, material_n, direction_in, along, slabs, field)
        field_soft, field_hard = field_soft + at_n * soft, field_hard + at_n * hard
    for i in range(3):
        field[i] = field_soft * upright[i] + field_hard * across[i]


@njit(cache=True, error_model="numpy")
def _reflected(
    normal: np.ndarray, material: int, direction_in: np.ndarray, along: np.ndarray, slabs: Slabs,
    field: np.ndarray,
) -> tuple[complex, complex]:
    """Return a ray's field that a face reflects, in the plane of ray and edge and across it."""
    reflected = field.copy()
    ray = reflect(normal, material, direction_in, slabs, reflected)
    across = cross(along, ray)
    across /= np.sqrt(dot(across, across))
    return dot(reflected, cross(ray, across)), dot(reflected, across)
