"""Find curves that vary along a variable (time, direction) more than their peers do.

A curve is a group that is cut into bins along the variable. It varies by the standard deviation of
the bins' levels beyond their errors. Model errors let all curves vary a little; a curve stands out
if it varies more than its peers. The evidence is the marginal likelihood over that standard
deviation, on a grid, as in a random-effects model (Searle, Casella, McCulloch 1992, Variance
components): all bins together show a cycle that no single bin shows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp
from scipy.stats import norm
from scipy.stats import t as student_t

from radiotwin.inference.gaussian import MAD_SD
from radiotwin.inference.groups import Statistic

SD_GRID = np.geomspace(0.05, 40.0, 64)  # standard deviations of the bins of a curve [dB]
LOG_GRID = np.log(SD_GRID)
MIN_BINS = 4
BIN_DOF = 5.0  # degrees of freedom of a bin's level: single bins may be far off
LEAST_ERROR = 0.5  # least factor on the errors, if bins scatter less than their errors
PEERS_LOG_SD = 0.4  # sd of log(standard deviation) between peers
PRIOR_LOG_SD = 0.7  # sd of the prior of their common log(standard deviation)
OUTLIER_SHARE = 0.1  # share of peers that may stand out themselves
OUTLIER_LOG_SD = 0.8  # sd of log(standard deviation) of curves that stand out


@dataclass(frozen=True, eq=False)
class Curves:
    """Variation of p curves with k bins in all.

    Attributes:
        log_likelihood: (p, grid) of each standard deviation in `SD_GRID`; 0 if not judged.
        log_null: (p,) log likelihood as one of its peers.
        judged: (p,) bool, whether at least MIN_BINS bins of the curve have a level.
        bins: part of the data -> level of each bin minus the median of its curve (k,), with errors.
    """

    log_likelihood: np.ndarray
    log_null: np.ndarray
    judged: np.ndarray
    bins: Mapping[str, Statistic]

    def log_odds(self, usual_sd: float, prior_odds: float) -> np.ndarray:
        """Compute the log odds (p,) that a curve's bins vary more than its peers'; NaN: not judged.

        Args:
            usual_sd: median standard deviation of the bins of a curve that stands out.
            prior_odds: prior odds that one of all curves stands out, divided among the judged ones.
        """
        log_prior = _log_normal(np.log(usual_sd), OUTLIER_LOG_SD)
        odds = logsumexp(self.log_likelihood + log_prior, axis=1) - self.log_null
        odds += np.log(prior_odds / max(self.judged.sum(), 1))
        return np.where(self.judged, odds, np.nan)

    def sd(self, quantile: float) -> np.ndarray:
        """Compute a posterior quantile (p,) of the sd of each judged curve's bins [dB]."""
        weight = np.exp(self.log_likelihood - self.log_likelihood.max(axis=1, keepdims=True))
        share = np.cumsum(weight, axis=1)
        share /= share[:, -1:]
        return SD_GRID[np.argmax(share >= quantile, axis=1)]

    @property
    def size(self) -> np.ndarray:
        """(p,) posterior median of the standard deviation of the bins [dB]; NaN = not judged."""
        return np.where(self.judged, self.sd(0.5), np.nan)

    def fitted(self, curve: int, part: str) -> np.ndarray:
        """Shrink each bin's level (k,) in a part of the data towards 0, more if its error is large.

        Args:
            curve: index of the curve whose standard deviation sets the shrinkage.
            part: name of the part of the data; bins without a level are 0.
        """
        bins, variance = self.bins[part], float(self.sd(0.5)[curve]) ** 2
        shrunk = bins.value * variance / (variance + bins.error**2)
        return np.where(np.isfinite(shrunk), shrunk, 0.0)


def compare_curves(found: Statistic, curve: np.ndarray, prior_sd: float, part: str) -> Curves:
    """Estimate how much each curve varies over its bins, and how likely peers vary as much.

    `found` are levels of k bins, `curve` (k,) each bin's curve, `prior_sd` the sd [dB] of the bins
    of a curve that does not stand out, `part` the name of this part of the data.
    """
    count = int(curve.max()) + 1
    known = np.isfinite(found.value) & (found.error > 0)
    deviation = np.where(known, found.value, np.nan)
    for each in range(count):
        of_curve = known & (curve == each)
        if of_curve.any():
            deviation[of_curve] -= np.median(found.value[of_curve])
    error = found.error
    if known.any():
        error = error * np.clip(MAD_SD * np.median(np.abs(deviation[known] / error[known])),
                                LEAST_ERROR, 1.0)
    log_likelihood = np.zeros((count, len(SD_GRID)))
    scale = np.hypot(error[known][:, None], SD_GRID)
    np.add.at(log_likelihood, curve[known],
              student_t.logpdf(deviation[known][:, None], BIN_DOF, scale=scale))
    judged = np.bincount(curve[known], minlength=count) >= MIN_BINS
    log_likelihood[~judged] = 0.0
    return Curves(log_likelihood, _log_null(log_likelihood, judged, prior_sd), judged,
                  {part: Statistic(deviation, error)})


def combine_curves(parts: list[Curves]) -> Curves:
    """Add the log-likelihoods of the same curves over several parts of the data."""
    return Curves(sum((each.log_likelihood for each in parts), np.zeros(1)),
                  sum((each.log_null for each in parts), np.zeros(1)),
                  np.any([each.judged for each in parts], axis=0),
                  {part: bins for each in parts for part, bins in each.bins.items()})


def _log_normal(middle: float | np.ndarray, log_sd: float) -> np.ndarray:
    """Compute log probabilities (…, grid) of a log-normal standard deviation of log median (…)."""
    density = norm.logpdf(LOG_GRID, np.expand_dims(middle, -1), log_sd)
    return density - logsumexp(density, axis=-1, keepdims=True)


OF_PEERS = _log_normal(LOG_GRID, PEERS_LOG_SD)  # (grid, grid), row: common standard deviation


def _log_null(log_likelihood: np.ndarray, judged: np.ndarray, prior_sd: float) -> np.ndarray:
    """Compute the log likelihood (p,) that each curve varies as its peers do, leave-one-out."""
    given = logsumexp(log_likelihood[:, None] + OF_PEERS, axis=2)
    anywhere = logsumexp(log_likelihood - np.log(len(SD_GRID)), axis=1)
    robust = np.logaddexp(np.log1p(-OUTLIER_SHARE) + given,
                          np.log(OUTLIER_SHARE) + anywhere[:, None])
    robust[~judged] = 0.0
    common = _log_normal(np.log(prior_sd), PRIOR_LOG_SD) + robust.sum(axis=0) - robust
    common -= logsumexp(common, axis=1, keepdims=True)
    return np.where(judged, logsumexp(common + given, axis=1), 0.0)
