"""Find the sequences of facets and edges that paths from a device may take, by shooting rays.

A path of several reflections visits a sequence of facets. A city has too many sequences to try
them all, so rays are shot from the device in all directions and reflected where they hit; the
sequences that they visit are the candidates [1]. The image method then finds the exact paths.
Facets that face the device, and their edges, are always candidates.

A city has far more edges than a device sees. Points along each edge are therefore connected to the
device, directly or by reflections; an edge with no visible point is not tried. After an edge, only
facets that the cone of diffracted rays can reach are tried: by Keller's law the receiver, or its
image, decides where on the edge the ray is diffracted, so the corners of a facet bound that point.

[1] Ling, Chou, Lee, "Shooting and bouncing rays", IEEE Trans. Antennas Propag. 37(2), 1989.
"""

from collections import OrderedDict
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import NamedTuple

import numpy as np
import pandas as pd

from radiotwin.propagation.paths.facets import CityFacets, expand, extract_facets
from radiotwin.propagation.paths.images import (
    MAX_INTERACTIONS,
    Candidates,
    PathBuffer,
    clear_paths,
    reflections_back,
    sequence_length,
    source_images,
)
from radiotwin.propagation.paths.interactions import around_edge
from radiotwin.propagation.paths.pruning import lit_part, narrow, open_window
from radiotwin.propagation.paths.surfaces import (
    ALONG,
    LENGTH,
    NORMAL,
    NORMAL_0,
    NORMAL_N,
    OFFSET,
    START,
    Surfaces,
)
from radiotwin.propagation.paths.two_edges import EdgePairsToTry
from radiotwin.runtime.compiled import njit
from radiotwin.scene.citymap import SKIN_M, CityMap

SAMPLE_M, SAMPLE_RAD = 0.3, 0.002  # least step of points on an edge [m], and seen from the device
SAMPLE_CHUNK = 100_000  # points at a time: about 50 MB
SAMPLE_STEP, SAMPLE_ORDER = 8, (3, 0, 6, 1, 4, 7, 2, 5)  # each pass tries every 8th point of a way
RAY_CHUNK = 200_000  # rays at a time: about 60 MB
DEVICE_RAYS = 100_000  # about half a degree apart
EDGE_RAYS = 2_000  # from each 20 m of an edge, about 5 degrees apart, 3 at the horizon
PLASTIC = 0.7548776662466927  # spreads rays along an edge evenly (Roberts' sequence)
LEVEL_SINE = 0.1  # sine of the elevation up to which rays are dense
EDGE_CHUNK = 100  # edges whose surroundings are searched at a time: about 100 MB
MAX_REMEMBERED_BYTES = 2**25  # cache of one search; 400 MB for all searches of `candidate_search`


