"""Facets and edges as compiled code reads them; the last facet is the ground, the plane z = 0 without end."""

from typing import NamedTuple

import numpy as np
from numba import njit

from radiotwin.paths.edges import Edges
from radiotwin.paths.facets import Facets

ON_PLANE_M = 1e-4  # a point this close to a plane is on neither side of it


# Columns of `Surfaces.planes` and `Surfaces.edges`. Numba counts the references to each array that it hands to a
# function, which would take longer than the geometry were there an array for each of these.
NORMAL, OFFSET, ORIGIN, AXIS_U, AXIS_V, SIZE, FULL, FIRST, END = 0, 3, 4, 7, 10, 13, 15, 16, 17
START, ALONG, LENGTH, TANGENT, NORMAL_0, NORMAL_N, EXTERIOR = 0, 3, 6, 7, 10, 13, 16


class Surfaces(NamedTuple):
    """Facets with the ground behind the last, and edges.

    Attributes:
        planes: (f + 1, 18) unit normal, offset, origin, two axes, sizes of `Facets`, whether it is full, and its
            first and behind its last triangle.
        triangle_uv_m: (t, 6) as in `Facets`.
        edges: (e, 17) start, direction, length, tangent in face 0, both normals and exterior angle of `Edges`.
    """

    planes: np.ndarray
    triangle_uv_m: np.ndarray
    edges: np.ndarray


def pack(facets: Facets, edges: Edges) -> Surfaces:
    """Lay out the city's surfaces for compiled code."""
    planes = np.column_stack([
        facets.normal, facets.offset_m, facets.origin_m, facets.axis_u, facets.axis_v, facets.size_m, facets.full,
        facets.first[:-1], facets.first[1:]])
    ground = [0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0, np.inf, np.inf, 1, 0, 0]
    return Surfaces(
        np.concatenate([planes, [ground]]).astype(float), np.ascontiguousarray(facets.triangle_uv_m, dtype=float),
        np.column_stack([edges.start_m, edges.direction, np.linalg.norm(edges.end_m - edges.start_m, axis=1),
                         edges.tangent_0, edges.normal_0, edges.normal_n, edges.exterior_rad]).astype(float))


@njit(cache=True, error_model="numpy")
def height(planes, facet, x, y, z):
    """How far a point lies before the plane of a facet [m]; negative: behind it."""
    return planes[facet, 0] * x + planes[facet, 1] * y + planes[facet, 2] * z - planes[facet, OFFSET]


@njit(cache=True, error_model="numpy")
def within(planes, triangle_uv_m, facet, x, y, z):
    """Whether a point of a facet's plane is on the facet."""
    if facet == len(planes) - 1:
        return True
    x, y, z = x - planes[facet, ORIGIN], y - planes[facet, ORIGIN + 1], z - planes[facet, ORIGIN + 2]
    at_u = x * planes[facet, AXIS_U] + y * planes[facet, AXIS_U + 1] + z * planes[facet, AXIS_U + 2]
    if at_u < 0.0 or at_u > planes[facet, SIZE]:
        return False
    at_v = x * planes[facet, AXIS_V] + y * planes[facet, AXIS_V + 1] + z * planes[facet, AXIS_V + 2]
    if at_v < 0.0 or at_v > planes[facet, SIZE + 1]:
        return False
    if planes[facet, FULL] > 0.0:
        return True
    corners = triangle_uv_m
    for k in range(int(planes[facet, FIRST]), int(planes[facet, END])):
        if _side(corners[k, 0], corners[k, 1], corners[k, 2], corners[k, 3], at_u, at_v) >= 0.0 \
                and _side(corners[k, 2], corners[k, 3], corners[k, 4], corners[k, 5], at_u, at_v) >= 0.0 \
                and _side(corners[k, 4], corners[k, 5], corners[k, 0], corners[k, 1], at_u, at_v) >= 0.0:
            return True
    return False


@njit(cache=True)
def _side(ax, ay, bx, by, x, y):
    return (bx - ax) * (y - ay) - (by - ay) * (x - ax)


@njit(cache=True, error_model="numpy")
def mirrored(planes, facet, x, y, z):
    """The mirror image of a point in the plane of a facet."""
    twice = 2.0 * height(planes, facet, x, y, z)
    return x - twice * planes[facet, 0], y - twice * planes[facet, 1], z - twice * planes[facet, 2]
