"""Whether values depend on a variable: permutations that keep together what is alike."""

from dataclasses import dataclass

import numpy as np

BINS = 10  # that a continuous variable is cut into
PERMUTATIONS = 2500
MIN_STRONGER = 20  # permutations that are stronger than what was observed, to stop early
MIN_LEVELS = 2  # of a label


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
        """Return the series of labels (n,), each in order of a position (n,)."""
        order = np.lexsort((np.arange(len(series)), position, series))
        return cls(order, np.flatnonzero(np.r_[True, np.diff(series[order]) > 0, True]))


def levels_of(values: np.ndarray) -> np.ndarray | None:
    """Return the bin (n,) of each value; None where there is nothing to compare.

    Args:
        values: (n,) integers are labels; of others NaN, where they are few, is a bin of its own.
    """
    if values.dtype.kind in "iu":
        level = np.unique(values, return_inverse=True)[1]
        enough = level.max() + 1 >= MIN_LEVELS and level.max() < len(level) // 5
        return level if enough else None
    if np.isfinite(values).mean() < 0.5 or np.nanstd(values) < 1e-9:
        return None
    edges = np.unique(np.nanquantile(values, np.linspace(0, 1, BINS + 1)[1:-1]))
    level = np.where(np.isfinite(values), np.searchsorted(edges, values), len(edges) + 1)
    level = np.unique(level, return_inverse=True)[1]
    return level if level.max() >= 1 else None


def permutation_p_value(level: np.ndarray, z: np.ndarray, series: Series,
                        rng: np.random.Generator) -> float:
    """Return the p-value of the values' squares between bins (n,).

    Where the bin changes within most series, each is rotated by a random number of places, so that
    neighbours stay neighbours; else whole series swap their means. (`scipy.stats.permutation_test`
    knows neither.) Sequential (Besag and Clifford 1991, 'Sequential Monte Carlo p-values').
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
    """Return p-values corrected for their number, in the given ascending order (Holm 1979)."""
    factor = len(p_values) - np.arange(len(p_values))
    return np.maximum.accumulate(np.minimum(p_values * factor, 1.0))


def _between(level: np.ndarray, z: np.ndarray, count: np.ndarray) -> float:
    """Return the sum of squares between the bins of `count` values."""
    return float((np.bincount(level, weights=z) ** 2 / count).sum())


def _changes_within(level: np.ndarray, starts: np.ndarray) -> bool:
    """Return whether the bin, in the order of the series, changes within most of them."""
    changed = np.r_[0, np.diff(level) != 0]
    changes = np.add.reduceat(changed, starts[:-1]) - changed[starts[:-1]]
    return bool(np.mean(changes > 0) > 0.5)


def _rotated(z: np.ndarray, starts: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the values, in the order of the series, each of which is rotated."""
    length = np.diff(starts)
    shift = (rng.random(len(length)) * length).astype(int)
    return np.concatenate([part for start, end, by in zip(
        starts[:-1].tolist(), starts[1:].tolist(), shift.tolist(), strict=True)
        for part in (z[start + by:end], z[start:start + by])])


def _swapped(z: np.ndarray, starts: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the values with the series' means elsewhere; what is around them stays."""
    length = np.diff(starts)
    means = np.add.reduceat(z, starts[:-1]) / length
    return z + np.repeat(rng.permutation(means) - means, length)
