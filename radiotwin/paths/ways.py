"""Ways from a device to the edges that it lights, directly or after reflections.

A city has far more edges than a device sees. Points along each edge are therefore joined with the
device, by way of the facets in between; an edge of which the device sees no such point is not
tried. Of the facets that are seen from an edge only those count which the cone of diffracted rays
can reach: by Keller's law a receiver, or its image, decides where on the edge the ray bends, so
the corners of a facet bound that place.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from radiotwin.paths.clearance import clear_paths
from radiotwin.paths.images import (
    MAX_INTERACTIONS,
    Candidates,
    PathBuffer,
    reflections_back,
    sequence_length,
    source_images,
)
from radiotwin.paths.pruning import cone_misses, lit_part
from radiotwin.paths.surfaces import ALONG, LENGTH, NORMAL_0, NORMAL_N, START, Surfaces
from radiotwin.paths.wedges import around_edge
from radiotwin.scene.citymap import SKIN_M, CityMap

SAMPLE_M, SAMPLE_RAD = 0.3, 0.002  # [m], [rad] seen from the device: step of points on an edge
SAMPLE_CHUNK = 100_000  # points at once: about 50 MB


class Ways(NamedTuple):
    """Ways to edges.

    Attributes:
        before: (w, a) facets before the edge; then -1.
        edge: (w,) rows of the edges.
        lit_m: (w, 2) start and end of the part of the edge that the device's image lights [m].
        source_m: (w, 2) position of that image along the edge, and distance from its line [m].
    """

    before: np.ndarray
    edge: np.ndarray
    lit_m: np.ndarray
    source_m: np.ndarray


def open_ways(
    city: CityMap, surfaces: Surfaces, before: np.ndarray, edge: np.ndarray, device_m: np.ndarray
) -> Ways:
    """Keep the ways on which nothing blocks every point of the edge.

    Args:
        city: 3D map.
        surfaces: of the map.
        before: (w, a) facets before the edge; then -1.
        edge: (w,) rows of the edges.
        device_m: (3,) position of the device [m].

    Returns:
        Those of the ways that the device sees the edge by.
    """
    lit_m, source_m, samples = _lit_parts(surfaces, before, edge, device_m)
    points = PathBuffer.allocate(SAMPLE_CHUNK + int(samples.max(initial=0)))
    one_by_one = Candidates(before, np.full(len(edge), -1), before[:, :0])
    way, is_seen = 0, np.zeros(len(edge), dtype=bool)
    while way < len(edge):
        found, way = _sample(surfaces, before, edge, device_m, lit_m, samples, way, points)
        is_seen[points.candidate[clear_paths(city, surfaces, one_by_one, points, found)]] = True
    seen = np.flatnonzero(is_seen)
    return Ways(before[seen], edge[seen], lit_m[seen], source_m[seen])


@njit(cache=True, nogil=True, error_model="numpy")
def _lit_parts(
    surfaces: Surfaces, before: np.ndarray, edge: np.ndarray, device_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lit part and the source as of `Ways`, and the number of points (w,) to try."""
    image = np.empty((MAX_INTERACTIONS + 1, 3))
    lit_m, source_m = np.zeros((len(edge), 2)), np.zeros((len(edge), 2))
    samples = np.zeros(len(edge), dtype=np.int64)
    for way in range(len(edge)):
        facets = before[way, :sequence_length(before, way)]
        if not source_images(surfaces.planes, facets, device_m, image):
            continue
        x, y, z = image[len(facets)]
        is_open, along_m, across_m = around_edge(surfaces.edges, edge[way], x, y, z)
        if not is_open:
            continue
        low_m, high_m = lit_part(surfaces.planes, surfaces.edges, edge[way], facets, image)
        if low_m < high_m:
            lit_m[way, 0], lit_m[way, 1] = low_m, high_m
            source_m[way, 0], source_m[way, 1] = along_m, across_m
            nearest_m = min(max(along_m, low_m), high_m) - along_m
            step_m = max(SAMPLE_M, SAMPLE_RAD * np.sqrt(across_m ** 2 + nearest_m ** 2))
            samples[way] = 2 + int((high_m - low_m) / step_m)
    return lit_m, source_m, samples


