"""A crude prediction of every level: one slope over distance, a level for each end.

It serves to tell how weak a link that was not detected probably was, before anything is fitted: no
map, no line of sight, and devices whose position is unknown have no distance.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr, ndtr

SLOPE_DB, SLOPE_SD_DB = -30.0, 10.0  # prior of the fall per decade: path-loss exponent 2 to 4
END_SD_DB = 8.0  # prior of what one device, or one receiver, differs from the others
MIN_LINKS = 5  # of an end that has a level of its own
LEVEL_ROUNDS = 8  # of expectation and maximisation
FIRST_SD_DB, MIN_SD_DB = 8.0, 6.0
LOST = 0.02  # probability that a link is blank although its level is above the limit
FIRST_BELOW_DB = 3.0  # how far below its limit a blank is taken to be at first


@dataclass(frozen=True, eq=False)
class CrudeLevel:
    """Predicted levels (n,) [dB], and the standard deviation of their errors [dB]."""

    mean_db: np.ndarray
    sd_db: float


def crude_level(level_db: np.ndarray, limit_db: np.ndarray, distance_m: np.ndarray,
                device: np.ndarray, receiver: np.ndarray) -> CrudeLevel:
    """Predict levels from distance and both ends, with blanks below a limit.

    Expectation and maximisation for censored normal levels (Dempster, Laird and Rubin 1977,
    'Maximum likelihood from incomplete data via the EM algorithm', JRSS B 39, Sec. 4.2).

    Args:
        level_db: (n,) readings [dB]; NaN: not detected.
        limit_db: (n,) below which a link is blank [dB]; -inf where that is unknown.
        distance_m: (n,) [m]; NaN where unknown.
        device: (n,) index of one end.
        receiver: (n,) index of the other.
    """
    blank = np.isnan(level_db)
    limited = blank & np.isfinite(limit_db)
    limit = np.where(limited, limit_db, 0.0)
    filled_db = np.where(blank, limit - FIRST_BELOW_DB, level_db)
    counted = ~blank | limited
    filled_db[~counted] = filled_db[counted].mean()
    distance = np.log10(distance_m)
    known = np.isfinite(distance)
    distance = np.where(known, distance, distance[known].mean() if known.any() else 0.0)
    distance = distance - distance.mean()
    ends = [_frequent(device), _frequent(receiver)]
    own_db = [np.zeros(end.max() + 1) for end in ends]
    slope_db, sd_db, variance = SLOPE_DB, FIRST_SD_DB, np.zeros(len(level_db))
    for _ in range(LEVEL_ROUNDS):
        for number, end in enumerate(ends):
            rest = filled_db - slope_db * distance - own_db[1 - number][ends[1 - number]]
            rest = rest - rest[counted].mean()
            sums = np.bincount(end[counted], rest[counted], len(own_db[number]))
            count = np.bincount(end[counted], minlength=len(own_db[number]))
            own_db[number] = sums / (count + (sd_db / END_SD_DB) ** 2)
        rest = filled_db - sum(own[end] for own, end in zip(own_db, ends, strict=True))
        x, y = distance[counted], rest[counted] - rest[counted].mean()
        x = x - x.mean()
        weight = (sd_db / SLOPE_SD_DB) ** 2
        slope_db = float((x @ y + weight * SLOPE_DB) / (x @ x + weight))
        rest = rest - slope_db * distance
        mean_db = rest[counted].mean() + filled_db - rest
        error = ((filled_db - mean_db) ** 2 + variance)[counted]
        sd_db = max(float(np.sqrt(error.mean())), MIN_SD_DB)
        z = (limit - mean_db) / sd_db
        ratio = np.exp(-0.5 * z * z - 0.5 * np.log(2 * np.pi) - log_ndtr(z))
        below = (1 - LOST) * ndtr(z)
        below = below / (below + LOST)  # probability that it was too weak, and not lost
        shift = np.where(limited, below * -ratio, 0.0)
        filled_db = np.where(blank, mean_db + sd_db * shift, level_db)
        variance = np.where(limited, sd_db**2 * np.clip(1 - ratio * (ratio + z), 0, 1), 0.0)
    return CrudeLevel(mean_db, sd_db)


def _frequent(label: np.ndarray) -> np.ndarray:
    """Return labels (n,) counted from 1; 0 stands for all that are rare."""
    frequent = np.bincount(label) >= MIN_LINKS
    return np.where(frequent, np.cumsum(frequent), 0)[label]
