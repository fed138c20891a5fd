"""Compute cluster-robust covariances of estimates whose rows have correlated errors.

The sandwich A⁻¹ M A⁻¹ (Liang and Zeger 1986, 'Longitudinal data analysis using generalized linear
models', Biometrika 73): A is the information of all rows, M the sum of squares of the clusters'
scores. With few clusters, the linearised leave-one-cluster-out jackknife instead (CV3 of MacKinnon,
Nielsen and Webb 2023, 'Fast and reliable jackknife and bootstrap methods for cluster-robust
inference', Journal of Applied Econometrics 38). In both a prior counts as one more observation. The
effective number of clusters of a parameter sets the degrees of freedom of its Student t quantile
(Carter, Schnepel and Steigerwald 2017, 'Asymptotic behavior of a t-test robust to cluster
heterogeneity', Review of Economics and Statistics 99).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, issparse
from scipy.stats import norm, t

MIN_CLUSTERS = 1.5  # effective clusters below which a clustering is ignored for a parameter
MAX_LEFT_OUT = 50  # clusters up to which the jackknife replaces the sandwich
MAX_WIDTH = 3.0  # interval without a cluster over that with all; if wider, the prior decides it
QUANTILE = 0.95  # upper end of a 90 % interval


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores and information of n rows and a prior about q parameters, at the best fit.

    Attributes:
        score: (n, q) gradient of each row's log-likelihood.
        root: (m, q) with root' root = information of the rows; m = k n, and row i belongs to data
            row i modulo n.
        precision: (q,) precision of the prior in the fit.
        prior_score_variance: (q,) variance of the prior's score.
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
        """Compute covariances (q, q), each scaled so that ±1.645 sd is a 90 % interval.

        The first is for independent rows, then one per clustering (n,), e.g. by place or
        flight, of two or more clusters, its sd widened by Student's t. The interval of a parameter,
        or contrast, is the widest of them. With too few effective clusters, a parameter keeps the
        sd of independent rows.
        """
        bread, information = self.bread, _dense(self.root.T @ self.root)
        independent = bread @ (information + np.diag(self.prior_score_variance)) @ bread
        found = [independent]
        for label in clusterings:
            cluster = np.unique(label, return_inverse=True)[1].ravel()
            count = cluster.max() + 1
            if count < 2:
                continue
            clustered = self._clustered(bread, information, cluster, count)
            clustered += bread @ np.diag(self.prior_score_variance) @ bread
            effective = self._effective_clusters(bread, cluster, count)
            widening = t.ppf(QUANTILE, np.maximum(effective - 1, 1.0)) / norm.ppf(QUANTILE)
            clustered_sd = np.sqrt(np.maximum(np.diag(clustered), 1e-300))
            sd = np.where(effective >= MIN_CLUSTERS, clustered_sd * widening,
                          np.sqrt(np.diag(independent)))
            found.append(clustered * np.outer(sd / clustered_sd, sd / clustered_sd))
        return found

    def _clustered(self, bread: np.ndarray, information: np.ndarray, cluster: np.ndarray,
                   count: int) -> np.ndarray:
        """Compute the covariance (q, q) for clusters (n,) with independent errors.

        The jackknife skips a parameter that only the prior would determine without a cluster.
        """
        sums = _sum_by_cluster(self.score, cluster, count)
        if count > MAX_LEFT_OUT:
            return count / (count - 1) * bread @ (sums.T @ sums) @ bread
        information = information + np.diag(self.precision + 1e-12)
        rows = np.tile(cluster, self.root.shape[0] // len(cluster))
        changes = np.empty_like(sums)
        for number in range(count):
            root = self.root[np.flatnonzero(rows == number)]
            bread_without = np.linalg.inv(information - _dense(root.T @ root))
            determined = np.diag(bread_without) <= MAX_WIDTH**2 * np.diag(bread)
            changes[number] = np.where(determined, bread_without @ sums[number], 0.0)
        return (count - 1) / count * changes.T @ changes

    def _effective_clusters(self, bread: np.ndarray, cluster: np.ndarray, count: int) -> np.ndarray:
        """Compute the effective number of clusters (q,): (Σ s)² / Σ s² of squared influences s."""
        influence = self.root @ bread
        times = influence.shape[0] // len(cluster)
        share = _sum_by_cluster(influence**2, np.tile(cluster, times), count)
        return share.sum(axis=0)**2 / np.maximum((share**2).sum(axis=0), 1e-300)


def _sum_by_cluster(rows: np.ndarray | csr_array, cluster: np.ndarray, count: int) -> np.ndarray:
    """Sum rows (n, q) by their cluster (n,) into (count, q)."""
    n = len(cluster)
    members = csr_array((np.ones(n), (cluster, np.arange(n))), shape=(count, n))
    return _dense(members @ rows)


def _dense(matrix: np.ndarray | csr_array) -> np.ndarray:
    """Convert a sparse or dense matrix to a dense array."""
    return matrix.toarray() if issparse(matrix) else np.asarray(matrix)  # type: ignore[union-attr]
