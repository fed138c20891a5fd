"""Regression of levels of which some were not detected, robust against outliers.

Errors follow a Student-t distribution with `dof` degrees of freedom and a scale for each group of
rows (Lange, Little and Taylor 1989, 'Robust statistical modeling using the t distribution', JASA
84); blanks are censored (`radiotwin.inference.student`). Solved by Newton steps on the exact
likelihood: a few EM steps would leave a bias of a decibel.

Errors arise mostly before the instrument. So where its response is not linear (a noise floor,
saturation), errors pass through it, too: mean and scale of the reading are those over all levels
that may arrive (Gauss-Hermite quadrature), and far below a floor all readings are alike.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, issparse

from radiotwin.inference import student
from radiotwin.inference.student import NO_LOSSES, Losses

MIN_SCALE_DB = 0.05
FIRST_SCALE_DB = 5.0  # where the search for the error scales begins
MAX_ITERATIONS = 40
TOLERANCE = 1e-3  # of the objective, at which the search ends [nats]
MIN_STEP = 1e-3  # share of a Newton step, below which none is taken
MAX_GROWTH = float(np.log(2.0))  # of a scale's logarithm in one step
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(7)  # over the levels that may arrive
MAX_DENSITY = 0.2  # share of entries that are not zero, up to which a design is kept sparse
OWN_SHARE = 0.5  # of the error scale: the instrument's own noise where it passes nothing on

Response = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Mean level (n,) [dB] -> what becomes of it (n,) [dB], and the slope of that (n,)."""


def design(blocks: list[np.ndarray], n: int) -> np.ndarray | csr_array:
    """Return columns (n, …) side by side; sparse where most is zero."""
    columns = np.hstack([np.zeros((n, 0)), *blocks])
    sparse = np.count_nonzero(columns) < MAX_DENSITY * columns.size
    return csr_array(columns) if sparse else columns


