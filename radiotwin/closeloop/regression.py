"""Regression of levels of which some were not detected, with Student-t errors: outliers and blanks do not bend it.

Errors follow a Student-t distribution with `dof` degrees of freedom and a scale for each group of links (Lange, Little
and Taylor 1989, 'Robust statistical modeling using the t distribution', JASA 84); a blank level counts as "below the
limit" (Tobin 1958) or, where links are lost whatever their level, as one of the two (Deaton and Irish 1984,
'Statistical models for zero expenditures in household budgets', Journal of Public Economics 23). Solved by Newton steps
on the exact likelihood: few EM steps would leave a bias of a decibel.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln, stdtr

LEAST_SCALE_DB = 0.05
ITERATIONS = 40
TOLERANCE = 1e-3  # nats
CURVATURE = 1e-6  # least, so that every step is defined

Bend = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Mean level [dB] -> what becomes of it [dB], and the slope of that."""


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
        gain_columns: (n, p1) design of the effects' part that is fitted.
        spread_db: (p0 + p1,) prior standard deviation of each coefficient around zero; inf = free.
        group: (n,) index of the error scale.
        receiver: what the receiver does to the level that arrives; None = nothing.
        dof: degrees of freedom of the errors.
        lost: (n,) probability that a link is blank whatever its level; or one for all.
    """

    level_db: np.ndarray
    limit_db: np.ndarray
    law_db: np.ndarray
    law_columns: np.ndarray
    paths: Bend | None
    gain_db: np.ndarray
    gain_columns: np.ndarray
    spread_db: np.ndarray
    group: np.ndarray
    receiver: Bend | None
    dof: float
    lost: np.ndarray | float = 0.0

    def mean(self, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n,) expected level [dB], and (n, p) its derivative in the coefficients.

        receiver(paths(law) + gains): gains act on all paths, whatever they are.
        """
        split = self.law_columns.shape[1]
        level_db = self.law_db + self.law_columns @ coefficients[:split]
        columns = self.law_columns
        if self.paths is not None:
            level_db, slope = self.paths(level_db)
            columns = columns * slope[:, None]
        level_db = level_db + self.gain_db + self.gain_columns @ coefficients[split:]
        columns = np.hstack([columns, self.gain_columns])
        if self.receiver is not None:
            level_db, slope = self.receiver(level_db)
            columns = columns * slope[:, None]
        return level_db, columns


@dataclass(frozen=True, eq=False)
class Solution:
    """Coefficients (p,), error scales (groups,) [dB], and the negative log-posterior [nats]."""

    coefficients: np.ndarray
    scale_db: np.ndarray
    objective: float


def solve(problem: Problem, start: Solution | None = None) -> Solution:
    """The maximum of the posterior."""
    p, groups = len(problem.spread_db), int(problem.group.max()) + 1
    if start is not None and len(start.coefficients) == p:
        beta, scale_db = start.coefficients.copy(), start.scale_db.copy()
    else:
        beta, scale_db = _least_squares(problem), np.full(groups, 5.0)
    precision = 1.0 / np.square(problem.spread_db)
    mean, columns = problem.mean(beta)
    objective = _objective(problem, mean, beta, scale_db, precision)
    for _ in range(ITERATIONS):
        before = objective
        slope, curvature, _ = _derivatives(problem, mean, scale_db)
        hessian = (columns.T * curvature) @ columns + np.diag(precision + 1e-9)
        step = np.linalg.solve(hessian, columns.T @ slope - precision * beta)
        size = 1.0
        while size > 1e-3:
            there = problem.mean(beta + size * step)
            tried = _objective(problem, there[0], beta + size * step, scale_db, precision)
            if tried <= objective + 1e-9:
                beta, objective, (mean, columns) = beta + size * step, tried, there
                break
            size *= 0.5
        scale_db = _scales(problem, mean, scale_db)
        objective = _objective(problem, mean, beta, scale_db, precision)
        if abs(before - objective) < TOLERANCE:
            break
    return Solution(beta, scale_db, objective)


def covariance(problem: Problem, solution: Solution) -> np.ndarray:
    """(p, p) of the coefficients, from the curvature at the maximum."""
    mean, columns = problem.mean(solution.coefficients)
    _, curvature, _ = _derivatives(problem, mean, solution.scale_db)
    precision = 1.0 / np.square(problem.spread_db)
    hessian = (columns.T * curvature) @ columns + np.diag(precision + 1e-9)
    return np.linalg.inv(hessian)


def mean_db(problem: Problem, solution: Solution) -> np.ndarray:
    """(n,) level that is expected before noise and the limit of detection [dB]."""
    return problem.mean(solution.coefficients)[0]


def nll(problem: Problem, solution: Solution) -> np.ndarray:
    """(n,) negative log-likelihood of each link [nats]."""
    return nll_at(problem, problem.mean(solution.coefficients)[0], solution.scale_db[problem.group])


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
    mean = mean_db(problem, solution)
    blank = np.isnan(problem.level_db)
    lack_db = np.minimum(np.where(np.isfinite(problem.limit_db), problem.limit_db, mean) - mean, 0.0)
    below = (1 - problem.lost) * stdtr(problem.dof, lack_db / solution.scale_db[problem.group])
    return np.where(blank, lack_db * below / np.maximum(problem.lost + below, 1e-300), problem.level_db - mean)


def _least_squares(problem: Problem) -> np.ndarray:
    seen = np.isfinite(problem.level_db)
    mean, columns = problem.mean(np.zeros(len(problem.spread_db)))
    precision = np.square(5.0 / problem.spread_db) + 1e-6
    return np.linalg.solve(columns[seen].T @ columns[seen] + np.diag(precision),
                           columns[seen].T @ (problem.level_db - mean)[seen])


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


def _objective(problem: Problem, mean: np.ndarray, beta: np.ndarray, scale_db: np.ndarray,
               precision: np.ndarray) -> float:
    value = nll_at(problem, mean, scale_db[problem.group]).sum()
    return float(value + 0.5 * np.sum(precision * beta**2))


def _derivatives(problem: Problem, mean: np.ndarray, scale_db: np.ndarray):
    """Slope (n,) of the log-likelihood in the mean, its curvature (n,), and the term (n,) whose sum over a group is 0
    at the best scale."""
    scale, dof = scale_db[problem.group], problem.dof
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


def _scales(problem: Problem, mean: np.ndarray, scale_db: np.ndarray) -> np.ndarray:
    """One step towards the best scales."""
    _, _, spread = _derivatives(problem, mean, scale_db)
    groups = len(scale_db)
    detected = np.bincount(problem.group[np.isfinite(problem.level_db)], minlength=groups)
    total = np.bincount(problem.group, weights=spread, minlength=groups)
    factor = np.clip(1.0 + total / np.maximum(detected, 1), 0.25, 4.0) ** 0.5
    return np.maximum(scale_db * np.where(detected > 1, factor, 1.0), LEAST_SCALE_DB)