@njit(cache=True, nogil=True, error_model="numpy")
def _sample(
    surfaces: Surfaces, before: np.ndarray, edge: np.ndarray, device_m: np.ndarray,
    lit_m: np.ndarray, samples: np.ndarray, way: int, points: PathBuffer,
) -> tuple[int, int]:
    """Put paths to points of lit parts, just off the edge, in a buffer, from a way on.

    Returns:
        Their number, and the way to go on with.
    """
    edges = surfaces.edges
    image = np.empty((MAX_INTERACTIONS + 1, 3))
    found = 0
    while way < len(edge) and found < SAMPLE_CHUNK:
        facets = before[way, :sequence_length(before, way)]
        if samples[way]:
            source_images(surfaces.planes, facets, device_m, image)
        at = edge[way]
        out_x = edges[at, NORMAL_0] + edges[at, NORMAL_N]
        out_y = edges[at, NORMAL_0 + 1] + edges[at, NORMAL_N + 1]
        out_z = edges[at, NORMAL_0 + 2] + edges[at, NORMAL_N + 2]
        skin = SKIN_M / np.sqrt(out_x ** 2 + out_y ** 2 + out_z ** 2)
        for k in range(samples[way]):
            share = (k + 0.5) / samples[way]
            along_m = lit_m[way, 0] + share * (lit_m[way, 1] - lit_m[way, 0])
            along_m = min(max(along_m, 0.0), edges[at, LENGTH])
            x = edges[at, START] + along_m * edges[at, ALONG]
            y = edges[at, START + 1] + along_m * edges[at, ALONG + 1]
            z = edges[at, START + 2] + along_m * edges[at, ALONG + 2]
            points_m = points.points_m[found]
            if reflections_back(surfaces.planes, surfaces.triangle_uv_m, facets, x, y, z, image,
                                points_m):
                points_m[0, 0], points_m[0, 1], points_m[0, 2] = device_m
                points_m[len(facets) + 1, 0] = x + skin * out_x
                points_m[len(facets) + 1, 1] = y + skin * out_y
                points_m[len(facets) + 1, 2] = z + skin * out_z
                points.candidate[found], points.count[found] = way, len(facets) + 2
                found += 1
        way += 1
    return found, way


@njit(cache=True, nogil=True, error_model="numpy")
def with_facets_after(
    surfaces: Surfaces, ways: Ways, first: np.ndarray, end: np.ndarray, after: np.ndarray,
    depth: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Combine each way to an edge with the sequences of facets after it that rays can reach.

    Args:
        surfaces: of the map.
        ways: to edges.
        first: (e,) first row in `after` of each edge.
        end: (e,) the row after its last one.
        after: (m, b) facets after the edge; then -1.
        depth: maximum number of interactions.

    Returns:
        (c,) row of the way, and (c,) row of `after`.
    """
    total = 0
    for way in range(len(ways.edge)):
        total += end[ways.edge[way]] - first[ways.edge[way]]
    of_way, of_after = np.empty(total, dtype=np.int64), np.empty(total, dtype=np.int64)
    count = 0
    for way in range(len(ways.edge)):
        edge = ways.edge[way]
        room = depth - 1 - sequence_length(ways.before, way)
        for row in range(first[edge], end[edge]):
            length = sequence_length(after, row)
            if length <= room and not cone_misses(
                    surfaces.planes, surfaces.edges, edge, after[row, :length], ways.lit_m[way],
                    ways.source_m[way]):
                of_way[count], of_after[count] = way, row
                count += 1
    return of_way[:count], of_after[:count]
