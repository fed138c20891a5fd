"""Power does not depend on which end is the device, and no sequence of interactions is missed."""

import itertools

import numpy as np
import pytest
import trimesh

from radiotwin.propagation.paths import path_powers
from radiotwin.propagation.paths.candidates import CandidateSearch
from radiotwin.propagation.paths.images import Candidates, PathBuffer, found_clear
from radiotwin.scene.citymap import CityMap

FREQUENCY_HZ = 2.4e9


def boxes(seed, side):
    """Side times side houses of different sizes, heights and directions."""
    rng, houses = np.random.default_rng(seed), []
    for column, row in np.ndindex(side, side):
        size_m = np.append(rng.uniform(15, 38, 2), rng.uniform(8, 40))
        house = trimesh.creation.box(extents=size_m)
        house.apply_transform(trimesh.transformations.rotation_matrix(rng.uniform(-0.3, 0.3), [0, 0, 1]))
        house.apply_translation([*(55 * (np.array([column, row]) - (side - 1) / 2) + rng.uniform(-4, 4, 2)), size_m[2] / 2])
        houses.append(house)
    mesh = trimesh.util.concatenate(houses)
    return CityMap(mesh.vertices, mesh.faces)


def outside(city, low_m, high_m, count, seed):
    points_m = np.random.default_rng(seed).uniform(low_m, high_m, (4 * count, 3))
    return points_m[~city.inside(points_m)][:count]


@pytest.fixture(scope="module")
def links():
    city = boxes(1, 4)
    device_m = outside(city, [-110, -110, 1.5], [110, 110, 1.6], 5, 2)
    receiver_m = outside(city, [-110, -110, 1.5], [110, 110, 60], 16, 3)
    return city, device_m, receiver_m, totals(city, device_m, receiver_m)


def totals(city, from_m, to_m):
    return np.array([path_powers(city, each_m, to_m, FREQUENCY_HZ).total for each_m in from_m])


def test_exchanged_ends_have_the_same_power(links):
    """Reciprocity: as rays are finite, not to the digit; with 300 rays from an edge it was 1.9 dB RMS."""
    city, device_m, receiver_m, total = links
    other = totals(city, receiver_m, device_m).T
    is_los = np.array([city.line_of_sight(each_m, receiver_m) for each_m in device_m])
    assert ((total > 0) == (other > 0)).all() and (~is_los).sum() > 40
    differ_db = 10 * np.log10(np.where(total > 0, other / np.maximum(total, 1e-300), 1.0))
    nlos_db, los_db = differ_db[~is_los], differ_db[is_los]
    assert np.sqrt((nlos_db**2).mean()) < 0.5 and np.median(np.abs(nlos_db)) < 0.01
    assert np.sqrt((los_db**2).mean()) < 0.1


def test_no_sequence_of_two_interactions_is_missed():
    """Against all sequences of two facets, and of an edge with a facet before or after it."""
    city = boxes(5, 2)
    device_m = outside(city, [-50, -50, 1.5], [50, 50, 1.6], 1, 6)[0]
    receiver_m = outside(city, [-60, -60, 1.5], [60, 60, 50], 40, 7)
    search = CandidateSearch(city, 2)
    facets, edges = len(search.surfaces.planes), len(search.surfaces.edges)
    every = [(one, other, -1, -1) for one, other in itertools.permutations(range(facets), 2)]
    every += [(-1, -1, edge, facet) for edge in range(edges) for facet in range(facets)]
    every += [(facet, -1, edge, -1) for edge in range(edges) for facet in range(facets)]
    rows = np.array(every)
    wanted = Candidates(np.ascontiguousarray(rows[:, :2]), rows[:, 2].copy(), rows[:, 3:].copy())
    found, expected = (paths_of(city, search, each, device_m, receiver_m)
                       for each in (search.candidates(device_m), wanted))
    assert len(expected) > 300 and expected <= found


def paths_of(city, search, candidates, device_m, receiver_m):
    """Receiver, facets and edge of each path of two interactions that nothing blocks."""
    buffer, out = PathBuffer.allocate(10_000), set()
    for clear in found_clear(city, search.surfaces, candidates, device_m, receiver_m, buffer):
        for path in clear[buffer.count[clear] == 4]:
            row = buffer.candidate[path]
            before, after = (tuple(each[row][each[row] >= 0].tolist()) for each in (candidates.before, candidates.after))
            out.add((int(buffer.receiver[path]), before, int(candidates.edge[row]), after))
    return out
