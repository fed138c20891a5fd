"""Likelihood of left-censored levels with Student-t errors (a robust Tobit model).

A blank means "below the limit of detection" (Tobin 1958). Where links are also lost at random, a
blank is either below the limit or lost (p-Tobit; Deaton and Irish 1984, 'Statistical models for
zero expenditures in household budgets', Journal of Public Economics 23). Where levels sometimes
drop by some decibels, the level's distribution is a mixture of two states.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import gammaln, stdtr

DOF = 4.0  # default degrees of freedom of errors with outliers
MIN_CURVATURE = 1e-6  # of a blank without information, so that every Newton step is defined
MIN_PROBABILITY = 1e-300  # smallest argument of a logarithm


@dataclass(frozen=True, eq=False)
class Losses:
    """Random losses that do not depend on the level; each (n,), or a scalar for all links.

    Attributes:
        blank: probability that a link is lost, i.e. blank for another reason than its level.
        drop: probability that the level before the limit of detection is lower by `drop_db`.
        drop_db: drop of the level [dB].
    """

    blank: np.ndarray | float = 0.0
    drop: np.ndarray | float = 0.0
    drop_db: np.ndarray | float = 0.0

    def select(self, rows: np.ndarray | slice) -> Losses:
        """Select the losses of some links by a mask, indices or a slice."""
        return Losses(*(value[rows] if isinstance(value, np.ndarray) else value
                        for value in (self.blank, self.drop, self.drop_db)))

    def states(self) -> Iterator[tuple[np.ndarray | float, np.ndarray | float]]:
        """Yield probability and drop [dB] of each state: not dropped and, if any may, dropped."""
        if np.any(self.drop):
            yield 1.0 - self.drop, 0.0
            yield self.drop, self.drop_db
        else:
            yield 1.0, 0.0


NO_LOSSES = Losses()


@dataclass(frozen=True, eq=False)
class ReadingLaw:
    """Predictive distribution of n readings: Student-t levels, censored at the limit of detection.

    Attributes:
        mean_db: (n,) mean of the uncensored level [dB].
        scale_db: (n,) scale of the level's error [dB].
        limit_db: (n,) limit of detection [dB]; -inf if unknown.
        dof: degrees of freedom, above 2.
        losses: blanks and drops that do not depend on the level.
    """

    mean_db: np.ndarray
    scale_db: np.ndarray
    limit_db: np.ndarray
    dof: float
    losses: Losses = NO_LOSSES

    @property
    def sd_db(self) -> np.ndarray:
        """(n,) standard deviation of the level [dB]."""
        return self.scale_db * sd_of_scale(self.dof)

    @cached_property
    def reading_db(self) -> np.ndarray:
        """(n,) mean level given that the link is detected [dB]."""
        return mean_if_detected(self.mean_db, self.scale_db, self.limit_db, self.dof, self.losses)

    @property
    def detection_probability(self) -> np.ndarray:
        """(n,) probability that the link is detected."""
        return detection_probability(self.mean_db, self.scale_db, self.limit_db, self.dof,
                                     self.losses)

    def nll(self, level_db: np.ndarray) -> np.ndarray:
        """Compute the negative log-likelihood of levels (n,), NaN = not detected [nats]."""
        return censored_nll(level_db, self.limit_db, self.mean_db, self.scale_db, self.dof,
                            self.losses)

    def rank(self, level_db: np.ndarray) -> np.ndarray:
        """Compute the probability (n,) that a detected reading is below levels (n,) [dB].

        NaN for a blank. Measured levels have ranks uniform in 0..1 if the distribution is right
        (probability integral transform; Dawid 1984, Journal of the Royal Statistical Society A
        147).
        """
        known = np.isfinite(self.limit_db)
        limit_db = np.where(known, self.limit_db, 0.0)
        law = self.mean_db, self.scale_db
        missed = np.where(known, below_probability(*law, limit_db, self.dof, self.losses), 0.0)
        below = below_probability(*law, level_db, self.dof, self.losses)
        return np.clip((below - missed) / np.maximum(1 - missed, MIN_PROBABILITY), 0.0, 1.0)

    def select(self, rows: np.ndarray) -> ReadingLaw:
        """Select the distribution of some links by a mask or indices."""
        return ReadingLaw(self.mean_db[rows], self.scale_db[rows], self.limit_db[rows], self.dof,
                          self.losses.select(rows))


def sd_of_scale(dof: float) -> float:
    """Compute the ratio of standard deviation to scale of Student's t distribution."""
    return float(np.sqrt(dof / (dof - 2)))


