"""Whether values depend on a variable: how often that is said where they do not, and corrections for many variables."""

import numpy as np
import pytest

from radiotwin.inference.dependence import (
    PERMUTATIONS,
    Series,
    holm,
    levels_of,
    permutation_p_value,
)

SERIES, LENGTH = 12, 60


def wandering(rng, memory=0.9):
    """Values in series, each of which remembers the one before it."""
    shock = rng.normal(size=(SERIES, LENGTH)) * np.sqrt(1 - memory**2)
    z = np.empty_like(shock)
    z[:, 0] = rng.normal(size=SERIES)
    for step in range(1, LENGTH):
        z[:, step] = memory * z[:, step - 1] + shock[:, step]
    return z.ravel()


def in_series(rng):
    """The series of shuffled rows, and the order of the shuffling."""
    shuffled = rng.permutation(SERIES * LENGTH)
    label, position = np.divmod(np.arange(SERIES * LENGTH), LENGTH)
    return shuffled, Series.sort(label[shuffled], position[shuffled])


def p_values(level, draws, depends=0.0):
    """Of values that wander; `level` draws the variable (n,) of a draw."""
    found = []
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        shuffled, series = in_series(rng)
        variable = level(rng)
        z = wandering(rng) + depends * (variable - variable.mean()) / variable.std()
        found.append(permutation_p_value(levels_of(variable[shuffled]), z[shuffled], series, rng))
    return np.array(found)


@pytest.mark.parametrize("level", [wandering, lambda rng: np.repeat(rng.normal(size=SERIES), LENGTH)])
def test_values_that_remember_depend_on_nothing_by_chance(level):
    """A variable that wanders, too, and one that belongs to whole series: neighbours must stay neighbours.

    Shuffling single values says so in 85 % of the first and all of the second.
    """
    found = p_values(level, 120)
    assert (found <= 0.1).mean() < 0.1 + 3 * np.sqrt(0.1 * 0.9 / 120) and (found <= 0.1).any()
    assert 0.3 < np.median(found) < 0.7 and found.min() > 0


@pytest.mark.seconds
@pytest.mark.parametrize("level", [wandering, lambda rng: np.repeat(rng.permutation(SERIES) % 2.0, LENGTH)])
def test_a_dependence_is_found(level):
    assert (p_values(level, 12, depends=1.5) <= 0.02).mean() > 0.8


def test_no_p_value_is_0():
    rng = np.random.default_rng(0)
    label = np.repeat(np.arange(40), 30)
    series = Series.sort(label, np.tile(np.arange(30), 40))
    z = np.where(np.tile(np.arange(30), 40) < 15, -1.0, 1.0) + 0.01 * rng.normal(size=1200)
    found = permutation_p_value(levels_of(np.tile(np.arange(30.0), 40)), z, series, rng)
    assert found == pytest.approx(1 / (PERMUTATIONS + 1))


def test_corrected_p_values_are_those_of_holm():
    """Holm 1979: the smallest times their number, the next times one less, and never less than the one before."""
    np.testing.assert_allclose(holm(np.array([0.01, 0.02, 0.03, 0.04])), [0.04, 0.06, 0.06, 0.06])


def test_bins_are_labels_or_shares_of_the_values():
    assert levels_of(np.zeros(50)) is None and levels_of(np.full(50, np.nan)) is None
    assert levels_of(np.arange(50)) is None, "a label for each value"
    np.testing.assert_array_equal(levels_of(np.tile([7, 3], 20)), np.tile([1, 0], 20))
    level = levels_of(np.r_[np.random.default_rng(0).normal(size=990), np.full(10, np.nan)])
    counts = np.bincount(level)
    assert len(counts) == 11 and counts[-1] == 10 and np.ptp(counts[:10]) <= 2
