"""Covariance of estimates from rows that err alike in clusters.

The sandwich A⁻¹ M A⁻¹ (Liang and Zeger 1986, 'Longitudinal data analysis using generalized linear
models', Biometrika 73): A is the information of all rows, M the sum of the squares of the clusters'
scores. With few clusters instead: the fit, linearised, without each (the jackknife CV3 of
MacKinnon, Nielsen and Webb 2023, 'Fast and reliable jackknife and bootstrap methods for
cluster-robust inference', Journal of Applied Econometrics 38). A prior counts as one more
observation, in both. How many clusters a parameter hangs on
decides the quantile of Student's t (Carter, Schnepel and Steigerwald 2017, 'Asymptotic behavior of
a t-test robust to cluster heterogeneity', Review of Economics and Statistics 99).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, issparse
from scipy.stats import norm, t

MIN_CLUSTERS = 1.5  # effective ones, below which a way to cluster says nothing of a parameter
MAX_LEFT_OUT = 50  # clusters, up to which the fit without each is looked at
MAX_WIDTH = 3.0  # of an interval without some data, over that with all: a wider one is the prior's
QUANTILE = 0.95  # upper end of a 90 % interval


@dataclass(frozen=True, eq=False)
class Scores:
    """How n rows and a prior bear on q parameters, at their best fit.

    Attributes:
        score: (n, q) slope of each row's log-likelihood.
        root: (m, q) whose square root' root is the information of the rows; m = k n, and row i of
            it belongs to row i modulo n.
        precision: (q,) of the prior as the fit has taken it.
        prior_score_variance: (q,) variance of the prior's own score.
    """

    score: np.ndarray | csr_array
    root: np.ndarray | csr_array
    precision: np.ndarray
    prior_score_variance: np.ndarray

    @property
    def bread(self) -> np.ndarray:
        """(q, q) inverse of the information of rows and prior."""
        return np.linalg.inv(_dense(self.root.T @ self.root) + np.diag(self.precision + 1e-12))

    def covariances(self, clusterings: list[np.ndarray]) -> list[np.ndarray]:
        """Return covariances (q, q) whose 1.645 standard deviations are the end of 90 % intervals.

        First that of independent rows, then of each clustering, with its t quantile. The interval
        of a parameter, or of a sum or difference of some, is the widest of them. What hangs on too
        few clusters has the standard deviation of independent rows.

        Args:
            clusterings: (n,) integer labels of rows that err alike, such as places, or flights.
        """
        bread, information = self.bread, _dense(self.root.T @ self.root)
        alone = bread @ (information + np.diag(self.prior_score_variance)) @ bread
        found = [alone]
        for label in clusterings:
            own = np.unique(label, return_inverse=True)[1].ravel()
            count = own.max() + 1
            if count < 2:
                continue
            clustered = self._clustered(bread, own, count)
            clustered += bread @ np.diag(self.prior_score_variance) @ bread
            clusters = self._effective_clusters(bread, own, count)
            widening = t.ppf(QUANTILE, np.maximum(clusters - 1, 1.0)) / norm.ppf(QUANTILE)
            own_sd = np.sqrt(np.maximum(np.diag(clustered), 1e-300))
            sd = np.where(clusters >= MIN_CLUSTERS, own_sd * widening, np.sqrt(np.diag(alone)))
            found.append(clustered * np.outer(sd / own_sd, sd / own_sd))
        return found

    def _clustered(self, bread: np.ndarray, own: np.ndarray, count: int) -> np.ndarray:
        """Return the covariance (q, q) by clusters (n,) that err by themselves.

        Few clusters bend the fit towards themselves: then by how far it moves without each. Without
        the only cluster that determines a parameter it moves to the prior, which does not count.
        """
        sums = _by_cluster(self.score, own, count)
        if count > MAX_LEFT_OUT:
            return count / (count - 1) * bread @ (sums.T @ sums) @ bread
        every = _dense(self.root.T @ self.root) + np.diag(self.precision + 1e-12)
        rows = np.tile(own, self.root.shape[0] // len(own))
        moves = np.empty_like(sums)
        for number in range(count):
            mine = self.root[np.flatnonzero(rows == number)]
            without = np.linalg.inv(every - _dense(mine.T @ mine))
            determined = np.diag(without) <= MAX_WIDTH**2 * np.diag(bread)
            moves[number] = np.where(determined, without @ sums[number], 0.0)
        return (count - 1) / count * moves.T @ moves

    def _effective_clusters(self, bread: np.ndarray, own: np.ndarray, count: int) -> np.ndarray:
        """Return (q,) number of equal clusters that would bear on a parameter as these do."""
        influence = self.root @ bread
        times = influence.shape[0] // len(own)
        share = _by_cluster(influence**2, np.tile(own, times), count)
        return share.sum(axis=0)**2 / np.maximum((share**2).sum(axis=0), 1e-300)


def _by_cluster(rows: np.ndarray | csr_array, own: np.ndarray, count: int) -> np.ndarray:
    """Return the sums (count, q) of rows (n, q) by their cluster (n,)."""
    members = csr_array((np.ones(len(own)), (own, np.arange(len(own)))), shape=(count, len(own)))
    return _dense(members @ rows)


def _dense(matrix: np.ndarray | csr_array) -> np.ndarray:
    return matrix.toarray() if issparse(matrix) else np.asarray(matrix)  # type: ignore[union-attr]
