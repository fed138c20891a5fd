"""Average residuals over bins of a variable."""

from dataclasses import dataclass

import numpy as np

MIN_LINKS = 6  # of a mean that is drawn


@dataclass(frozen=True, eq=False)
class BinMeans:
    """Means over bins of links.

    Attributes:
        at: (b,) mean of the variable in each bin.
        mean: (b,) mean of what is averaged [dB].
        error: (b,) standard error of the mean [dB].
    """

    at: np.ndarray
    mean: np.ndarray
    error: np.ndarray


def bin_index(value: np.ndarray, count: int) -> np.ndarray:
    """Assign values to bins that hold about as many values each.

    Args:
        value: (n,) finite values.
        count: number of bins; where there are at most as many distinct values, each has its own.

    Returns:
        (n,) index of the bin of each value
    """
    values = np.unique(value)
    if len(values) <= count:
        return np.searchsorted(values, value)
    inner = np.unique(np.quantile(value, np.linspace(0, 1, count + 1)[1:-1]))
    return np.searchsorted(inner, value, side="right")


def bin_means(index: np.ndarray, value: np.ndarray, residual_db: np.ndarray,
              block: np.ndarray) -> BinMeans:
    """Average residuals over bins; bins of fewer than `MIN_LINKS` links are left out.

    Args:
        index: (n,) bin of each link.
        value: (n,) variable.
        residual_db: (n,) values to average [dB].
        block: (n,) index of the block of links with a common error, which counts as one
            observation in the standard error.
    """
    count = np.bincount(index)
    mean = np.bincount(index, weights=residual_db) / np.maximum(count, 1)
    deviation_db = residual_db - mean[index]
    pairs, pair = np.unique(np.column_stack([index, block]), axis=0, return_inverse=True)
    sums = np.bincount(pair.ravel(), weights=deviation_db)
    between = np.bincount(pairs[:, 0], weights=sums**2)
    # At least the standard error of independent links: in a bin of a single block the deviations
    # sum to zero.
    independent = np.bincount(index, weights=deviation_db**2)
    error = np.sqrt(np.maximum(between, independent)) / np.maximum(count, 1)
    at = np.bincount(index, weights=value) / np.maximum(count, 1)
    used = count >= MIN_LINKS
    return BinMeans(at[used], mean[used], error[used])
