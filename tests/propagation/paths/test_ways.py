"""Ways to edges and the cone of diffracted rays, against rays that are found without them."""

import numpy as np

from radiotwin.propagation.paths.candidates import CandidateSearch, _open_ways
from radiotwin.propagation.paths.pruning import narrow, open_window


def test_a_facet_that_a_diffracted_ray_hits_is_never_missed(town):
    """Rays to points of facets, mirrored in up to two others, from where they leave the edge."""
    search = CandidateSearch(town(0.2), 3)
    planes, edges = search.surfaces.planes, search.surfaces.edges
    rng = np.random.default_rng(3)
    missed = 0
    for _ in range(3000):
        edge, after = rng.integers(len(edges)), rng.integers(len(planes) - 1, size=rng.integers(1, 4))
        source_m = np.array([rng.uniform(-30, 60), rng.uniform(0.1, 80)])
        low_m, high_m = np.sort(rng.uniform(0, edges[edge, 6], 2))
        window = np.empty(4)
        open_window(edges, edge, np.array([low_m, high_m]), window)
        misses = not all(narrow(planes, edges, edge, after, k, source_m, window) for k in range(len(after)))
        missed += misses
        for k, facet in enumerate(after):
            if not misses:
                break
            share = rng.uniform(size=(50, 2)) * planes[facet, 13:15]
            points_m = planes[facet, 4:7] + share[:, :1] * planes[facet, 7:10] + share[:, 1:] * planes[facet, 10:13]
            for mirror in after[:k][::-1]:
                normal = planes[mirror, :3]
                points_m = points_m - 2 * (points_m @ normal - planes[mirror, 3])[:, None] * normal
            offset_m = points_m - edges[edge, :3]
            along_m = offset_m @ edges[edge, 3:6]
            across_m = np.linalg.norm(offset_m - along_m[:, None] * edges[edge, 3:6], axis=1)
            at_m = source_m[0] + (along_m - source_m[0]) * source_m[1] / (source_m[1] + across_m)
            if not ((low_m < at_m) & (at_m < high_m)).any():
                break  # this is the facet that is missed
        else:
            assert not misses
    assert 300 < missed < 2900


def test_only_edges_that_the_device_sees_are_tried(city_of):
    """A box behind a higher one is hidden, except for what looks out above or beside it; of the near one the device sees three edges."""
    city = city_of((0, -20, 5, 20, 30), (30, -10, 40, 10, 10), (30, 100, 40, 120, 10))
    search = CandidateSearch(city, 1)
    everything = np.arange(len(search.surfaces.edges))
    ways = _open_ways(city, search.surfaces, np.full((len(everything), 1), -1), everything, np.array([-20.0, 0, 1.5]))
    middle_m = search.facets.edge_ends_m[ways.edge].mean(axis=1)
    assert set(np.unique(ways.edge)) < set(everything) and len(np.unique(ways.edge)) == len(ways.edge)
    hidden = (middle_m[:, 0] > 25) & (np.abs(middle_m[:, 1]) < 50)
    assert not hidden.any() and (middle_m[:, 1] > 50).any() and (middle_m[:, 0] < 10).sum() == 3
