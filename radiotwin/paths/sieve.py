"""What cannot be a path, found quickly: most candidates are sieved out here, before the image method takes over.

Every test is necessary, none is sufficient, and all are a little looser than the exact ones.
"""

import numpy as np
from numba import njit

from radiotwin.paths.surfaces import LENGTH, OFFSET, ON_PLANE_M, SIZE, height, mirrored

ROUNDING_M = 1e-6


@njit(cache=True, error_model="numpy")
def lit_part(planes, edges, edge, before, image):
    """The part of an edge that the device lights by the facets before it: from and to [m]; none where from >= to.

    A point at t metres along the edge lies before a facet, and its line to the image passes within a side of the
    facet's rectangle, where expressions that are linear in t are positive. For the facet next to the edge these hold
    for the edge itself, for the one before that for its image, and so on.
    """
    low_m, high_m = -ROUNDING_M, edges[edge, LENGTH] + ROUNDING_M
    ends = np.empty((2, 3))
    ends[0] = edges[edge, :3]
    ends[1] = ends[0] + edges[edge, LENGTH] * edges[edge, 3:6]
    values = np.empty((2, 5))
    for k in range(len(before) - 1, -1, -1):
        facet = before[k]
        ix, iy, iz = image[k + 1]
        behind_m = -height(planes, facet, ix, iy, iz)
        origin, axis_u, axis_v = planes[facet, 4:7], planes[facet, 7:10], planes[facet, 10:13]
        image_u, image_v = _along(image[k + 1], origin, axis_u), _along(image[k + 1], origin, axis_v)
        for end in range(2):
            before_m = height(planes, facet, ends[end, 0], ends[end, 1], ends[end, 2])
            u = image_u * before_m + behind_m * _along(ends[end], origin, axis_u)
            v = image_v * before_m + behind_m * _along(ends[end], origin, axis_v)
            whole_m = before_m + behind_m
            values[end, 0] = before_m
            values[end, 1], values[end, 2] = u, v
            values[end, 3] = planes[facet, SIZE] * whole_m - u
            values[end, 4] = planes[facet, SIZE + 1] * whole_m - v
        bounds = 1 if facet == len(planes) - 1 else 5  # the ground has no sides
        for i in range(bounds):
            low_m, high_m = _positive(values[0, i], values[1, i], edges[edge, LENGTH], low_m, high_m)
        if low_m >= high_m:
            return 0.0, 0.0
        for end in range(2):
            ends[end, 0], ends[end, 1], ends[end, 2] = \
                mirrored(planes, facet, ends[end, 0], ends[end, 1], ends[end, 2])
    return low_m, high_m


@njit(cache=True, error_model="numpy")
def _along(point_m, origin_m, axis):
    return (point_m[0] - origin_m[0]) * axis[0] + (point_m[1] - origin_m[1]) * axis[1] \
        + (point_m[2] - origin_m[2]) * axis[2]


@njit(cache=True, error_model="numpy")
def _positive(at_start, at_end, length_m, low_m, high_m):
    """Narrow [low, high] to where a linear function of the metres along an edge is positive."""
    if at_start < 0.0 and at_end < 0.0:
        return 0.0, 0.0
    if at_start < 0.0:
        low_m = max(low_m, length_m * at_start / (at_start - at_end) - ROUNDING_M)
    elif at_end < 0.0:
        high_m = min(high_m, length_m * at_start / (at_start - at_end) + ROUNDING_M)
    return low_m, high_m


@njit(cache=True, error_model="numpy")
def through_facet(planes, facet, image, receiver_m, possible):
    """Rows of receivers that see an image through a facet's bounding rectangle, put in `possible`; how many.

    Most candidates fail here, so this and `over_edge` keep to a few numbers that stay in registers.
    """
    nx, ny, nz = planes[facet, :3]
    offset_m = planes[facet, OFFSET]
    ox, oy, oz = planes[facet, 4:7]
    ux, uy, uz = planes[facet, 7:10]
    vx, vy, vz = planes[facet, 10:13]
    size_u, size_v = planes[facet, 13:15]
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
        if endless or (-ROUNDING_M < u < size_u + ROUNDING_M and -ROUNDING_M < v < size_v + ROUNDING_M):
            possible[count] = i
            count += 1
    return count


@njit(cache=True, error_model="numpy")
def over_edge(planes, edges, edge, behind, low_m, high_m, along_m, across_m, receiver_m, possible):
    """Rows of receivers that a ray over the lit part of an edge may reach by the facets behind it, put in `possible`.

    Args:
        edge, behind: the edge, and the facets behind it.
        low_m, high_m: the lit part.
        along_m, across_m: the source as the edge sees it.
        receiver_m: (n, 3) [m]
        possible: (n,) output.

    Returns:
        how many
    """
    # All in metres from the edge's start. The image of a receiver in the facets is an affine map of it.
    matrix, shift = np.eye(3), -edges[edge, :3]
    for k in range(len(behind)):
        normal = planes[behind[k], :3]
        turned = _times(matrix, normal)
        shift += 2.0 * planes[behind[k], OFFSET] * turned
        for i in range(3):
            for j in range(3):
                matrix[i, j] -= 2.0 * turned[i] * normal[j]
    xx, xy, xz = matrix[0]
    yx, yy, yz = matrix[1]
    zx, zy, zz = matrix[2]
    x0, y0, z0 = shift
    ax, ay, az = edges[edge, 3:6]
    nx, ny, nz = edges[edge, 10:13]
    mx, my, mz = edges[edge, 13:16]
    # The first facet behind the edge; any will do where there is none, it is not asked then.
    facet = behind[0] if len(behind) else 0
    sided = len(behind) > 0 and facet < len(planes) - 1
    fx, fy, fz = planes[facet, :3]
    ox, oy, oz = planes[facet, 4:7] - edges[edge, :3]
    ux, uy, uz = planes[facet, 7:10]
    vx, vy, vz = planes[facet, 10:13]
    size_u, size_v = planes[facet, 13:15]
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
            if not (-ROUNDING_M < u < size_u + ROUNDING_M and -ROUNDING_M < v < size_v + ROUNDING_M):
                continue
        possible[count] = i
        count += 1
    return count


@njit(cache=True, error_model="numpy")
def _times(matrix, vector):
    out = np.empty(3)
    for i in range(3):
        out[i] = matrix[i, 0] * vector[0] + matrix[i, 1] * vector[1] + matrix[i, 2] * vector[2]
    return out
