"""Fast rejection of receivers that a candidate cannot reach, before the image method is applied.

Every test is necessary and none is sufficient; all are slightly looser than the exact ones.
"""

import numpy as np

from radiotwin.propagation.paths.surfaces import (
    ALONG,
    AXIS_U,
    AXIS_V,
    LENGTH,
    NORMAL,
    NORMAL_0,
    NORMAL_N,
    OFFSET,
    ON_PLANE_M,
    ORIGIN,
    SIZE,
    START,
    height,
    mirrored,
)
from radiotwin.runtime.compiled import njit

ROUNDING_M = 1e-6  # [m], slack of the tests for rounding in double precision


@njit(cache=True, error_model="numpy")
def lit_part(
    planes: np.ndarray, edges: np.ndarray, edge: int, before: np.ndarray, image: np.ndarray
) -> tuple[float, float]:
    """Return the part of an edge that the device can light by way of the facets before it.

    A point at t metres along the edge lies before a facet, and its line to the image passes within
    a side of the facet's rectangle, where expressions that are linear in t are positive. For the
    facet next to the edge these hold for the edge itself, for the one before that for its mirror
    image, and so on.

    Args:
        planes: of `Surfaces`.
        edges: of `Surfaces`.
        edge: row of `edges`.
        before: (b,) facets before the edge.
        image: (b + 1, 3) the device and its images in them [m].

    Returns:
        Start and end of the lit part along the edge [m]; the part is empty where start >= end.
    """
    length_m = edges[edge, LENGTH]
    low_m, high_m = -ROUNDING_M, length_m + ROUNDING_M
    ends = np.empty((2, 3))
    ends[0] = edges[edge, START:START + 3]
    ends[1] = ends[0] + length_m * edges[edge, ALONG:ALONG + 3]
    values = np.empty((2, 5))
    for k in range(len(before) - 1, -1, -1):
        facet = before[k]
        ix, iy, iz = image[k + 1]
        behind_m = -height(planes, facet, ix, iy, iz)
        origin = planes[facet, ORIGIN:ORIGIN + 3]
        axis_u, axis_v = planes[facet, AXIS_U:AXIS_U + 3], planes[facet, AXIS_V:AXIS_V + 3]
        image_u = _coordinate(image[k + 1], origin, axis_u)
        image_v = _coordinate(image[k + 1], origin, axis_v)
        for end in range(2):
            before_m = height(planes, facet, ends[end, 0], ends[end, 1], ends[end, 2])
            u = image_u * before_m + behind_m * _coordinate(ends[end], origin, axis_u)
            v = image_v * before_m + behind_m * _coordinate(ends[end], origin, axis_v)
            whole_m = before_m + behind_m
            values[end, 0] = before_m
            values[end, 1], values[end, 2] = u, v
            values[end, 3] = planes[facet, SIZE] * whole_m - u
            values[end, 4] = planes[facet, SIZE + 1] * whole_m - v
        bounds = 1 if facet == len(planes) - 1 else 5  # the ground has no sides
        for i in range(bounds):
            low_m, high_m = _positive(values[0, i], values[1, i], length_m, low_m, high_m)
        if low_m >= high_m:
            return 0.0, 0.0
        for end in range(2):
            ends[end, 0], ends[end, 1], ends[end, 2] = \
                mirrored(planes, facet, ends[end, 0], ends[end, 1], ends[end, 2])
    return low_m, high_m


