"""Double diffraction: paths over two edges, such as two roofs, or a corner and a roof.

It is for links that no other path reaches. The first edge is one that the device sees; the second
borders a facet that rays from the first edge hit, so the pair is found from either end.

The field is that of two wedges in sequence. For parallel edges, distances and spreading are those
of Kouyoumjian and Pathak with the first edge as a line source; they equal those of the first method
of ITU-R P.526-15 for two isolated edges (section 4.4.1: Epstein-Peterson with Millington's
correction). For other edges, the curvature of the wave depends on the angle between them. Slope
diffraction is left out, so the two edges of one flat roof, along which the field vanishes, carry no
power.
"""

from typing import NamedTuple

import numpy as np

from radiotwin.propagation.paths.fields import vertical
from radiotwin.propagation.paths.interactions import Slabs, around_edge, diffract
from radiotwin.propagation.paths.surfaces import (
    ALONG,
    LENGTH,
    NORMAL_0,
    NORMAL_N,
    START,
    Surfaces,
    cross,
    dot,
)
from radiotwin.runtime.compiled import njit
from radiotwin.scene.citymap import SKIN_M, CityMap

STEPS = 30  # most Newton steps to find the points on two edges; five are typical
PRECISION_M = 1e-6  # of these points


class EdgePairs(NamedTuple):
    """Paths over two edges.

    Attributes:
        receiver: (p,) row of the receiver.
        edge: (p, 2) rows of the edges.
        points_m: (p, 4, 3) device, points on the edges, receiver [m].
    """

    receiver: np.ndarray
    edge: np.ndarray
    points_m: np.ndarray


class EdgePairsToTry(NamedTuple):
    """First edges that a device sees, and second edges that a path may take after each.

    Attributes:
        edge: (s,) rows of the first edges.
        second: (m,) rows of the second edges, grouped by first edge.
        first: (s + 1,) first row in `second` for each first edge.
    """

    edge: np.ndarray
    second: np.ndarray
    first: np.ndarray


def paths_over_two_edges(city: CityMap, surfaces: Surfaces, to_try: EdgePairsToTry,
                         device_m: np.ndarray, receiver_m: np.ndarray) -> EdgePairs:
    """Find the unblocked paths from a device (3,) to receivers (n, 3) [m] over two edges."""
    tried = _possible(surfaces.edges, to_try, device_m, receiver_m)
    points_m, possible = _solve(surfaces.edges, tried, device_m, receiver_m)
    tried, points_m = tried[possible], points_m[possible]
    faces = surfaces.edges[tried[:, 1:]]
    outward = faces[..., NORMAL_0:NORMAL_0 + 3] + faces[..., NORMAL_N:NORMAL_N + 3]
    off_m = points_m.copy()
    off_m[:, 1:3] += SKIN_M * outward / np.linalg.norm(outward, axis=2, keepdims=True)
    clear = np.arange(len(tried))
    for leg in (1, 2, 0):  # the leg between two edges is blocked most often
        clear = clear[city.line_of_sight(off_m[clear, leg], off_m[clear, leg + 1])]
    return EdgePairs(tried[clear, 0], tried[clear, 1:], points_m[clear])


@njit(cache=True, nogil=True, error_model="numpy")
def _possible(edges: np.ndarray, to_try: EdgePairsToTry, device_m: np.ndarray,
              receiver_m: np.ndarray) -> np.ndarray:
    """List rows (t, 3) of receiver, first and second edge that Keller's cones do not rule out.

    The device's cone at the first edge must meet the second; the receiver's cone, the first.
    """
    n, first_edges = len(receiver_m), len(to_try.edge)
    end_m = np.empty((len(edges), 2, 3))
    for k in range(len(edges)):
        end_m[k, 0] = edges[k, START:START + 3]
        end_m[k, 1] = end_m[k, 0] + edges[k, LENGTH] * edges[k, ALONG:ALONG + 3]
    # Rays from the device over a first edge meet a second edge or not, for any receiver.
    meets = np.empty(len(to_try.second), dtype=np.bool_)
    for j in range(first_edges):
        for row in range(to_try.first[j], to_try.first[j + 1]):
            meets[row] = _cone_meets(edges, to_try.edge[j], device_m, end_m[to_try.second[row]])
    out = np.empty((1024, 3), dtype=np.int64)
    count = 0
    is_open = np.empty(len(edges), dtype=np.bool_)
    for i in range(n):
        for k in range(len(edges)):
            is_open[k] = around_edge(edges, k, receiver_m[i, 0], receiver_m[i, 1],
                                     receiver_m[i, 2])[0]
        for j in range(first_edges):
            for row in range(to_try.first[j], to_try.first[j + 1]):
                second = to_try.second[row]
                if meets[row] and is_open[second] and _cone_meets(
                        edges, second, receiver_m[i], end_m[to_try.edge[j]]):
                    if count == len(out):
                        out = np.concatenate((out, np.empty_like(out)))
                    out[count, 0], out[count, 1], out[count, 2] = i, to_try.edge[j], second
                    count += 1
    return out[:count]


