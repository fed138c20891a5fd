"""Groups and their peers, against closed forms and over many draws."""

import numpy as np
import pytest

from radiotwin.inference.groups import (
    Groups,
    Statistic,
    Units,
    combine_parts,
    compare_with_peers,
    levels,
    log_scatters,
    median_polish,
    medians,
    subtract_unit_errors,
)


def alone(n):
    return Units(np.arange(n), np.arange(n))


def test_medians_are_those_of_each_group():
    rng = np.random.default_rng(0)
    values, group = rng.normal(size=500), rng.integers(0, 40, 500)
    expected = [np.median(values[group == each]) if (group == each).any() else np.nan for each in range(45)]
    assert medians(values, group, 45) == pytest.approx(np.array(expected), nan_ok=True)


def test_the_error_of_a_level_is_that_of_its_units():
    rng, found = np.random.default_rng(1), []
    unit = np.repeat(np.arange(1000), 20)
    label = unit // 25
    for _ in range(30):
        values = rng.normal(size=1000)[unit] + 0.2 * rng.normal(size=len(unit))
        level = levels(values, Groups.of_labels(label, Units(unit, unit)), 0.0, 0.1)
        found.append(level.value / level.error)
    assert np.std(found) == pytest.approx(1.0, abs=0.12)  # twenty times as many values would be 4.5


def test_a_scatter_is_relative_and_ignores_the_level():
    rng = np.random.default_rng(2)
    label = np.repeat(np.arange(2), 4000)
    values = np.where(label == 0, 2.0, 5.0) * rng.normal(size=8000) + 30 * label
    found = log_scatters(values, Groups.of_labels(label, alone(8000)), 0.0, 10.0)
    assert np.exp(np.diff(found.value)) == pytest.approx(2.5, rel=0.05)


def test_scores_of_peers_are_as_large_as_chance_makes_them():
    rng, scores = np.random.default_rng(3), []
    for _ in range(400):
        spread, error = 0.4, np.full(9, 0.3)
        found = compare_with_peers(Statistic(rng.normal(scale=np.hypot(spread, error)), error), spread, 40.0)
        scores.append(found.score)
    assert np.std(scores) == pytest.approx(1.0, abs=0.2)


def test_an_outlier_does_not_widen_the_spread_that_it_is_compared_with():
    value = np.array([0.1, -0.2, 0.0, 0.2, -0.1, -6.0, 0.1, 0.05])
    found = compare_with_peers(Statistic(value, np.full(8, 0.1)), 0.3, 40.0)
    assert found.spread[5] < 0.35 and found.size[5] == pytest.approx(-6.05, abs=0.1)
    log_odds = found.log_odds(5.0, 0.1)
    assert log_odds[5] > 10 and (np.delete(log_odds, 5) < -2).all()


def test_two_parts_of_the_data_are_weighted_by_precision():
    error = np.array([0.2, 0.2, 0.2])
    sure = compare_with_peers(Statistic(np.array([0.0, 0.0, 3.0]), error), 0.1, 40.0)
    vague = compare_with_peers(Statistic(np.array([0.0, np.nan, -3.0]), 20 * error), 0.1, 40.0)
    both = combine_parts([sure, vague])
    assert both.size[2] == pytest.approx(sure.size[2], abs=0.1) and both.error[2] <= sure.error[2]
    assert both.size[1] == sure.size[1]


def test_a_median_polish_removes_both_ends_and_leaves_their_pair():
    one, other = (each.ravel() for each in np.mgrid[:5, :6])
    pair_db = np.where((one == 2) & (other == 3), 4.0, 0.0)
    left = median_polish(3.0 * one - 2.0 * other + pair_db, [one, other])
    assert left == pytest.approx(pair_db, abs=1e-6)


def test_errors_that_groups_share_in_a_unit_are_subtracted():
    rng = np.random.default_rng(4)
    unit = np.tile(np.arange(40), 3)
    label = np.repeat(np.arange(3), 40)
    values = 5 * rng.normal(size=40)[unit] + np.array([0.0, 0.0, 2.0])[label]
    left = subtract_unit_errors(values, label, unit)
    levels_db = [np.median(left[label == each]) for each in range(3)]
    assert levels_db[2] - levels_db[0] == pytest.approx(2.0, abs=0.3)
    assert np.std(left[label == 0]) < 0.5 * np.std(values[label == 0])
