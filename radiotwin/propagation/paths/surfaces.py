"""Surfaces: facets and edges of a map as arrays for compiled code, and their basic geometry.

The last facet is the flat ground, the plane z = 0. On a terrain, its triangles are facets like any
other, and no point lies above the last facet. Vector products return tuples of three numbers:
allocating an array takes longer than the computation.
"""

from typing import Any, NamedTuple

import numpy as np

from radiotwin.runtime.compiled import njit

ON_PLANE_M = 1e-4  # a point this close to a plane counts as on it [m]
GROUND_MATERIAL = -1  # last row of `Slabs`: flat ground, and the triangles of a terrain

# First columns of the fields of `Surfaces.planes` and `Surfaces.edges`. Numba counts references to
# each array argument; with an array for each field, that would take longer than the geometry.
NORMAL, OFFSET, ORIGIN, AXIS_U, AXIS_V, SIZE, FULL, FIRST, END, MATERIAL = (
    0, 3, 4, 7, 10, 13, 15, 16, 17, 18)
START, ALONG, LENGTH, TANGENT, NORMAL_0, NORMAL_N, EXTERIOR, MATERIAL_0, MATERIAL_N = (
    0, 3, 6, 7, 10, 13, 16, 17, 18)

Triple = tuple[float, float, float]
Vector = np.ndarray | Triple


class Surfaces(NamedTuple):
    """f facets, then the ground, and e convex edges between two facets.

    If a building leans on a higher one without shared corners, the edge of its roof in that wall is
    an edge here, too; it lies inside the higher building, so no ray reaches it. The exterior angle
    of an edge, π to 2 π, is that of the open space, from face 0 towards the normal of face 0.

    Attributes:
        planes: (f + 1, 19) outward unit normal, distance of the plane from the origin [m], a corner
            of the bounding rectangle [m], unit vectors u and v along its sides, u × v = normal,
            lengths of the sides [m], 1 if the facet fills the rectangle, its first triangle and the
            one after its last, row of the city's materials.
        triangle_uv_m: (t, 6) corners u, v, u, v, u, v of the triangles in the plane [m].
        edges: (e, 19) start [m], unit vector to the end, length [m], unit vector in face 0 at right
            angles to the edge, outward normals of face 0 and face n, exterior angle [rad],
            materials of face 0 and face n.
    """

    planes: np.ndarray
    triangle_uv_m: np.ndarray
    edges: np.ndarray


@njit(cache=True, error_model="numpy")
def height(planes: np.ndarray, facet: int, x: float, y: float, z: float) -> float:
    """Return the signed distance of a point from the plane of a facet [m]; negative: behind it."""
    return planes[facet, NORMAL] * x + planes[facet, NORMAL + 1] * y \
        + planes[facet, NORMAL + 2] * z - planes[facet, OFFSET]


@njit(cache=True, error_model="numpy")
def within(planes: np.ndarray, triangle_uv_m: np.ndarray, facet: int, x: float, y: float, z: float
           ) -> bool:
    """Return True if a point in the plane of a facet lies on the facet; the ground is endless."""
    if facet == len(planes) - 1:
        return True
    x = x - planes[facet, ORIGIN]
    y = y - planes[facet, ORIGIN + 1]
    z = z - planes[facet, ORIGIN + 2]
    at_u = x * planes[facet, AXIS_U] + y * planes[facet, AXIS_U + 1] \
        + z * planes[facet, AXIS_U + 2]
    if at_u < 0.0 or at_u > planes[facet, SIZE]:
        return False
    at_v = x * planes[facet, AXIS_V] + y * planes[facet, AXIS_V + 1] \
        + z * planes[facet, AXIS_V + 2]
    if at_v < 0.0 or at_v > planes[facet, SIZE + 1]:
        return False
    if planes[facet, FULL] > 0.0:
        return True
    corners = triangle_uv_m
    for k in range(int(planes[facet, FIRST]), int(planes[facet, END])):
        au, av, bu, bv, cu, cv = corners[k]
        if _side(au, av, bu, bv, at_u, at_v) >= 0.0 \
                and _side(bu, bv, cu, cv, at_u, at_v) >= 0.0 \
                and _side(cu, cv, au, av, at_u, at_v) >= 0.0:
            return True
    return False


@njit(cache=True)
def _side(ax: float, ay: float, bx: float, by: float, x: float, y: float) -> float:
    """Return twice the signed area of a, b, (x, y): positive if the point is left of a to b."""
    return (bx - ax) * (y - ay) - (by - ay) * (x - ax)


@njit(cache=True, error_model="numpy")
def mirrored(planes: np.ndarray, facet: int, x: float, y: float, z: float
             ) -> tuple[float, float, float]:
    """Return the mirror image of a point in the plane of a facet."""
    twice = 2.0 * height(planes, facet, x, y, z)
    return (x - twice * planes[facet, NORMAL], y - twice * planes[facet, NORMAL + 1],
            z - twice * planes[facet, NORMAL + 2])


@njit(cache=True)
def dot(a: Vector, b: Vector) -> Any:
    """Return the product a · b without conjugation; complex if a or b is."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def cross(a: Vector, b: Vector) -> Triple:
    """Return the product a × b of real vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def divided(a: Vector, by: float) -> Triple:
    """Return a vector divided by a number."""
    return a[0] / by, a[1] / by, a[2] / by
