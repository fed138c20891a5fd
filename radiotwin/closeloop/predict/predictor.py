"""The final prediction: named physics, an interpolated rest and regressions, by weights.

Near measured places interpolation and trees know most, and far from them physics does. So each
member of the combination has a weight near measurements and one far from them, with a smooth
transition. The weights are those with the least held-out error on other folds: no reading has a
part in the members by which it is predicted, and no error of its fold has one in the weights. For a
few numbers that many readings choose, nested cross-validation is not needed (Wainer and Cawley
2021, 'Nested cross-validation when selecting classifiers is overzealous for most practical
applications', Expert Systems with Applications 182).

A fold predicts its held-out links as the twin of a loop predicts any link
(`radiotwin.twin.model.model.FittedModel.law_on`): both have members from `_learn`.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.predict.baselines import (
    BOOSTING,
    EXTRA_TREES,
    LAWS,
    TREES,
    Part,
    fitted_law,
    grow_trees,
    held_out_baselines,
)
from radiotwin.closeloop.predict.weights import (
    HALF_M,
    Combination,
    HeldOut,
    combination,
    half_distance_m,
)
from radiotwin.links import Links
from radiotwin.propagation.laws.base import ChannelModel
from radiotwin.propagation.laws.forest import Forest
from radiotwin.propagation.laws.log_distance import LogDistance
from radiotwin.runtime.processes import in_threads
from radiotwin.twin.model.blend import FORESTS, LEVEL_FORESTS, NAMED, REST, Blend
from radiotwin.twin.model.correlated_shadowing import (
    CorrelatedShadowing,
    moving_ends,
    receivers_move,
)
from radiotwin.twin.model.model import Fit, FittedModel

MAX_AWAY_LINKS = 12_000  # of which quadrants are held out
AWAY_TREES = 20
MIN_LEARNT = 60  # detected links that anything is learnt from
SAME_M = 0.1  # measured places closer together are one


@dataclass(frozen=True, eq=False)
class CombinedPrediction:
    """Held-out prediction by all that was learnt, and by other models alone.

    Attributes:
        reading_db: (n,) mean of a reading of each link [dB]: of its receiver and time, given that
            it is detected; NaN where there is none.
        map_db: (n,) what a map has there [dB]: the mean level at a faultless receiver, also below
            the limit of detection.
        rank: (n,) probability of a lower reading than the measured one.
        combination: of all links, by which the twin predicts.
        baselines: (n,) held-out prediction of other models [dB], by name.
    """

    reading_db: np.ndarray
    map_db: np.ndarray
    rank: np.ndarray
    combination: Combination
    baselines: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def coverage(self) -> float:
        """Share of held-out readings in the central 90 % intervals; NaN where there is none."""
        known = self.rank[np.isfinite(self.rank)]
        return float((np.abs(known - 0.5) <= 0.45).mean()) if len(known) else np.nan


def combined_prediction(model: CrossFit, with_rest: bool, seed: int) -> CombinedPrediction:
    """Return the held-out prediction by all that was learnt.

    Trees upon the physics are members, and trees alone, too: a pattern that fits what was measured
    may be wrong beyond.

    Args:
        model: with all effects that have a name.
        with_rest: whether to interpolate the rest, too, where the model does not yet.
        seed: of trees and samples.
    """
    links = model.links
    parts = [Part(each.links) for each in model.folds]
    baselines, laws = held_out_baselines(model, parts, seed)
    rest = [REST] if with_rest or model.whole.shadowing else []
    names = [NAMED, *FORESTS, *LEVEL_FORESTS, *rest,
             *(kind.name for kind in LAWS if kind is not LogDistance)]

    def of_fold(number: int) -> tuple[FittedModel, HeldOut]:
        """Return what is learnt outside a fold, and its links."""
        fold = model.folds[number]
        learnt = _learn(fold, parts[number], names, seed, laws=laws[number])
        test = np.flatnonzero((model.index == number) & fold.usable)
        return learnt, _held_out(learnt, fold, test, model.index[test])

    with warnings.catch_warnings():  # whose filters threads leave as another one had them
        folds = in_threads(of_fold, range(len(model.folds)))
    held_out = HeldOut.join([each for _, each in folds])
    away = _quadrants_held_out(model, folds[-1][0], parts[-1], names, seed)
    half_m, dof = half_distance_m(held_out, away), model.whole.model.dof

    reading_db, map_db, rank = np.full((3, len(links)), np.nan)
    for number, (learnt, _) in enumerate(folds):
        own = combination(held_out.select(held_out.fold != number),
                          away.select(away.fold != number), names, half_m, dof)
        fold = model.folds[number]
        test = np.flatnonzero((model.index == number) & fold.usable)
        learnt = _combined(learnt, fold, own)
        law = learnt.law_on(fold.on_rows(test))
        reading_db[test], rank[test] = law.reading_db, law.rank(links.level_db[test])
        map_db[test] = learnt.law_on(fold.for_map(test)).mean_db
    return CombinedPrediction(reading_db, map_db, rank,
                              combination(held_out, away, names, half_m, dof), baselines)


def served(model: CrossFit, found: Combination, seed: int) -> FittedModel:
    """Return what a twin predicts by: all that was learnt from all links, combined.

    Args:
        model: with all effects that have a name.
        found: `CombinedPrediction.combination`.
        seed: as of `combined_prediction`.
    """
    whole = model.whole
    return _combined(_learn(whole, Part(whole.links), found.weights, seed), whole, found)


def _learn(fit: Fit, part: Part, names: Collection[str], seed: int, trees: int = TREES,
           rest: CorrelatedShadowing | None = None,
           laws: dict[str, ChannelModel] | None = None) -> FittedModel:
    """Return all that is learnt from the training links of a fit; its weights are still equal.

    Args:
        fit: to some of n links.
        part: the links.
        names: of the members.
        seed: of trees and samples.
        trees: number of them.
        rest: interpolated rest; None: it is fitted where it is a member.
        laws: fitted already, by name.
    """
    if REST in names:
        rest = rest or fit.shadowing or fit.rest(seed)
    laws = laws or {kind.name: fitted_law(kind, fit.links, fit.train)
                    for kind in LAWS if kind.name in names}
    move = receivers_move(fit.links)
    ends_m, other = moving_ends(fit.links.select(fit.train), move)
    places = np.unique(np.column_stack([np.round(ends_m / SAME_M) * SAME_M, other]), axis=0)
    boresight_deg = fit.links.boresight_deg
    declared = np.flatnonzero(np.isfinite(boresight_deg))
    blend = Blend(dict.fromkeys(names, (1 / len(names), 1 / len(names))), HALF_M, (1.0, 1.0), move,
                  places[:, :3].astype(np.float32), places[:, 3].astype(int),  # as they are stored
                  grown_forests(fit, part, seed, names, trees),
                  {name: law for name, law in laws.items() if name in names},
                  np.column_stack([declared, boresight_deg[declared]]))
    return replace(fit.learnt, shadowing=rest or fit.shadowing, blend=blend)


def _combined(learnt: FittedModel, fit: Fit, found: Combination) -> FittedModel:
    """Return what was learnt with its weights, without what has none."""
    assert learnt.blend is not None
    blend = learnt.blend.weighted(found.weights, found.half_m, found.sd_ratio)
    shadowing = learnt.shadowing if REST in found.weights else fit.shadowing
    return replace(learnt, blend=blend, shadowing=shadowing)


def _held_out(learnt: FittedModel, fit: Fit, test: np.ndarray, fold: np.ndarray) -> HeldOut:
    """Return rows (m,) of a fit's links, of folds (m,), and what members predict of them."""
    assert learnt.blend is not None
    own = fit.on_rows(test)
    members_db, scales_db, unheard_db = learnt.members_on(own)
    losses = own.model.losses
    blank, drop, drop_db = (np.broadcast_to(np.asarray(each, dtype=float), len(test))
                            for each in (losses.blank, losses.drop, losses.drop_db))
    return HeldOut(own.links.level_db, own.model.limit_db, members_db, scales_db, unheard_db,
                   learnt.blend.away_m(own.links), blank, drop, drop_db, fold)


