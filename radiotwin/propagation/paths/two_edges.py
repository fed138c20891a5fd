"""Diffraction at two edges, one after the other: over two roofs, or round a corner and over a roof.

It is for links that no other path reaches. The first edge is one that the device sees; the second
is at a facet that rays from the first one hit, so that it is found from either end.

The field is that of two wedges in sequence. For parallel edges the distances in the coefficients
and the spreading are those of Kouyoumjian and Pathak's theory with an edge as the second source,
and equal those of the first of ITU-R P.526-15's methods for two isolated edges (section 4.4.1:
Epstein and Peterson's with Millington's correction). For others the curvatures of the wave at the
edges depend on the angle between them. Terms of the field's slope are left out: over the two edges
of one flat roof, along which the field vanishes, nothing is found.
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

STEPS = 30  # of the search for the points on two edges; it mostly takes five
PRECISION_M = 1e-6  # [m], of these points


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
    """Edges that a device sees, and those that may come after each.

    Attributes:
        edge: (s,) rows of the edges.
        second: (m,) edges after them, those of the first one first.
        first: (s + 1,) first row in `second` of each edge.
    """

    edge: np.ndarray
    second: np.ndarray
    first: np.ndarray


def paths_over_two_edges(
    city: CityMap, surfaces: Surfaces, to_try: EdgePairsToTry, device_m: np.ndarray,
    receiver_m: np.ndarray,
) -> EdgePairs:
    """Find the paths from a device (3,) to receivers (n, 3) [m] over two edges."""
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
def _possible(
    edges: np.ndarray, to_try: EdgePairsToTry, device_m: np.ndarray, receiver_m: np.ndarray
) -> np.ndarray:
    """Return the receivers and pairs of edges, (t, 3), that Keller's cones do not rule out."""
    n, seen = len(receiver_m), len(to_try.edge)
    end_m = np.empty((len(edges), 2, 3))
    for k in range(len(edges)):
        end_m[k, 0] = edges[k, START:START + 3]
        end_m[k, 1] = end_m[k, 0] + edges[k, LENGTH] * edges[k, ALONG:ALONG + 3]
    # Whether rays from the device over a first edge meet a second one does not depend on receivers
    meets = np.empty(len(to_try.second), dtype=np.bool_)
    for j in range(seen):
        for row in range(to_try.first[j], to_try.first[j + 1]):
            meets[row] = _cone_meets(edges, to_try.edge[j], device_m, end_m[to_try.second[row]])
    out = np.empty((1024, 3), dtype=np.int64)
    count = 0
    is_open = np.empty(len(edges), dtype=np.bool_)
    for i in range(n):
        for k in range(len(edges)):
            is_open[k] = around_edge(edges, k, receiver_m[i, 0], receiver_m[i, 1],
                                     receiver_m[i, 2])[0]
        for j in range(seen):
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
    """Return whether rays from a point over an edge may meet a segment (2, 3) [m].

    They leave the edge where (q - s) d = (t - s) (d + r), see `pruning.narrow`; True may be
    wrong, False never is.
    """
    _, s, d = around_edge(edges, edge, from_m[0], from_m[1], from_m[2])
    low_m, high_m, most_m = np.inf, -np.inf, 0.0
    for end in range(2):
        _, q, r = around_edge(edges, edge, end_m[end, 0], end_m[end, 1], end_m[end, 2])
        low_m, high_m, most_m = min(low_m, q), max(high_m, q), max(most_m, r)
    if low_m > s:  # r is at most that of an end, and at least 0
        low_m = s + (low_m - s) * d / (d + most_m)
    if high_m < s:
        high_m = s + (high_m - s) * d / (d + most_m)
    return low_m < edges[edge, LENGTH] and high_m > 0.0


@njit(cache=True, error_model="numpy")
def _solve(
    edges: np.ndarray, tried: np.ndarray, device_m: np.ndarray, receiver_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the shortest paths (t, 4, 3) over pairs of edges, and the rows where there is one."""
    points_m, possible = np.empty((len(tried), 4, 3)), np.empty(len(tried), dtype=np.int64)
    count = 0
    for i in range(len(tried)):
        end_m, one, other = receiver_m[tried[i, 0]], tried[i, 1], tried[i, 2]
        if not around_edge(edges, other, end_m[0], end_m[1], end_m[2])[0]:
            continue
        s, t = shortest(edges[one], edges[other], device_m, end_m)
        if not (0.0 < s < edges[one, LENGTH] and 0.0 < t < edges[other, LENGTH]):
            continue
        first_m = edges[one, START:START + 3] + s * edges[one, ALONG:ALONG + 3]
        second_m = edges[other, START:START + 3] + t * edges[other, ALONG:ALONG + 3]
        if around_edge(edges, one, second_m[0], second_m[1], second_m[2])[0] \
                and around_edge(edges, other, first_m[0], first_m[1], first_m[2])[0]:
            points_m[i, 0], points_m[i, 1] = device_m, first_m
            points_m[i, 2], points_m[i, 3] = second_m, end_m
            possible[count] = i
            count += 1
    return points_m, possible[:count]


@njit(cache=True, error_model="numpy")
def shortest(
    one: np.ndarray, other: np.ndarray, from_m: np.ndarray, to_m: np.ndarray
) -> tuple[float, float]:
    """Return where the shortest way over two edges' lines crosses them (Fermat's principle).

    The length is convex in both positions; Newton's method with halved steps finds its minimum,
    where the angles of the ray to each edge are equal before and after it (Keller's law). Edges are
    rows of `Surfaces.edges`, the way's ends (3,) [m].

    Returns:
        Positions along the edges from their starts [m]; -1 where the way goes through the point in
        which the edges meet.
    """
    a, b = one[ALONG:ALONG + 3], other[ALONG:ALONG + 3]
    apart = other[START:START + 3] - one[START:START + 3]
    # Lengths and slopes follow from these and the positions alone
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
def wave_at_edge(
    near_m: float, between_m: float, far_m: float, sine2: float
) -> tuple[float, float]:
    """Return what the wave from one edge is at another edge.

    Args:
        near_m: length of the leg on the other side of the edge in question [m].
        between_m: length between the edges [m].
        far_m: length of the leg beyond the first edge [m].
        sine2: squared sine of the angle between the planes that the ray between the edges forms
            with the one and with the other.

    Returns:
        Distance in the transition function of the edge in question, over sin² of the angle between
        ray and edge [m] (Kouyoumjian and Pathak, eq. 33), and the length [m] that together with
        `near_m` gives this distance as s s' / (s + s').
    """
    curvature = (1.0 - sine2) / (between_m + far_m) + sine2 / between_m
    distance_m = near_m * (1.0 + near_m * curvature) * between_m * (between_m + far_m) \
        / ((between_m + near_m) * (between_m + far_m + near_m))
    return distance_m, distance_m * near_m / (near_m - distance_m)


@njit(cache=True, error_model="numpy")
def two_edge_gains(
    surfaces: Surfaces, wave_number: float, slabs: Slabs, edge: np.ndarray, points_m: np.ndarray,
) -> np.ndarray:
    """Return the power gains (p,), linear, of paths over two edges, (p, 2) as in `EdgePairs`.

    The other arguments are those of `radiotwin.propagation.paths.fields.path_gains`.
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
    """Return the squared sine of the angle between the planes of a ray and either edge."""
    across, to = cross(one, ray), cross(other, ray)
    size2 = dot(across, across) * dot(to, to)
    return 0.0 if size2 < 1e-12 else max(1.0 - dot(across, to) ** 2 / size2, 0.0)
