"""Sequences of interactions that are tried from one device."""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from radiotwin.paths.edges import extract_edges
from radiotwin.paths.facets import extract_facets
from radiotwin.paths.images import Candidates
from radiotwin.paths.shooting import FacetSequences, device_sequences, edge_sequences
from radiotwin.paths.surfaces import OFFSET, pack
from radiotwin.paths.topology import build_topology, expand
from radiotwin.scene.citymap import CityMap

MAX_AFTER_EDGE = 1  # reflections; a second one would double the time for 0.01 dB


@lru_cache(maxsize=12)  # a map and those with errors that stand beside it
def candidate_search(city: CityMap, depth: int) -> "CandidateSearch":
    """Return the search of a city, made once: it keeps the surroundings of edges it has seen."""
    return CandidateSearch(city, depth)


class CandidateSearch:
    """Search for the candidates of devices in one city.

    Args:
        city: 3D map.
        depth: maximum number of interactions of a path, at least 1.

    Attributes:
        facets: of the city.
        edges: of the city.
        surfaces: both, for compiled code.
        ground: row of the ground in `surfaces.planes`.
    """

    def __init__(self, city: CityMap, depth: int) -> None:
        topology = build_topology(city)
        self.facets = extract_facets(city, topology)
        self.edges = extract_edges(city, self.facets, topology)
        self.surfaces = pack(self.facets, self.edges)
        self.ground = len(self.facets)
        self._city, self._depth = city, depth
        self._after = min(MAX_AFTER_EDGE, depth - 1)
        self._from_edge: dict[int, FacetSequences] = {}
        facet = self.edges.facet.ravel()
        edge = np.repeat(np.arange(len(self.edges)), 2)
        order = np.lexsort((edge, facet))
        self._edge_of_facet = edge[order]
        self._first_edge = np.searchsorted(facet[order], np.arange(len(self.facets) + 2))

    def candidates(self, device_m: np.ndarray) -> Candidates:
        """Find the sequences from a device, those without an edge first.

        Args:
            device_m: (3,) position [m].

        Returns:
            All sequences of up to `depth` interactions that are worth trying.
        """
        normal, offset_m = self.surfaces.planes[:, :3], self.surfaces.planes[:, OFFSET]
        sequences = device_sequences(self._city, self.facets, normal, device_m, self._depth)
        facing = np.flatnonzero(normal @ device_m > offset_m)
        single = np.full((len(facing), self._depth), -1)
        single[:, 0] = facing
        reflections = np.unique(np.concatenate([sequences.facets[sequences.order > 0], single]),
                                axis=0)
        none = np.full((len(reflections), max(self._after, 1)), -1)
        over_edges = self._over_edges(*self._to_edges(sequences, facing))
        rows = [(reflections, none[:, 0], none), *over_edges]
        before, edge, after = (np.concatenate(part) for part in zip(*rows))
        interactions = (before >= 0).sum(axis=1) + (edge >= 0) + (after >= 0).sum(axis=1)
        keep = interactions <= self._depth
        return Candidates(np.ascontiguousarray(before[keep]), edge[keep],
                          np.ascontiguousarray(after[keep]))

    def _over_edges(
        self, before: np.ndarray, edge: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Combine each sequence up to an edge with each sequence after that edge."""
        seen = [self._sequences_from_edge(row) for row in edge]
        for order in range(self._after + 1):
            after = [sequences.facets[sequences.order == order] for sequences in seen]
            repeats = [len(part) for part in after]
            if sum(repeats):
                facets = np.concatenate(after)
                padded = np.full((len(facets), max(self._after, 1)), -1)
                padded[:, :facets.shape[1]] = facets
                yield np.repeat(before, repeats, axis=0), np.repeat(edge, repeats), padded

    def _to_edges(
        self, sequences: FacetSequences, facing: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return facets (n, depth) and edge (n,) of the ways to the edges of all facets hit."""
        direct = np.column_stack([np.zeros(len(facing), dtype=int), facing])
        reflected = sequences.next_facets[sequences.next_facets[:, 0] > 0]
        pairs = np.concatenate([direct, reflected])
        pairs = pairs[sequences.order[pairs[:, 0]] < self._depth]
        first = self._first_edge[pairs[:, 1]]
        row, within = expand(self._first_edge[pairs[:, 1] + 1] - first)
        both = np.unique(np.column_stack([pairs[row, 0], self._edge_of_facet[first[row] + within]]),
                         axis=0)
        return sequences.facets[both[:, 0]], both[:, 1]

    def _sequences_from_edge(self, edge: int) -> FacetSequences:
        if edge not in self._from_edge:
            self._from_edge[edge] = edge_sequences(
                self._city, self.facets, self.surfaces.planes[:, :3], self.edges, edge, self._after)
        return self._from_edge[edge]