@njit(cache=True, error_model="numpy")
def _cone_meets(edges: np.ndarray, edge: int, from_m: np.ndarray, end_m: np.ndarray) -> bool:
    """Return False if no ray from a point (3,), diffracted by an edge, meets a segment (2, 3) [m].

    Letters are as in `pruning.narrow`. True may be wrong.
    """
    _, s, d = around_edge(edges, edge, from_m[0], from_m[1], from_m[2])
    low_m, high_m, most_m = np.inf, -np.inf, 0.0
    for end in range(2):
        _, q, r = around_edge(edges, edge, end_m[end, 0], end_m[end, 1], end_m[end, 2])
        low_m, high_m, most_m = min(low_m, q), max(high_m, q), max(most_m, r)
    if low_m > s:  # r lies between 0 and the larger one of the ends
        low_m = s + (low_m - s) * d / (d + most_m)
    if high_m < s:
        high_m = s + (high_m - s) * d / (d + most_m)
    return low_m < edges[edge, LENGTH] and high_m > 0.0


@njit(cache=True, error_model="numpy")
def _solve(edges: np.ndarray, tried: np.ndarray, device_m: np.ndarray, receiver_m: np.ndarray
           ) -> tuple[np.ndarray, np.ndarray]:
    """Find the shortest path over each pair of edges in `tried` (t, 3), from device to receiver.

    Returns its points (t, 4, 3) [m], and the rows with a path along the edges and outside both
    wedges. Other rows are not written.
    """
    points_m, possible = np.empty((len(tried), 4, 3)), np.empty(len(tried), dtype=np.int64)
    count = 0
    for i in range(len(tried)):
        end_m, first_edge, second_edge = receiver_m[tried[i, 0]], tried[i, 1], tried[i, 2]
        if not around_edge(edges, second_edge, end_m[0], end_m[1], end_m[2])[0]:
            continue
        s, t = shortest(edges[first_edge], edges[second_edge], device_m, end_m)
        if not (0.0 < s < edges[first_edge, LENGTH] and 0.0 < t < edges[second_edge, LENGTH]):
            continue
        first_m = edges[first_edge, START:START + 3] + s * edges[first_edge, ALONG:ALONG + 3]
        second_m = edges[second_edge, START:START + 3] + t * edges[second_edge, ALONG:ALONG + 3]
        if around_edge(edges, first_edge, second_m[0], second_m[1], second_m[2])[0] \
                and around_edge(edges, second_edge, first_m[0], first_m[1], first_m[2])[0]:
            points_m[i, 0], points_m[i, 1] = device_m, first_m
            points_m[i, 2], points_m[i, 3] = second_m, end_m
            possible[count] = i
            count += 1
    return points_m, possible[:count]


