"""Diffraction at two edges, against products of single ones, ITU-R P.526 and Fermat's principle."""

import numpy as np
import pytest
from scipy.optimize import minimize

from radiotwin.propagation.paths import path_powers
from radiotwin.propagation.paths.candidates import CandidateSearch
from radiotwin.propagation.paths.two_edges import shortest, wave_at_edge
from tests.propagation.links import FREQUENCY_HZ, friis, knife_edge_db, one_link, sharp_roofs

DEVICE_M, RECEIVER_M = np.array([-150.0, 0, 2]), np.array([230.0, 0, 5])


def two_roofs(*heights_m):
    return sharp_roofs(*zip((0, 60), heights_m))


def over_free(city, from_m, to_m, kind):
    """Power of paths over one or two edges, over that of free space."""
    return one_link(city, from_m, to_m, depth=2)[kind] / friis(np.linalg.norm(to_m - from_m))


def above_line(height_m, x_m, from_m, to_m):
    """Height of an edge above the line between two (x, z) points."""
    return height_m - (from_m[1] + (x_m - from_m[0]) / (to_m[0] - from_m[0]) * (to_m[1] - from_m[1]))


def test_two_parallel_edges_are_a_product():
    """Each edge is the other's end of the path; the spreading is Millington's (ITU-R P.526-15, eq. 36)."""
    got = over_free(two_roofs(30, 34), DEVICE_M, RECEIVER_M, "diffracted_2")
    ridges_m = np.array([[0, 0, 30]]), np.array([[60, 0, 34]])
    first = over_free(sharp_roofs((0, 30)), DEVICE_M, ridges_m[1][0], "diffracted")
    second = over_free(sharp_roofs((60, 34)), ridges_m[0][0], RECEIVER_M, "diffracted")
    legs = ((DEVICE_M, ridges_m[0]), (ridges_m[0], ridges_m[1]), (ridges_m[1], RECEIVER_M))
    a, b, c = (np.linalg.norm(end - start) for start, end in legs)
    # Each power is over that of the straight line, whose lengths are not those of the bent ways
    straight = np.linalg.norm(RECEIVER_M - DEVICE_M) / (
        np.linalg.norm(DEVICE_M - ridges_m[1]) * np.linalg.norm(RECEIVER_M - ridges_m[0]))
    spreading = straight**2 * b * (a + b) * (b + c) / (a + b + c)
    assert got == pytest.approx(first * second * spreading, rel=1e-6)


@pytest.mark.parametrize("heights_m", [(30, 34), (34, 30), (30, 30), (40, 33)])
def test_two_knife_edges(heights_m):
    """ITU-R P.526-15, section 4.4.1, first method, which has neither material nor the wedge's angle."""
    a, b, c = 150.0, 60.0, 170.0
    got_db = 10 * np.log10(over_free(two_roofs(*heights_m), DEVICE_M, RECEIVER_M, "diffracted_2"))
    ends = [(x, z) for x, _, z in (DEVICE_M, RECEIVER_M)]
    tops = [(0.0, heights_m[0]), (60.0, heights_m[1])]
    successive_db = knife_edge_db(above_line(heights_m[0], 0, ends[0], tops[1]), a, b) \
        + knife_edge_db(above_line(heights_m[1], 60, tops[0], ends[1]), b, c) \
        + 10 * np.log10((a + b) * (b + c) / (b * (a + b + c)))
    assert got_db == pytest.approx(-successive_db, abs=1)


def test_the_points_obey_fermat(town):
    edges = CandidateSearch(town(0.3), 2).surfaces.edges
    rng = np.random.default_rng(1)
    for one, other in rng.integers(len(edges), size=(40, 2)):
        if one == other:
            continue
        from_m, to_m = rng.uniform([-100, -100, 1], [100, 100, 60], (2, 3))

        def length_m(at):
            p = edges[one, :3] + at[0] * edges[one, 3:6]
            q = edges[other, :3] + at[1] * edges[other, 3:6]
            return sum(np.linalg.norm(leg) for leg in (p - from_m, q - p, to_m - q))

        best = minimize(length_m, [1.0, 1.0], method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-12,
                                                                             "maxiter": 4000})
        found = shortest(edges[one], edges[other], from_m, to_m)
        if found == (-1.0, -1.0):  # through a common corner, which is no path over two edges
            meet_m = edges[one, :3] + best.x[0] * edges[one, 3:6] - edges[other, :3] - best.x[1] * edges[other, 3:6]
            assert np.linalg.norm(meet_m) < 0.01
        else:
            assert length_m(found) <= best.fun + 1e-6


def test_the_wave_of_an_edge():
    """For parallel edges the first is a line source; at right angles the second sees that wave from one point."""
    distance_m, length_m = wave_at_edge(30.0, 20.0, 100.0, 0.0)
    assert distance_m == pytest.approx(30 * 20 / 50) and length_m == pytest.approx(20)
    assert wave_at_edge(30.0, 20.0, 100.0, 1.0)[0] == pytest.approx(30 * 120 / 150)


def test_at_the_second_shadow_boundary_half_the_field_is_left():
    """The ray from the first edge grazes the second: a quarter of the power of the first edge alone."""
    height_m = 30 + (RECEIVER_M[2] - 30) * 60 / RECEIVER_M[0] + 0.03
    both = over_free(two_roofs(30, height_m), DEVICE_M, RECEIVER_M, "diffracted_2")
    alone = over_free(sharp_roofs((0, 30)), DEVICE_M, RECEIVER_M, "diffracted")
    assert 10 * np.log10(both / alone) == pytest.approx(-6, abs=0.5)


def test_only_where_nothing_else_arrives():
    receiver_m = np.array([RECEIVER_M, [230.0, 0, 60]])
    powers = path_powers(two_roofs(30, 34), DEVICE_M, receiver_m, FREQUENCY_HZ)
    assert (powers.diffracted_2 > 0).tolist() == [True, False] and powers.total[1] > powers.total[0] > 0
    assert powers.directions.of_links(np.array([0])).power.sum() == pytest.approx(powers.total[0])
