"""How surely a gain on held-out data is not chance."""

import numpy as np
from scipy.special import logsumexp

FLIPS = 4_000  # sign flips drawn: a p-value of 0.1 is known to 0.005


def cross_fit_p_value(gains: np.ndarray) -> float:
    """Return a bound on the probability of such held-out gains if the effect is not there.

    A likelihood ratio whose parameters were fitted elsewhere is 1 on average then, if the model
    without the effect is known, and so is its mean over the folds; by Markov's inequality
    (Wasserman, Ramdas and Balakrishnan 2020, 'Universal inference', PNAS 117(29), the cross-fit
    test). Here that model is fitted elsewhere, too, so that the average is above 1 where links are
    few.

    Args:
        gains: (folds,) gain in log-likelihood of each fold [nats].
    """
    return float(np.exp(-max(logsumexp(gains) - np.log(len(gains)), 0.0)))


def sign_flip_p_value(gains: np.ndarray, seed: int) -> float:
    """Return the one-sided sign-flip permutation p-value of the sum of gains.

    Args:
        gains: (pieces,) gain of each independent piece of evidence; zeros do not count.
        seed: of the flips.
    """
    rng = np.random.default_rng(seed)
    gains = gains[gains != 0]
    if not len(gains):
        return 1.0
    # Batches of matrix products: scipy.stats.permutation_test takes ten times as long on 6,000.
    batch = max(int(4e6 // len(gains)), 100)
    larger, done = 0, 0
    while done < FLIPS:
        count = min(batch, FLIPS - done)
        signs = rng.integers(0, 2, (count, len(gains))) * 2 - 1
        larger += int((signs @ gains >= gains.sum()).sum())
        done += count
    return (larger + 1) / (FLIPS + 1)
