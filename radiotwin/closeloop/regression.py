"""Regression of levels of which some were not detected, with Student-t errors: outliers and blanks do not bend it.

Errors follow a Student-t distribution with `dof` degrees of freedom and a scale for each group of links (Lange, Little
and Taylor 1989, 'Robust statistical modeling using the t distribution', JASA 84); a blank level counts as "below the
limit" (Tobin 1958) or, where links are lost whatever their level, as one of the two (Deaton and Irish 1984,
'Statistical models for zero expenditures in household budgets', Journal of Public Economics 23). Solved by Newton steps
on the exact likelihood: few EM steps would leave a bias of a decibel.

Errors are mostly shadowing, which happens before the receiver. So where a receiver bends levels (noise floor,
saturation), errors are bent with them: mean and spread of the reading are those of all levels that may arrive (Gauss
and Hermite), and far below a floor all readings are alike.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, issparse
from scipy.special import gammaln, stdtr

LEAST_SCALE_DB = 0.05
FIRST_SCALE_DB = 5.0
ITERATIONS = 40
TOLERANCE = 1e-3  # nats
CURVATURE = 1e-6  # least, so that every step is defined
NODES, WEIGHTS = np.polynomial.hermite_e.hermegauss(7)  # of levels that may arrive
MOSTLY_ZERO = 0.2  # of a design at most is not zero where it is kept sparse
OWN_SHARE = 0.5  # of the error scale, which a receiver's own noise has where it passes nothing on

Bend = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Mean level [dB] -> what becomes of it [dB], and the slope of that."""


def design(parts: list[np.ndarray], links: int) -> np.ndarray | csr_array:
    """Columns (n, …) side by side; sparse where most is zero, as effects of single receivers are."""
    columns = np.hstack([np.zeros((links, 0)), *parts])
    return csr_array(columns) if np.count_nonzero(columns) < MOSTLY_ZERO * columns.size else columns


