"""Sequences of turns that are worth trying from one device."""

from functools import lru_cache

import numpy as np

from radiotwin.paths.edges import extract_edges
from radiotwin.paths.facets import checked_topology, extract_facets
from radiotwin.paths.images import Candidates
from radiotwin.paths.shooting import Chains, device_chains, edge_views
from radiotwin.paths.surfaces import OFFSET, pack
from radiotwin.scene.citymap import CityMap

DEVICE_RAYS = 100_000  # half a degree apart
# What lies behind an edge is seen from many of its points, so fewer rays do. A second mirror behind the edge would
# double the time for 0.01 dB.
EDGE_RAYS, EDGE_STEP_M, BEHIND_EDGE = 300, 20.0, 1


@lru_cache(maxsize=4)
def search_of(city: CityMap, depth: int) -> "CandidateSearch":
    """The search of a city, made once: what lies behind its edges is seen once for all devices."""
    return CandidateSearch(city, depth)


class CandidateSearch:
    """Candidates of devices in one city; what does not depend on the device is found once.

    Args:
        city: the map.
        depth: most turns of a path, at least 1.

    Attributes:
        facets, edges, surfaces: of the city.
        ground: row of the ground in `surfaces.planes`.
    """

    def __init__(self, city: CityMap, depth: int):
        topology = checked_topology(city)
        self.facets = extract_facets(city, topology)
        self.edges = extract_edges(city, self.facets, topology)
        self.surfaces = pack(self.facets, self.edges)
        self.ground = len(self.facets)
        self._city, self._depth = city, depth
        self._behind = min(BEHIND_EDGE, depth - 1)
        self._views: dict[int, Chains] = {}
        pairs = np.column_stack([self.edges.facet.ravel(), np.repeat(np.arange(len(self.edges)), 2)])
        pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
        self._edge_of_facet = pairs[:, 1]
        self._first_edge = np.searchsorted(pairs[:, 0], np.arange(len(self.facets) + 2))

    def candidates(self, device_m: np.ndarray) -> Candidates:
        """Sequences from a device at (3,) [m], those without an edge first."""
        normal, offset_m = self.surfaces.planes[:, :3], self.surfaces.planes[:, OFFSET]
        chains = device_chains(self._city, self.facets, normal, device_m, self._depth, DEVICE_RAYS)
        facing = np.flatnonzero(normal @ device_m > offset_m)
        alone = np.full((len(facing), self._depth), -1)
        alone[:, 0] = facing
        mirrors = np.unique(np.concatenate([chains.facets[chains.order > 0], alone]), axis=0)
        none = np.full((len(mirrors), max(self._behind, 1)), -1)
        rows = [(mirrors, none[:, 0], none), *self._over_edges(*self._edges_behind(chains, facing))]
        before, edge, behind = (np.concatenate(part) for part in zip(*rows))
        turns = (before >= 0).sum(axis=1) + (edge >= 0) + (behind >= 0).sum(axis=1)
        keep = turns <= self._depth
        return Candidates(np.ascontiguousarray(before[keep]), edge[keep], np.ascontiguousarray(behind[keep]))

    def _over_edges(self, before: np.ndarray, edge: np.ndarray):
        """Each sequence up to an edge with each sequence behind that edge."""
        views = [self._view(row) for row in edge]
        for order in range(self._behind + 1):
            behind = [view.facets[view.order == order] for view in views]
            repeats = [len(part) for part in behind]
            if sum(repeats):
                facets = np.concatenate(behind)
                padded = np.full((len(facets), max(self._behind, 1)), -1)
                padded[:, :facets.shape[1]] = facets
                yield np.repeat(before, repeats, axis=0), np.repeat(edge, repeats), padded

    def _edges_behind(self, chains: Chains, facing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Facets before an edge (n, depth) and the edge (n,): the edges of all facets that rays hit."""
        direct = np.column_stack([np.zeros(len(facing), dtype=int), facing])
        pairs = np.concatenate([direct, chains.next_facets[chains.next_facets[:, 0] > 0]])
        pairs = pairs[chains.order[pairs[:, 0]] < self._depth]
        first = self._first_edge[pairs[:, 1]]
        repeats = self._first_edge[pairs[:, 1] + 1] - first
        within = np.arange(repeats.sum()) - np.repeat(np.cumsum(repeats) - repeats, repeats)
        both = np.unique(np.column_stack([np.repeat(pairs[:, 0], repeats),
                                          self._edge_of_facet[np.repeat(first, repeats) + within]]), axis=0)
        return chains.facets[both[:, 0]], both[:, 1]

    def _view(self, edge: int) -> Chains:
        if edge not in self._views:
            self._views[edge] = edge_views(self._city, self.facets, self.edges, edge, EDGE_RAYS, EDGE_STEP_M,
                                           self.surfaces.planes[:, :3], self._behind)
        return self._views[edge]
