"""Fit a robust Tobit regression: levels with outliers, some below the limit of detection.

Errors follow a Student-t distribution with `dof` degrees of freedom and one scale per group of rows
(Lange, Little and Taylor 1989, 'Robust statistical modeling using the t distribution', JASA 84);
blanks are censored (`radiotwin.inference.student`). Newton steps maximise the exact likelihood: a
few EM steps would leave a bias of a decibel.

Most errors arise before the receiver. Where its response is not linear (a noise floor, saturation),
they pass through that response: mean and scale of a reading are taken over the distribution of the
arriving level (Gauss-Hermite quadrature), so that far below a floor all readings are alike.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, issparse

from radiotwin.inference.student import MIN_PROBABILITY, NO_LOSSES, Losses, ReadingLaw

MIN_SCALE_DB = 0.05
FIRST_SCALE_DB = 5.0  # initial error scale
MAX_ITERATIONS = 40
TOLERANCE = 1e-3  # improvement of the objective at which the iteration stops [nats]
MIN_STEP = 1e-3  # smallest fraction of a Newton step that is tried
MAX_GROWTH = float(np.log(2.0))  # largest change of log(scale) in one step
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(7)  # quadrature over the arriving level
MAX_DENSITY = 0.2  # share of non-zero entries up to which a design matrix is stored as sparse
INSTRUMENT_SHARE = 0.5  # receiver noise over the error scale, where the response is flat

Response = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Map the level (n,) before to the level (n,) behind [dB], with the slope (n,) of the map."""


def design(blocks: list[np.ndarray], n: int) -> np.ndarray | csr_array:
    """Stack columns (n, …) into a design matrix; sparse if below MAX_DENSITY are not zero."""
    columns = np.hstack([np.zeros((n, 0)), *blocks])
    sparse = np.count_nonzero(columns) < MAX_DENSITY * columns.size
    return csr_array(columns) if sparse else columns


