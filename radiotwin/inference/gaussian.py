"""Gaussian likelihood of levels of which some lie below the limit of detection (left-censored)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import log_ndtr, ndtr

if TYPE_CHECKING:
    import torch

HALF_LOG_2PI = 0.5 * np.log(2.0 * np.pi)


def gaussian_nll(
    level_db: np.ndarray, mean_db: np.ndarray, sigma_db: np.ndarray, limit_db: float | None
) -> np.ndarray:
    """Negative log-likelihood of each level, in nats; the arguments broadcast against each other.

    level_db [dB]: NaN = not detected, which counts as P(level < limit): -log Phi((limit - mean) / sigma)
    (Tobin 1958, 'Estimation of relationships for limited dependent variables'), or as 0 where limit_db is None.
    """
    missing = np.isnan(level_db)
    seen = 0.5 * ((level_db - mean_db) / sigma_db) ** 2 + np.log(sigma_db) + HALF_LOG_2PI
    if not missing.any():
        return seen
    below = 0.0 if limit_db is None else -log_ndtr((limit_db - mean_db) / sigma_db)
    return np.where(missing, below, seen)


def mean_if_detected(mean_db: np.ndarray, sigma_db: np.ndarray, limit_db: float) -> np.ndarray:
    """Mean level [dB] of those links of a kind that are detected, that is, lie above the limit; broadcasts.

    What a prediction has to be compared with measured levels by: near the limit only the strong ones were measured,
    and the mean of all lies below the mean of those. mean + sigma * phi(a) / Phi(-a), a = (limit - mean) / sigma
    (the truncated normal distribution; Johnson, Kotz and Balakrishnan 1994, section 13.10.1).
    """
    below = (limit_db - mean_db) / sigma_db
    return mean_db + sigma_db * np.exp(-0.5 * below**2 - HALF_LOG_2PI - log_ndtr(-below))


def standardised(level_db: np.ndarray, mean_db: np.ndarray, sigma_db: np.ndarray, limit_db: float | None) -> np.ndarray:
    """(level - mean) / sigma of each link (n,); of one that was not detected (NaN) the mean below the limit,
    -phi(a) / Phi(a), a = (limit - mean) / sigma, as in `mean_if_detected`. limit_db: None where all were detected."""
    residual = (level_db - mean_db) / sigma_db
    missing = np.isnan(residual)
    if missing.any():
        below = (limit_db - mean_db[missing]) / sigma_db[missing]
        residual[missing] = -np.exp(-0.5 * below**2 - HALF_LOG_2PI - log_ndtr(below))
    return residual


def gaussian_nll_torch(
    level: torch.Tensor, mean: torch.Tensor, log_sigma: torch.Tensor, censored: torch.Tensor
) -> torch.Tensor:
    """The same in torch, differentiable in mean and log_sigma.

    Where `censored` is True, `level` holds the limit of detection instead of a level. Everything broadcasts.
    """
    import torch

    z = (level - mean) * torch.exp(-log_sigma)
    # The branch that is not taken must stay finite, or its gradient (0 times infinity) is NaN.
    below = -torch.special.log_ndtr(torch.where(censored, z, 0.0))
    seen = 0.5 * torch.where(censored, 0.0, z) ** 2 + log_sigma + HALF_LOG_2PI
    return torch.where(censored, below, seen)


def detection_probability(mean_db: np.ndarray, sd_db: np.ndarray,
                          limit_db: np.ndarray | float) -> np.ndarray:
    """Return the probability that a level lies above the limit; -inf: always. Broadcasts."""
    return ndtr((mean_db - limit_db) / sd_db)
