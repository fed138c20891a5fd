"""Likelihood of levels with Student-t errors, of which some were not detected (left-censored).

A blank level counts as "below the limit" (Tobin 1958) or, where links drop out whatever their
level, as one of the two (Deaton and Irish 1984, 'Statistical models for zero expenditures in
household budgets', Journal of Public Economics 23). Where levels drop now and then, a level is of
one of two states, a mixture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import gammaln, stdtr

DOF = 4.0  # degrees of freedom of errors with outliers, where they are not estimated
MIN_CURVATURE = 1e-6  # of a blank that says nothing, so that every Newton step is defined
MIN_PROBABILITY = 1e-300  # of which a logarithm is taken


@dataclass(frozen=True, eq=False)
class Losses:
    """Blanks and drops that befall links whatever their level; each (n,), or one for all.

    Attributes:
        blank: probability that a link is blank.
        drop: probability that its level is lower, before the limit of detection.
        drop_db: by how much [dB].
    """

    blank: np.ndarray | float = 0.0
    drop: np.ndarray | float = 0.0
    drop_db: np.ndarray | float = 0.0

    def select(self, rows: np.ndarray | slice) -> Losses:
        """Return those of some links (a mask, indices, a slice), where they are (n,)."""
        return Losses(*(value[rows] if isinstance(value, np.ndarray) else value
                        for value in (self.blank, self.drop, self.drop_db)))

    def states(self) -> Iterator[tuple[np.ndarray | float, np.ndarray | float]]:
        """Yield probability and loss [dB] of each state a level may be in."""
        if np.any(self.drop):
            yield 1.0 - self.drop, 0.0
            yield self.drop, self.drop_db
        else:
            yield 1.0, 0.0


NO_LOSSES = Losses()


@dataclass(frozen=True, eq=False)
class ReadingLaw:
    """Distribution of n levels: Student-t about a mean, and blank below the limit of detection.

    Attributes:
        mean_db: (n,) mean level, also below the limit [dB].
        scale_db: (n,) scale of its error [dB].
        limit_db: (n,) below which nothing is detected [dB]; -inf where it is not known.
        dof: degrees of freedom, above 2.
        losses: of the links, whatever their level.
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
        """(n,) mean of a reading: of the level, given that it is detected [dB]."""
        return mean_if_detected(self.mean_db, self.scale_db, self.limit_db, self.dof, self.losses)

    @property
    def detection_probability(self) -> np.ndarray:
        """(n,) probability that the link is detected."""
        return detection_probability(self.mean_db, self.scale_db, self.limit_db, self.dof,
                                     self.losses)

    def nll(self, level_db: np.ndarray) -> np.ndarray:
        """Return the negative log-likelihood of levels (n,), NaN = not detected [nats]."""
        return censored_nll(level_db, self.limit_db, self.mean_db, self.scale_db, self.dof,
                            self.losses)

    def rank(self, level_db: np.ndarray) -> np.ndarray:
        """Return the probability (n,) that a reading is below levels (n,); NaN of a blank.

        It is uniform between 0 and 1 where the law is right (probability integral transform; Dawid
        1984, Journal of the Royal Statistical Society A 147).
        """
        known = np.isfinite(self.limit_db)
        limit_db = np.where(known, self.limit_db, 0.0)
        own = self.mean_db, self.scale_db
        missed = np.where(known, below_probability(*own, limit_db, self.dof, self.losses), 0.0)
        below = below_probability(*own, level_db, self.dof, self.losses)
        return np.clip((below - missed) / np.maximum(1 - missed, MIN_PROBABILITY), 0.0, 1.0)

    def select(self, rows: np.ndarray) -> ReadingLaw:
        """Return that of some of the links (a mask or indices)."""
        return ReadingLaw(self.mean_db[rows], self.scale_db[rows], self.limit_db[rows], self.dof,
                          self.losses.select(rows))


def sd_of_scale(dof: float) -> float:
    """Return the standard deviation of Student's t of scale 1."""
    return float(np.sqrt(dof / (dof - 2)))


def log_density(z: np.ndarray, dof: float) -> np.ndarray:
    """Return the logarithm of Student's t density at z, any shape."""
    constant = gammaln(0.5 * (dof + 1)) - gammaln(0.5 * dof) - 0.5 * np.log(dof * np.pi)
    return constant - 0.5 * (dof + 1) * np.log1p(z * z / dof)


def censored_nll(level_db: np.ndarray, limit_db: np.ndarray, mean_db: np.ndarray,
                 scale_db: np.ndarray, dof: float, losses: Losses = NO_LOSSES) -> np.ndarray:
    """Return the negative log-likelihood of each level [nats].

    Args:
        level_db: (n,) measured; NaN = not detected.
        limit_db: (n,) below which nothing is detected; -inf where a blank says nothing.
        mean_db: (n,) of the prediction, of levels that have not dropped [dB].
        scale_db: (n,) of its error [dB].
        dof: degrees of freedom of the errors.
        losses: of the links, whatever their level.

    Returns:
        (n,)
    """
    blank = np.isnan(level_db)
    if np.any(losses.drop):
        density = np.logaddexp.reduce(_of_states(level_db, mean_db, scale_db, dof, losses)[1])
    else:  # one state; a blank's is replaced below
        density = log_density((level_db - mean_db) / scale_db, dof)
    value = np.log(scale_db) - density - np.log1p(-np.asarray(losses.blank, dtype=float))
    if blank.any():
        own = losses.select(blank)
        known = np.isfinite(limit_db[blank])
        limit = np.where(known, limit_db[blank], mean_db[blank])
        missed = own.blank + (1 - own.blank) * below_probability(
            mean_db[blank], scale_db[blank], limit, dof, own)
        value[blank] = np.where(known, -np.log(np.maximum(missed, MIN_PROBABILITY)), 0.0)
    return value