@dataclass(frozen=True, eq=False)
class CensoredRegression:
    """Data and model of a regression of n levels: mean = receiver(paths(law) + gains).

    Attributes:
        level_db: (n,) measured levels [dB]; NaN = not detected.
        limit_db: (n,) limits of detection [dB]; -inf if unknown: then a blank carries no
            information.
        law_db: (n,) fixed part of the channel law's mean [dB].
        law_columns: (n, p0) design matrix of the fitted part of the channel law.
        paths: response applied between law and gains; None = identity.
        gain_db: (n,) fixed gains [dB].
        gain_columns: (n, p1) design matrix of the fitted gains, see `design`.
        prior_sd_db: (p0 + p1,) prior standard deviation of each coefficient around zero;
            inf = flat prior.
        group: (n,) index of the error scale of each row.
        receiver: response of the receiver to the arriving level; None = identity.
        dof: degrees of freedom of the errors.
        losses: blanks and drops that do not depend on the level.
        random_effect_sd_db: (n,) or scalar, standard deviation of random effects, added in
            quadrature to the error scale [dB].
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
        """Compute the mean level that arrives at the receiver, from coefficients (p0 + p1,).

        Returns:
            (n,) mean level [dB], and its derivative (n,) with respect to the channel law's level;
            None if that is 1 everywhere.
        """
        split, slope = self.law_columns.shape[1], None
        level_db = self.law_db + self.law_columns @ coefficients[:split]
        if self.paths is not None:
            level_db, slope = self.paths(level_db)
        return level_db + self.gain_db + self.gain_columns @ coefficients[split:], slope

    def linearise(self, coefficients: np.ndarray, scale_db: np.ndarray) -> "Linearisation":
        """Compute mean and error scale of the readings behind the receiver, with their derivatives.

        If the receiver's response is not linear, by quadrature over the arriving level.
        Coefficients are (p0 + p1,), error scales (groups,) [dB].
        """
        arriving_db, law_slope = self.arriving(coefficients)
        scale = np.hypot(scale_db[self.group], self.random_effect_sd_db)
        if self.receiver is None:
            return Linearisation(arriving_db, scale, law_slope, np.ones(1), np.zeros(1), np.ones(1))
        mean, square, slope, cross = np.zeros((4, len(arriving_db)))
        for node, weight in zip(NODES, WEIGHTS / WEIGHTS.sum(), strict=True):
            level_db, node_slope = self.receiver(arriving_db + node * scale)
            change = level_db - arriving_db  # small: squares of the levels would cancel
            mean += weight * change
            square += weight * change**2
            slope += weight * node_slope
            cross += weight * change * (node_slope - 1)
        variance = np.maximum(square - mean**2, 0.0)
        instrument = (INSTRUMENT_SHARE * scale_db[self.group]) ** 2
        share = 1 - instrument / scale**2  # so that a linear response keeps the scale
        total = instrument + share * variance
        growth = share * (cross - mean * (slope - 1)) / total
        return Linearisation(arriving_db + mean, np.sqrt(total), law_slope, slope, growth,
                             variance / total)

    def predict(self, result: "FitResult") -> "Linearisation":
        """Compute mean and scale of the uncensored readings from a fit [dB]."""
        return self.linearise(result.coefficients, result.scale_db)

    def nll(self, result: "FitResult") -> np.ndarray:
        """Compute the negative log-likelihood (n,) of each level under a fit [nats]."""
        predicted = self.predict(result)
        return self.nll_at(predicted.mean_db, predicted.scale_db)

    def nll_at(self, mean_db: np.ndarray, scale_db: np.ndarray) -> np.ndarray:
        """Compute the negative log-likelihood (n,) of the levels for mean and scale (n,) [nats]."""
        return self.reading_law(mean_db, scale_db).nll(self.level_db)

    def reading_law(self, mean_db: np.ndarray, scale_db: np.ndarray) -> ReadingLaw:
        """Return the distribution of the readings for mean and scale (n,) [dB]."""
        return ReadingLaw(mean_db, scale_db, self.limit_db, self.dof, self.losses)

    def residual_db(self, result: "FitResult") -> np.ndarray:
        """Compute measured minus predicted levels (n,) [dB], also for blanks.

        The expected drop of a level is added back. The residual of a blank is min(limit - mean, 0),
        times the probability that it is blank because of its level and was not lost.
        """
        predicted = self.predict(result)
        mean_db, blank = predicted.mean_db, np.isnan(self.level_db)
        limit_db = np.where(np.isfinite(self.limit_db), self.limit_db, mean_db)
        excess_db = np.minimum(limit_db - mean_db, 0.0)
        excess_law = self.reading_law(-excess_db, predicted.scale_db)
        below = (1 - self.losses.blank) * excess_law.below(np.zeros(len(mean_db)))
        missed = np.maximum(self.losses.blank + below, MIN_PROBABILITY)
        dropped_db = self.reading_law(mean_db, predicted.scale_db).expected_drop_db(self.level_db)
        return np.where(blank, excess_db * below / missed, self.level_db - mean_db + dropped_db)


@dataclass(frozen=True, eq=False)
class Linearisation:
    """Mean and scale of n readings, and their derivatives with respect to the arriving level.

    Attributes:
        mean_db, scale_db: (n,) of the reading [dB].
        law_slope: (n,) derivative of the arriving level with respect to the channel law's level;
            None if it is 1 everywhere.
        slope: (n,) or (1,), d mean / d arriving level.
        growth: (n,) or (1,), d log(scale) / d arriving level [1/dB].
        passed: (n,) or (1,), share of scale_db² that passed through the receiver.
    """

    mean_db: np.ndarray
    scale_db: np.ndarray
    law_slope: np.ndarray | None
    slope: np.ndarray
    growth: np.ndarray
    passed: np.ndarray


@dataclass(frozen=True, eq=False)
class FitResult:
    """Fitted coefficients (p,), error scales (groups,) [dB], and negative log-posterior [nats]."""

    coefficients: np.ndarray
    scale_db: np.ndarray
    objective: float


def fit(problem: CensoredRegression, start: FitResult | None = None) -> FitResult:
    """Maximise the posterior by at most MAX_ITERATIONS damped Newton steps.

    `start`: an earlier fit, ignored if it has more coefficients or fewer scales; coefficients that
    it lacks are the last ones and start at 0. A group's scale stays with one detected row or none.
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
        slope, hessian, growth, scale_gain_nats = _slope_and_hessian(problem, predicted, precision)
        slope = slope - precision * beta
        step = np.linalg.solve(hessian, slope)
        if 0.5 * slope @ step + scale_gain_nats < TOLERANCE:
            break
        fraction, before = 1.0, objective
        while fraction > MIN_STEP:
            new_beta = beta + fraction * step
            new_scale_db = np.maximum(scale_db * np.exp(fraction * growth), MIN_SCALE_DB)
            reached = problem.linearise(new_beta, new_scale_db)
            tried = _objective(problem, reached, new_beta, precision)
            if tried <= objective + 1e-9:
                beta, scale_db, predicted, objective = new_beta, new_scale_db, reached, tried
                break
            fraction *= 0.5
        if before - objective < TOLERANCE:
            break
    return FitResult(beta, scale_db, objective)