def log_density(z: np.ndarray, dof: float) -> np.ndarray:
    """Compute the log density of Student's t with scale 1 at z (any shape)."""
    constant = gammaln(0.5 * (dof + 1)) - gammaln(0.5 * dof) - 0.5 * np.log(dof * np.pi)
    return constant - 0.5 * (dof + 1) * np.log1p(z * z / dof)


def censored_nll(level_db: np.ndarray, limit_db: np.ndarray, mean_db: np.ndarray,
                 scale_db: np.ndarray, dof: float, losses: Losses = NO_LOSSES) -> np.ndarray:
    """Compute the negative log-likelihood of each level under the robust Tobit model.

    Args:
        level_db: (n,) measured levels [dB]; NaN = not detected.
        limit_db: (n,) limits of detection [dB]; -inf if unknown: then a blank contributes 0.
        mean_db: (n,) predicted mean of levels that have not dropped [dB].
        scale_db: (n,) scale of the errors [dB].
        dof: degrees of freedom of the errors.
        losses: blanks and drops that do not depend on the level.

    Returns:
        (n,) negative log-likelihood [nats].
    """
    blank = np.isnan(level_db)
    if np.any(losses.drop):
        density = np.logaddexp.reduce(_state_densities(level_db, mean_db, scale_db, dof, losses)[1])
    else:  # one state; the density of a blank is replaced below
        density = log_density((level_db - mean_db) / scale_db, dof)
    value = np.log(scale_db) - density - np.log1p(-np.asarray(losses.blank, dtype=float))
    if blank.any():
        known = np.isfinite(limit_db[blank])
        missed = _blank_probability(limit_db[blank], mean_db[blank], scale_db[blank], dof,
                                    losses.select(blank))
        value[blank] = np.where(known, -np.log(missed), 0.0)
    return value


