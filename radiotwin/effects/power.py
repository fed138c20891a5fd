"""Powers and decibels."""

import numpy as np

NEPERS = np.log(10) / 10  # of power in a decibel
MIN_POWER = 1e-290  # of which a logarithm is taken


def add_power(level_db: np.ndarray, power: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the level of the sum of two powers, and its slope in the first level.

    Args:
        level_db: (n,) first power [dB].
        power: (n,) second power, in units of that of 0 dB.

    Returns:
        (n,) [dB], and (n,) slope.
    """
    first = np.maximum(np.exp(level_db * NEPERS), MIN_POWER)
    total = first + power
    return np.log(total) / NEPERS, first / total
