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
        """Yield probability and drop [dB] of the state without a drop and, if any, with one."""
        if np.any(self.drop):
            yield 1.0 - self.drop, 0.0
            yield self.drop, self.drop_db
        else:
            yield 1.0, 0.0


NO_LOSSES = Losses()


def sd_of_scale(dof: float) -> float:
    """Compute the ratio of standard deviation to scale of Student's t distribution."""
    return float(np.sqrt(dof / (dof - 2)))


def log_density(z: np.ndarray, dof: float) -> np.ndarray:
    """Compute the log density of Student's t with scale 1 at z (any shape)."""
    constant = gammaln(0.5 * (dof + 1)) - gammaln(0.5 * dof) - 0.5 * np.log(dof * np.pi)
    return constant - 0.5 * (dof + 1) * np.log1p(z * z / dof)


@dataclass(frozen=True, eq=False)
class ReadingLaw:
    """Predictive distribution of n readings: Student-t levels, censored at the limit of detection.

    Attributes:
        mean_db: (n,) mean of the uncensored level, without drops [dB].
        scale_db: (n,) scale of the level's error [dB].
        limit_db: (n,) limit of detection [dB]; -inf if unknown: then a blank has likelihood 1.
        dof: degrees of freedom of the error, above 2.
        losses: blanks and drops that do not depend on the level.
    """

    mean_db: np.ndarray
    scale_db: np.ndarray
    limit_db: np.ndarray
    dof: float
    losses: Losses = NO_LOSSES

    def select(self, rows: np.ndarray) -> ReadingLaw:
        """Select the distribution of some links by a mask or indices."""
        return ReadingLaw(self.mean_db[rows], self.scale_db[rows], self.limit_db[rows], self.dof,
                          self.losses.select(rows))

    @property
    def sd_db(self) -> np.ndarray:
        """(n,) standard deviation of the level [dB]."""
        return self.scale_db * sd_of_scale(self.dof)

    @cached_property
    def reading_db(self) -> np.ndarray:
        """(n,) mean level given that the link is detected [dB].

        The mean of the standardised t above a = (limit - mean) / scale is
        f(a) / F(-a) * (dof + a²) / (dof - 1).
        """
        known, dof = np.isfinite(self.limit_db), self.dof
        total_db, detected = np.zeros((2, len(self.mean_db)))
        for probability, drop_db in self.losses.states():
            a = np.where(known, np.where(known, self.limit_db, 0.0) - self.mean_db + drop_db,
                         0.0) / self.scale_db
            above = np.maximum(stdtr(dof, -a), MIN_PROBABILITY)
            above_db = self.scale_db * np.exp(log_density(a, dof)) / above * (
                dof + a * a) / (dof - 1)
            weight = probability * np.where(known, above, 1.0)
            total_db += weight * (self.mean_db - drop_db + np.where(known, above_db, 0.0))
            detected += weight
        return total_db / detected

    @property
    def detection_probability(self) -> np.ndarray:
        """(n,) probability that the link is detected."""
        return (1 - self.losses.blank) * (1 - self._missed)

    @property
    def _missed(self) -> np.ndarray:
        """(n,) probability that the level is below the limit; 0 if the limit is unknown."""
        known = np.isfinite(self.limit_db)
        return np.where(known, self.below(np.where(known, self.limit_db, 0.0)), 0.0)

    def below(self, level_db: np.ndarray) -> np.ndarray:
        """Compute the probability (n,) that the uncensored level is below a finite level (n,)."""
        return sum((probability * stdtr(self.dof, (level_db - self.mean_db + drop_db)
                                        / self.scale_db)
                    for probability, drop_db in self.losses.states()),
                   np.zeros(len(self.mean_db)))

    def rank(self, level_db: np.ndarray) -> np.ndarray:
        """Compute the probability (n,) that a detected reading is below levels (n,) [dB].

        NaN for a blank. Measured levels have ranks uniform in 0..1 if the distribution is right
        (probability integral transform; Dawid 1984, Journal of the Royal Statistical Society A
        147).
        """
        missed, below = self._missed, self.below(level_db)
        return np.clip((below - missed) / np.maximum(1 - missed, MIN_PROBABILITY), 0.0, 1.0)

    def nll(self, level_db: np.ndarray) -> np.ndarray:
        """Compute the negative log-likelihood (n,) of levels (n,), NaN = not detected [nats]."""
        blank = np.isnan(level_db)
        if np.any(self.losses.drop):
            density = np.logaddexp.reduce(self._state_densities(level_db)[1])
        else:  # one state; the density of a blank is replaced below
            density = log_density((level_db - self.mean_db) / self.scale_db, self.dof)
        value = np.log(self.scale_db) - density - np.log1p(
            -np.asarray(self.losses.blank, dtype=float))
        if blank.any():
            blanks = self.select(blank)
            value[blank] = np.where(np.isfinite(blanks.limit_db),
                                    -np.log(blanks._blank_probability), 0.0)
        return value

    def derivatives(self, level_db: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute the derivatives of the log-likelihood of levels (n,), NaN = not detected.

        Returns:
            (n,) derivative with respect to the mean, (n,) positive approximation to the negative
            second derivative, (n,) derivative with respect to log(scale).
        """
        blank, dof = np.isnan(level_db), self.dof
        if np.any(self.losses.drop):
            z, log_densities = self._state_densities(level_db)
            share = np.exp(log_densities - np.logaddexp.reduce(log_densities))
        else:
            z = np.where(blank, 0.0, (level_db - self.mean_db) / self.scale_db)[None]
            share = np.ones(1)
        weight = share * (dof + 1) / (dof + z * z)
        slope = (weight * z).sum(axis=0) / self.scale_db
        curvature = weight.sum(axis=0) / self.scale_db**2
        scale_slope = (weight * z * z).sum(axis=0) - 1.0
        if blank.any():
            blanks = self.select(blank)
            known, scale = np.isfinite(blanks.limit_db), blanks.scale_db
            limit = np.where(known, blanks.limit_db, blanks.mean_db)
            ratio, scale_ratio, bend = np.zeros((3, len(scale)))
            for probability, drop_db in blanks.losses.states():
                z = (limit - blanks.mean_db + drop_db) / scale
                state_ratio = (1 - blanks.losses.blank) * probability * np.exp(
                    log_density(z, dof)) / blanks._blank_probability
                ratio += state_ratio
                scale_ratio += state_ratio * z
                bend += state_ratio * z * (dof + 1) / (dof + z * z)
            bend += ratio**2
            slope[blank] = np.where(known, -ratio / scale, 0.0)
            curvature[blank] = np.where(known, np.maximum(bend, MIN_CURVATURE) / scale**2,
                                        MIN_CURVATURE)
            scale_slope[blank] = np.where(known, -scale_ratio, 0.0)
        return slope, curvature, scale_slope

    @cached_property
    def _blank_probability(self) -> np.ndarray:
        """(n,) probability, above 0, of a blank; without meaning if the limit is unknown."""
        below = self.below(np.where(np.isfinite(self.limit_db), self.limit_db, self.mean_db))
        return np.maximum(self.losses.blank + (1 - self.losses.blank) * below, MIN_PROBABILITY)

    def expected_drop_db(self, level_db: np.ndarray) -> np.ndarray:
        """Compute the posterior mean of each level's drop (n,) [dB]; 0 for a blank."""
        if not np.any(self.losses.drop):
            return np.zeros(len(level_db))
        _, log_densities = self._state_densities(level_db)
        dropped = np.exp(log_densities[1] - np.logaddexp.reduce(log_densities))
        return np.where(np.isnan(level_db), 0.0, dropped * self.losses.drop_db)

    def _state_densities(self, level_db: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute residuals over scale (states, n), 0 for a blank, and log joint densities."""
        z, log_densities = [], []
        for probability, drop_db in self.losses.states():
            z.append(np.where(np.isnan(level_db), 0.0,
                              (level_db - self.mean_db + drop_db) / self.scale_db))
            log_densities.append(np.log(np.maximum(probability, MIN_PROBABILITY))
                                 + log_density(z[-1], self.dof))
        return np.array(z), np.array(log_densities)
