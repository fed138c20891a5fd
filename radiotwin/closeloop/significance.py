"""How surely a gain on held-out links is no chance."""

import numpy as np
from scipy.special import logsumexp

FLIPS = 4_000


def gain_p(gains: np.ndarray) -> float:
    """Bound on the chance of such held-out gains (folds,) [nats] if the effect is not there.

    A likelihood ratio whose parameters were fitted elsewhere is at most 1 on average then, and so is its mean over the
    folds; by Markov's inequality (Wasserman, Ramdas and Balakrishnan 2020, 'Universal inference', PNAS 117(29), the
    cross-fit test).
    """
    return float(np.exp(-max(logsumexp(gains) - np.log(len(gains)), 0.0)))


def sign_flip_p(gains: np.ndarray, seed: int) -> float:
    """Chance of a sum this large if each piece of evidence were as likely to speak against as for it."""
    rng = np.random.default_rng(seed)
    gains = gains[gains != 0]
    if not len(gains):
        return 1.0
    most = max(int(4e6 // len(gains)), 100)
    larger, done = 0, 0
    while done < FLIPS:
        count = min(most, FLIPS - done)
        larger += int(((rng.integers(0, 2, (count, len(gains))) * 2 - 1) @ gains >= gains.sum()).sum())
        done += count
    return (larger + 1) / (FLIPS + 1)
