"""Gaussian Tobit model: likelihood of left-censored levels, and the log-distance line fitted by it.

The torch form stays beside the NumPy one: it takes log(sd), whose gradient training needs, and
masks the branch that is not taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.special import log_ndtr

if TYPE_CHECKING:
    import torch

MAD_SD = 1.4826  # standard deviation over median absolute deviation of a normal distribution
HALF_LOG_2PI = 0.5 * np.log(2.0 * np.pi)
Limit = float | np.ndarray | None
"""Limit of detection [dB], scalar or (n,); None or -inf: unknown."""
MIN_SD_DB, MAX_SD_DB = 0.1, 100.0  # bounds of a fitted standard deviation, far outside real ones
EXPONENT_PRIOR = 3.0, 2.0  # mean and sd; decides only where all distances are nearly equal


def robust_sd(values: np.ndarray) -> float:
    """Estimate the standard deviation of values (n,) from their median absolute deviation."""
    return MAD_SD * float(np.median(np.abs(values - np.median(values))))


def limits_of(limit_db: Limit, n: int) -> np.ndarray:
    """Return the limit of detection of n links as a read-only array (n,) [dB]; -inf: unknown."""
    return np.broadcast_to(np.asarray(-np.inf if limit_db is None else limit_db, float), n)


def gaussian_nll(level_db: np.ndarray, mean_db: np.ndarray, sd_db: np.ndarray,
                 limit_db: Limit) -> np.ndarray:
    """Compute the negative log-likelihood [nats] of each level [dB] under the Gaussian Tobit model.

    The arguments broadcast. NaN is not detected, and contributes -log P(level < limit) = -log
    Phi((limit - mean) / sd) (Tobin 1958, 'Estimation of relationships for limited dependent
    variables'), or 0 if the limit is unknown.
    """
    missing = np.isnan(level_db)
    of_detected = 0.5 * ((level_db - mean_db) / sd_db) ** 2 + np.log(sd_db) + HALF_LOG_2PI
    if not missing.any():
        return of_detected
    if limit_db is None:
        return np.where(missing, 0.0, of_detected)
    of_blank = np.where(np.isneginf(limit_db), 0.0, -log_ndtr((limit_db - mean_db) / sd_db))
    return np.where(missing, of_blank, of_detected)


def mean_if_detected(mean_db: np.ndarray, sd_db: np.ndarray,
                     limit_db: np.ndarray | float) -> np.ndarray:
    """Compute the mean of a level given that it is above the limit [dB]; the arguments broadcast.

    Compare measured levels with this mean: near the limit only the strong links were detected.
    Truncated normal: mean + sd * phi(a) / Phi(-a), a = (limit - mean) / sd (Johnson, Kotz and
    Balakrishnan 1994, section 13.10.1). A limit of -inf means that every link is detected.
    """
    return mean_db + sd_db * _mills_ratio((mean_db - limit_db) / sd_db)


def _mills_ratio(z: np.ndarray) -> np.ndarray:
    """Compute phi(z) / Phi(z) of the standard normal distribution without underflow."""
    return np.exp(-0.5 * z**2 - HALF_LOG_2PI - log_ndtr(z))


def standardised(level_db: np.ndarray, mean_db: np.ndarray, sd_db: np.ndarray,
                 limit_db: Limit) -> np.ndarray:
    """Compute the standardised residual (level - mean) / sd of each link; all are (n,).

    A blank with a known limit gets the conditional mean of a residual below the limit,
    -phi(a) / Phi(a), a = (limit - mean) / sd; one without, NaN.
    """
    residual = (level_db - mean_db) / sd_db
    missing = np.isnan(residual)
    if missing.any():
        limits_db = limits_of(limit_db, len(level_db))
        residual[missing] = -_mills_ratio((limits_db[missing] - mean_db[missing]) / sd_db[missing])
    return residual


def gaussian_nll_torch(level: torch.Tensor, mean: torch.Tensor, log_sd: torch.Tensor,
                       censored: torch.Tensor) -> torch.Tensor:
    """Compute `gaussian_nll` in torch, differentiable in mean and log_sd; everything broadcasts.

    `level` is the limit of detection where `censored` (bool); `log_sd` a natural logarithm.
    """
    import torch

    z = (level - mean) * torch.exp(-log_sd)
    # The branch that is not taken must stay finite, or its gradient (0 times infinity) is NaN.
    below = -torch.special.log_ndtr(torch.where(censored, z, 0.0))
    seen = 0.5 * torch.where(censored, 0.0, z) ** 2 + log_sd + HALF_LOG_2PI
    return torch.where(censored, below, seen)


@dataclass(frozen=True)
class LogDistanceLine:
    """Log-distance law: gain = intercept - 10 * exponent * log10(d / 1 m) + N(0, sd^2).

    Attributes:
        intercept_db: mean gain at 1 m [dB].
        exponent: path-loss exponent, positive where the gain falls with distance.
        sd_db: standard deviation [dB].
    """

    intercept_db: float
    exponent: float
    sd_db: float

    def mean_db(self, log_distance: np.ndarray) -> np.ndarray:
        """Compute the mean gain [dB] at log10(d / 1 m), any shape."""
        return self.intercept_db - 10.0 * self.exponent * log_distance


def fit_line(log_distance: np.ndarray, level_db: np.ndarray,
             limit_db: Limit) -> LogDistanceLine:
    """Fit the log-distance line by Tobit maximum likelihood, with a weak prior on the exponent.

    At log10(d / 1 m) (n,), levels (n,) [dB], NaN: not detected, at least two detected; the limit
    must be known for every blank. The likelihood has one maximum only (Olsen 1978, 'Note on the
    uniqueness of the maximum likelihood estimator for the Tobit model', Econometrica 46), so the
    least-squares line through the detected levels is a safe start.
    """
    detected = ~np.isnan(level_db)
    x, y = log_distance[detected], level_db[detected]
    # Centred and scaled, as L-BFGS needs parameters of similar size.
    x_mid, x_scale, y_mid = x.mean(), max(float(x.std()), 1e-3), y.mean()
    u, v = (x - x_mid) / x_scale, y - y_mid
    u_below = (log_distance[~detected] - x_mid) / x_scale
    limit = limits_of(limit_db, len(level_db))[~detected] - y_mid
    prior_loss, prior_sd = (10.0 * x_scale * value for value in EXPONENT_PRIOR)

    def negative_log_posterior(theta: np.ndarray) -> tuple[float, np.ndarray]:
        level, slope, log_sd = theta
        h = np.exp(-log_sd)
        z, z_below = h * (v - level - slope * u), h * (limit - level - slope * u_below)
        ratio, z_prior = _mills_ratio(z_below), (slope + prior_loss) / prior_sd
        value = 0.5 * z @ z + len(z) * log_sd - log_ndtr(z_below).sum() + 0.5 * z_prior**2
        gradient = [
            h * (ratio.sum() - z.sum()),
            h * (ratio @ u_below - z @ u) + z_prior / prior_sd,
            len(z) - z @ z + ratio @ z_below,
        ]
        return value / len(level_db), np.array(gradient) / len(level_db)

    slope = float(u @ v) / max(float(u @ u), 1e-9)
    log_floor = np.log(MIN_SD_DB)
    start = np.array([0.0, slope, max(np.log(np.std(v - slope * u) + 1e-9), log_floor)])
    bounds = [(None, None), (None, None), (log_floor, None)]
    level, slope, log_sd = minimize(negative_log_posterior, start, jac=True, method="L-BFGS-B",
                                    bounds=bounds, options={"ftol": 1e-14, "gtol": 1e-8}).x
    slope_db = slope / x_scale
    return LogDistanceLine(float(y_mid + level - slope_db * x_mid), float(-slope_db / 10.0),
                           float(np.exp(log_sd)))


def shift_line(line: LogDistanceLine, log_distance: np.ndarray, level_db: np.ndarray,
               limit_db: Limit, prior_db: float, prior_sd_db: float) -> LogDistanceLine:
    """Shift a line up or down to fit few or no levels: maximum a posteriori of the intercept.

    Levels (n,) [dB] at log10(d / 1 m) (n,); NaN: not detected, which contributes nothing if the
    limit is unknown. The shift has a normal prior of `prior_db` and `prior_sd_db`.
    """

    def negative_log_posterior(shift_db: float) -> float:
        mean_db = line.mean_db(log_distance) + shift_db
        nll = gaussian_nll(level_db, mean_db, np.asarray(line.sd_db), limit_db).sum()
        return nll + 0.5 * ((shift_db - prior_db) / prior_sd_db) ** 2

    reach_db = 10.0 * prior_sd_db
    bounds = (prior_db - reach_db, prior_db + reach_db)
    shift_db = minimize_scalar(negative_log_posterior, bounds=bounds, method="bounded").x
    return LogDistanceLine(line.intercept_db + float(shift_db), line.exponent, line.sd_db)


def fit_sd_db(level_db: np.ndarray, mean_db: np.ndarray, limit_db: Limit) -> float:
    """Fit the standard deviation [dB] of levels (n,) about means (n,) by Tobit maximum likelihood.

    From MIN_SD_DB to MAX_SD_DB. NaN: not detected; such a blank needs a limit to contribute.
    """

    def negative_log_likelihood(log_sd: float) -> float:
        return gaussian_nll(level_db, mean_db, np.exp(log_sd), limit_db).sum()

    bounds = (np.log(MIN_SD_DB), np.log(MAX_SD_DB))
    log_sd = minimize_scalar(negative_log_likelihood, bounds=bounds, method="bounded").x
    return float(np.exp(log_sd))
