"""A path counts once, and a link carries no more than its paths: on paths that are written here, without Sionna RT."""

from types import SimpleNamespace

import numpy as np
import pytest

from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.solver import IMPOSSIBLE_DB, PathGains, distinct_paths

FREQUENCY_HZ, LIGHT = 2.4e9, 299_792_458.0
SPECULAR, DIFFRACTION = 1, 8


def path(length_m, *points_m, types=None, strength=1.0, departs=(0.0, 0.0, 1.0)):
    """A path with reflections at some points; `strength` relative to free space over its own length."""
    return {"length_m": length_m, "points_m": points_m, "types": types or [SPECULAR] * len(points_m),
            "field": strength * LIGHT / FREQUENCY_HZ / (4 * np.pi * length_m), "departs": departs}


DIRECT = path(50.0)
BLANK = path(50.0, departs=(1.0, 0.0, 0.0))  # counted, but not stored by Sionna RT: direct, without a direction


def arrays(*links):
    """The arrays of Sionna RT's `Paths` for links with any number of paths each."""
    depth, n, k = 3, len(links), max(map(len, links))
    found = SimpleNamespace(a=[np.zeros((n, k)), np.zeros((n, k))], tau=np.full((n, k), -1.0),
                            interactions=np.zeros((depth, n, k), dtype=np.uint32), vertices=np.zeros((depth, n, k, 3)),
                            **{name: np.zeros((n, k)) for name in ("theta_t", "phi_t", "theta_r", "phi_r")})
    for row, link in enumerate(links):
        for column, one in enumerate(link):
            at = row, column
            found.a[0][at], found.tau[at] = one["field"], one["length_m"] / LIGHT
            found.theta_t[at] = np.arccos(one["departs"][2])
            found.phi_t[at] = np.arctan2(one["departs"][1], one["departs"][0])
            found.theta_r[at] = np.pi  # from below, as it left upwards
            for level, (kind, point_m) in enumerate(zip(one["types"], one["points_m"])):
                found.interactions[level, row, column], found.vertices[level, row, column] = kind, point_m
    return found


def stub(settings):
    solver = object.__new__(PathGains)
    solver.settings, solver._city = settings, SimpleNamespace(frequency=[FREQUENCY_HZ])
    return solver


def gain_db(*paths, antennas=(None, None), **settings):
    power, bound = stub(SolverSettings(batch_receivers=1, **settings))._combine(arrays(paths), antennas)
    return 10 * np.log10(power[0]), 10 * np.log10(bound[0])


FREE_DB = 20 * np.log10(LIGHT / FREQUENCY_HZ / (4 * np.pi * 50.0))
WALL = path(60.0, (10.0, 5.0, 3.0), strength=0.5)
SYMMETRIC = path(60.0, (10.0, -5.0, 3.0), strength=0.5)


@pytest.mark.parametrize("combining", ["power", "coherent"])
def test_a_link_has_one_direct_path_in_the_right_direction(combining):
    """Seen: a 58 m link at -52.35 dB where free space is -75.39, as its direct path came out 130 times."""
    upwards = SimpleNamespace(pattern=SimpleNamespace(peak_dbi=7.0), gain_dbi=lambda way: 7.0 * way[..., 2])
    for order in ([DIRECT], [DIRECT, BLANK, BLANK], [BLANK, DIRECT, BLANK], [*[BLANK] * 129, DIRECT]):
        found_db = gain_db(*order, antennas=(upwards, None), combining=combining)[0]
        assert found_db == pytest.approx(FREE_DB + 7.0, abs=1e-6)


@pytest.mark.parametrize("combining", ["power", "coherent"])
def test_copies_of_a_reflection_count_once(combining):
    once = gain_db(DIRECT, WALL, combining=combining)
    near = path(60.0 * (1 + 4e-7), (10.0, 5.004, 3.0), strength=0.5)
    again = gain_db(WALL, near, DIRECT, WALL, combining=combining)
    assert again == pytest.approx(once, abs=0.01)