def _quadrants_held_out(model: CrossFit, learnt: FittedModel, part: Part, names: list[str],
                        seed: int) -> HeldOut:
    """Hold out each quadrant of the last fold's training links, fit to the others, and predict.

    Of the physics the coefficients are fitted again, and of rest and kriging the values. What the
    links that are held out still decide is, of a few numbers for all: the place of a box, the
    length of a correlation.
    """
    fit = model.folds[-1]
    assert learnt.blend is not None
    rows = np.flatnonzero(fit.train)
    if len(rows) > MAX_AWAY_LINKS:
        rng = np.random.default_rng(seed)
        rows = np.sort(rng.choice(rows, MAX_AWAY_LINKS, replace=False))
    part, quadrant = part.select(rows), _quadrant(fit.links)[rows]
    known = fit.on_rows(rows)
    found = [_held_out(learnt, fit, rows[:0], rows[:0])]
    for each in range(4):
        out = quadrant == each
        test = np.flatnonzero(out)
        if not len(test) or np.isfinite(part.links.level_db[~out]).sum() < MIN_LEARNT:
            continue
        inner = replace(known.model, train=~out).fit(known)
        rest = None if REST not in names else inner.rest(seed, learnt.shadowing)
        laws = {kind.name: fitted_law(kind, part.links, ~out, learnt.blend.laws.get(kind.name))
                for kind in LAWS if kind.name in names}
        away = _learn(inner, part, names, seed, AWAY_TREES, rest, laws)
        found.append(_held_out(away, inner, test, model.index[rows[test]]))
    return HeldOut.join(found)


def _quadrant(links: Links) -> np.ndarray:
    """Return the quadrant (n,) of the area that the end that moves is in.

    With one left out, as much is extrapolated as by a map of more than was measured.
    """
    moving_m = moving_ends(links, receivers_move(links))[0]
    above = moving_m[:, :2] > np.median(moving_m[:, :2], axis=0)
    return above @ np.array([1, 2])


def grown_forests(fit: Fit, part: Part, seed: int, names: Collection[str],
                  trees: int = TREES) -> dict[str, Forest]:
    """Grow trees on training links: on the standardised residual (`FORESTS`), and on the levels.

    A blank counts as the named effects' mean below the limit. The receiver is no feature of
    theirs: its effects have names, and a map has none.

    Args:
        fit: to some of n links.
        part: the links, with the features of trees.
        seed: of the trees.
        names: those that are asked for, among others.
        trees: number of them.
    """
    if not set(names) & set(FORESTS + LEVEL_FORESTS):
        return {}
    rows = np.flatnonzero(fit.train)
    z = fit.training_z
    mean_db, scale_db, _ = fit.reading_parts()
    level_db = mean_db[rows] + z * scale_db[rows]
    return {name: grow_trees(kind, part.common[rows], target, seed, trees)
            for both, target in ((FORESTS, z), (LEVEL_FORESTS, level_db))
            for name, kind in zip(both, (EXTRA_TREES, BOOSTING), strict=True) if name in names}
