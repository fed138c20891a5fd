"""Curves that change more than their peers, over many draws."""

import numpy as np
import pytest

from radiotwin.inference.curves import combine_curves, compare_curves
from radiotwin.inference.groups import Statistic

BINS, ERROR_DB, PRIOR_DB, ODDS = 16, 0.4, 0.1, 0.03


def drawn(rng, count, moves_db):
    """Levels of `count` curves, of which the first moves with this standard deviation."""
    curve = np.repeat(np.arange(count), BINS)
    level_db = rng.normal(scale=ERROR_DB, size=len(curve))
    cycle = np.sqrt(2) * np.sin(2 * np.pi * 3 * np.arange(BINS) / BINS)
    level_db[curve == 0] += 4.0 + moves_db * cycle
    return Statistic(level_db, np.full(len(curve), ERROR_DB)), curve


@pytest.mark.parametrize("count", [2, 8])
def test_a_cycle_that_no_single_bin_shows_is_found(count):
    rng, found, sizes = np.random.default_rng(0), [], []
    for _ in range(60):
        curve = compare_curves(*drawn(rng, count, 2.5), PRIOR_DB, "all")
        found.append(curve.log_odds(3.0, ODDS))
        sizes.append(curve.size[0])
    found = np.array(found)
    assert (found[:, 0] > 2.2).mean() > 0.9
    assert (found[:, 1:] > 0).mean() < 0.02
    assert np.median(sizes) == pytest.approx(2.5, rel=0.15)


def test_curves_that_all_vary_alike_do_not_stand_out():
    rng = np.random.default_rng(1)
    curve = np.repeat(np.arange(6), BINS)
    most = [np.nanmax(compare_curves(Statistic(rng.normal(size=len(curve)), np.full(len(curve), 0.2)), curve,
                             PRIOR_DB, "all").log_odds(3.0, ODDS)) for _ in range(60)]
    assert np.mean(np.array(most) > 0) < 0.05


def test_an_interval_of_the_size_holds_the_truth():
    rng, held = np.random.default_rng(2), []
    for _ in range(200):
        found = compare_curves(*drawn(rng, 4, 1.5), PRIOR_DB, "all")
        held.append(found.sd(0.05)[0] <= 1.5 <= found.sd(0.95)[0])
    assert np.mean(held) > 0.85


def test_two_parts_of_the_data_say_more_than_one():
    rng, more = np.random.default_rng(3), []
    for _ in range(40):
        parts = [compare_curves(*drawn(rng, 4, 1.0), PRIOR_DB, name) for name in ("one", "two")]
        both = combine_curves(parts)
        more.append(both.log_odds(3.0, ODDS)[0] > parts[0].log_odds(3.0, ODDS)[0])
        assert set(both.bins) == {"one", "two"}
    assert np.mean(more) > 0.9


def test_a_curve_of_few_bins_is_not_judged():
    curve = np.repeat([0, 1], [3, BINS])
    found = compare_curves(Statistic(np.zeros(len(curve)), np.ones(len(curve))), curve, PRIOR_DB, "all")
    assert np.isnan(found.size[0]) and np.isnan(found.log_odds(3.0, ODDS)[0]) and found.size[1] < 2.0
