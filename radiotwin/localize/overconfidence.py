"""Correction for correlated residuals: how many of a device's links count as one.

A channel model that is wrong in one street is wrong in the same way at every position along it.
Multiplying the likelihoods of all links as if they were independent then claims too small a
credible region. The remedy here is a composite likelihood [1]: the log-likelihood is divided by the
design effect, the factor by which correlation between residuals widens the distribution of the
position's estimate beyond what independence would give.

[1] Varin, Reid, Firth, "An overview of composite likelihood methods", Statistica Sinica 21, 2011,
section 2.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import pdist, squareform

BIN_M, N_BINS = 20.0, 20  # width of a bin of distance [m], and number of bins
SIGNIFICANT = 3.0  # standard errors above which a correlation is taken for real
MAX_Z = 3.0  # an outlier counts as this many standard deviations
MAX_POSITIONS = 1500  # of one device: memory grows with their square


@dataclass(frozen=True)
class DeviceResiduals:
    """Residuals of a device at its most likely position.

    Attributes:
        receiver_m: (n, 3) positions of the receivers [m].
        z: (n,) residuals in standard deviations.
        slope: (n, 2) change of the link's mean with the device's x and y at constant line of sight,
            in standard deviations per metre.
    """

    receiver_m: np.ndarray
    z: np.ndarray
    slope: np.ndarray

    def thinned(self) -> DeviceResiduals:
        """Return at most MAX_POSITIONS of them, evenly over the rows, with outliers clipped."""
        pick = slice(None, None, -(-len(self.z) // MAX_POSITIONS) or 1)
        return DeviceResiduals(self.receiver_m[pick], np.clip(self.z[pick], -MAX_Z, MAX_Z),
                               self.slope[pick])


def residual_correlation(devices: list[DeviceResiduals]) -> np.ndarray:
    """Return the correlation of residuals by distance between receivers, pooled over devices.

    Args:
        devices: residuals of each.

    Returns:
        (N_BINS,) in bins of BIN_M. It is 0 from the first bin on that is not above SIGNIFICANT
        standard errors of independent residuals, so that uncorrelated data give zeros.
    """
    product, pairs, square, n = np.zeros(N_BINS), np.zeros(N_BINS), 0.0, 0
    for each in devices:
        if len(each.z) < 2:
            continue
        bins = np.minimum((pdist(each.receiver_m) / BIN_M).astype(int), N_BINS)
        first, second = np.triu_indices(len(each.z), k=1)
        product += np.bincount(bins, each.z[first] * each.z[second], N_BINS + 1)[:N_BINS]
        pairs += np.bincount(bins, minlength=N_BINS + 1)[:N_BINS]
        square += float(each.z @ each.z)
        n += len(each.z)
    if n == 0 or square == 0.0:
        return np.zeros(N_BINS)
    correlation = product / np.maximum(pairs, 1) / (square / n)
    noise = (pairs > 0) & (correlation <= SIGNIFICANT / np.sqrt(np.maximum(pairs, 1)))
    return np.where(np.cumsum(noise) > 0, 0.0, correlation)


def design_effect(residuals: DeviceResiduals, correlation: np.ndarray) -> float:
    """Return the factor by which to divide a device's log-likelihood.

    trace(H^-1 J) / 2 with H = sum_i a_i a_i', J = sum_ij rho_ij a_i a_j' over the slopes a: the
    mean widening of the position's variance; times the residuals' mean square, where that is above
    1 (the standard deviation is too small).

    Args:
        residuals: of the device.
        correlation: (N_BINS,) as from `residual_correlation`.

    Returns:
        at least 1
    """
    if len(residuals.z) < 3:
        return 1.0
    bins = np.minimum((squareform(pdist(residuals.receiver_m)) / BIN_M).astype(int), N_BINS)
    rho = np.append(correlation, 0.0)[bins]
    np.fill_diagonal(rho, 1.0)
    information = residuals.slope.T @ residuals.slope
    score_covariance = residuals.slope.T @ rho @ residuals.slope
    widening = np.trace(np.linalg.pinv(information) @ score_covariance) / 2.0
    return float(max(1.0, widening) * max(1.0, np.mean(residuals.z**2)))