def derivatives(level_db: np.ndarray, limit_db: np.ndarray, mean_db: np.ndarray,
                scale_db: np.ndarray, dof: float, losses: Losses,
                ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the derivatives of the robust Tobit log-likelihood; arguments as in `censored_nll`.

    Returns:
        (n,) derivative with respect to the mean, (n,) positive approximation to the negative second
        derivative, (n,) derivative with respect to log(scale).
    """
    blank = np.isnan(level_db)
    if np.any(losses.drop):
        z, log_densities = _state_densities(level_db, mean_db, scale_db, dof, losses)
        share = np.exp(log_densities - np.logaddexp.reduce(log_densities))
    else:
        z, share = np.where(blank, 0.0, (level_db - mean_db) / scale_db)[None], np.ones(1)
    weight = share * (dof + 1) / (dof + z * z)
    slope, curvature = (weight * z).sum(axis=0) / scale_db, weight.sum(axis=0) / scale_db**2
    scale_slope = (weight * z * z).sum(axis=0) - 1.0
    if blank.any():
        known, mean, scale = np.isfinite(limit_db[blank]), mean_db[blank], scale_db[blank]
        blank_losses, limit = losses.select(blank), np.where(known, limit_db[blank], mean)
        missed = _blank_probability(limit_db[blank], mean, scale, dof, blank_losses)
        ratio, scale_ratio, bend = np.zeros((3, len(mean)))
        for probability, drop_db in blank_losses.states():
            z = (limit - mean + drop_db) / scale
            state_ratio = (1 - blank_losses.blank) * probability * np.exp(
                log_density(z, dof)) / missed
            ratio += state_ratio
            scale_ratio += state_ratio * z
            bend += state_ratio * z * (dof + 1) / (dof + z * z)
        bend += ratio**2
        slope[blank] = np.where(known, -ratio / scale, 0.0)
        curvature[blank] = np.where(known, np.maximum(bend, MIN_CURVATURE) / scale**2,
                                    MIN_CURVATURE)
        scale_slope[blank] = np.where(known, -scale_ratio, 0.0)
    return slope, curvature, scale_slope


def _blank_probability(limit_db: np.ndarray, mean_db: np.ndarray, scale_db: np.ndarray, dof: float,
                       losses: Losses) -> np.ndarray:
    """Compute the probability (b,), above 0, that a link is lost or below its limit.

    The value where the limit is -inf (unknown) is not to be used.
    """
    finite_db = np.where(np.isfinite(limit_db), limit_db, mean_db)
    below = below_probability(mean_db, scale_db, finite_db, dof, losses)
    return np.maximum(losses.blank + (1 - losses.blank) * below, MIN_PROBABILITY)


def expected_drop_db(level_db: np.ndarray, mean_db: np.ndarray, scale_db: np.ndarray, dof: float,
                     losses: Losses) -> np.ndarray:
    """Compute the posterior mean of each level's drop (n,) [dB]; 0 for a blank."""
    if not np.any(losses.drop):
        return np.zeros(len(level_db))
    _, log_densities = _state_densities(level_db, mean_db, scale_db, dof, losses)
    dropped = np.exp(log_densities[1] - np.logaddexp.reduce(log_densities))
    return np.where(np.isnan(level_db), 0.0, dropped * losses.drop_db)


def below_probability(mean_db: np.ndarray, scale_db: np.ndarray, limit_db: np.ndarray, dof: float,
                      losses: Losses) -> np.ndarray:
    """Compute the probability (n,) that a level, dropped or not, is below a finite limit (n,)."""
    return sum((probability * stdtr(dof, (limit_db - mean_db + drop_db) / scale_db)
                for probability, drop_db in losses.states()), np.zeros(len(mean_db)))


def mean_if_detected(mean_db: np.ndarray, scale_db: np.ndarray, limit_db: np.ndarray,
                     dof: float, losses: Losses = NO_LOSSES) -> np.ndarray:
    """Compute the mean level given detection: of Student's t truncated at the limit.

    The mean of the standardised t above a = (limit - mean) / scale is
    f(a) / F(-a) * (dof + a²) / (dof - 1).

    Args:
        mean_db: (n,) mean of levels that have not dropped [dB].
        scale_db: (n,) scale of the errors [dB].
        limit_db: (n,) limit of detection [dB]; -inf if unknown.
        dof: degrees of freedom, above 1.
        losses: blanks and drops that do not depend on the level.

    Returns:
        (n,) mean of the detected levels [dB].
    """
    known = np.isfinite(limit_db)
    total_db, detected = np.zeros((2, len(mean_db)))
    for probability, drop_db in losses.states():
        a = np.where(known, np.where(known, limit_db, 0.0) - mean_db + drop_db, 0.0) / scale_db
        above = np.maximum(stdtr(dof, -a), MIN_PROBABILITY)
        above_db = scale_db * np.exp(log_density(a, dof)) / above * (dof + a * a) / (dof - 1)
        weight = probability * np.where(known, above, 1.0)
        total_db += weight * (mean_db - drop_db + np.where(known, above_db, 0.0))
        detected += weight
    return total_db / detected


def detection_probability(mean_db: np.ndarray, scale_db: np.ndarray, limit_db: np.ndarray,
                          dof: float, losses: Losses = NO_LOSSES) -> np.ndarray:
    """Compute the probability (n,) that a link is detected; arguments as in `censored_nll`."""
    known = np.isfinite(limit_db)
    below = below_probability(mean_db, scale_db, np.where(known, limit_db, 0.0), dof, losses)
    return (1 - losses.blank) * (1 - np.where(known, below, 0.0))


def _state_densities(level_db: np.ndarray, mean_db: np.ndarray, scale_db: np.ndarray, dof: float,
                     losses: Losses) -> tuple[np.ndarray, np.ndarray]:
    """Compute the standardised residuals z in both states, and log(state probability * density(z)).

    Returns:
        (states, n) each; z is 0 for a blank.
    """
    z, log_densities = [], []
    for probability, drop_db in losses.states():
        z.append(np.where(np.isnan(level_db), 0.0, (level_db - mean_db + drop_db) / scale_db))
        log_densities.append(np.log(np.maximum(probability, MIN_PROBABILITY))
                             + log_density(z[-1], dof))
    return np.array(z), np.array(log_densities)
