"""Sequences of interactions that are tried from one device."""

from collections import OrderedDict
from functools import lru_cache
from threading import Lock

import numpy as np

from radiotwin.paths.edges import extract_edges
from radiotwin.paths.facets import extract_facets
from radiotwin.paths.images import Candidates
from radiotwin.paths.shooting import (
    DEVICE_RAYS,
    FacetSequences,
    device_sequences,
    edge_sequences,
)
from radiotwin.paths.surfaces import OFFSET, pack
from radiotwin.paths.topology import build_topology, expand
from radiotwin.paths.two_edges import FacetEdges
from radiotwin.paths.ways import open_ways, with_facets_after
from radiotwin.scene.citymap import CityMap

EDGE_CHUNK = 500  # edges at once whose surroundings are searched: about 100 MB
MAX_REMEMBERED_BYTES = 2**25  # of one search, so 400 MB of all that `candidate_search` keeps


@lru_cache(maxsize=12)  # a map and those with errors that stand beside it
def candidate_search(city: CityMap, depth: int) -> "CandidateSearch":
    """Return the search of a city, made once: it keeps the surroundings of edges it has seen."""
    return CandidateSearch(city, depth)


class CandidateSearch:
    """Search for the candidates of devices in one city; several threads may ask it.

    Args:
        city: 3D map.
        depth: maximum number of interactions of a path, at least 1.

    Attributes:
        facets: of the city.
        edges: of the city.
        surfaces: both, for compiled code.
        is_ground: (f + 1,) bool, rows of the ground in `surfaces.planes`.
        facet_edges: edges at each facet.
    """

    def __init__(self, city: CityMap, depth: int) -> None:
        topology = build_topology(city)
        self.facets = extract_facets(city, topology)
        self.edges = extract_edges(city, self.facets, topology)
        self.surfaces = pack(self.facets, self.edges, city.terrain is None)
        self.is_ground = np.zeros(len(self.facets) + 1, dtype=bool)
        self.is_ground[-1] = True
        if city.terrain is not None:
            self.is_ground[self.facets.of_face[city.terrain]] = True
        self._city, self._depth = city, depth
        self._after = np.empty((0, depth - 1), dtype=int)
        self._first_after, self._end_after = np.full((2, len(self.edges)), -1)
        self._remembered: OrderedDict[tuple[bytes, int], Candidates] = OrderedDict()
        self._one_at_a_time = Lock()
        facet = self.edges.facet.ravel()
        edge = np.repeat(np.arange(len(self.edges)), 2)
        order = np.lexsort((edge, facet))
        self.facet_edges = FacetEdges(self.facets.of_face, edge[order], np.searchsorted(
            facet[order], np.arange(len(self.facets) + 2)))

    def candidates(self, device_m: np.ndarray, rays: int = DEVICE_RAYS) -> Candidates:
        """Find the sequences from a device, those without an edge first, and remember them.

        Args:
            device_m: (3,) position [m].
            rays: that are shot from it.

        Returns:
            All sequences of up to `depth` interactions that are worth trying.
        """
        key = np.asarray(device_m, dtype=float).tobytes(), rays
        with self._one_at_a_time:
            if key in self._remembered:
                self._remembered.move_to_end(key)
                return self._remembered[key]
        found = self._find(device_m, rays)
        with self._one_at_a_time:
            self._remembered[key] = found
            while len(self._remembered) > 1 and sum(
                    each.nbytes for of_device in self._remembered.values()
                    for each in of_device) > MAX_REMEMBERED_BYTES:
                self._remembered.popitem(last=False)
        return found

    def _find(self, device_m: np.ndarray, rays: int) -> Candidates:
        normal, offset_m = self.surfaces.planes[:, :3], self.surfaces.planes[:, OFFSET]
        sequences = device_sequences(self._city, self.facets, normal, device_m, self._depth,
                                     rays)
        facing = np.flatnonzero(normal @ device_m > offset_m)
        single = np.full((len(facing), self._depth), -1)
        single[:, 0] = facing
        reflections = np.unique(np.concatenate([sequences.facets[sequences.order > 0], single]),
                                axis=0)
        ways = open_ways(self._city, self.surfaces, *self._to_edges(sequences, facing), device_m)
        with self._one_at_a_time:
            self._look_around(np.unique(ways.edge[self._first_after[ways.edge] < 0]))
            after = self._after  # others replace it, its rows stay
        way, row = with_facets_after(self.surfaces, ways, self._first_after, self._end_after,
                                     after, self._depth)
        none = np.full((len(reflections), self._depth), -1)
        return Candidates(np.concatenate([reflections, ways.before[way]]),
                          np.concatenate([none[:, 0], ways.edge[way]]),
                          np.concatenate([none[:, 1:], after[row]]))

    def _to_edges(
        self, sequences: FacetSequences, facing: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return facets (n, depth) and edge (n,) of the ways to the edges of all facets hit."""
        direct = np.column_stack([np.zeros(len(facing), dtype=int), facing])
        reflected = sequences.next_facets[sequences.next_facets[:, 0] > 0]
        pairs = np.concatenate([direct, reflected])
        pairs = pairs[sequences.order[pairs[:, 0]] < self._depth]
        first = self.facet_edges.first[pairs[:, 1]]
        row, within = expand(self.facet_edges.first[pairs[:, 1] + 1] - first)
        edge = self.facet_edges.edge[first[row] + within]
        both = np.unique(np.column_stack([pairs[row, 0], edge]), axis=0)
        return sequences.facets[both[:, 0]], both[:, 1]

    def _look_around(self, edges: np.ndarray) -> None:
        """Find the sequences of facets after edges (n,)."""
        for start in range(0, len(edges), EDGE_CHUNK):
            part = edges[start:start + EDGE_CHUNK]
            found = edge_sequences(self._city, self.facets, self.surfaces.planes[:, :3],
                                   self.edges, part, self._depth - 1)
            order = np.argsort(found.source, kind="stable")
            bounds = np.searchsorted(found.source[order], np.arange(len(part) + 1))
            self._first_after[part] = len(self._after) + bounds[:-1]
            self._end_after[part] = len(self._after) + bounds[1:]
            self._after = np.concatenate([self._after, found.facets[order]])
