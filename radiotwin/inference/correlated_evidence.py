"""Evidence for a cause beside errors that are allowed to be correlated.

A base lacks more than noise: walls stand elsewhere than on the map, materials differ. Such a rest
is a Gaussian field over positions, unknown to the catalogue, and it explains part of whatever has a
position. So a cause is judged by how much likelier the data are with it *beside* that field, whose
strength is fitted anew each time (Kennedy and O'Hagan 2001, 'Bayesian calibration of computer
models', J. R. Stat. Soc. B 63; Brynjarsdóttir and O'Hagan 2014, Inverse Problems 30).

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

MAX_POINTS = 400  # of a part of a series: its matrix is decomposed
MAX_ROWS = 8000  # of all series
MIN_POINTS = 3  # of a part that says anything
# Of correlation [m]: shadowing decorrelates within 10 to 50 m (3GPP TR 38.901, Table 7.5-6). Longer
# ones would explain whatever an antenna or a wrong position does to a device's levels.
LENGTHS_M = (5.0, 12.0, 30.0)
# Along a weak field the likelihood is flat: no slope may be left that adds up to a nat.
PRECISION = {"maxfun": 60, "ftol": 1e-8, "gtol": 0.001}
START = np.array([0.0, -1.0])  # logarithms: noise variance, field over noise
BOUNDS = np.array([[-6.0, -7.0], [6.0, 7.0]])


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns (n, q), and prior standard deviations (q,) of their coefficients."""

    values: np.ndarray
    prior_sd: np.ndarray

    def beside(self, other: Columns) -> Columns:
        """Return both, side by side."""
        return Columns(np.hstack([self.values, other.values]),
                       np.concatenate([self.prior_sd, other.prior_sd]))


