"""Random numbers: an independent stream for every purpose, all from one seed."""

import numpy as np

PURPOSES = ("learning", "real flight", "decisions", "choice", "twin evaluation",
            "truth evaluation", "planning")


def stream(seed: int, purpose: str, number: int = 0) -> np.random.Generator:
    """Return the generator of a purpose.

    Args:
        seed: of the run.
        purpose: one of `PURPOSES`.
        number: of the replica, flight or round, where there are several.
    """
    # Counted from 1, because numpy takes [1, 2, 0] for [1, 2].
    return np.random.default_rng([seed, PURPOSES.index(purpose) + 1, number + 1])