def test_the_strongest_of_copies_counts():
    """Two houses that touch have one edge each at the same place; the ray is diffracted there once."""
    edges = [path(70.0, (1.0, 2.0, 3.0), types=[DIFFRACTION], strength=strength) for strength in (0.1, 0.4, 0.2)]
    expected_db = 20 * np.log10(0.4 * LIGHT / FREQUENCY_HZ / (4 * np.pi * 70.0))
    for order in ([0, 1, 2], [2, 1, 0], [1, 0, 2]):
        assert gain_db(*(edges[i] for i in order))[0] == pytest.approx(expected_db, abs=1e-9)


@pytest.mark.parametrize("other", [
    SYMMETRIC,  # the wall across the street
    path(60.0, (10.0, 5.0, 3.0), types=[DIFFRACTION], strength=0.5),
    path(60.0, (10.0, 5.0, 3.0), (12.0, 5.0, 3.0), strength=0.5),
    path(60.0, (10.0, 5.05, 3.0), strength=0.5),
    path(60.01, (10.0, 5.0, 3.0), strength=0.5)])
def test_different_paths_of_one_length_stay(other):
    power = 10 ** (gain_db(WALL)[0] / 10) + 10 ** (gain_db(other)[0] / 10)
    assert gain_db(WALL, other)[0] == pytest.approx(10 * np.log10(power), abs=1e-9)


def test_copies_are_found_between_other_paths_of_the_same_length_and_not_between_links():
    paths = [path(60.0 * (1 + shift), (10.0, y_m, 3.0)) for shift, y_m in
             ((0, 5.0), (1e-7, -5.0), (2e-7, 7.0), (3e-7, 5.0), (4e-7, -5.0), (5e-7, 5.001))]
    found = arrays(paths, [WALL], [], [DIRECT, DIRECT, SYMMETRIC])
    turn = np.where(found.tau > 0, -1.0, 0.0)
    kept = distinct_paths(found.interactions, found.vertices, found.tau * LIGHT, found.a[0], turn)
    assert kept[0].tolist() == [True, True, True, False, False, False] and kept.sum(axis=1).tolist() == [3, 1, 0, 2]


def test_no_paths_at_all():
    power, bound = stub(SolverSettings(batch_receivers=1))._combine(arrays([]), (None, None))
    assert power.tolist() == bound.tolist() == [0.0]


@pytest.mark.parametrize("combining", ["power", "coherent"])
def test_the_bound_is_free_space_over_each_path(combining):
    amplitudes = LIGHT / FREQUENCY_HZ / (4 * np.pi) / np.array([50.0, 60.0, 60.0])
    expected = np.sum(amplitudes**2) if combining == "power" else amplitudes.sum() ** 2
    bound_db = gain_db(DIRECT, WALL, SYMMETRIC, BLANK, combining=combining)[1]
    assert bound_db == pytest.approx(10 * np.log10(expected), abs=1e-9)


def test_antennas_raise_the_bound_by_their_peaks():
    away = SimpleNamespace(pattern=SimpleNamespace(peak_dbi=8.0), gain_dbi=lambda way: np.full(way.shape[:-1], -3.0))
    assert gain_db(DIRECT, antennas=(away, away)) == pytest.approx((FREE_DB - 6, FREE_DB + 16), abs=1e-9)


def test_an_impossible_link_is_solved_again_alone_with_another_seed():
    solutions, calls = [[-70, IMPOSSIBLE_DB, np.nan, IMPOSSIBLE_DB], [-75], [IMPOSSIBLE_DB]], []
    solver, points_m = stub(SolverSettings(batch_receivers=4, seed=5)), np.arange(12.0).reshape(4, 3)

    def solve(device_m, points_m, antennas, seed):
        calls.append((points_m.tolist(), seed))
        return np.array(solutions[len(calls) - 1], dtype=float)

    solver._solve = solve
    found_db = solver.solve(np.zeros(3), points_m)
    assert found_db == pytest.approx([-70, -75, np.nan, IMPOSSIBLE_DB], nan_ok=True)
    assert calls == [(points_m.tolist(), 5), ([points_m[1].tolist()], 6), ([points_m[3].tolist()], 6)]