class PathsToEdges(NamedTuple):
    """Partial paths from a device by reflections to w edges.

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


def _open_paths_to_edges(city: CityMap, surfaces: Surfaces, before: np.ndarray, edge: np.ndarray,
                         device_m: np.ndarray) -> PathsToEdges:
    """Select the open ways from the device (3,) [m] by facets `before` (w, a) to edges (w,).

    A way is open if any of the points sampled on the lit part of the edge is visible that way.
    """
    lit_m, source_m, samples = _lit_parts(surfaces, before, edge, device_m)
    points = PathBuffer.allocate(SAMPLE_CHUNK + int(samples.max(initial=0)))
    reflections = Candidates(before, np.full(len(edge), -1), before[:, :0])
    is_seen = np.zeros(len(edge), dtype=bool)
    for first in SAMPLE_ORDER:  # a few points suffice for most open ways
        way = 0
        while way < len(edge):
            found, way = _sample_edges(surfaces, before, edge, device_m, lit_m, samples, is_seen,
                                       first, way, points)
            clear = clear_paths(city, surfaces, reflections, points, found)
            is_seen[points.candidate[clear]] = True
    seen = np.flatnonzero(is_seen)
    return PathsToEdges(before[seen], edge[seen], lit_m[seen], source_m[seen])


@njit(cache=True, nogil=True, error_model="numpy")
def _lit_parts(surfaces: Surfaces, before: np.ndarray, edge: np.ndarray, device_m: np.ndarray
               ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the part of each edge that the device can light (w, 2) [m], and the source (w, 2) [m].

    Both as in `PathsToEdges`; and the number of points to sample (w,). All are 0 if nothing is lit.
    """
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
def _sample_edges(surfaces: Surfaces, before: np.ndarray, edge: np.ndarray, device_m: np.ndarray,
                  lit_m: np.ndarray, samples: np.ndarray, is_seen: np.ndarray, first: int, way: int,
                  points: PathBuffer) -> tuple[int, int]:
    """Fill a buffer with paths from the device, by reflections, to sampled points of edges.

    A way is a row of `before` and `edge`. Of its `samples`, every `SAMPLE_STEP`-th is tried from
    number `first` on, just off the edge; ways in `is_seen` are skipped. Begins at row `way`, and
    stops when `SAMPLE_CHUNK` paths are found. Returns their number, and the way with which to
    continue.
    """
    edges = surfaces.edges
    image = np.empty((MAX_INTERACTIONS + 1, 3))
    found = 0
    while way < len(edge) and found < SAMPLE_CHUNK:
        if is_seen[way] or first >= samples[way]:
            way += 1
            continue
        facets = before[way, :sequence_length(before, way)]
        source_images(surfaces.planes, facets, device_m, image)
        edge_row = edge[way]
        out_x = edges[edge_row, NORMAL_0] + edges[edge_row, NORMAL_N]
        out_y = edges[edge_row, NORMAL_0 + 1] + edges[edge_row, NORMAL_N + 1]
        out_z = edges[edge_row, NORMAL_0 + 2] + edges[edge_row, NORMAL_N + 2]
        skin = SKIN_M / np.sqrt(out_x ** 2 + out_y ** 2 + out_z ** 2)
        for k in range(first, samples[way], SAMPLE_STEP):
            share = (k + 0.5) / samples[way]
            along_m = lit_m[way, 0] + share * (lit_m[way, 1] - lit_m[way, 0])
            along_m = min(max(along_m, 0.0), edges[edge_row, LENGTH])
            x = edges[edge_row, START] + along_m * edges[edge_row, ALONG]
            y = edges[edge_row, START + 1] + along_m * edges[edge_row, ALONG + 1]
            z = edges[edge_row, START + 2] + along_m * edges[edge_row, ALONG + 2]
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
def _with_facets_after(surfaces: Surfaces, ways: PathsToEdges, first: np.ndarray, end: np.ndarray,
                       after: np.ndarray, parent: np.ndarray, depth: int
                       ) -> tuple[np.ndarray, np.ndarray]:
    """Combine partial paths to edges with the sequences `after` (m, b) that rays hit behind them.

    `first` and `end` (e,) delimit an edge's rows in `after`, the empty sequence first; `parent`
    (m,) is the row without the last facet. Returns rows (c,) of the ways, and of `after`, of paths
    of at most `depth` interactions.
    """
    max_rows = total = 0
    for way in range(len(ways.edge)):
        rows = end[ways.edge[way]] - first[ways.edge[way]]
        max_rows, total = max(max_rows, rows), total + rows
    of_way, of_after = np.empty(total, dtype=np.int64), np.empty(total, dtype=np.int64)
    window, is_open = np.empty((max_rows, 4)), np.empty(max_rows, dtype=np.bool_)
    count = 0
    for way in range(len(ways.edge)):
        edge = ways.edge[way]
        room = depth - 1 - sequence_length(ways.before, way)
        for row in range(first[edge], end[edge]):
            place, length = row - first[edge], sequence_length(after, row)
            if length == 0:
                open_window(surfaces.edges, edge, ways.lit_m[way], window[place])
                is_open[place] = True
            else:
                window[place] = window[parent[row] - first[edge]]
                is_open[place] = length <= room and is_open[parent[row] - first[edge]] and narrow(
                    surfaces.planes, surfaces.edges, edge, after[row], length - 1,
                    ways.source_m[way], window[place])
            if is_open[place]:
                of_way[count], of_after[count] = way, row
                count += 1
    return of_way[:count], of_after[:count]


