"""Fit the weights and the error scale of a combination of models to held-out links.

Two sets of links are used: those of held-out folds, and those of held-out quadrants of the area,
because a map extrapolates. Errors of each set are relative to its best predictor. Quadrants count
less if the combination would predict a fold worse than the best predictor alone; if no weight of
theirs helps, the best predictor is taken (the discrete super learner: van der Laan, Polley and
Hubbard 2007, Statistical Applications in Genetics and Molecular Biology 6).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.optimize import minimize

from radiotwin.inference.held_out import combine, convex_weights
from radiotwin.inference.student import Losses, ReadingLaw
from radiotwin.twin.model.blend import NAMED, blended, far_share, sd_factor

HALF_M = 50.0  # half distance if it cannot be estimated from links [m]
PULL = 0.01  # shrinkage towards the best predictor, see `convex_weights`: 2 % of the RMSE
QUADRANT_COUNTS = (1.0, 0.25, 0.0625, 0.0)  # weights of the quadrants that are tried in turn
AS_GOOD = 1.01  # largest ratio of the RMSE on an unseen fold to that of the best predictor
MIN_WEIGHT = 0.02  # predictors with less, near and far, are left out
PASSES = 3  # alternating fits of weights and error scale
SD_LINKS = 4_000  # sample for the error scale
LOG_SD_RATIO = 3.0  # bound of its natural logarithm, plus and minus
SAME_RATIO = 0.01  # penalty for log ratios near and far that differ by 1 [nats/link]


@dataclass(frozen=True, eq=False)
class HeldOut:
    """n held-out links with their prediction by each of k predictors.

    Attributes:
        level_db: (n,) measured level [dB]; NaN = not detected.
        limit_db: (n,) limit of detection [dB].
        predicted_db: (n, k) predicted mean level [dB]; NaN without a prediction.
        scales_db: (n, k) error scale [dB].
        unheard_db: (n,) standard deviation of unheard levels [dB].
        away_m: (n,) distance from the nearest measured place [m].
        blank, drop, drop_db: (n,) losses that do not depend on the level, see `Losses`.
        fold: (n,) fold of each link.
    """

    level_db: np.ndarray
    limit_db: np.ndarray
    predicted_db: np.ndarray
    scales_db: np.ndarray
    unheard_db: np.ndarray
    away_m: np.ndarray
    blank: np.ndarray
    drop: np.ndarray
    drop_db: np.ndarray
    fold: np.ndarray

    def __len__(self) -> int:
        return len(self.level_db)

    def select(self, rows: np.ndarray) -> HeldOut:
        """Return the links of a mask or of indices."""
        return HeldOut(*(getattr(self, each.name)[rows] for each in fields(self)))

    def reading_law(self, mean_db: np.ndarray, scale_db: np.ndarray, dof: float) -> ReadingLaw:
        """Return the predicted distribution of readings with means and error scales (n,) [dB]."""
        return ReadingLaw(mean_db, np.hypot(scale_db, self.unheard_db), self.limit_db, dof,
                          Losses(self.blank, self.drop, self.drop_db))

    @classmethod
    def join(cls, parts: list[HeldOut]) -> HeldOut:
        """Concatenate several sets of links."""
        return cls(*(np.concatenate([getattr(part, each.name) for part in parts])
                     for each in fields(cls)))


@dataclass(frozen=True)
class Combination:
    """Weights of a combination, see `radiotwin.twin.model.blend.Blend`.

    Attributes:
        weights: weight near measurements and far from them, by the predictor's name.
        half_m: distance at which the near and far weights count equally [m].
        sd_ratio: error scale over that of the predictors, near and far.
    """

    weights: dict[str, tuple[float, float]]
    half_m: float
    sd_ratio: tuple[float, float]


def half_distance_m(held_out: HeldOut, quadrants: HeldOut) -> float:
    """Return the distance from measurements at which near and far weights count equally [m].

    It is the geometric mean of both sets' median distances, so it scales with the campaign.
    """
    medians_m = [np.median(each.away_m[np.isfinite(each.away_m)])
                 for each in (held_out, quadrants) if np.isfinite(each.away_m).any()]
    if len(medians_m) < 2:
        return HALF_M
    return float(np.sqrt(np.prod(np.maximum(medians_m, 1.0))))


def combination(held_out: HeldOut, quadrants: HeldOut, names: list[str], half_m: float,
                dof: float) -> Combination:
    """Fit the weights with the least squared error of readings, and the error scale.

    Args:
        held_out: links of held-out folds.
        quadrants: links of held-out quadrants.
        names: names of the k predictors.
        half_m: `half_distance_m` of both sets [m].
        dof: degrees of freedom of the Student-t errors.
    """
    held_out, quadrants = (each.select(np.isfinite(each.predicted_db).all(axis=1))
                           for each in (held_out, quadrants))
    if not np.isfinite(held_out.level_db).any():  # nothing could be held out
        return Combination({NAMED: (1.0, 1.0)}, half_m, (1.0, 1.0))
    sd_ratio = 1.0, 1.0
    for _ in range(PASSES):
        weights = _weights(held_out, quadrants, half_m, sd_ratio, dof)
        sd_ratio = _sd_ratio(held_out, quadrants, weights, half_m, dof)
    return Combination({name: (float(near), float(far)) for name, (near, far) in
                        zip(names, weights.T, strict=True) if near or far}, half_m, sd_ratio)


def _weights(held_out: HeldOut, quadrants: HeldOut, half_m: float, sd_ratio: tuple[float, float],
             dof: float) -> np.ndarray:
    """Fit weights (2, k) of k predictors, near and far, by least squared error of readings.

    `quadrants` count less, until unseen folds are predicted nearly as well (`AS_GOOD`) as by the
    best predictor; otherwise this one gets all weight. Weights below `MIN_WEIGHT` become 0.
    """
    sets = []
    for links in (held_out, quadrants):
        links = links.select(np.isfinite(links.level_db))
        share = far_share(links.away_m, half_m)
        factor = sd_factor(share, sd_ratio)
        error_db = links.level_db[:, None] - np.column_stack(
            [links.reading_law(mean_db, scale_db * factor, dof).reading_db
             for mean_db, scale_db in zip(links.predicted_db.T, links.scales_db.T, strict=True)])
        best_db = np.sqrt(np.square(error_db).mean(axis=0).min()) if len(links) else 1.0
        sets.append((error_db / max(best_db, 1e-6), share, links.fold))
    (error, share, fold), (error_quadrants, share_quadrants, fold_quadrants) = sets

    def fitted(count: float, left_out: int = -1) -> np.ndarray:
        """Return weights if quadrants count `count` times; the fold `left_out` is not used."""
        near, far = fold != left_out, fold_quadrants != left_out
        # Scale errors so that both sets count by their mean square, not by their number of links.
        factor = np.sqrt(count * near.sum() / max(far.sum(), 1))
        found = convex_weights(np.vstack([error[near], factor * error_quadrants[far]]),
                               np.concatenate([share[near], share_quadrants[far]]), PULL)
        found[:, found.max(axis=0) < MIN_WEIGHT] = 0.0
        return found / found.sum(axis=1, keepdims=True)

    folds = np.unique(fold)
    if len(folds) < 2:
        return fitted(QUADRANT_COUNTS[0])
    for count in QUADRANT_COUNTS:
        square = sum(np.square(combine(error[fold == each], share[fold == each],
                                       fitted(count, each))).sum() for each in folds)
        if np.sqrt(square / len(error)) <= AS_GOOD:
            return fitted(count)
    best = np.square(error).mean(axis=0).argmin()
    return np.tile(np.arange(error.shape[1]) == best, (2, 1)).astype(float)


def _sd_ratio(held_out: HeldOut, quadrants: HeldOut, weights: np.ndarray, half_m: float,
              dof: float) -> tuple[float, float]:
    """Fit two factors of the combined predictors' error scale, near and far from measurements.

    By likelihood, with a penalty for factors that differ, on a sample of about `SD_LINKS` held-out
    links. `quadrants` are used, too, as errors far from measurements show only in them.
    """
    links = HeldOut.join([held_out, quadrants])
    links = links.select(np.arange(0, len(links), max(len(links) // SD_LINKS, 1)))
    share = far_share(links.away_m, half_m)
    mean_db, scale_db = blended(links.predicted_db, links.scales_db, share, weights, (1.0, 1.0))

    def objective(log_ratio: np.ndarray) -> float:
        near, far = np.exp(log_ratio)
        law = links.reading_law(mean_db, scale_db * sd_factor(share, (near, far)), dof)
        return float(law.nll(links.level_db).mean()
                     + 0.5 * SAME_RATIO * (log_ratio[0] - log_ratio[1]) ** 2)

    start = [[0.0, 0.0], [-0.4, -0.4], [-0.4, 0.0]]
    near, far = np.exp(minimize(
        objective, start[0], method="Nelder-Mead", bounds=[(-LOG_SD_RATIO, LOG_SD_RATIO)] * 2,
        options={"xatol": 0.01, "fatol": 1e-5, "initial_simplex": start}).x)
    return float(near), float(far)