def derivatives(level_db: np.ndarray, limit_db: np.ndarray, mean_db: np.ndarray,
                scale_db: np.ndarray, dof: float, losses: Losses,
                ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return derivatives of the log-likelihood; arguments as of `censored_nll`.

    Returns:
        (n,) slope in the mean, (n,) curvature in it, (n,) slope in the logarithm of the scale.
    """
    blank = np.isnan(level_db)
    if np.any(losses.drop):
        z, of_states = _of_states(level_db, mean_db, scale_db, dof, losses)
        share = np.exp(of_states - np.logaddexp.reduce(of_states))
    else:
        z, share = np.where(blank, 0.0, (level_db - mean_db) / scale_db)[None], np.ones(1)
    weight = share * (dof + 1) / (dof + z * z)
    slope, curvature = (weight * z).sum(axis=0) / scale_db, weight.sum(axis=0) / scale_db**2
    scale_slope = (weight * z * z).sum(axis=0) - 1.0
    if blank.any():
        known, mean, scale = np.isfinite(limit_db[blank]), mean_db[blank], scale_db[blank]
        own, limit = losses.select(blank), np.where(known, limit_db[blank], mean)
        missed = np.maximum(own.blank + (1 - own.blank) * below_probability(
            mean, scale, limit, dof, own), MIN_PROBABILITY)
        ratio, outward, bending = np.zeros((3, len(mean)))
        for probability, loss_db in own.states():
            z = (limit - mean + loss_db) / scale
            its = (1 - own.blank) * probability * np.exp(log_density(z, dof)) / missed
            ratio += its
            outward += its * z
            bending += its * z * (dof + 1) / (dof + z * z)
        bending += ratio**2
        slope[blank] = np.where(known, -ratio / scale, 0.0)
        curvature[blank] = np.where(known, np.maximum(bending, MIN_CURVATURE) / scale**2,
                                    MIN_CURVATURE)
        scale_slope[blank] = np.where(known, -outward, 0.0)
    return slope, curvature, scale_slope


def expected_drop_db(level_db: np.ndarray, mean_db: np.ndarray, scale_db: np.ndarray, dof: float,
                     losses: Losses) -> np.ndarray:
    """Return by how much each level has dropped, as far as it shows (n,) [dB]; 0 of a blank."""
    if not np.any(losses.drop):
        return np.zeros(len(level_db))
    _, of_states = _of_states(level_db, mean_db, scale_db, dof, losses)
    dropped = np.exp(of_states[1] - np.logaddexp.reduce(of_states))
    return np.where(np.isnan(level_db), 0.0, dropped * losses.drop_db)


def below_probability(mean_db: np.ndarray, scale_db: np.ndarray, limit_db: np.ndarray, dof: float,
                      losses: Losses) -> np.ndarray:
    """Return the probability (n,) of a level below a limit (n,), finite [dB]."""
    return sum((probability * stdtr(dof, (limit_db - mean_db + loss_db) / scale_db)
                for probability, loss_db in losses.states()), np.zeros(len(mean_db)))


def mean_if_detected(mean_db: np.ndarray, scale_db: np.ndarray, limit_db: np.ndarray,
                     dof: float, losses: Losses = NO_LOSSES) -> np.ndarray:
    """Return the mean level of those links of a kind that are detected [dB].

    Near the limit only the strong ones are. The mean of Student's t above
    a = (limit - mean) / scale is f(a) / F(-a) * (dof + a²) / (dof - 1).

    Args:
        mean_db: (n,) of all links of the kind that have not dropped [dB].
        scale_db: (n,) of their errors [dB].
        limit_db: (n,) -inf where no limit is known.
        dof: degrees of freedom, above 1.
        losses: of the links, whatever their level.
    """
    known = np.isfinite(limit_db)
    total_db, detected = np.zeros((2, len(mean_db)))
    for probability, loss_db in losses.states():
        a = np.where(known, np.where(known, limit_db, 0.0) - mean_db + loss_db, 0.0) / scale_db
        above = np.maximum(stdtr(dof, -a), MIN_PROBABILITY)
        above_db = scale_db * np.exp(log_density(a, dof)) / above * (dof + a * a) / (dof - 1)
        weight = probability * np.where(known, above, 1.0)
        total_db += weight * (mean_db - loss_db + np.where(known, above_db, 0.0))
        detected += weight
    return total_db / detected


def detection_probability(mean_db: np.ndarray, scale_db: np.ndarray, limit_db: np.ndarray,
                          dof: float, losses: Losses = NO_LOSSES) -> np.ndarray:
    """Return the probability that a link is detected (n,); arguments as of `censored_nll`."""
    known = np.isfinite(limit_db)
    below = below_probability(mean_db, scale_db, np.where(known, limit_db, 0.0), dof, losses)
    return (1 - losses.blank) * (1 - np.where(known, below, 0.0))


def _of_states(level_db: np.ndarray, mean_db: np.ndarray, scale_db: np.ndarray, dof: float,
               losses: Losses) -> tuple[np.ndarray, np.ndarray]:
    """Return z (states, n), 0 of a blank, and log of probability times density of z (states, n)."""
    z, weight = [], []
    for probability, loss_db in losses.states():
        own = np.where(np.isnan(level_db), 0.0, (level_db - mean_db + loss_db) / scale_db)
        z.append(own)
        weight.append(np.log(np.maximum(probability, MIN_PROBABILITY)) + log_density(own, dof))
    return np.array(z), np.array(weight)
