"""Groups of values that change along a variable more than their peers do.

A curve is a group whose bins along a variable (time, direction) have levels of their own. How much
it changes is the standard deviation of these levels beyond their errors. Errors of a model let all
curves change a little; a curve stands out if it changes more than its peers. Its evidence is the
marginal likelihood over that standard deviation, on a grid, as in a random-effects model (Searle,
Casella, McCulloch 1992, Variance components): a cycle that no single bin shows is seen in all bins
together.
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

SD_GRID = np.geomspace(0.05, 40.0, 64)  # dB
LOG_GRID = np.log(SD_GRID)
MIN_BINS = 4
BIN_DOF = 5.0  # of a bin's level: single bins may be far off
LEAST_ERROR = 0.5  # of what errors say, where bins are closer together
PEERS_LOG_SD = 0.4  # by which peers' standard deviations differ
PRIOR_LOG_SD = 0.7  # of what they have in common
OUTLIER_SHARE = 0.1  # of peers that stand out themselves
OUTLIER_LOG_SD = 0.8  # of the standard deviation of a curve that stands out


@dataclass(frozen=True, eq=False)
class Curves:
    """How much p curves of k bins change.

    Attributes:
        log_likelihood: (p, grid) of each standard deviation of `SD_GRID`; 0 of one that is not
            judged.
        log_null: (p,) log likelihood as one of its peers.
        judged: (p,) bool.
        bins: level of each bin less that of its curve (k,), with its error, by part of the data.
    """

    log_likelihood: np.ndarray
    log_null: np.ndarray
    judged: np.ndarray
    bins: Mapping[str, Statistic]

    def log_odds(self, usual_sd: float, prior_odds: float) -> np.ndarray:
        """Return the log odds (p,) that a curve changes more than its peers; NaN = not judged.

        Args:
            usual_sd: of the bins of a curve that stands out, its median.
            prior_odds: that one of all curves stands out, shared among those that are judged.
        """
        log_prior = _log_normal(np.log(usual_sd), OUTLIER_LOG_SD)
        odds = logsumexp(self.log_likelihood + log_prior, axis=1) - self.log_null
        odds += np.log(prior_odds / max(self.judged.sum(), 1))
        return np.where(self.judged, odds, np.nan)

    def sd(self, quantile: float) -> np.ndarray:
        """Return a quantile (p,) of the standard deviation of each curve's bins."""
        weight = np.exp(self.log_likelihood - self.log_likelihood.max(axis=1, keepdims=True))
        share = np.cumsum(weight, axis=1)
        share /= share[:, -1:]
        return SD_GRID[np.argmax(share >= quantile, axis=1)]

    @property
    def size(self) -> np.ndarray:
        """(p,) standard deviation of the bins; NaN = not judged."""
        return np.where(self.judged, self.sd(0.5), np.nan)

    def fitted(self, curve: int, part: str) -> np.ndarray:
        """Return the levels (k,) of a curve's bins in one part of the data, shrunk by their errors.

        Args:
            curve: whose standard deviation is taken.
            part: of the data. A bin that is not judged is 0.
        """
        bins, variance = self.bins[part], float(self.sd(0.5)[curve]) ** 2
        shrunk = bins.value * variance / (variance + bins.error**2)
        return np.where(np.isfinite(shrunk), shrunk, 0.0)


def curves(found: Statistic, curve: np.ndarray, prior_sd: float, part: str) -> Curves:
    """Return how much curves change, beside their peers.

    Args:
        found: level of each of k bins.
        curve: (k,) number of the curve that a bin is of.
        prior_sd: standard deviation of the bins of a curve that does not stand out.
        part: name of this part of the data.
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


def curves_together(parts: list[Curves]) -> Curves:
    """Return the same curves in several parts of the data, whose bins change as much."""
    return Curves(sum((each.log_likelihood for each in parts), np.zeros(1)),
                  sum((each.log_null for each in parts), np.zeros(1)),
                  np.any([each.judged for each in parts], axis=0),
                  {part: bins for each in parts for part, bins in each.bins.items()})


def _log_normal(middle: float | np.ndarray, log_sd: float) -> np.ndarray:
    """Return log probabilities (…, grid) of a log-normal standard deviation with a middle (…)."""
    density = norm.logpdf(LOG_GRID, np.expand_dims(middle, -1), log_sd)
    return density - logsumexp(density, axis=-1, keepdims=True)


OF_PEERS = _log_normal(LOG_GRID, PEERS_LOG_SD)  # (grid, grid) by what they have in common


def _log_null(log_likelihood: np.ndarray, judged: np.ndarray, prior_sd: float) -> np.ndarray:
    """Return the log likelihood (p,) of each curve as one of the others.

    What peers have in common is inferred from the prior and all others, some of which may stand
    out themselves.
    """
    given = logsumexp(log_likelihood[:, None] + OF_PEERS, axis=2)
    anywhere = logsumexp(log_likelihood - np.log(len(SD_GRID)), axis=1)
    robust = np.logaddexp(np.log1p(-OUTLIER_SHARE) + given,
                          np.log(OUTLIER_SHARE) + anywhere[:, None])
    robust[~judged] = 0.0
    common = _log_normal(np.log(prior_sd), PRIOR_LOG_SD) + robust.sum(axis=0) - robust
    common -= logsumexp(common, axis=1, keepdims=True)
    return np.where(judged, logsumexp(common + given, axis=1), 0.0)