@dataclass(frozen=True, eq=False)
class Problem:
    """n links to be explained.

    Attributes:
        level_db: (n,) NaN = not detected.
        limit_db: (n,) below which nothing is detected; -inf where a blank tells nothing.
        law_db: (n,) the base's part of the mean that is given.
        law_columns: (n, p0) design of the base's part that is fitted.
        paths: what is added to the base's power on the way; None = nothing.
        gain_db: (n,) part of the effects that is given.
        gain_columns: (n, p1) design of the effects' part that is fitted, see `design`.
        spread_db: (p0 + p1,) prior standard deviation of each coefficient around zero; inf = free.
        group: (n,) index of the error scale.
        receiver: what the receiver does to the level that arrives; None = nothing.
        dof: degrees of freedom of the errors.
        lost: (n,) probability that a link is blank whatever its level; or one for all.
        unsure_db: (n,) standard deviation of what nothing was learned of, beside the error scale; or one for all.
    """

    level_db: np.ndarray
    limit_db: np.ndarray
    law_db: np.ndarray
    law_columns: np.ndarray
    paths: Bend | None
    gain_db: np.ndarray
    gain_columns: np.ndarray | csr_array
    spread_db: np.ndarray
    group: np.ndarray
    receiver: Bend | None
    dof: float
    lost: np.ndarray | float = 0.0
    unsure_db: np.ndarray | float = 0.0

    def arriving(self, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """(n,) expected level before the receiver [dB], and (n,) its slope in the law; None where that is one.

        paths(law) + gains: gains act on all paths, whatever they are.
        """
        split, slope = self.law_columns.shape[1], None
        level_db = self.law_db + self.law_columns @ coefficients[:split]
        if self.paths is not None:
            level_db, slope = self.paths(level_db)
        return level_db + self.gain_db + self.gain_columns @ coefficients[split:], slope

    def expect(self, coefficients: np.ndarray, scale_db: np.ndarray) -> "Expected":
        """What is read, for error scales (groups,) [dB]."""
        arriving_db, law_slope = self.arriving(coefficients)
        scale = np.hypot(scale_db[self.group], self.unsure_db)
        if self.receiver is None:
            return Expected(arriving_db, scale, law_slope, np.ones(1), np.zeros(1), np.ones(1))
        mean, square, slope, both = np.zeros((4, len(arriving_db)))
        for node, weight in zip(NODES, WEIGHTS / WEIGHTS.sum()):
            level_db, passed = self.receiver(arriving_db + node * scale)
            moved = level_db - arriving_db  # or squares of large levels would be subtracted
            mean += weight * moved
            square += weight * moved**2
            slope += weight * passed
            both += weight * moved * (passed - 1)
        variance = np.maximum(square - mean**2, 0.0)
        own = (OWN_SHARE * scale_db[self.group]) ** 2
        share = 1 - own / scale**2  # so that what passes unbent keeps its scale
        total = own + share * variance
        growth = share * (both - mean * (slope - 1)) / total
        return Expected(arriving_db + mean, np.sqrt(total), law_slope, slope, growth, variance / total)


@dataclass(frozen=True, eq=False)
class Expected:
    """What is expected of n links.

    Attributes:
        mean_db, scale_db: (n,) of the reading.
        law_slope: (n,) of the arriving level in the law; None where it is one.
        slope: (n,) of the mean in the arriving level; or one for all.
        growth: (n,) of log(scale) in it [1/dB]; or one for all.
        passed: (n,) share of scale_db² that has come through the receiver; or one for all.
    """

    mean_db: np.ndarray
    scale_db: np.ndarray
    law_slope: np.ndarray | None
    slope: np.ndarray
    growth: np.ndarray
    passed: np.ndarray


@dataclass(frozen=True, eq=False)
class Solution:
    """Coefficients (p,), error scales (groups,) [dB], and the negative log-posterior [nats]."""

    coefficients: np.ndarray
    scale_db: np.ndarray
    objective: float


def solve(problem: Problem, start: Solution | None = None) -> Solution:
    """The maximum of the posterior. A start may know fewer coefficients: the others come last, and are 0 there."""
    p, groups = len(problem.spread_db), int(problem.group.max()) + 1
    if start is not None and len(start.coefficients) <= p and len(start.scale_db) == groups:
        beta = np.concatenate([start.coefficients, np.zeros(p - len(start.coefficients))])
        scale_db = start.scale_db.copy()
    else:
        beta, scale_db = _least_squares(problem), np.full(groups, FIRST_SCALE_DB)
    precision = 1.0 / np.square(problem.spread_db)
    expected = problem.expect(beta, scale_db)
    objective = _objective(problem, expected, beta, precision)
    for _ in range(ITERATIONS):
        before = objective
        slope, hessian = _slope_and_hessian(problem, expected, precision)
        step = np.linalg.solve(hessian, slope - precision * beta)
        size = 1.0
        while size > 1e-3:
            there = problem.expect(beta + size * step, scale_db)
            tried = _objective(problem, there, beta + size * step, precision)
            if tried <= objective + 1e-9:
                beta, objective, expected = beta + size * step, tried, there
                break
            size *= 0.5
        scale_db = _scales(problem, expected, scale_db)
        expected = problem.expect(beta, scale_db)
        objective = _objective(problem, expected, beta, precision)
        if abs(before - objective) < TOLERANCE:
            break
    return Solution(beta, scale_db, objective)


def covariance(problem: Problem, solution: Solution) -> np.ndarray:
    """(p, p) of the coefficients, from the curvature at the maximum."""
    expected = expect(problem, solution)
    return np.linalg.inv(_slope_and_hessian(problem, expected, 1.0 / np.square(problem.spread_db))[1])


def expect(problem: Problem, solution: Solution) -> Expected:
    """What a solution expects to be read, before noise and the limit of detection."""
    return problem.expect(solution.coefficients, solution.scale_db)


def nll(problem: Problem, solution: Solution) -> np.ndarray:
    """(n,) negative log-likelihood of each link [nats]."""
    expected = expect(problem, solution)
    return nll_at(problem, expected.mean_db, expected.scale_db)


def detected_db(mean_db: np.ndarray, scale_db: np.ndarray, limit_db: np.ndarray, dof: float) -> np.ndarray:
    """(n,) mean level of links of a kind that are detected [dB]: near the limit only the strong ones are.

    The mean of Student's t above a = (limit - mean) / scale is f(a) / F(-a) * (dof + a²) / (dof - 1). Where no limit is
    known it is -inf.
    """
    known = np.isfinite(limit_db)
    a = np.where(known, np.where(known, limit_db, 0.0) - mean_db, 0.0) / scale_db
    density = np.exp(gammaln(0.5 * (dof + 1)) - gammaln(0.5 * dof) - 0.5 * (dof + 1) * np.log1p(a * a / dof)) \
        / np.sqrt(dof * np.pi)
    above_db = scale_db * density / np.maximum(stdtr(dof, -a), 1e-300) * (dof + a * a) / (dof - 1)
    return mean_db + np.where(known, above_db, 0.0)


def residual_db(problem: Problem, solution: Solution) -> np.ndarray:
    """(n,) measured minus expected [dB]; of a blank level, how much lower than expected it is to be thought: the
    least change of the mean after which it is as likely detected as not, 0 where it already is less likely, times the
    probability that it is blank for its level rather than lost."""
    expected = expect(problem, solution)
    mean, blank = expected.mean_db, np.isnan(problem.level_db)
    lack_db = np.minimum(np.where(np.isfinite(problem.limit_db), problem.limit_db, mean) - mean, 0.0)
    below = (1 - problem.lost) * stdtr(problem.dof, lack_db / expected.scale_db)
    return np.where(blank, lack_db * below / np.maximum(problem.lost + below, 1e-300), problem.level_db - mean)


def _least_squares(problem: Problem) -> np.ndarray:
    seen = np.isfinite(problem.level_db)
    expected = problem.expect(np.zeros(len(problem.spread_db)), np.full(int(problem.group.max()) + 1, FIRST_SCALE_DB))
    pull = np.where(seen, expected.slope * (problem.level_db - expected.mean_db), 0.0)
    slope, squares = _moments(problem, expected, pull, np.where(seen, expected.slope**2, 0.0))
    return np.linalg.solve(squares + np.diag(np.square(FIRST_SCALE_DB / problem.spread_db) + 1e-6), slope)


def _moments(problem: Problem, expected: Expected, pull: np.ndarray,
             weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """X' pull (p,) and X' diag(weight) X (p, p), X being the derivative of the arriving level in the coefficients."""
    law, gains = problem.law_columns, problem.gain_columns
    if expected.law_slope is not None:
        law = law * expected.law_slope[:, None]
    weighted = law * weight[:, None]
    between = gains.T @ weighted
    squares = gains.T @ (gains * weight[:, None])
    if issparse(squares):
        squares = squares.toarray()
    return (np.concatenate([law.T @ pull, gains.T @ pull]),
            np.block([[law.T @ weighted, between.T], [between, squares]]))


def nll_at(problem: Problem, mean: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """(n,) negative log-likelihood of each link [nats] around any mean (n,) with any error scale (n,) [dB]."""
    dof = problem.dof
    blank = np.isnan(problem.level_db)
    lost = np.broadcast_to(problem.lost, mean.shape)
    z = np.where(blank, 0.0, (problem.level_db - mean) / scale)
    value = 0.5 * (dof + 1) * np.log1p(z * z / dof) + np.log(scale) + 0.5 * np.log(dof * np.pi) \
        + gammaln(0.5 * dof) - gammaln(0.5 * (dof + 1)) - np.log1p(-lost)
    if blank.any():
        limit, told = problem.limit_db[blank], np.isfinite(problem.limit_db[blank])
        z = np.where(told, (np.where(told, limit, 0.0) - mean[blank]) / scale[blank], np.inf)
        chance = lost[blank] + (1 - lost[blank]) * stdtr(dof, np.where(told, z, 0.0))
        value[blank] = np.where(told, -np.log(np.maximum(chance, 1e-300)), 0.0)
    return value


def _objective(problem: Problem, expected: Expected, beta: np.ndarray, precision: np.ndarray) -> float:
    value = nll_at(problem, expected.mean_db, expected.scale_db).sum()
    return float(value + 0.5 * np.sum(precision * beta**2))


def _slope_and_hessian(problem: Problem, expected: Expected, precision: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(p,) slope of the log-likelihood in the coefficients, and (p, p) curvature of the posterior."""
    slope, curvature, spread = _derivatives(problem, expected)
    growth, dof = expected.growth, problem.dof
    pull = slope * expected.slope + spread * growth
    bending = curvature * expected.slope**2 + 2 * dof / (dof + 3) * growth**2  # (Lange et al. 1989, Fisher information)
    toward, hessian = _moments(problem, expected, pull, bending)
    return toward, hessian + np.diag(precision + 1e-9)


def _derivatives(problem: Problem, expected: Expected):
    """Slope (n,) of the log-likelihood in the mean, its curvature (n,), and its slope (n,) in the logarithm of the
    scale."""
    mean, scale, dof = expected.mean_db, expected.scale_db, problem.dof
    blank = np.isnan(problem.level_db)
    z = np.where(blank, 0.0, (problem.level_db - mean) / scale)
    weight = (dof + 1) / (dof + z * z)
    slope, curvature, spread = weight * z / scale, weight / scale**2, weight * z * z - 1.0
    if blank.any():
        told = np.isfinite(problem.limit_db[blank])
        z = (np.where(told, problem.limit_db[blank], mean[blank]) - mean[blank]) / scale[blank]
        log_density = gammaln(0.5 * (dof + 1)) - gammaln(0.5 * dof) - 0.5 * np.log(dof * np.pi) \
            - 0.5 * (dof + 1) * np.log1p(z * z / dof)
        lost = np.broadcast_to(problem.lost, mean.shape)[blank]
        ratio = (1 - lost) * np.exp(log_density) / np.maximum(lost + (1 - lost) * stdtr(dof, z), 1e-300)
        bending = ratio * (ratio + z * (dof + 1) / (dof + z * z))
        slope[blank] = np.where(told, -ratio / scale[blank], 0.0)
        curvature[blank] = np.where(told, np.maximum(bending, CURVATURE) / scale[blank] ** 2, CURVATURE)
        spread[blank] = np.where(told, -ratio * z, 0.0)
    return slope, curvature, spread


def _scales(problem: Problem, expected: Expected, scale_db: np.ndarray) -> np.ndarray:
    """One step towards the best scales. Of links of which a receiver passes little on, little is learned."""
    _, _, spread = _derivatives(problem, expected)
    groups, seen = len(scale_db), np.isfinite(problem.level_db)
    passed = np.broadcast_to(expected.passed, seen.shape)
    detected = np.bincount(problem.group, weights=passed * seen, minlength=groups)
    total = np.bincount(problem.group, weights=passed * spread, minlength=groups)
    factor = np.clip(1.0 + total / np.maximum(detected, 1), 0.25, 4.0) ** 0.5
    return np.maximum(scale_db * np.where(detected > 1, factor, 1.0), LEAST_SCALE_DB)
