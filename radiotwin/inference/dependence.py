"""Test whether values depend on a variable, by permutations that keep series correlated."""

from dataclasses import dataclass

import numpy as np

BINS = 10  # quantile bins of a continuous variable
PERMUTATIONS = 2500
MIN_STRONGER = 20  # permutations beyond the observed statistic, at which the test stops


@dataclass(frozen=True, eq=False)
class Series:
    """n values in series, such as the links of a device along a flight.

    Attributes:
        order: (n,) rows, series after series, each in order.
        starts: (series + 1,) where each series starts in `order`.
    """

    order: np.ndarray
    starts: np.ndarray

    @classmethod
    def sort(cls, series: np.ndarray, position: np.ndarray) -> "Series":
        """Group rows by series label (n,) and sort each series by position (n,)."""
        order = np.lexsort((np.arange(len(series)), position, series))
        return cls(order, np.flatnonzero(np.r_[True, np.diff(series[order]) > 0, True]))


def levels_of(values: np.ndarray) -> np.ndarray | None:
    """Bin a variable (n,): integer labels as they are, others by quantiles, NaN in one more bin.

    None with a single bin, more than n / 5 labels, or more than half of the values NaN.
    """
    if values.dtype.kind in "iu":
        level = np.unique(values, return_inverse=True)[1]
        return level if 1 <= level.max() < len(level) // 5 else None
    if np.isfinite(values).mean() < 0.5 or np.nanstd(values) < 1e-9:
        return None
    edges = np.unique(np.nanquantile(values, np.linspace(0, 1, BINS + 1)[1:-1]))
    level = np.where(np.isfinite(values), np.searchsorted(edges, values), len(edges) + 1)
    level = np.unique(level, return_inverse=True)[1]
    return level if level.max() >= 1 else None


def permutation_p_value(level: np.ndarray, z: np.ndarray, series: Series,
                        rng: np.random.Generator) -> float:
    """Test by permutation whether the means of values z (n,) differ between bins `level` (n,).

    If the bin changes within most series, each series is rotated by a random shift, which keeps
    neighbours together; else the series exchange their means. (`scipy.stats.permutation_test` does
    neither.) Stops early (Besag and Clifford 1991, 'Sequential Monte Carlo p-values'). Above 0.
    """
    level, z, count = level[series.order], z[series.order], np.maximum(np.bincount(level), 1)
    observed = _between(level, z, count)
    permuted = _rotated if _changes_within(level, series.starts) else _swapped
    stronger, tried = 0, 0
    while tried < PERMUTATIONS and stronger < MIN_STRONGER:
        stronger += _between(level, permuted(z, series.starts, rng), count) >= observed
        tried += 1
    return stronger / tried if stronger == MIN_STRONGER else (stronger + 1) / (tried + 1)


def holm(p_values: np.ndarray) -> np.ndarray:
    """Correct ascending p-values for multiple tests (Holm 1979)."""
    factor = len(p_values) - np.arange(len(p_values))
    return np.maximum.accumulate(np.minimum(p_values * factor, 1.0))


def _between(level: np.ndarray, z: np.ndarray, count: np.ndarray) -> float:
    """Compute the sum of squares between bins of z (n,); `count` (bins,) values are in each."""
    return float((np.bincount(level, weights=z) ** 2 / count).sum())


def _changes_within(level: np.ndarray, starts: np.ndarray) -> bool:
    """Check whether the bin changes within more than half of the series."""
    changed = np.r_[0, np.diff(level) != 0]
    changes = np.add.reduceat(changed, starts[:-1]) - changed[starts[:-1]]
    return bool(np.mean(changes > 0) > 0.5)


def _rotated(z: np.ndarray, starts: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rotate the values of each series cyclically by a random shift."""
    length = np.diff(starts)
    shift = (rng.random(len(length)) * length).astype(int)
    return np.concatenate([part for start, end, by in zip(
        starts[:-1].tolist(), starts[1:].tolist(), shift.tolist(), strict=True)
        for part in (z[start + by:end], z[start:start + by])])


def _swapped(z: np.ndarray, starts: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Exchange the means of the series at random; deviations from the means stay."""
    length = np.diff(starts)
    means = np.add.reduceat(z, starts[:-1]) / length
    return z + np.repeat(rng.permutation(means) - means, length)
