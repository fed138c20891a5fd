"""Weights of the members of a combination, and how far off it is, from links that were held out.

Two sets of links count: those that folds held out, and those of quadrants of the area that were
held out, because a map extrapolates. Each set counts by its errors relative to those of its best
member. Quadrants count less where the combination would predict a held-out fold worse than the best
member alone does; where none does as well, that member is taken (the discrete super learner: van
der Laan, Polley and Hubbard 2007, Statistical Applications in Genetics and Molecular Biology 6).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.optimize import minimize

from radiotwin.inference.held_out import combine, convex_weights
from radiotwin.inference.student import Losses, ReadingLaw
from radiotwin.twin.model.blend import NAMED, blended, far_share, sd_factor

HALF_M = 50.0  # distance at which near and far count the same, where no distance tells
PULL = 0.01  # towards the best single member, see `convex_weights`: 2 % of the RMSE
AWAY_COUNTS = (1.0, 0.25, 0.0625, 0.0)  # what quadrants count beside held-out links, first to last
AS_GOOD = 1.01  # RMSE of a combination on folds that it has not seen over that of the best member
MIN_WEIGHT = 0.02  # a member that has less, near and far, is left out
PASSES = 3  # weights need the error scale, and that needs the weights
SD_LINKS = 4_000  # whose likelihood tells how wide errors are
LOG_SD_RATIO = 3.0  # its natural logarithm is within plus and minus this
SAME_RATIO = 0.01  # a link: penalty of a log ratio near and far that differ by 1 [nats]


@dataclass(frozen=True, eq=False)
class HeldOut:
    """n links that were held out, and their prediction by each member.

    Attributes:
        level_db: (n,) measured [dB]; NaN = not detected.
        limit_db: (n,) of detection [dB].
        members_db: (n, k) mean level by each member [dB]; NaN where there is none.
        scales_db: (n, k) of their errors [dB].
        unheard_db: (n,) standard deviation of what is unheard [dB].
        away_m: (n,) distance from what was learnt from [m].
        blank, drop, drop_db: (n,) losses whatever the level, see `Losses`.
        fold: (n,) that each link belongs to.
    """

    level_db: np.ndarray
    limit_db: np.ndarray
    members_db: np.ndarray
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
        """Return some of the links (a mask or indices)."""
        return HeldOut(*(getattr(self, each.name)[rows] for each in fields(self)))

    def law(self, mean_db: np.ndarray, scale_db: np.ndarray, dof: float) -> ReadingLaw:
        """Return the distribution of the levels by means (n,) and error scales (n,) [dB]."""
        return ReadingLaw(mean_db, np.hypot(scale_db, self.unheard_db), self.limit_db, dof,
                          Losses(self.blank, self.drop, self.drop_db))

    @classmethod
    def join(cls, parts: list[HeldOut]) -> HeldOut:
        """Return the links of several sets."""
        return cls(*(np.concatenate([getattr(part, each.name) for part in parts])
                     for each in fields(cls)))


@dataclass(frozen=True)
class Combination:
    """How members are combined, see `radiotwin.twin.model.blend.Blend`.

    Attributes:
        weights: of each member that has one, near measurements and far from them.
        half_m: distance at which near and far count the same [m].
        sd_ratio: error scale over that of the members, near and far.
    """

    weights: dict[str, tuple[float, float]]
    half_m: float
    sd_ratio: tuple[float, float]


def half_distance_m(held_out: HeldOut, away: HeldOut) -> float:
    """Return the distance at which near and far count the same [m].

    The geometric mean of the medians of both sets, so that the typical link of one is as near as
    that of the other is far: measured places are metres apart in one campaign and a kilometre in
    another.
    """
    medians_m = [np.median(each.away_m[np.isfinite(each.away_m)])
                 for each in (held_out, away) if np.isfinite(each.away_m).any()]
    if len(medians_m) < 2:
        return HALF_M
    return float(np.sqrt(np.prod(np.maximum(medians_m, 1.0))))


def combination(held_out: HeldOut, away: HeldOut, names: list[str], half_m: float,
                dof: float) -> Combination:
    """Return the weights with the least squared error of readings, and how wide errors are.

    Args:
        held_out: links that folds held out.
        away: links of quadrants that were held out.
        names: of the k members.
        half_m: of `half_distance_m`.
        dof: degrees of freedom of the errors.
    """
    held_out, away = (each.select(np.isfinite(each.members_db).all(axis=1))
                      for each in (held_out, away))
    if not np.isfinite(held_out.level_db).any():  # nothing could be held out
        return Combination({NAMED: (1.0, 1.0)}, half_m, (1.0, 1.0))
    sd_ratio = 1.0, 1.0
    for _ in range(PASSES):
        weights = _weights(held_out, away, half_m, sd_ratio, dof)
        sd_ratio = _sd_ratio(held_out, away, weights, half_m, dof)
    return Combination({name: (float(near), float(far)) for name, (near, far) in
                        zip(names, weights.T, strict=True) if near or far}, half_m, sd_ratio)


def _weights(held_out: HeldOut, away: HeldOut, half_m: float, sd_ratio: tuple[float, float],
             dof: float) -> np.ndarray:
    """Return weights (2, k), near and far; 0 of members that count next to nothing."""
    sets = []
    for links in (held_out, away):
        links = links.select(np.isfinite(links.level_db))
        share = far_share(links.away_m, half_m)
        factor = sd_factor(share, sd_ratio)
        error_db = links.level_db[:, None] - np.column_stack(
            [links.law(mean_db, scale_db * factor, dof).reading_db
             for mean_db, scale_db in zip(links.members_db.T, links.scales_db.T, strict=True)])
        best_db = np.sqrt(np.square(error_db).mean(axis=0).min()) if len(links) else 1.0
        sets.append((error_db / max(best_db, 1e-6), share, links.fold))
    (error, share, fold), (error_away, share_away, fold_away) = sets

    def fitted(counts: float, but: int = -1) -> np.ndarray:
        """Return weights where quadrants count so much, without the links of a fold."""
        own, away = fold != but, fold_away != but
        # Both sets as means over their links, whatever the number of these.
        repeated = np.sqrt(counts * own.sum() / max(away.sum(), 1))
        found = convex_weights(np.vstack([error[own], repeated * error_away[away]]),
                               np.concatenate([share[own], share_away[away]]), PULL)
        found[:, found.max(axis=0) < MIN_WEIGHT] = 0.0
        return found / found.sum(axis=1, keepdims=True)

    folds = np.unique(fold)
    if len(folds) < 2:
        return fitted(AWAY_COUNTS[0])
    for counts in AWAY_COUNTS:
        square = sum(np.square(combine(error[fold == each], share[fold == each],
                                       fitted(counts, each))).sum() for each in folds)
        if np.sqrt(square / len(error)) <= AS_GOOD:
            return fitted(counts)
    best = np.square(error).mean(axis=0).argmin()
    return np.tile(np.arange(error.shape[1]) == best, (2, 1)).astype(float)


def _sd_ratio(held_out: HeldOut, away: HeldOut, weights: np.ndarray, half_m: float,
              dof: float) -> tuple[float, float]:
    """Return the error scale over that of the members, near and far, of highest likelihood.

    Of held-out links and of quadrants together: a map extrapolates, and links that lie near others
    do not tell what that costs.
    """
    links = HeldOut.join([held_out, away])
    links = links.select(np.arange(0, len(links), max(len(links) // SD_LINKS, 1)))
    share = far_share(links.away_m, half_m)
    mean_db, scale_db = blended(links.members_db, links.scales_db, share, weights, (1.0, 1.0))

    def objective(log_ratio: np.ndarray) -> float:
        near, far = np.exp(log_ratio)
        law = links.law(mean_db, scale_db * sd_factor(share, (near, far)), dof)
        return float(law.nll(links.level_db).mean()
                     + 0.5 * SAME_RATIO * (log_ratio[0] - log_ratio[1]) ** 2)

    start = [[0.0, 0.0], [-0.4, -0.4], [-0.4, 0.0]]
    near, far = np.exp(minimize(
        objective, start[0], method="Nelder-Mead", bounds=[(-LOG_SD_RATIO, LOG_SD_RATIO)] * 2,
        options={"xatol": 0.01, "fatol": 1e-5, "initial_simplex": start}).x)
    return float(near), float(far)