@dataclass(frozen=True, eq=False)
class CorrelatedEvidence:
    """Marginal likelihoods of residuals beside a correlated rest.

    Attributes:
        rows: (m,) rows that are used, part after part.
        parts: where each part of a series is among them: links near each other; what is further
            away counts as not correlated.
        bases: of each part the eigenvectors of its correlation matrix.
        spectrum: (m,) the eigenvalues.
        length_m: of the correlation.
    """

    rows: np.ndarray
    parts: list[slice]
    bases: list[np.ndarray]
    spectrum: np.ndarray
    length_m: float

    @classmethod
    def fit(cls, series: np.ndarray, position_m: np.ndarray, z: np.ndarray, nuisance: Columns,
            seed: int) -> Self:
        """Choose the length of the correlation at which residuals are likeliest.

        Rows (n,) have the label of the field that they belong to, a position [m], and a residual,
        NaN if it is of no use. Where there are many, some are drawn.
        """
        rng = np.random.default_rng(seed)
        chosen = []
        known = np.flatnonzero(np.isfinite(z))
        labels, member = np.unique(series[known], return_inverse=True)
        most = max(MAX_ROWS // max(len(labels), 1), MIN_POINTS)
        for number in rng.permutation(len(labels))[:MAX_ROWS // MIN_POINTS]:
            mine = known[member == number]
            if len(mine) > most:
                mine = np.sort(rng.choice(mine, most, replace=False))
            chosen += [part for part in _near_each_other(mine, position_m)
                       if len(part) >= MIN_POINTS]
        tried = [cls._decomposed(chosen, position_m, length_m) for length_m in LENGTHS_M]
        return max(tried, key=lambda each: each.log_evidence(z, nuisance))

    @classmethod
    def _decomposed(cls, chosen: list[np.ndarray], position_m: np.ndarray,
                    length_m: float) -> Self:
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
        """Return values (n, …) in the eigenbasis (m, …)."""
        mine = values[self.rows]
        return np.concatenate([basis.T @ mine[part] for part, basis in
                               zip(self.parts, self.bases, strict=True)]) if self.parts else mine

    def log_evidence(self, z: np.ndarray, columns: Columns) -> float:
        """Return the log marginal likelihood of residuals (n,) at the best variances [nats]."""
        return self.of_rotated(self.rotated(z), self.rotated(columns.values), columns.prior_sd)[0]

    def coefficients(self, z: np.ndarray, columns: Columns) -> tuple[np.ndarray, np.ndarray]:
        """Return the coefficients (q,) of columns at the best variances, and their errors (q,).

        An error is the standard deviation that a coefficient has after the data.
        """
        rotated, values = self.rotated(z), self.rotated(columns.values)
        theta = self.of_rotated(rotated, values, columns.prior_sd)[1]
        weighted = values.T / (np.exp(theta[0]) * (1.0 + np.exp(theta[1]) * self.spectrum))
        spread = np.linalg.inv(weighted @ values + np.diag(1.0 / np.square(columns.prior_sd)))
        return spread @ (weighted @ rotated), np.sqrt(np.diag(spread))

    def of_rotated(self, z: np.ndarray, columns: np.ndarray, prior_sd: np.ndarray,
                   start: np.ndarray = START) -> tuple[float, np.ndarray]:
        """Return the same of rotated values (m,), (m, q), and the two variances' logarithms."""
        if not len(z):
            return 0.0, START

        # In units in which the likelihood is about as curved along either variance.
        share = 1.0 - 1.0 / (1.0 + np.exp(start[1]) * self.spectrum)
        unit = 1.0 / np.sqrt(0.5 * np.array([len(z), max(float(share @ share), 1.0)]))

        def negative(scaled: np.ndarray) -> tuple[float, np.ndarray]:
            value, slope = self.at(z, columns, prior_sd, scaled * unit)
            return -value, -slope * unit

        found = minimize(negative, start / unit, jac=True, method="L-BFGS-B",
                         bounds=list(zip(*(BOUNDS / unit), strict=True)), options=PRECISION)
        return -float(found.fun), found.x * unit

    def at(self, z: np.ndarray, columns: np.ndarray, prior_sd: np.ndarray,
           theta: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the log marginal likelihood of rotated values at given variances [nats].

        And its derivatives (2,) by the logarithms of the variances.
        """
        variance = np.exp(theta[0]) * (1.0 + np.exp(theta[1]) * self.spectrum)
        share = 1.0 - np.exp(theta[0]) / variance  # of the field
        value, left, freedom = np.log(variance).sum() + (z * z / variance).sum(), z, np.zeros(2)
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
            left = z - columns @ best
            weighted *= np.sqrt(share)
            of_field = weighted @ weighted.T
            freedom = np.array([np.trace(cho_solve(factor, each)) for each in (inner, of_field)])
        excess = 1.0 - left * left / variance
        slope = np.array([excess.sum(), share @ excess]) - freedom
        return -0.5 * float(value) - 0.5 * len(z) * np.log(2 * np.pi), -0.5 * slope

    def information(self, pattern: np.ndarray, columns: np.ndarray, prior_sd: np.ndarray,
                    theta: np.ndarray) -> float:
        """Return how sharply the data would show a pattern of unit size [1/size²].

        Twice the expected log-likelihood ratio of the pattern beside columns that are fitted, too;
        both are rotated. Others as of `at`.
        """
        variance = np.exp(theta[0]) * (1.0 + np.exp(theta[1]) * self.spectrum)
        weighted = columns.T / variance
        inner = weighted @ columns + np.diag(1.0 / np.square(prior_sd))
        shared = weighted @ pattern
        left = (pattern * pattern / variance).sum() - shared @ np.linalg.solve(inner, shared)
        return max(float(left), 0.0)


def _near_each_other(rows: np.ndarray, position_m: np.ndarray) -> list[np.ndarray]:
    """Return rows in parts of at most `MAX_POINTS`, halved across the longest side (k-d tree)."""
    if len(rows) <= MAX_POINTS:
        return [rows]
    mine_m = position_m[rows]
    order = np.argsort(mine_m[:, np.ptp(mine_m, axis=0).argmax()], kind="stable")
    half = len(rows) // 2
    return [part for each in (order[:half], order[half:])
            for part in _near_each_other(rows[np.sort(each)], position_m)]
