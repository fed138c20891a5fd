"""Compute the evidence for a cause against residuals with spatially correlated model error.

A channel model lacks more than noise: walls are off on the map, materials differ. This model error
is a Gaussian field over positions and could explain part of any cause that has a position. So a
cause is judged by the marginal likelihood with it *and* that field, whose strength is fitted each
time (Kennedy and O'Hagan 2001, 'Bayesian calibration of computer models', J. R. Stat. Soc. B 63;
Brynjarsdóttir and O'Hagan 2014, Inverse Problems 30).

Residuals z = columns · b + field + noise, with b ~ N(0, prior²), a field of exponential correlation
(Gudmundson 1991) for each series and white noise. In the eigenbasis of a series' correlation matrix
the two variances are diagonal, so that one marginal likelihood costs as much as a regression.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.linalg import cho_factor, cho_solve, eigh
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

MAX_POINTS = 400  # points in a part of a series, the size of a matrix to decompose
MAX_ROWS = 8000  # rows of all series together
MIN_POINTS = 3  # points in a part; smaller parts are left out
# Correlation lengths [m]: shadowing decorrelates within 10 to 50 m (3GPP TR 38.901, Table 7.5-6).
# Longer ones would explain the effect of an antenna or a wrong position on a device's levels.
LENGTHS_M = (5.0, 12.0, 30.0)
# With a weak field the likelihood is nearly flat: a remaining slope must not add up to a nat.
PRECISION = {"maxfun": 60, "ftol": 1e-8, "gtol": 0.001}
START = np.array([0.0, -1.0])  # log(noise variance), log(field variance / noise variance)
BOUNDS = np.array([[-6.0, -7.0], [6.0, 7.0]])


@dataclass(frozen=True, eq=False)
class Columns:
    """Regression columns (n, q), and prior standard deviations (q,) of their coefficients."""

    values: np.ndarray
    prior_sd: np.ndarray

    def beside(self, other: Columns) -> Columns:
        """Stack the columns of both side by side."""
        return Columns(np.hstack([self.values, other.values]),
                       np.concatenate([self.prior_sd, other.prior_sd]))


@dataclass(frozen=True, eq=False)
class CorrelatedEvidence:
    """Marginal likelihood of residuals with a correlated model error.

    Attributes:
        rows: (m,) rows that are used, part after part.
        parts: slice of `rows` of each part of a series: links near each other; different parts
            count as not correlated.
        bases: eigenvectors of the correlation matrix of each part.
        spectrum: (m,) eigenvalues of all parts.
        length_m: correlation length [m].
    """

    rows: np.ndarray
    parts: list[slice]
    bases: list[np.ndarray]
    spectrum: np.ndarray
    length_m: float

    @classmethod
    def fit(cls, series: np.ndarray, position_m: np.ndarray, z: np.ndarray, nuisance: Columns,
            seed: int) -> Self:
        """Build the evidence for the correlation length with the highest marginal likelihood.

        Residuals z (n,), NaN: not used, at positions (n, 3) [m] have a field for each label of
        `series` (n,); `nuisance` is fitted in every likelihood. `seed` draws rows if there are more
        than `MAX_ROWS`; parts of fewer than `MIN_POINTS` are left out.
        """
        rng = np.random.default_rng(seed)
        chosen = []
        known = np.flatnonzero(np.isfinite(z))
        labels, member = np.unique(series[known], return_inverse=True)
        max_rows = max(MAX_ROWS // max(len(labels), 1), MIN_POINTS)
        for number in rng.permutation(len(labels))[:MAX_ROWS // MIN_POINTS]:
            rows = known[member == number]
            if len(rows) > max_rows:
                rows = np.sort(rng.choice(rows, max_rows, replace=False))
            chosen += [part for part in _split_by_position(rows, position_m)
                       if len(part) >= MIN_POINTS]
        tried = [cls._decomposed(chosen, position_m, length_m) for length_m in LENGTHS_M]
        return max(tried, key=lambda each: each.log_evidence(z, nuisance))

    @classmethod
    def _decomposed(cls, chosen: list[np.ndarray], position_m: np.ndarray,
                    length_m: float) -> Self:
        """Decompose the exponential correlation matrix of each part (rows) into eigenvectors."""
        ends = np.cumsum([0, *(len(rows) for rows in chosen)])
        parts = [slice(a, b) for a, b in zip(ends, ends[1:], strict=False)]
        bases, spectra = [], [np.zeros(0)]
        for rows in chosen:
            apart_m = cdist(position_m[rows], position_m[rows])
            values, vectors = eigh(np.exp(-apart_m / length_m))
            bases.append(vectors)
            spectra.append(np.maximum(values, 0.0))
        rows = np.concatenate([np.zeros(0, dtype=int), *chosen])
        return cls(rows, parts, bases, np.concatenate(spectra), length_m)

    def rotated(self, values: np.ndarray) -> np.ndarray:
        """Select `rows` of values (n, …), and transform them into the eigenbasis (m, …)."""
        used = values[self.rows]
        return np.concatenate([basis.T @ used[part] for part, basis in
                               zip(self.parts, self.bases, strict=True)]) if self.parts else used

    def log_evidence(self, z: np.ndarray, columns: Columns) -> float:
        """Compute the log marginal likelihood of residuals (n,), variances fitted [nats]."""
        return self.of_rotated(self.rotated(z), self.rotated(columns.values), columns.prior_sd)[0]

    def coefficients(self, z: np.ndarray, columns: Columns) -> tuple[np.ndarray, np.ndarray]:
        """Compute posterior mean (q,) and covariance (q, q) of the columns' coefficients.

        Noise and field variances are fitted to the residuals z (n,).
        """
        rotated, values = self.rotated(z), self.rotated(columns.values)
        theta = self.of_rotated(rotated, values, columns.prior_sd)[1]
        weighted = values.T / (np.exp(theta[0]) * (1.0 + np.exp(theta[1]) * self.spectrum))
        covariance = np.linalg.inv(weighted @ values + np.diag(1.0 / np.square(columns.prior_sd)))
        return covariance @ (weighted @ rotated), covariance

    def of_rotated(self, z: np.ndarray, columns: np.ndarray, prior_sd: np.ndarray,
                   start: np.ndarray = START) -> tuple[float, np.ndarray]:
        """Fit noise and field variance by marginal likelihood, in the eigenbasis of the field.

        Residuals (m,) and columns (m, q) are transformed by `rotated`; `start` as in `START`.
        Returns the log marginal likelihood [nats] and the fitted (2,) `theta` of `at`; without rows
        0 and `START`.
        """
        if not len(z):
            return 0.0, START

        # Scaled so that the likelihood has about the same curvature along both variances.
        share = 1.0 - 1.0 / (1.0 + np.exp(start[1]) * self.spectrum)
        unit = 1.0 / np.sqrt(0.5 * np.array([len(z), max(float(share @ share), 1.0)]))

        def negative_log_evidence(scaled: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = self.at(z, columns, prior_sd, scaled * unit)
            return -value, -slope * unit

        found = minimize(negative_log_evidence, start / unit, jac=True, method="L-BFGS-B",
                         bounds=list(zip(*(BOUNDS / unit), strict=True)), options=PRECISION)
        return -float(found.fun), found.x * unit

    def at(self, z: np.ndarray, columns: np.ndarray, prior_sd: np.ndarray,
           theta: np.ndarray) -> tuple[float, np.ndarray]:
        """Compute the log marginal likelihood of rotated residuals [nats], and its gradient (2,).

        `theta` (2,): log noise variance, and log of field over noise variance.
        """
        variance = np.exp(theta[0]) * (1.0 + np.exp(theta[1]) * self.spectrum)
        share = 1.0 - np.exp(theta[0]) / variance  # of the variance that is the field's
        value, residual, freedom = np.log(variance).sum() + (z * z / variance).sum(), z, np.zeros(2)
        if columns.shape[1]:
            # A matrix times its own transpose takes half of the time of another product
            root = np.sqrt(variance)
            weighted = columns.T / root
            inner = weighted @ weighted.T
            factor = cho_factor(inner + np.diag(1.0 / np.square(prior_sd)), lower=True)
            moments = weighted @ (z / root)
            best = cho_solve(factor, moments)
            value += 2 * np.log(np.diag(factor[0])).sum() + 2 * np.log(prior_sd).sum()
            value -= moments @ best
            residual = z - columns @ best
            weighted *= np.sqrt(share)
            of_field = weighted @ weighted.T
            freedom = np.array([np.trace(cho_solve(factor, squares))
                                for squares in (inner, of_field)])
        excess = 1.0 - residual * residual / variance
        slope = np.array([excess.sum(), share @ excess]) - freedom
        return -0.5 * float(value) - 0.5 * len(z) * np.log(2 * np.pi), -0.5 * slope

    def information(self, pattern: np.ndarray, columns: np.ndarray, prior_sd: np.ndarray,
                    theta: np.ndarray) -> float:
        """Compute the Fisher information about the size of a level pattern (m,) [1/size²].

        Twice the expected log-likelihood ratio of size 1 to 0, with the columns fitted as well. All
        are transformed by `rotated`; other arguments as in `at`.
        """
        variance = np.exp(theta[0]) * (1.0 + np.exp(theta[1]) * self.spectrum)
        weighted = columns.T / variance
        inner = weighted @ columns + np.diag(1.0 / np.square(prior_sd))
        shared = weighted @ pattern
        information = (pattern * pattern / variance).sum() - shared @ np.linalg.solve(inner, shared)
        return max(float(information), 0.0)


def _split_by_position(rows: np.ndarray, position_m: np.ndarray) -> list[np.ndarray]:
    """Split rows into parts of at most `MAX_POINTS`, halved across the longest side (k-d tree)."""
    if len(rows) <= MAX_POINTS:
        return [rows]
    rows_m = position_m[rows]
    order = np.argsort(rows_m[:, np.ptp(rows_m, axis=0).argmax()], kind="stable")
    half = len(rows) // 2
    return [part for side in (order[:half], order[half:])
            for part in _split_by_position(rows[np.sort(side)], position_m)]
