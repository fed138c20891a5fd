"""Ways to edges and the cone of diffracted rays, against rays that are found without them."""

import numpy as np

from radiotwin.propagation.paths.candidates import CandidateSearch
from radiotwin.propagation.paths.pruning import narrow, open_window


def test_a_window_stays_open_for_every_ray_that_goes_through_the_facets(town):
    """Rays on Keller's cone, drawn at random, through mirrored facets; a window that shuts has to have none."""
    search = CandidateSearch(town(0.2), 3)
    planes, edges = search.surfaces.planes, search.surfaces.edges
    rng = np.random.default_rng(3)
    shut = passed = 0
    for _ in range(300):
        row = int(rng.integers(len(edges)))
        lit_m = np.sort(rng.uniform(0, edges[row, 6], 2))
        source_m = np.array([rng.uniform(-30, 60), rng.uniform(0.1, 80)])
        at_m, angle = rng.uniform(*lit_m, 200), rng.uniform(0, edges[row, 16], 200)
        slope = (at_m - source_m[0]) / source_m[1]
        ray = slope[:, None] * edges[row, 3:6] + np.cos(angle)[:, None] * edges[row, 7:10] \
            + np.sin(angle)[:, None] * edges[row, 10:13]
        start_m = edges[row, :3] + at_m[:, None] * edges[row, 3:6]
        after, goes, window = [], np.ones(200, dtype=bool), np.empty(4)
        open_window(edges, row, lit_m, window)
        for k in range(3):
            hits = np.array([_through(planes, facet, after, start_m, ray) for facet in range(len(planes) - 1)])
            likely = np.flatnonzero((hits & goes).any(axis=1))
            after.append(int(rng.choice(likely)) if len(likely) and rng.random() < 0.7 else int(rng.integers(len(hits))))
            goes &= hits[after[-1]]
            if not narrow(planes, edges, row, np.array(after), k, source_m, window):
                assert not goes.any()
                shut += 1
                break
            assert ((window[0] < at_m[goes]) & (at_m[goes] < window[1])).all()
            assert ((window[2] < angle[goes]) & (angle[goes] < window[3])).all()
            passed += goes.any()
    assert shut > 50 and passed > 100


def _through(planes, facet, mirrors, start_m, ray):
    """Whether rays (n, 3) go through a facet's rectangle that is mirrored in others, the last one first."""
    axes = planes[facet, [[0, 1, 2], [7, 8, 9], [10, 11, 12]]]
    origin_m = planes[facet, 4:7]
    for mirror in mirrors[::-1]:
        normal = planes[mirror, :3]
        origin_m = origin_m - 2 * (origin_m @ normal - planes[mirror, 3]) * normal
        axes = axes - 2 * np.outer(axes @ normal, normal)
    far = ((origin_m - start_m) @ axes[0]) / (ray @ axes[0])
    u, v = ((start_m + far[:, None] * ray - origin_m) @ axes[1:].T).T
    return (far > 1e-9) & (u > 0) & (v > 0) & (u < planes[facet, 13]) & (v < planes[facet, 14])
