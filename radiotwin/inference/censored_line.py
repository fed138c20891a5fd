"""Maximum-likelihood log-distance line through levels of which some were not detected (Tobit regression)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.special import log_ndtr

from radiotwin.inference.gaussian import HALF_LOG_2PI, gaussian_nll

MIN_SIGMA_DB = 0.1
EXPONENT_PRIOR = (-3.0, 2.0)
"""Mean and standard deviation of a normal prior: decides only where the distances hardly differ."""


@dataclass(frozen=True)
class LogDistanceLine:
    """gain = intercept + 10 * exponent * log10(d / 1 m) + N(0, sigma^2), the log-distance law."""

    intercept_db: float
    exponent: float
    sigma_db: float

    def mean_db(self, log_distance: np.ndarray) -> np.ndarray:
        """Mean gain [dB] at log10(d / 1 m), any shape."""
        return self.intercept_db + 10.0 * self.exponent * log_distance


def fit_line(log_distance: np.ndarray, level_db: np.ndarray, limit_db: float | None) -> LogDistanceLine:
    """The line of highest likelihood, with a weak prior on the exponent.

    log_distance: (n,) log10(d / 1 m); level_db: (n,), NaN = below limit_db. At least two detected levels.

    The Tobit likelihood has one maximum only (Olsen 1978, 'Note on the uniqueness of the maximum likelihood
    estimator for the Tobit model', Econometrica 46), so the least-squares line through the detected is a safe start.
    """
    detected = ~np.isnan(level_db)
    x, y = log_distance[detected], level_db[detected]
    # Centred and scaled: L-BFGS wants parameters of about one size.
    x_mid, x_scale, y_mid = x.mean(), max(float(x.std()), 1e-3), y.mean()
    u, v = (x - x_mid) / x_scale, y - y_mid
    u_below, limit = (log_distance[~detected] - x_mid) / x_scale, (limit_db or 0.0) - y_mid
    prior_slope, prior_spread = (10.0 * x_scale * value for value in EXPONENT_PRIOR)

    def objective(theta: np.ndarray) -> tuple[float, np.ndarray]:
        level, slope, log_sigma = theta
        h = np.exp(-log_sigma)
        z, z_below = h * (v - level - slope * u), h * (limit - level - slope * u_below)
        log_phi = log_ndtr(z_below)
        ratio = np.exp(-0.5 * z_below**2 - HALF_LOG_2PI - log_phi)
        pull = (slope - prior_slope) / prior_spread
        value = 0.5 * z @ z + len(z) * log_sigma - log_phi.sum() + 0.5 * pull**2
        gradient = [
            h * (ratio.sum() - z.sum()),
            h * (ratio @ u_below - z @ u) + pull / prior_spread,
            len(z) - z @ z + ratio @ z_below,
        ]
        return value / len(level_db), np.array(gradient) / len(level_db)

    slope = float(u @ v) / max(float(u @ u), 1e-9)
    log_floor = np.log(MIN_SIGMA_DB)
    start = np.array([0.0, slope, max(np.log(np.std(v - slope * u) + 1e-9), log_floor)])
    bounds = [(None, None), (None, None), (log_floor, None)]
    found = minimize(
        objective, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-14, "gtol": 1e-8}
    )
    level, slope, log_sigma = found.x
    slope_db = slope / x_scale
    return LogDistanceLine(
        float(y_mid + level - slope_db * x_mid), float(slope_db / 10.0), float(np.exp(log_sigma))
    )


def shift_line(
    line: LogDistanceLine,
    log_distance: np.ndarray,
    level_db: np.ndarray,
    limit_db: float | None,
    prior_db: float,
    spread_db: float,
) -> LogDistanceLine:
    """The line moved up or down to few or no levels: a maximum a posteriori shift with the prior N(prior, spread^2).

    log_distance, level_db: (n,) as in `fit_line`; n may be 0, then the shift is the prior's mean.
    """

    def objective(shift_db: float) -> float:
        mean_db = line.mean_db(log_distance) + shift_db
        nll = gaussian_nll(level_db, mean_db, np.asarray(line.sigma_db), limit_db).sum()
        return nll + 0.5 * ((shift_db - prior_db) / spread_db) ** 2

    reach_db = 10.0 * spread_db
    shift_db = minimize_scalar(
        objective, bounds=(prior_db - reach_db, prior_db + reach_db), method="bounded"
    ).x
    return LogDistanceLine(line.intercept_db + float(shift_db), line.exponent, line.sigma_db)


def fit_sigma(level_db: np.ndarray, mean_db: np.ndarray, limit_db: float | None) -> float:
    """The standard deviation [dB] of highest likelihood around given means, (n,) each, NaN = below limit_db."""

    def objective(log_sigma: float) -> float:
        return gaussian_nll(level_db, mean_db, np.exp(log_sigma), limit_db).sum()

    return float(
        np.exp(minimize_scalar(objective, bounds=(np.log(MIN_SIGMA_DB), np.log(100.0)), method="bounded").x)
    )