def _least_squares(problem: CensoredRegression) -> np.ndarray:
    """Compute start coefficients (p,): one Gauss-Newton step from 0, on detected levels only.

    It is a ridge regression: coefficients have their priors, errors the scale `FIRST_SCALE_DB`.
    """
    known = np.isfinite(problem.level_db)
    first_scale_db = np.full(int(problem.group.max()) + 1, FIRST_SCALE_DB)
    predicted = problem.linearise(np.zeros(len(problem.prior_sd_db)), first_scale_db)
    score = np.where(known, predicted.slope * (problem.level_db - predicted.mean_db), 0.0)
    slope, squares = _moments(problem, predicted, score, np.where(known, predicted.slope**2, 0.0))
    ridge = np.diag(np.square(FIRST_SCALE_DB / problem.prior_sd_db) + 1e-6)
    return np.linalg.solve(squares + ridge, slope)


def _moments(problem: CensoredRegression, predicted: Linearisation, score: np.ndarray,
             weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute X' score (p,) and X' diag(weight) X (p, p), X = d arriving level / d coefficients."""
    law, gains = problem.law_columns, problem.gain_columns
    if predicted.law_slope is not None:
        law = law * predicted.law_slope[:, None]
    weighted = law * weight[:, None]
    between = gains.T @ weighted
    squares = gains.T @ (gains * weight[:, None])
    if issparse(squares):
        squares = squares.toarray()
    return (np.concatenate([law.T @ score, gains.T @ score]),
            np.block([[law.T @ weighted, between.T], [between, squares]]))


def _objective(problem: CensoredRegression, predicted: Linearisation, beta: np.ndarray,
               precision: np.ndarray) -> float:
    """Compute the negative log-posterior [nats]."""
    value = problem.nll_at(predicted.mean_db, predicted.scale_db).sum()
    return float(value + 0.5 * np.sum(precision * beta**2))


def _slope_and_hessian(problem: CensoredRegression, predicted: Linearisation,
                       precision: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Compute the derivatives of the log-posterior for one Newton step.

    Gradient (p,) of the log-likelihood, negative Hessian (p, p) of the log-posterior, step of the
    log scales (groups,), in which a row counts by the share of its error that passes the receiver,
    and the approximate gain of that step [nats].
    """
    slope, curvature, scale_slope = problem.reading_law(
        predicted.mean_db, predicted.scale_db).derivatives(problem.level_db)
    # Fisher information of one row about log(scale) (Lange et al. 1989).
    growth, information = predicted.growth, 2 * problem.dof / (problem.dof + 3)
    toward, hessian = _moments(problem, predicted, slope * predicted.slope + scale_slope * growth,
                               curvature * predicted.slope**2 + information * growth**2)
    is_detected = np.isfinite(problem.level_db)
    passed = np.broadcast_to(predicted.passed, is_detected.shape)
    detected = np.bincount(problem.group, weights=passed * is_detected)
    total = np.bincount(problem.group, weights=passed * scale_slope)
    change = np.where(detected > 1, total / np.maximum(detected, 1) / information, 0.0)
    change = np.clip(change, -MAX_GROWTH, MAX_GROWTH)
    return (toward, hessian + np.diag(precision + 1e-9), change,
            0.5 * information * float(detected @ change**2))
