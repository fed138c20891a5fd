"""Gaussian likelihood of levels of which some lie below the limit of detection (left-censored)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.special import log_ndtr, ndtr

if TYPE_CHECKING:
    import torch

HALF_LOG_2PI = 0.5 * np.log(2.0 * np.pi)

Limit = float | np.ndarray | None
"""Level below which nothing is detected [dB], for all links or each (n,); None or -inf: unknown."""


def limits_of(limit_db: Limit, n: int) -> np.ndarray:
    """Return the limit of each of n links [dB]; -inf where it is unknown."""
    return np.broadcast_to(np.asarray(-np.inf if limit_db is None else limit_db, float), n)


def gaussian_nll(level_db: np.ndarray, mean_db: np.ndarray, sd_db: np.ndarray,
                 limit_db: Limit) -> np.ndarray:
    """Return the negative log-likelihood of each level [nats].

    The arguments broadcast against each other. A level that was not detected counts as
    P(level < limit): -log Phi((limit - mean) / sd) (Tobin 1958, 'Estimation of relationships for
    limited dependent variables').

    Args:
        level_db: measured [dB]; NaN: not detected.
        mean_db: expected [dB].
        sd_db: standard deviation [dB].
        limit_db: limit of detection [dB]; None: what was not detected counts 0, as it does where
            the limit is -inf.

    Returns:
        [nats], of the broadcast shape.
    """
    missing = np.isnan(level_db)
    seen = 0.5 * ((level_db - mean_db) / sd_db) ** 2 + np.log(sd_db) + HALF_LOG_2PI
    if not missing.any():
        return seen
    if limit_db is None:
        return np.where(missing, 0.0, seen)
    below = np.where(np.isneginf(limit_db), 0.0, -log_ndtr((limit_db - mean_db) / sd_db))
    return np.where(missing, below, seen)


def mean_if_detected(mean_db: np.ndarray, sd_db: np.ndarray,
                     limit_db: np.ndarray | float) -> np.ndarray:
    """Return the mean of a level given that it lies above the limit.

    Compare measured levels with this: near the limit only the strong ones were detected, whose mean
    lies above the mean of all. mean + sd * phi(a) / Phi(-a), a = (limit - mean) / sd, of the
    truncated normal distribution (Johnson, Kotz and Balakrishnan 1994, section 13.10.1).

    Args:
        mean_db: expected [dB]; all arguments broadcast.
        sd_db: standard deviation [dB].
        limit_db: limit of detection [dB]; -inf: everything is detected.

    Returns:
        [dB], of the broadcast shape.
    """
    below = (limit_db - mean_db) / sd_db
    return mean_db + sd_db * np.exp(-0.5 * below**2 - HALF_LOG_2PI - log_ndtr(-below))


def standardised(level_db: np.ndarray, mean_db: np.ndarray, sd_db: np.ndarray,
                 limit_db: Limit) -> np.ndarray:
    """Return the standardised residual (level - mean) / sd of each link.

    A link that was not detected gets its conditional mean below the limit, -phi(a) / Phi(a),
    a = (limit - mean) / sd, as in `mean_if_detected`.

    Args:
        level_db: (n,) measured [dB]; NaN: not detected.
        mean_db: (n,) expected [dB].
        sd_db: (n,) standard deviation [dB].
        limit_db: limit of detection [dB]; unknown only for links that were detected.

    Returns:
        (n,) residual in standard deviations.
    """
    residual = (level_db - mean_db) / sd_db
    missing = np.isnan(residual)
    if missing.any():
        limits_db = limits_of(limit_db, len(level_db))
        below = (limits_db[missing] - mean_db[missing]) / sd_db[missing]
        residual[missing] = -np.exp(-0.5 * below**2 - HALF_LOG_2PI - log_ndtr(below))
    return residual


def gaussian_nll_torch(level: torch.Tensor, mean: torch.Tensor, log_sd: torch.Tensor,
                       censored: torch.Tensor) -> torch.Tensor:
    """Return `gaussian_nll` in torch, differentiable in mean and log_sd; everything broadcasts.

    Args:
        level: measured; where `censored`, the limit of detection instead.
        mean: expected, in the unit of `level`.
        log_sd: natural logarithm of the standard deviation.
        censored: bool, what was not detected.

    Returns:
        [nats], of the broadcast shape.
    """
    import torch

    z = (level - mean) * torch.exp(-log_sd)
    # The branch that is not taken must stay finite, or its gradient (0 times infinity) is NaN.
    below = -torch.special.log_ndtr(torch.where(censored, z, 0.0))
    seen = 0.5 * torch.where(censored, 0.0, z) ** 2 + log_sd + HALF_LOG_2PI
    return torch.where(censored, below, seen)


def detection_probability(mean_db: np.ndarray, sd_db: np.ndarray,
                          limit_db: np.ndarray | float) -> np.ndarray:
    """Return the probability that a level lies above the limit; the arguments broadcast.

    Args:
        mean_db: expected [dB].
        sd_db: standard deviation [dB].
        limit_db: limit of detection [dB]; -inf: everything is detected.

    Returns:
        in 0..1, of the broadcast shape.
    """
    return ndtr((mean_db - limit_db) / sd_db)