@dataclass(frozen=True, eq=False)
class CensoredRegression:
    """n levels to be explained: mean = receiver(paths(law) + gains).

    Attributes:
        level_db: (n,) NaN = not detected.
        limit_db: (n,) below which nothing is detected; -inf where a blank says nothing.
        law_db: (n,) part of the law's mean that is given [dB].
        law_columns: (n, p0) design of the law's part that is fitted.
        paths: response between law and gains; None = none.
        gain_db: (n,) gains that are given [dB].
        gain_columns: (n, p1) design of the gains that are fitted, see `design`.
        prior_sd_db: (p0 + p1,) prior standard deviation of each coefficient around zero;
            inf = free.
        group: (n,) index of the error scale.
        receiver: response to the level that arrives; None = none.
        dof: degrees of freedom of the errors.
        losses: of links, whatever their level.
        random_effect_sd_db: (n,), or one for all, standard deviation of what nothing was learnt of,
            beside the error scale [dB].
    """

    level_db: np.ndarray
    limit_db: np.ndarray
    law_db: np.ndarray
    law_columns: np.ndarray
    paths: Response | None
    gain_db: np.ndarray
    gain_columns: np.ndarray | csr_array
    prior_sd_db: np.ndarray
    group: np.ndarray
    receiver: Response | None
    dof: float
    losses: Losses = NO_LOSSES
    random_effect_sd_db: np.ndarray | float = 0.0

    def arriving(self, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the mean level before the receiver (n,) [dB] by coefficients (p0 + p1,).

        And its slope in the law (n,); None where that is one.
        """
        split, slope = self.law_columns.shape[1], None
        level_db = self.law_db + self.law_columns @ coefficients[:split]
        if self.paths is not None:
            level_db, slope = self.paths(level_db)
        return level_db + self.gain_db + self.gain_columns @ coefficients[split:], slope

    def linearise(self, coefficients: np.ndarray, scale_db: np.ndarray) -> "Linearisation":
        """Return mean and scale of the readings with their derivatives.

        By coefficients (p0 + p1,) and error scales (groups,) [dB].
        """
        arriving_db, law_slope = self.arriving(coefficients)
        scale = np.hypot(scale_db[self.group], self.random_effect_sd_db)
        if self.receiver is None:
            return Linearisation(arriving_db, scale, law_slope, np.ones(1), np.zeros(1), np.ones(1))
        mean, square, slope, both = np.zeros((4, len(arriving_db)))
        for node, weight in zip(NODES, WEIGHTS / WEIGHTS.sum(), strict=True):
            level_db, passed = self.receiver(arriving_db + node * scale)
            moved = level_db - arriving_db  # or squares of large levels would be subtracted
            mean += weight * moved
            square += weight * moved**2
            slope += weight * passed
            both += weight * moved * (passed - 1)
        variance = np.maximum(square - mean**2, 0.0)
        own = (OWN_SHARE * scale_db[self.group]) ** 2
        share = 1 - own / scale**2  # so that what passes unchanged keeps its scale
        total = own + share * variance
        growth = share * (both - mean * (slope - 1)) / total
        return Linearisation(arriving_db + mean, np.sqrt(total), law_slope, slope, growth,
                             variance / total)

    def predict(self, result: "FitResult") -> "Linearisation":
        """Return mean and scale of the readings by a fit, before the limit of detection."""
        return self.linearise(result.coefficients, result.scale_db)

    def nll(self, result: "FitResult") -> np.ndarray:
        """Return the negative log-likelihood (n,) of each level by a fit [nats]."""
        predicted = self.predict(result)
        return self.nll_at(predicted.mean_db, predicted.scale_db)

    def nll_at(self, mean_db: np.ndarray, scale_db: np.ndarray) -> np.ndarray:
        """Return the negative log-likelihood (n,) around any mean and scale (n,) [nats]."""
        return student.censored_nll(self.level_db, self.limit_db, mean_db, scale_db, self.dof,
                                    self.losses)

    def residual_db(self, result: "FitResult") -> np.ndarray:
        """Return measured minus predicted levels (n,) [dB].

        What a level has probably dropped by is added. Of a blank: the least change of the mean
        after which it is as likely detected as not, 0 where it already is less likely, times the
        probability that it is blank for its level and did not drop out.
        """
        predicted = self.predict(result)
        mean, blank = predicted.mean_db, np.isnan(self.level_db)
        limit = np.where(np.isfinite(self.limit_db), self.limit_db, mean)
        excess_db = np.minimum(limit - mean, 0.0)
        below = (1 - self.losses.blank) * student.below_probability(
            -excess_db, predicted.scale_db, np.zeros(len(mean)), self.dof, self.losses)
        missed = np.maximum(self.losses.blank + below, student.MIN_PROBABILITY)
        dropped_db = student.expected_drop_db(self.level_db, mean, predicted.scale_db, self.dof,
                                              self.losses)
        return np.where(blank, excess_db * below / missed, self.level_db - mean + dropped_db)


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Mean and scale of n readings, and how they change with the level that arrives.

    Attributes:
        mean_db, scale_db: (n,) of the reading [dB].
        law_slope: (n,) of the arriving level in the law; None where it is one.
        slope: (n,), or one for all, of the mean in the arriving level.
        growth: (n,), or one for all, of log(scale) in it [1/dB].
        passed: (n,), or one for all, share of scale_db² that has come through the receiver.
    """

    mean_db: np.ndarray
    scale_db: np.ndarray
    law_slope: np.ndarray | None
    slope: np.ndarray
    growth: np.ndarray
    passed: np.ndarray


@dataclass(frozen=True, eq=False)
class FitResult:
    """Coefficients (p,), error scales (groups,) [dB], and the negative log-posterior [nats]."""

    coefficients: np.ndarray
    scale_db: np.ndarray
    objective: float


def fit(problem: CensoredRegression, start: FitResult | None = None) -> FitResult:
    """Return the maximum of the posterior.

    Args:
        problem: n levels and p coefficients.
        start: an earlier fit; it may have fewer coefficients, the others then start at 0 and come
            last.
    """
    p, groups = len(problem.prior_sd_db), int(problem.group.max()) + 1
    if start is not None and len(start.coefficients) <= p and len(start.scale_db) >= groups:
        beta = np.concatenate([start.coefficients, np.zeros(p - len(start.coefficients))])
        scale_db = start.scale_db[:groups].copy()
    else:
        beta, scale_db = _least_squares(problem), np.full(groups, FIRST_SCALE_DB)
    precision = 1.0 / np.square(problem.prior_sd_db)
    predicted = problem.linearise(beta, scale_db)
    objective = _objective(problem, predicted, beta, precision)
    for _ in range(MAX_ITERATIONS):
        slope, hessian, growth, grown_nats = _slope_and_hessian(problem, predicted, precision)
        slope = slope - precision * beta
        step = np.linalg.solve(hessian, slope)
        if 0.5 * slope @ step + grown_nats < TOLERANCE:
            break
        size, before = 1.0, objective
        while size > MIN_STEP:
            there = beta + size * step, np.maximum(scale_db * np.exp(size * growth), MIN_SCALE_DB)
            reached = problem.linearise(*there)
            tried = _objective(problem, reached, there[0], precision)
            if tried <= objective + 1e-9:
                (beta, scale_db), predicted, objective = there, reached, tried
                break
            size *= 0.5
        if before - objective < TOLERANCE:
            break
    return FitResult(beta, scale_db, objective)


def _least_squares(problem: CensoredRegression) -> np.ndarray:
    seen = np.isfinite(problem.level_db)
    first_scale_db = np.full(int(problem.group.max()) + 1, FIRST_SCALE_DB)
    predicted = problem.linearise(np.zeros(len(problem.prior_sd_db)), first_scale_db)
    pull = np.where(seen, predicted.slope * (problem.level_db - predicted.mean_db), 0.0)
    slope, squares = _moments(problem, predicted, pull, np.where(seen, predicted.slope**2, 0.0))
    ridge = np.diag(np.square(FIRST_SCALE_DB / problem.prior_sd_db) + 1e-6)
    return np.linalg.solve(squares + ridge, slope)


def _moments(problem: CensoredRegression, predicted: Linearisation, pull: np.ndarray,
             weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return X' pull (p,) and X' diag(weight) X (p, p).

    X is the derivative of the arriving level in the coefficients.
    """
    law, gains = problem.law_columns, problem.gain_columns
    if predicted.law_slope is not None:
        law = law * predicted.law_slope[:, None]
    weighted = law * weight[:, None]
    between = gains.T @ weighted
    squares = gains.T @ (gains * weight[:, None])
    if issparse(squares):
        squares = squares.toarray()
    return (np.concatenate([law.T @ pull, gains.T @ pull]),
            np.block([[law.T @ weighted, between.T], [between, squares]]))


def _objective(problem: CensoredRegression, predicted: Linearisation, beta: np.ndarray,
               precision: np.ndarray) -> float:
    value = problem.nll_at(predicted.mean_db, predicted.scale_db).sum()
    return float(value + 0.5 * np.sum(precision * beta**2))


def _slope_and_hessian(problem: CensoredRegression, predicted: Linearisation,
                       precision: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return how the posterior changes with the coefficients and the scales.

    Returns:
        the log-likelihood's slope (p,), the posterior's curvature (p, p); a step towards the best
        scales (groups,) [logarithm], for which rows count little of which the receiver passes
        little on; and about what that step gains [nats].
    """
    slope, curvature, scale_slope = student.derivatives(
        problem.level_db, problem.limit_db, predicted.mean_db, predicted.scale_db, problem.dof,
        problem.losses)
    # Of the logarithm of a scale, a link's Fisher information (Lange et al. 1989).
    growth, information = predicted.growth, 2 * problem.dof / (problem.dof + 3)
    toward, hessian = _moments(problem, predicted, slope * predicted.slope + scale_slope * growth,
                               curvature * predicted.slope**2 + information * growth**2)
    seen = np.isfinite(problem.level_db)
    passed = np.broadcast_to(predicted.passed, seen.shape)
    detected = np.bincount(problem.group, weights=passed * seen)
    total = np.bincount(problem.group, weights=passed * scale_slope)
    change = np.where(detected > 1, total / np.maximum(detected, 1) / information, 0.0)
    change = np.clip(change, -MAX_GROWTH, MAX_GROWTH)
    return (toward, hessian + np.diag(precision + 1e-9), change,
            0.5 * information * float(detected @ change**2))