class FacetEdges(NamedTuple):
    """The edges of each facet.

    Attributes:
        edge: (m,) edges, facet after facet.
        first: (f + 2,) first row in `edge` of each facet, and of the ground, which has none.
    """

    edge: np.ndarray
    first: np.ndarray

    def of(self, facet: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the edges (m,) of facets (n,), and for each edge the row (m,) of its facet."""
        row, within = expand(self.first[facet + 1] - self.first[facet])
        return self.edge[self.first[facet[row]] + within], row


@dataclass(frozen=True, eq=False)
class FacetSequences:
    """Sequences of facets that rays from sources visit; the first row of each source is empty.

    Attributes:
        source: (c,) row of the source.
        facets: (c, depth) rows of `Surfaces.planes`, then -1.
        order: (c,) number of facets.
        parent: (c,) row of the sequence without its last facet; its own row if empty.
        next_facets: (m, 2) row of a sequence, and a facet that rays hit after it.
    """

    source: np.ndarray
    facets: np.ndarray
    order: np.ndarray
    parent: np.ndarray
    next_facets: np.ndarray


@lru_cache(maxsize=4)
def _sphere(count: int) -> np.ndarray:
    """Return (count, 3) unit vectors of a Fibonacci lattice (Gonzalez, Math. Geosci. 42, 2010).

    Three times as dense as a uniform one at the horizon, where distant facets look small.
    """
    z = LEVEL_SINE * np.sinh((1 - (2 * np.arange(count) + 1) / count) * np.arcsinh(1 / LEVEL_SINE))
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - z * z)
    vectors = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])
    vectors.flags.writeable = False  # cached
    return vectors


def _edge_sequences(city: CityMap, facets: CityFacets, rows: np.ndarray, depth: int
                    ) -> FacetSequences:
    """Shoot rays from edges `rows` (n,), and record the sequences of facets that they hit.

    EDGE_RAYS rays start from each 20 m of an edge, at most 10 times as many, spread along it.
    """
    edges, ends_m = facets.surfaces.edges[rows], facets.edge_ends_m[rows]
    normal_0, normal_n = edges[:, NORMAL_0:NORMAL_0 + 3], edges[:, NORMAL_N:NORMAL_N + 3]
    offset_m = ends_m[:, 1] - ends_m[:, 0]
    starts = np.clip(np.ceil(np.linalg.norm(offset_m, axis=1) / 20.0).astype(int), 1, 10)
    source, within = expand(starts)
    outward = normal_0 + normal_n
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    direction = _sphere(EDGE_RAYS)
    spread = np.arange(EDGE_RAYS) * PLASTIC % 1.0
    is_open = np.maximum(normal_0 @ direction.T, normal_n @ direction.T) > 0
    start, ray = np.nonzero(is_open[source])
    of_edge, share = source[start], (within[start] + spread[ray]) / starts[source[start]]
    start_m = ends_m[of_edge, 0] + share[:, None] * offset_m[of_edge] + SKIN_M * outward[of_edge]
    return _shoot(city, facets, start_m, direction[ray], of_edge, len(rows), depth, False)


def _shoot(city: CityMap, facets: CityFacets, start_m: np.ndarray, direction: np.ndarray,
           source: np.ndarray, sources: int, depth: int, beyond: bool = True) -> FacetSequences:
    """Trace rays (n,) over up to `depth` reflections; return the sequences of facets they hit.

    `beyond`: also record the facet hit after the last reflection in `next_facets`.
    """
    normal = facets.surfaces.planes[:, NORMAL:NORMAL + 3]
    row = source  # row of the sequence that each ray has visited
    sequences, of_source = [np.empty((sources, 0), dtype=int)], [np.arange(sources)]
    parents = [np.arange(sources)]
    first = [0]
    next_facets = []
    count = sources
    for level in range(depth + beyond):
        distance_m, facet = np.concatenate(
            [_first_facets(city, facets, start_m[a:a + RAY_CHUNK], direction[a:a + RAY_CHUNK])
             for a in range(0, len(start_m), RAY_CHUNK)] or [np.empty((2, 0))], axis=1)
        hit = np.flatnonzero(facet >= 0)
        row, facet = row[hit], facet[hit].astype(int)
        # Few are distinct: faster than np.unique, which sorts all rays.
        inverse, pairs = pd.factorize(row * len(normal) + facet, sort=True)
        parent, last = np.divmod(pairs, len(normal))
        next_facets.append(np.column_stack([parent, last]))
        if level == depth:
            break
        sequences.append(np.column_stack([sequences[-1][parent - first[-1]], last]))
        of_source.append(of_source[-1][parent - first[-1]])
        parents.append(parent)
        first.append(count)
        row = count + inverse
        count += len(pairs)
        direction, outward = direction[hit], normal[facet]
        start_m = start_m[hit] + distance_m[hit, None] * direction + SKIN_M * outward
        direction = direction - 2 * np.einsum("ij,ij->i", direction, outward)[:, None] * outward
    padded = [np.pad(part, ((0, 0), (0, depth - part.shape[1])), constant_values=-1)
              for part in sequences]
    order = np.repeat(np.arange(len(sequences)), [len(part) for part in sequences])
    return FacetSequences(np.concatenate(of_source), np.concatenate(padded), order,
                          np.concatenate(parents),
                          np.concatenate(next_facets or [np.empty((0, 2), dtype=int)]))


def _first_facets(city: CityMap, facets: CityFacets, start_m: np.ndarray, direction: np.ndarray
                  ) -> np.ndarray:
    """Return distance [m] and index of the first facet that each ray hits, as (2, n).

    The index is -1 for none, or the back of one. Flat ground is the last facet, without edges.
    """
    distance_m, face, cosine = city.first_hits_towards(start_m, direction)
    facet = np.where(face >= 0, facets.of_face[face], -1)
    facet[(face >= 0) & (cosine >= 0)] = -1
    if city.terrain is not None:
        return np.stack([distance_m, facet])
    # Flat ground is infinite; the city's mesh of it may end, or be missing.
    with np.errstate(divide="ignore", invalid="ignore"):
        fall_m = np.where(direction[:, 2] < 0, -start_m[:, 2] / direction[:, 2], np.inf)
    on_ground = (fall_m > 0) & (fall_m < np.inf) & (distance_m > fall_m - 0.1)
    return np.stack([np.where(on_ground, np.maximum(fall_m, 0), distance_m),
                     np.where(on_ground, len(facets.surfaces.planes) - 1, facet)])


@lru_cache(maxsize=12)  # a map and its variants with random errors
def candidate_search(city: CityMap, depth: int) -> "CandidateSearch":
    """Return the cached `CandidateSearch` of a city; it keeps what rays from edges have hit."""
    return CandidateSearch(city, depth)


class CandidateSearch:
    """Search for the sequences of interactions from any device in one city; thread-safe.

    Args:
        city: 3D map.
        depth: maximum number of interactions of a path, at least 1.

    Attributes:
        facets: facets and edges of the city.
        surfaces: the same as arrays, `facets.surfaces`.
        is_ground: (f + 1,) bool, the rows of `surfaces.planes` that are ground.
    """

    def __init__(self, city: CityMap, depth: int) -> None:
        self.facets = extract_facets(city)
        self.surfaces = self.facets.surfaces
        self.is_ground = np.zeros(len(self.surfaces.planes), dtype=bool)
        self.is_ground[-1] = True
        if city.terrain is not None:
            self.is_ground[self.facets.of_face[city.terrain]] = True
        self._city, self._depth = city, depth
        self._after = np.empty((0, depth - 1), dtype=int)
        self._parent_after = np.empty(0, dtype=int)
        edges = len(self.surfaces.edges)
        self._first_after, self._end_after = np.full((2, edges), -1)
        self._remembered: OrderedDict[tuple[bytes, int], Candidates] = OrderedDict()
        self._lock = Lock()
        facet, edge = self.facets.edge_facets.ravel(), np.repeat(np.arange(edges), 2)
        order = np.lexsort((edge, facet))
        self._facet_edges = FacetEdges(edge[order], np.searchsorted(
            facet[order], np.arange(len(self.is_ground) + 1)))

    def candidates(self, device_m: np.ndarray, rays: int = DEVICE_RAYS) -> Candidates:
        """Find sequences of reflections, and at most one diffraction, of paths from (3,) [m].

        Those without an edge come first.
        """
        key = np.asarray(device_m, dtype=float).tobytes(), rays
        with self._lock:
            if key in self._remembered:
                self._remembered.move_to_end(key)
                return self._remembered[key]
        found = self._find(device_m, rays)
        with self._lock:
            self._remembered[key] = found
            while len(self._remembered) > 1 and sum(
                    array.nbytes for of_device in self._remembered.values()
                    for array in of_device) > MAX_REMEMBERED_BYTES:
                self._remembered.popitem(last=False)
        return found

    def pairs_of_edges(self, edges: np.ndarray) -> EdgePairsToTry:
        """List second edges to try after each of the first edges (s,), for double diffraction.

        A second edge borders a facet that rays from the first edge hit directly; `candidates` must
        have been called for a device that sees the first edges.
        """
        with self._lock:
            after, first = self._after, self._first_after[edges]
            row, within = expand(self._end_after[edges] - first)
        rows = first[row] + within
        single = (after[rows] >= 0).sum(axis=1) == 1
        second, of_facet = self._facet_edges.of(after[rows[single], 0])
        pairs = np.unique(np.column_stack([row[single][of_facet], second]), axis=0)
        pairs = pairs[edges[pairs[:, 0]] != pairs[:, 1]]
        return EdgePairsToTry(edges, pairs[:, 1],
                              np.searchsorted(pairs[:, 0], np.arange(len(edges) + 1)))

    def _find(self, device_m: np.ndarray, rays: int) -> Candidates:
        """Compute the result of `candidates` for a device that is not cached."""
        planes = self.surfaces.planes
        direction = _sphere(rays)
        sequences = _shoot(self._city, self.facets, np.broadcast_to(device_m, direction.shape),
                           direction, np.zeros(rays, dtype=int), 1, self._depth)
        facing = np.flatnonzero(planes[:, NORMAL:NORMAL + 3] @ device_m > planes[:, OFFSET])
        single = np.full((len(facing), self._depth), -1)
        single[:, 0] = facing
        reflected = sequences.facets[sequences.order > 0]
        reflections = np.unique(np.concatenate(
            [reflected, single, self._corner_sequences(facing)]), axis=0)
        ways = _open_paths_to_edges(self._city, self.surfaces,
                                    *self._to_edges(sequences, facing), device_m)
        with self._lock:
            self._shoot_from_edges(np.unique(ways.edge[self._first_after[ways.edge] < 0]))
            after, parent = self._after, self._parent_after  # other threads only append rows
        way, row = _with_facets_after(self.surfaces, ways, self._first_after, self._end_after,
                                     after, parent, self._depth)
        none = np.full((len(reflections), self._depth), -1)
        return Candidates(np.concatenate([reflections, ways.before[way]]),
                          np.concatenate([none[:, 0], ways.edge[way]]),
                          np.concatenate([none[:, 1:], after[row]]))

    def _corner_sequences(self, facing: np.ndarray) -> np.ndarray:
        """List reflections (n, depth) in corners, at a facet of `facing` (f,) and its neighbour.

        From far away, the strips that reflect rays back are too narrow to be hit by the rays shot.
        """
        corners = self.facets.corners
        found = corners[np.isin(corners[:, 0], facing)] if self._depth > 1 else corners[:0]
        out = np.full((len(found), self._depth), -1)
        out[:, :2] = found[:, :self._depth]
        return out

    def _to_edges(self, sequences: FacetSequences, facing: np.ndarray
                  ) -> tuple[np.ndarray, np.ndarray]:
        """List ways, facets (n, depth) and edge (n,), to the edges of facets hit, or `facing`."""
        direct = np.column_stack([np.zeros(len(facing), dtype=int), facing])
        reflected = sequences.next_facets[sequences.next_facets[:, 0] > 0]
        pairs = np.concatenate([direct, reflected])
        pairs = pairs[sequences.order[pairs[:, 0]] < self._depth]
        edge, row = self._facet_edges.of(pairs[:, 1])
        ways = np.unique(np.column_stack([pairs[row, 0], edge]), axis=0)
        return sequences.facets[ways[:, 0]], ways[:, 1]

    def _shoot_from_edges(self, edges: np.ndarray) -> None:
        """Shoot rays from edges (n,) and cache the facet sequences hit, for later devices."""
        after, parents, count = [self._after], [self._parent_after], len(self._after)
        for start in range(0, len(edges), EDGE_CHUNK):
            part = edges[start:start + EDGE_CHUNK]
            found = _edge_sequences(self._city, self.facets, part, self._depth - 1)
            order = np.argsort(found.source, kind="stable")
            row = np.empty_like(order)
            row[order] = count + np.arange(len(order))
            bounds = count + np.searchsorted(found.source[order], np.arange(len(part) + 1))
            self._first_after[part], self._end_after[part] = bounds[:-1], bounds[1:]
            after.append(found.facets[order])
            parents.append(row[found.parent[order]])
            count += len(order)
        self._after, self._parent_after = np.concatenate(after), np.concatenate(parents)