@njit(cache=True, error_model="numpy")
def cone_misses(
    planes: np.ndarray, edges: np.ndarray, edge: int, after: np.ndarray, lit_m: np.ndarray,
    source_m: np.ndarray,
) -> bool:
    """Return whether diffracted rays from the lit part of an edge miss one of the facets after it.

    A ray to a point at q along the edge and r from its line leaves the edge at t, where
    (q - s) d = (t - s) (d + r), with the source at s along the edge and d from its line. So t is
    above a bound where (q - s) d > (bound - s) (d + r). For all points of a facet that holds if it
    holds at the corners of its rectangle: r is convex, and where that is the wrong way round, a
    lower bound of r that is linear takes its place.

    Args:
        planes: of `Surfaces`.
        edges: of `Surfaces`.
        edge: row of `edges`.
        after: (b,) facets after the edge.
        lit_m: (2,) start and end of the lit part [m].
        source_m: (2,) position of the source along the edge, and distance from its line [m].

    Returns:
        Whether none of the rays goes through all facets; False may be wrong, True never is.
    """
    start, along = edges[edge, START:START + 3], edges[edge, ALONG:ALONG + 3]
    corner, centre = np.empty((4, 3)), np.empty(3)
    for k in range(len(after)):
        facet = after[k]
        if facet == len(planes) - 1:
            continue
        for i in range(4):
            for axis in range(3):
                corner[i, axis] = planes[facet, ORIGIN + axis] \
                    + (i % 2) * planes[facet, SIZE] * planes[facet, AXIS_U + axis] \
                    + (i // 2) * planes[facet, SIZE + 1] * planes[facet, AXIS_V + axis]
            for j in range(k - 1, -1, -1):
                corner[i, 0], corner[i, 1], corner[i, 2] = mirrored(
                    planes, after[j], corner[i, 0], corner[i, 1], corner[i, 2])
            for axis in range(3):
                corner[i, axis] -= start[axis]
        for axis in range(3):
            centre[axis] = corner[:, axis].sum()
        centre_along = centre[0] * along[0] + centre[1] * along[1] + centre[2] * along[2]
        for axis in range(3):
            centre[axis] -= centre_along * along[axis]
        size = np.sqrt((centre ** 2).sum())
        below = above = True
        low_m, high_m = lit_m[0] - source_m[0], lit_m[1] - source_m[0]
        for i in range(4):
            at_m = corner[i, 0] * along[0] + corner[i, 1] * along[1] + corner[i, 2] * along[2]
            across2 = (corner[i] ** 2).sum() - at_m * at_m
            across_m = source_m[1] + np.sqrt(max(across2, 0.0))
            least_m = source_m[1]
            if size > 0.0:
                least_m += (corner[i, 0] * centre[0] + corner[i, 1] * centre[1]
                            + corner[i, 2] * centre[2]) / size
            leans_m = (at_m - source_m[0]) * source_m[1]
            below = below and leans_m < low_m * (least_m if low_m > 0.0 else across_m)
            above = above and leans_m > high_m * (across_m if high_m > 0.0 else least_m)
        if below or above:
            return True
    return False


@njit(cache=True, error_model="numpy")
def _coordinate(point_m: np.ndarray, origin_m: np.ndarray, axis: np.ndarray) -> float:
    """Return a point's coordinate along an axis from an origin [m]."""
    return (point_m[0] - origin_m[0]) * axis[0] + (point_m[1] - origin_m[1]) * axis[1] \
        + (point_m[2] - origin_m[2]) * axis[2]


@njit(cache=True, error_model="numpy")
def _positive(
    at_start: float, at_end: float, length_m: float, low_m: float, high_m: float
) -> tuple[float, float]:
    """Narrow an interval of an edge to where a function linear along the edge is positive."""
    if at_start < 0.0 and at_end < 0.0:
        return 0.0, 0.0
    if at_start < 0.0:
        low_m = max(low_m, length_m * at_start / (at_start - at_end) - ROUNDING_M)
    elif at_end < 0.0:
        high_m = min(high_m, length_m * at_start / (at_start - at_end) + ROUNDING_M)
    return low_m, high_m


@njit(cache=True, error_model="numpy")
def through_facet(
    planes: np.ndarray, facet: int, image: np.ndarray, receiver_m: np.ndarray, possible: np.ndarray
) -> int:
    """Find the receivers that see an image through a facet's bounding rectangle.

    Most candidates end here, so this and `over_edge` use only few scalars, which stay in registers.

    Args:
        planes: of `Surfaces`.
        facet: row of `planes`.
        image: (3,) image of the device in the facet [m].
        receiver_m: (n, 3) positions [m].
        possible: (n,) output: rows of the receivers.

    Returns:
        The number of rows in `possible`.
    """
    nx, ny, nz = planes[facet, NORMAL:NORMAL + 3]
    offset_m = planes[facet, OFFSET]
    ox, oy, oz = planes[facet, ORIGIN:ORIGIN + 3]
    ux, uy, uz = planes[facet, AXIS_U:AXIS_U + 3]
    vx, vy, vz = planes[facet, AXIS_V:AXIS_V + 3]
    size_u, size_v = planes[facet, SIZE:SIZE + 2]
    endless = facet == len(planes) - 1
    ix, iy, iz = image
    behind_m = offset_m - (nx * ix + ny * iy + nz * iz)
    image_u = (ix - ox) * ux + (iy - oy) * uy + (iz - oz) * uz
    image_v = (ix - ox) * vx + (iy - oy) * vy + (iz - oz) * vz
    count = 0
    for i in range(len(receiver_m)):
        x, y, z = receiver_m[i, 0], receiver_m[i, 1], receiver_m[i, 2]
        before_m = nx * x + ny * y + nz * z - offset_m
        if before_m < ON_PLANE_M:
            continue
        x, y, z = x - ox, y - oy, z - oz
        share = behind_m / (before_m + behind_m)
        u = image_u + share * (x * ux + y * uy + z * uz - image_u)
        v = image_v + share * (x * vx + y * vy + z * vz - image_v)
        if endless or (-ROUNDING_M < u < size_u + ROUNDING_M
                       and -ROUNDING_M < v < size_v + ROUNDING_M):
            possible[count] = i
            count += 1
    return count


@njit(cache=True, error_model="numpy")
def over_edge(
    planes: np.ndarray, edges: np.ndarray, edge: int, after: np.ndarray, low_m: float,
    high_m: float, along_m: float, across_m: float, receiver_m: np.ndarray, possible: np.ndarray,
) -> int:
    """Find the receivers that a ray over the lit part of an edge may reach.

    Args:
        planes: of `Surfaces`.
        edges: of `Surfaces`.
        edge: row of `edges`.
        after: facets after the edge.
        low_m: start of the lit part along the edge [m].
        high_m: end of the lit part [m].
        along_m: position of the source along the edge [m].
        across_m: distance of the source from the edge's line [m].
        receiver_m: (n, 3) positions [m].
        possible: (n,) output: rows of the receivers.

    Returns:
        The number of rows in `possible`.
    """
    # All in metres from the edge's start. A receiver's image in the facets is an affine map of it.
    matrix, shift = np.eye(3), -edges[edge, START:START + 3]
    for k in range(len(after)):
        normal = planes[after[k], NORMAL:NORMAL + 3]
        turned = _product(matrix, normal)
        shift += 2.0 * planes[after[k], OFFSET] * turned
        for i in range(3):
            for j in range(3):
                matrix[i, j] -= 2.0 * turned[i] * normal[j]
    xx, xy, xz = matrix[0]
    yx, yy, yz = matrix[1]
    zx, zy, zz = matrix[2]
    x0, y0, z0 = shift
    ax, ay, az = edges[edge, ALONG:ALONG + 3]
    nx, ny, nz = edges[edge, NORMAL_0:NORMAL_0 + 3]
    mx, my, mz = edges[edge, NORMAL_N:NORMAL_N + 3]
    # The first facet after the edge; where there is none, facet 0 stands in and is not used
    facet = after[0] if len(after) else 0
    sided = len(after) > 0 and facet < len(planes) - 1
    fx, fy, fz = planes[facet, NORMAL:NORMAL + 3]
    ox, oy, oz = planes[facet, ORIGIN:ORIGIN + 3] - edges[edge, START:START + 3]
    ux, uy, uz = planes[facet, AXIS_U:AXIS_U + 3]
    vx, vy, vz = planes[facet, AXIS_V:AXIS_V + 3]
    size_u, size_v = planes[facet, SIZE:SIZE + 2]
    count = 0
    for i in range(len(receiver_m)):
        rx, ry, rz = receiver_m[i, 0], receiver_m[i, 1], receiver_m[i, 2]
        x = xx * rx + xy * ry + xz * rz + x0
        y = yx * rx + yy * ry + yz * rz + y0
        z = zx * rx + zy * ry + zz * rz + z0
        to_along_m = x * ax + y * ay + z * az
        to_across_m = np.sqrt(max(x * x + y * y + z * z - to_along_m * to_along_m, 1e-12))
        at_m = along_m + (to_along_m - along_m) * across_m / (across_m + to_across_m)
        if not low_m < at_m < high_m:
            continue
        if x * nx + y * ny + z * nz < -ROUNDING_M and x * mx + y * my + z * mz < -ROUNDING_M:
            continue
        if sided:
            qx, qy, qz = at_m * ax - ox, at_m * ay - oy, at_m * az - oz
            x, y, z = x - ox, y - oy, z - oz
            before_m, behind_m = qx * fx + qy * fy + qz * fz, -(x * fx + y * fy + z * fz)
            if before_m < 0.0 or behind_m < 0.0:
                continue
            share = before_m / max(before_m + behind_m, ON_PLANE_M)
            x, y, z = qx + share * (x - qx), qy + share * (y - qy), qz + share * (z - qz)
            u, v = x * ux + y * uy + z * uz, x * vx + y * vy + z * vz
            if not (-ROUNDING_M < u < size_u + ROUNDING_M
                    and -ROUNDING_M < v < size_v + ROUNDING_M):
                continue
        possible[count] = i
        count += 1
    return count


@njit(cache=True, error_model="numpy")
def _product(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return a matrix (3, 3) times a vector (3,); numba's `@` would need BLAS."""
    out = np.empty(3)
    for i in range(3):
        out[i] = matrix[i, 0] * vector[0] + matrix[i, 1] * vector[1] + matrix[i, 2] * vector[2]
    return out