@njit(cache=True, error_model="numpy")
def shortest(one: np.ndarray, other: np.ndarray, from_m: np.ndarray, to_m: np.ndarray
             ) -> tuple[float, float]:
    """Find the shortest path between points (3,) over the lines of two edges (Fermat's principle).

    The length is convex in both positions; Newton's method with halved steps finds its minimum,
    where Keller's law holds at both edges. Returns positions along the edges [m]; (-1, -1) if no
    path is found: it passes the intersection of the edges, an end lies on an edge, or the iteration
    does not converge.
    """
    a, b = one[ALONG:ALONG + 3], other[ALONG:ALONG + 3]
    apart = other[START:START + 3] - one[START:START + 3]
    # Lengths and slopes depend on these products and the positions only.
    cosine, apart2, apart_a, apart_b = dot(a, b), dot(apart, apart), dot(apart, a), dot(apart, b)
    start, end = from_m - one[START:START + 3], to_m - other[START:START + 3]
    start_at, end_at = dot(start, a), dot(end, b)
    start_off2, end_off2 = dot(start, start) - start_at ** 2, dot(end, end) - end_at ** 2
    s, t = 0.5 * one[LENGTH], 0.5 * other[LENGTH]
    length_m = np.inf
    step_s = step_t = 0.0
    for _ in range(STEPS):
        near_m = np.sqrt(max(start_off2 + (s - start_at) ** 2, 0.0))
        between_m = np.sqrt(max(apart2 + s * s + t * t + 2.0 * (t * apart_b - s * apart_a
                                                                - s * t * cosine), 0.0))
        far_m = np.sqrt(max(end_off2 + (t - end_at) ** 2, 0.0))
        if min(near_m, between_m, far_m) < PRECISION_M:
            return -1.0, -1.0
        if near_m + between_m + far_m > length_m + PRECISION_M:  # too far: go back by half
            step_s, step_t = 0.5 * step_s, 0.5 * step_t
            s, t = s - step_s, t - step_t
            continue
        length_m = near_m + between_m + far_m
        first_a, third_b = (s - start_at) / near_m, (end_at - t) / far_m
        second_a = (apart_a + t * cosine - s) / between_m
        second_b = (apart_b + t - s * cosine) / between_m
        slope_s, slope_t = first_a - second_a, second_b - third_b
        ss = (1.0 - first_a ** 2) / near_m + (1.0 - second_a ** 2) / between_m
        tt = (1.0 - second_b ** 2) / between_m + (1.0 - third_b ** 2) / far_m
        st = -(cosine - second_a * second_b) / between_m
        scale = ss * tt - st * st
        if not scale > 0.0:
            return -1.0, -1.0
        step_s = (st * slope_t - tt * slope_s) / scale
        step_t = (st * slope_s - ss * slope_t) / scale
        s, t = s + step_s, t + step_t
        if abs(step_s) + abs(step_t) < PRECISION_M:
            return s, t
    return -1.0, -1.0


@njit(cache=True, error_model="numpy")
def wave_at_edge(near_m: float, between_m: float, far_m: float, sine2: float
                 ) -> tuple[float, float]:
    """Compute the distance parameter at one of two edges, for the wave diffracted by the other.

    Legs are from this edge to the nearer end of the path, between the edges, and from the other
    edge to its end [m]; `sine2` is of the angle between the planes that the ray between the edges
    spans with them. Returns the parameter of this edge's transition function over sin² of the angle
    between ray and edge [m] (Kouyoumjian and Pathak, eq. 33), and the length s' [m] for which s s'
    / (s + s') with s = `near_m` is that distance.
    """
    curvature = (1.0 - sine2) / (between_m + far_m) + sine2 / between_m
    distance_m = near_m * (1.0 + near_m * curvature) * between_m * (between_m + far_m) \
        / ((between_m + near_m) * (between_m + far_m + near_m))
    return distance_m, distance_m * near_m / (near_m - distance_m)


@njit(cache=True, error_model="numpy")
def two_edge_gains(surfaces: Surfaces, wave_number: float, slabs: Slabs, edge: np.ndarray,
                   points_m: np.ndarray) -> np.ndarray:
    """Compute the power gains (p,), linear, of paths over two edges, see `EdgePairs`.

    The other arguments are those of `radiotwin.propagation.paths.fields.buffer_gains`.
    """
    gain = np.empty(len(edge))
    direction, field = np.empty((3, 3)), np.empty(3, dtype=np.complex128)
    for i in range(len(edge)):
        legs = points_m[i, 1:] - points_m[i, :3]
        a, b, c = np.sqrt((legs ** 2).sum(axis=1))
        for k, length_m in enumerate((a, b, c)):
            direction[k] = legs[k] / length_m
        sine2 = _twist(surfaces.edges[edge[i, 0], ALONG:ALONG + 3],
                       surfaces.edges[edge[i, 1], ALONG:ALONG + 3], direction[1])
        field[0], field[1], field[2] = vertical(direction[0])
        diffract(surfaces.edges, edge[i, 0], direction[0], direction[1], a,
                 wave_at_edge(a, b, c, sine2)[1], wave_number, slabs, field)
        diffract(surfaces.edges, edge[i, 1], direction[1], direction[2],
                 wave_at_edge(c, b, a, sine2)[1], c, wave_number, slabs, field)
        power = abs(dot(field, vertical(direction[2]))) ** 2
        spread = 1.0 / (a * c * (b * (a + b + c) + a * c * sine2))
        gain[i] = spread * power / (2.0 * wave_number) ** 2
    return gain


@njit(cache=True, error_model="numpy")
def _twist(one: np.ndarray, other: np.ndarray, ray: np.ndarray) -> float:
    """Return the squared sine of the angle between the planes that a ray spans with two edges."""
    across, to = cross(one, ray), cross(other, ray)
    size2 = dot(across, across) * dot(to, to)
    return 0.0 if size2 < 1e-12 else max(1.0 - dot(across, to) ** 2 / size2, 0.0)
