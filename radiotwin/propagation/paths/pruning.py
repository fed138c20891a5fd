"""Reject receivers that a sequence of interactions cannot reach, before the image method.

Every test is necessary, none is sufficient; all are slightly looser than the exact ones.
"""

import numpy as np

from radiotwin.propagation.paths.surfaces import (
    ALONG,
    AXIS_U,
    AXIS_V,
    EXTERIOR,
    LENGTH,
    NORMAL,
    NORMAL_0,
    NORMAL_N,
    OFFSET,
    ON_PLANE_M,
    ORIGIN,
    SIZE,
    START,
    TANGENT,
    dot,
    height,
    mirrored,
)
from radiotwin.runtime.compiled import njit

ROUNDING_M, ROUNDING_RAD = 1e-6, 1e-6  # slack of the tests for rounding in double precision
GROUP = 16  # neighbouring receivers that are tested together first


@njit(cache=True, error_model="numpy")
def spheres_around(receiver_m: np.ndarray) -> np.ndarray:
    """Enclose every `GROUP` consecutive receivers (n, 3) in a sphere: centre, radius (g, 4) [m]."""
    spheres = np.empty((-(-len(receiver_m) // GROUP), 4))
    for group in range(len(spheres)):
        points_m = receiver_m[group * GROUP:(group + 1) * GROUP]
        radius2 = 0.0
        for axis in range(3):
            spheres[group, axis] = (points_m[:, axis].min() + points_m[:, axis].max()) / 2.0
        for i in range(len(points_m)):
            radius2 = max(radius2, ((points_m[i] - spheres[group, :3]) ** 2).sum())
        spheres[group, 3] = np.sqrt(radius2) + ROUNDING_M
    return spheres


@njit(cache=True, error_model="numpy")
def lit_part(planes: np.ndarray, edges: np.ndarray, edge: int, before: np.ndarray, image: np.ndarray
             ) -> tuple[float, float]:
    """Return the part of an edge, from and to [m], that the device's ray may hit by given facets.

    A point at t metres along the edge is in front of a facet, and its line to the image passes
    within a side of the facet's rectangle, if expressions that are linear in t are positive. They
    are evaluated for the edge at the last facet, for its mirror image at the one before, and so on.
    `image` (b + 1, 3) are the device and its images in the facets `before` (b,) [m]. Empty if start
    >= end.
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
            apart_m = before_m + behind_m
            values[end, 0] = before_m
            values[end, 1], values[end, 2] = u, v
            values[end, 3] = planes[facet, SIZE] * apart_m - u
            values[end, 4] = planes[facet, SIZE + 1] * apart_m - v
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
def open_window(edges: np.ndarray, edge: int, lit_m: np.ndarray, window: np.ndarray) -> None:
    """Write the window (4,) of all rays that leave the lit part (2,) [m] of an edge.

    A window bounds the position along the edge [m], from and to, and the angle around the edge from
    face 0 [rad], from and to. `narrow` reduces it.
    """
    window[0], window[1] = lit_m[0], lit_m[1]
    window[2], window[3] = -ROUNDING_RAD, edges[edge, EXTERIOR] + ROUNDING_RAD


@njit(cache=True, error_model="numpy")
def narrow(planes: np.ndarray, edges: np.ndarray, edge: int, after: np.ndarray, k: int,
           source_m: np.ndarray, window: np.ndarray) -> bool:
    """Narrow a window (4,) of diffracted rays in place to those through facet `after[k]`.

    Positions along the edge: q of a point at distance r from the edge's line, s of the source at
    distance d, which are `source_m` (2,). The ray leaves the edge at t, where (q - s) d = (t - s)
    (d + r). So t is above a bound if (q - s) d > (bound - s) (d + r). That holds for all points of
    a facet if it holds at the corners of its rectangle: r is convex; where convexity does not help,
    a linear lower bound of r is used. Facets are mirrored so that rays to them stay straight; the
    angle around the edge is not changed by that. Returns False if no ray passes; True may be wrong.
    """
    facet = after[k]
    if facet == len(planes) - 1:
        return True
    row = edges[edge]
    corners = np.empty((6, 4))
    x, y, at_m, across_m, least_m, corner = corners
    # Corners of the mirrored rectangle: position along the edge, and x, y across it
    for i in range(4):
        for axis in range(3):
            corner[axis] = planes[facet, ORIGIN + axis] \
                + (i % 2) * planes[facet, SIZE] * planes[facet, AXIS_U + axis] \
                + (i // 2) * planes[facet, SIZE + 1] * planes[facet, AXIS_V + axis]
        for j in range(k - 1, -1, -1):
            corner[0], corner[1], corner[2] = mirrored(planes, after[j], corner[0], corner[1],
                                                       corner[2])
        for axis in range(3):
            corner[axis] -= row[START + axis]
        at_m[i] = dot(corner, row[ALONG:ALONG + 3]) - source_m[0]
        x[i] = dot(corner, row[TANGENT:TANGENT + 3])
        y[i] = dot(corner, row[NORMAL_0:NORMAL_0 + 3])
        across_m[i] = np.sqrt(x[i] * x[i] + y[i] * y[i])
    # Least distance from the edge's line, by the component towards the middle of the facet
    centre_x, centre_y = x.sum(), y.sum()
    size = np.sqrt(centre_x * centre_x + centre_y * centre_y)
    for i in range(4):
        least_m[i] = (centre_x * x[i] + centre_y * y[i]) / size if size > 0.0 else 0.0
    if source_m[1] + least_m.min() <= ROUNDING_M:
        least_m[:] = 0.0
    # Narrow the positions along the edge
    low_m, high_m = np.inf, -np.inf
    for i in range(4):
        to_nearest_m = at_m[i] * source_m[1] / (source_m[1] + least_m[i])
        to_corner_m = at_m[i] * source_m[1] / (source_m[1] + across_m[i])
        low_m = min(low_m, to_corner_m if at_m[i] > 0.0 else to_nearest_m)
        high_m = max(high_m, to_nearest_m if at_m[i] > 0.0 else to_corner_m)
    window[0] = max(window[0], source_m[0] + low_m - ROUNDING_M)
    window[1] = min(window[1], source_m[0] + high_m + ROUNDING_M)
    if window[0] >= window[1]:
        return False
    # Narrow the angles around the edge, unless the facet's are two parts of the window
    least_rad, most_rad = np.inf, -np.inf  # from the facet's middle
    for i in range(4):
        aside_rad = np.arctan2(centre_x * y[i] - centre_y * x[i], centre_x * x[i] + centre_y * y[i])
        least_rad, most_rad = min(least_rad, aside_rad), max(most_rad, aside_rad)
    if size == 0.0 or most_rad - least_rad >= np.pi - ROUNDING_RAD:  # edge's line crosses the facet
        return True
    middle_rad = np.arctan2(centre_y, centre_x)
    parts, low_rad, high_rad = 0, 0.0, 0.0
    for turn in range(-1, 2):
        from_rad = max(window[2], middle_rad + least_rad + 2.0 * np.pi * turn - ROUNDING_RAD)
        to_rad = min(window[3], middle_rad + most_rad + 2.0 * np.pi * turn + ROUNDING_RAD)
        if from_rad < to_rad:
            parts, low_rad, high_rad = parts + 1, from_rad, to_rad
    if parts == 1:
        window[2], window[3] = low_rad, high_rad
    return parts > 0


@njit(cache=True, error_model="numpy")
def _coordinate(point_m: np.ndarray, origin_m: np.ndarray, axis: np.ndarray) -> float:
    """Return a point's coordinate along an axis from an origin [m]."""
    return (point_m[0] - origin_m[0]) * axis[0] + (point_m[1] - origin_m[1]) * axis[1] \
        + (point_m[2] - origin_m[2]) * axis[2]


@njit(cache=True, error_model="numpy")
def _positive(at_start: float, at_end: float, length_m: float, low_m: float, high_m: float
              ) -> tuple[float, float]:
    """Clip an interval along an edge [m] to where a linear function is positive; 0, 0 is empty."""
    if at_start < 0.0 and at_end < 0.0:
        return 0.0, 0.0
    if at_start < 0.0:
        low_m = max(low_m, length_m * at_start / (at_start - at_end) - ROUNDING_M)
    elif at_end < 0.0:
        high_m = min(high_m, length_m * at_start / (at_start - at_end) + ROUNDING_M)
    return low_m, high_m


@njit(cache=True, error_model="numpy")
def through_facet(planes: np.ndarray, facet: int, image: np.ndarray, receiver_m: np.ndarray,
                  spheres: np.ndarray, possible: np.ndarray) -> int:
    """Find the receivers (n, 3) that see an image (3,) [m] through a facet's bounding rectangle.

    Writes their rows into `possible` (n,), and returns their number. Most candidates are rejected
    here, so this and `over_edge` use few scalars, which stay in registers.
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
    # Planes through the image and the rectangle's sides; a sphere is outside if its centre is more
    # than its radius below one of them
    low_u, high_u = np.sqrt(image_u ** 2 + behind_m ** 2), \
        np.sqrt((size_u - image_u) ** 2 + behind_m ** 2)
    low_v, high_v = np.sqrt(image_v ** 2 + behind_m ** 2), \
        np.sqrt((size_v - image_v) ** 2 + behind_m ** 2)
    count = 0
    for group in range(len(spheres)):
        x, y, z = spheres[group, 0], spheres[group, 1], spheres[group, 2]
        reach_m = spheres[group, 3]
        height_m = nx * x + ny * y + nz * z - offset_m
        if height_m < -reach_m:
            continue
        if not endless:
            x, y, z = x - ox, y - oy, z - oz
            u = x * ux + y * uy + z * uz - image_u
            v = x * vx + y * vy + z * vz - image_v
            height_m += behind_m
            if u * behind_m + image_u * height_m < -reach_m * low_u \
                    or (size_u - image_u) * height_m - u * behind_m < -reach_m * high_u \
                    or v * behind_m + image_v * height_m < -reach_m * low_v \
                    or (size_v - image_v) * height_m - v * behind_m < -reach_m * high_v:
                continue
        for i in range(group * GROUP, min((group + 1) * GROUP, len(receiver_m))):
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
def over_edge(planes: np.ndarray, edges: np.ndarray, edge: int, after: np.ndarray,
              window: np.ndarray, source_m: np.ndarray, receiver_m: np.ndarray, spheres: np.ndarray,
              frame: np.ndarray, possible: np.ndarray) -> int:
    """Find the receivers that a ray diffracted at the lit part of an edge may reach.

    Writes their rows into `possible` (n,), and returns their number. `window` (4,) is narrowed to
    all facets `after` the edge; `source_m` as in `narrow`; `frame` (3, 4) is working memory.
    """
    # All in metres from the edge's start. A receiver's image in the facets is an affine function of
    # its position. Allocating arrays would take longer than the geometry.
    for i in range(3):
        for j in range(3):
            frame[i, j] = 1.0 if i == j else 0.0
        frame[i, 3] = -edges[edge, START + i]
    for k in range(len(after)):
        nx, ny, nz = planes[after[k], NORMAL:NORMAL + 3]
        for i in range(3):
            turned = frame[i, 0] * nx + frame[i, 1] * ny + frame[i, 2] * nz
            frame[i, 3] += 2.0 * planes[after[k], OFFSET] * turned
            frame[i, 0] -= 2.0 * turned * nx
            frame[i, 1] -= 2.0 * turned * ny
            frame[i, 2] -= 2.0 * turned * nz
    xx, xy, xz, x0 = frame[0]
    yx, yy, yz, y0 = frame[1]
    zx, zy, zz, z0 = frame[2]
    ax, ay, az = edges[edge, ALONG:ALONG + 3]
    nx, ny, nz = edges[edge, NORMAL_0:NORMAL_0 + 3]
    mx, my, mz = edges[edge, NORMAL_N:NORMAL_N + 3]
    # The first facet after the edge; if there is none, facet 0 as an unused placeholder
    facet = after[0] if len(after) else 0
    sided = len(after) > 0 and facet < len(planes) - 1
    fx, fy, fz = planes[facet, NORMAL:NORMAL + 3]
    ox, oy, oz = planes[facet, ORIGIN] - edges[edge, START], \
        planes[facet, ORIGIN + 1] - edges[edge, START + 1], \
        planes[facet, ORIGIN + 2] - edges[edge, START + 2]
    ux, uy, uz = planes[facet, AXIS_U:AXIS_U + 3]
    vx, vy, vz = planes[facet, AXIS_V:AXIS_V + 3]
    size_u, size_v = planes[facet, SIZE:SIZE + 2]
    low_m, high_m = window[0], window[1]
    along_m, across_m = source_m
    # Half planes at the window's angles; receivers are between them
    tx, ty, tz = edges[edge, TANGENT:TANGENT + 3]
    narrow_angle = window[3] - window[2] < np.pi
    cosine, sine = np.cos(window[2]), np.sin(window[2])
    lx, ly, lz = cosine * nx - sine * tx, cosine * ny - sine * ty, cosine * nz - sine * tz
    cosine, sine = np.cos(window[3]), np.sin(window[3])
    hx, hy, hz = sine * tx - cosine * nx, sine * ty - cosine * ny, sine * tz - cosine * nz
    count = 0
    # First the spheres around groups of receivers, then the receivers of those that remain
    for group in range(len(spheres)):
        rx, ry, rz = spheres[group, 0], spheres[group, 1], spheres[group, 2]
        reach_m = spheres[group, 3]
        x = xx * rx + xy * ry + xz * rz + x0
        y = yx * rx + yy * ry + yz * rz + y0
        z = zx * rx + zy * ry + zz * rz + z0
        if narrow_angle:
            if lx * x + ly * y + lz * z < -reach_m or hx * x + hy * y + hz * z < -reach_m:
                continue
        elif x * nx + y * ny + z * nz < -reach_m and x * mx + y * my + z * mz < -reach_m:
            continue
        to_along_m = x * ax + y * ay + z * az
        to_across_m = np.sqrt(max(x * x + y * y + z * z - to_along_m * to_along_m, 0.0))
        near_m, far_m = across_m + max(to_across_m - reach_m, 0.0), across_m + to_across_m + reach_m
        most_m, least_m = to_along_m - along_m + reach_m, to_along_m - along_m - reach_m
        if along_m + most_m * across_m / (near_m if most_m > 0.0 else far_m) < low_m \
                or along_m + least_m * across_m / (far_m if least_m > 0.0 else near_m) > high_m:
            continue
        for i in range(group * GROUP, min((group + 1) * GROUP, len(receiver_m))):
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
