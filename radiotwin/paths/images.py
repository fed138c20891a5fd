"""Paths over given facets and at most one edge, by the image method: where they turn.

The device is mirrored in the facets before the edge, one after another, and the receiver in those behind it; where
the straight line between the images goes through a facet, the ray turns (Balanis, "Advanced Engineering
Electromagnetics", 2nd ed., ch. 5). Whether something stands in between is not asked here.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from radiotwin.paths.sieve import lit_part, over_edge, through_facet
from radiotwin.paths.surfaces import ALONG, LENGTH, ON_PLANE_M, START, height, mirrored, within
from radiotwin.paths.wedges import around_edge

MOST_TURNS = 6  # facets and edge of one path


class Candidates(NamedTuple):
    """Sequences of turns to try between one device and any receiver.

    Attributes:
        before: (c, a) facets before the edge, or all where there is none; -1 behind the last.
        edge: (c,) row of the edges; -1: none.
        behind: (c, b) facets behind the edge; -1 behind the last.
    """

    before: np.ndarray
    edge: np.ndarray
    behind: np.ndarray


class Buffer(NamedTuple):
    """Paths that were found.

    Attributes:
        receiver, candidate: (capacity,) rows of the receivers and the candidates.
        points_m: (capacity, MOST_TURNS + 2, 3) device, turns, receiver [m].
        count: (capacity,) how many of the points are used.
    """

    receiver: np.ndarray
    candidate: np.ndarray
    points_m: np.ndarray
    count: np.ndarray  # type: ignore[assignment]  # hides the method of tuples, which nobody calls

    @classmethod
    def of(cls, capacity: int) -> "Buffer":
        return cls(np.empty(capacity, dtype=np.int64), np.empty(capacity, dtype=np.int64),
                   np.empty((capacity, MOST_TURNS + 2, 3)), np.empty(capacity, dtype=np.int64))


@njit(cache=True, nogil=True, error_model="numpy")
def find_paths(surfaces, candidates, device_m, receiver_m, cursor, buffer):
    """Try candidates x receivers in order from `cursor` until the buffer is full.

    Args:
        surfaces: `Surfaces`.
        candidates: `Candidates`.
        device_m: (3,) [m]
        receiver_m: (n, 3) [m]
        cursor: candidate * n + receiver to begin with.
        buffer: filled from its first row on.

    Returns:
        (paths found, the next cursor)
    """
    planes, uv_m, edges = surfaces.planes, surfaces.triangle_uv_m, surfaces.edges
    n = len(receiver_m)
    image, mirror = np.empty((MOST_TURNS + 1, 3)), np.empty((MOST_TURNS + 1, 3))
    possible = np.empty(n, dtype=np.int64)
    found = 0
    for row in range(cursor // n, len(candidates.edge)):
        usable, before, behind = _source_images(planes, candidates.before, candidates.behind, row, device_m, image)
        if not usable:
            continue
        facets_before, facets_behind = candidates.before[row, :before], candidates.behind[row, :behind]
        edge = candidates.edge[row]
        along_m = across_m = 0.0
        if edge < 0:
            count = through_facet(planes, facets_before[-1], image[before], receiver_m, possible)
        else:
            usable, along_m, across_m = \
                around_edge(edges, edge, image[before, 0], image[before, 1], image[before, 2])
            if not usable:
                continue
            low_m, high_m = lit_part(planes, edges, edge, facets_before, image)
            count = 0
            if low_m < high_m:
                count = over_edge(planes, edges, edge, facets_behind, low_m, high_m, along_m, across_m,
                                  receiver_m, possible)
        for i in range(count):
            at = possible[i]
            if row * n + at < cursor:
                continue
            if found == len(buffer.count):
                return found, row * n + at
            x, y, z = receiver_m[at, 0], receiver_m[at, 1], receiver_m[at, 2]
            points_m = buffer.points_m[found]
            turns = before
            if edge >= 0:
                ok, x, y, z = _behind_edge(planes, uv_m, edges, edge, facets_behind, before + 1, along_m, across_m,
                                           x, y, z, mirror, points_m)
                if not ok:
                    continue
                turns += behind + 1
            if not _before_edge(planes, uv_m, facets_before, x, y, z, image, points_m):
                continue
            points_m[0] = device_m
            points_m[turns + 1] = receiver_m[at]
            buffer.receiver[found], buffer.candidate[found], buffer.count[found] = at, row, turns + 2
            found += 1
    return found, n * len(candidates.edge)


@njit(cache=True, error_model="numpy")
def _source_images(planes, all_before, all_behind, row, device_m, image):
    """Mirror the device in the facets before the edge: (possible, facets before, facets behind)."""
    image[0] = device_m
    before = behind = 0
    while before < all_before.shape[1] and all_before[row, before] >= 0:
        facet = all_before[row, before]
        x, y, z = image[before, 0], image[before, 1], image[before, 2]
        if height(planes, facet, x, y, z) < ON_PLANE_M:
            return False, 0, 0
        before += 1
        image[before, 0], image[before, 1], image[before, 2] = mirrored(planes, facet, x, y, z)
    while behind < all_behind.shape[1] and all_behind[row, behind] >= 0:
        behind += 1
    return True, before, behind


@njit(cache=True, error_model="numpy")
def _before_edge(planes, uv_m, before, x, y, z, image, points_m):
    """Turns from a point, the edge or the receiver, back to the device; whether there is such a path."""
    for k in range(len(before) - 1, -1, -1):
        ok, x, y, z = _meet(planes, uv_m, before[k], x, y, z,
                            image[k + 1, 0], image[k + 1, 1], image[k + 1, 2])
        if not ok:
            return False
        points_m[k + 1, 0], points_m[k + 1, 1], points_m[k + 1, 2] = x, y, z
    return True


@njit(cache=True, error_model="numpy")
def _behind_edge(planes, uv_m, edges, edge, behind, first, along_m, across_m, x, y, z, mirror, points_m):
    """Turns on the edge and behind it to the receiver x, y, z, from points_m[first] on: (there are any, the first)."""
    for k in range(len(behind) - 1, -1, -1):  # mirror[k]: the receiver in the facets from the last down to k
        facet = behind[k]
        if height(planes, facet, x, y, z) < ON_PLANE_M:
            return False, x, y, z
        x, y, z = mirrored(planes, facet, x, y, z)
        mirror[k, 0], mirror[k, 1], mirror[k, 2] = x, y, z
    is_open, to_along_m, to_across_m = around_edge(edges, edge, x, y, z)
    at_m = along_m + (to_along_m - along_m) * across_m / (across_m + to_across_m)
    if not is_open or at_m < 0.0 or at_m > edges[edge, LENGTH]:
        return False, x, y, z
    edge_x = edges[edge, START] + at_m * edges[edge, ALONG]
    edge_y = edges[edge, START + 1] + at_m * edges[edge, ALONG + 1]
    edge_z = edges[edge, START + 2] + at_m * edges[edge, ALONG + 2]
    points_m[first, 0], points_m[first, 1], points_m[first, 2] = edge_x, edge_y, edge_z
    x, y, z = edge_x, edge_y, edge_z
    for k in range(len(behind)):
        ok, x, y, z = _meet(planes, uv_m, behind[k], x, y, z, mirror[k, 0], mirror[k, 1], mirror[k, 2])
        if not ok:
            return False, x, y, z
        points_m[first + 1 + k, 0], points_m[first + 1 + k, 1], points_m[first + 1 + k, 2] = x, y, z
    return True, edge_x, edge_y, edge_z


@njit(cache=True, error_model="numpy")
def _meet(planes, uv_m, facet, x, y, z, image_x, image_y, image_z):
    """Where the line from a point before a facet to an image behind it goes through it: (it does, x, y, z)."""
    before_m = height(planes, facet, x, y, z)
    behind_m = -height(planes, facet, image_x, image_y, image_z)
    if before_m < ON_PLANE_M or behind_m < ON_PLANE_M:
        return False, x, y, z
    share = before_m / (before_m + behind_m)
    x, y, z = x + share * (image_x - x), y + share * (image_y - y), z + share * (image_z - z)
    return within(planes, uv_m, facet, x, y, z), x, y, z
