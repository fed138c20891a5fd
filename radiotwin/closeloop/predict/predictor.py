"""Combine the named effects, interpolated shadowing, laws and trees into one weighted prediction.

Near measured places interpolation and trees predict best, far from them physics does. So each
predictor of the combination has a weight near measurements and one far from them, with a smooth
transition. The weights minimise the held-out error on other folds: no reading takes part in the
predictors or in the weights by which it is predicted. Nested cross-validation is not needed for so
few weights (Wainer and Cawley 2021, 'Nested cross-validation when selecting classifiers is
overzealous for most practical applications', Expert Systems with Applications 182).

Folds and the loop's twin predict by the same code
(`radiotwin.twin.model.model.FittedModel.reading_law_on`).
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
from radiotwin.twin.model.blend import FORESTS, LEVEL_FORESTS, NAMED, SHADOWED, Blend
from radiotwin.twin.model.correlated_shadowing import (
    CorrelatedShadowing,
    moving_ends,
    receivers_move,
)
from radiotwin.twin.model.model import Fit, FittedModel

MAX_AWAY_LINKS = 12_000  # sample of which quadrants are held out
AWAY_TREES = 20  # trees of a quadrant's fit
MIN_LEARNT = 60  # least number of detected training links outside a quadrant
SAME_M = 0.1  # measured places are rounded to this [m]


@dataclass(frozen=True, eq=False)
class CombinedPrediction:
    """Held-out prediction by the combination of models, and by each baseline alone.

    Attributes:
        reading_db: (n,) mean reading [dB] of the link's receiver and time, given that it is
            detected; NaN without a prediction.
        map_db: (n,) value of a map [dB]: mean level at a faultless receiver, also below the limit
            of detection.
        rank: (n,) predicted probability of a reading below the measured one.
        combination: weights from all links, by which the twin predicts.
        baselines: (n,) held-out predictions [dB] by the baseline's name.
    """

    reading_db: np.ndarray
    map_db: np.ndarray
    rank: np.ndarray
    combination: Combination
    baselines: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def coverage(self) -> float:
        """Share of held-out readings within their central 90 % intervals; NaN without any."""
        known = self.rank[np.isfinite(self.rank)]
        return float((np.abs(known - 0.5) <= 0.45).mean()) if len(known) else np.nan


def combined_prediction(model: CrossFit, with_shadowing: bool, seed: int) -> CombinedPrediction:
    """Predict held-out links by a weighted combination of models.

    Predictors: base with effects, trees on its residual and on levels, shadowing, laws.
    The weights for a fold are fitted to the links of the other folds.

    Args:
        model: cross-validated fit with all named effects.
        with_shadowing: whether to interpolate the residual even if the model has no shadowing.
        seed: random seed of trees and samples.
    """
    links = model.links
    parts = [Part(each.links) for each in model.folds]
    baselines, laws = held_out_baselines(model, parts, seed)
    shadowed = [SHADOWED] if with_shadowing or model.whole.shadowing else []
    names = [NAMED, *FORESTS, *LEVEL_FORESTS, *shadowed,
             *(kind.name for kind in LAWS if kind is not LogDistance)]

    def of_fold(number: int) -> tuple[FittedModel, HeldOut]:
        """Return the predictors learnt outside a fold, and their prediction of its links."""
        fold = model.folds[number]
        learnt = _learn(fold, parts[number], names, seed, laws=laws[number])
        test = np.flatnonzero((model.index == number) & fold.usable)
        return learnt, _held_out(learnt, fold, test, model.index[test])

    with warnings.catch_warnings():  # threads interleave their changes of the filters
        folds = in_threads(of_fold, range(len(model.folds)))
    held_out = HeldOut.join([each for _, each in folds])
    quadrants = _hold_out_quadrants(model, folds[-1][0], parts[-1], names, seed)
    half_m, dof = half_distance_m(held_out, quadrants), model.whole.model.dof

    reading_db, map_db, rank = np.full((3, len(links)), np.nan)
    for number, (learnt, _) in enumerate(folds):
        weights = combination(held_out.select(held_out.fold != number),
                              quadrants.select(quadrants.fold != number), names, half_m, dof)
        fold = model.folds[number]
        test = np.flatnonzero((model.index == number) & fold.usable)
        learnt = _combined(learnt, fold, weights)
        law = learnt.reading_law_on(fold.on_rows(test))
        reading_db[test], rank[test] = law.reading_db, law.rank(links.level_db[test])
        map_db[test] = learnt.reading_law_on(fold.for_map(test)).mean_db
    return CombinedPrediction(reading_db, map_db, rank,
                              combination(held_out, quadrants, names, half_m, dof), baselines)


def combined_fit(model: CrossFit, found: Combination, seed: int) -> FittedModel:
    """Learn the predictors of a combination from all links, for the loop's twin.

    Args:
        model: cross-validated fit with all named effects.
        found: weights, `CombinedPrediction.combination`.
        seed: random seed, as in `combined_prediction`.
    """
    whole = model.whole
    return _combined(_learn(whole, Part(whole.links), found.weights, seed), whole, found)


def _learn(fit: Fit, part: Part, names: Collection[str], seed: int, trees: int = TREES,
           shadowing: CorrelatedShadowing | None = None,
           laws: dict[str, ChannelModel] | None = None) -> FittedModel:
    """Learn the predictors of a combination (effects, trees, laws, …), all with equal weights."""
    if SHADOWED in names:
        shadowing = shadowing or fit.shadowing or fit.fit_shadowing(seed)
    laws = laws or {kind.name: fitted_law(kind, fit.links, fit.train)
                    for kind in LAWS if kind.name in names}
    move = receivers_move(fit.links)
    ends_m, other = moving_ends(fit.links.select(fit.train), move)
    places = np.unique(np.column_stack([np.round(ends_m / SAME_M) * SAME_M, other]), axis=0)
    boresight_deg = fit.links.boresight_deg
    declared = np.flatnonzero(np.isfinite(boresight_deg))
    blend = Blend(dict.fromkeys(names, (1 / len(names), 1 / len(names))), HALF_M, (1.0, 1.0), move,
                  places[:, :3].astype(np.float32), places[:, 3].astype(int),  # as they are stored
                  _grow_forests(fit, part, seed, names, trees),
                  {name: law for name, law in laws.items() if name in names},
                  np.column_stack([declared, boresight_deg[declared]]))
    return replace(fit.learnt, shadowing=shadowing or fit.shadowing, blend=blend)


def _combined(learnt: FittedModel, fit: Fit, found: Combination) -> FittedModel:
    """Return a learnt model with the weights of a combination, without unweighted predictors."""
    assert learnt.blend is not None
    blend = learnt.blend.weighted(found.weights, found.half_m, found.sd_ratio)
    shadowing = learnt.shadowing if SHADOWED in found.weights else fit.shadowing
    return replace(learnt, blend=blend, shadowing=shadowing)


def _held_out(learnt: FittedModel, fit: Fit, test: np.ndarray, fold: np.ndarray) -> HeldOut:
    """Predict the links `test` (m,) of a fit by each predictor; `fold` (m,) is their fold."""
    assert learnt.blend is not None
    tested = fit.on_rows(test)
    predicted_db, scales_db, unheard_db = learnt.predictions_on(tested)
    losses = tested.model.losses
    blank, drop, drop_db = (np.broadcast_to(np.asarray(each, dtype=float), len(test))
                            for each in (losses.blank, losses.drop, losses.drop_db))
    return HeldOut(tested.links.level_db, tested.model.limit_db, predicted_db, scales_db,
                   unheard_db, learnt.blend.away_m(tested.links), blank, drop, drop_db, fold)


def _hold_out_quadrants(model: CrossFit, learnt: FittedModel, part: Part, names: list[str],
                        seed: int) -> HeldOut:
    """Predict quadrants of the last fold's training links by predictors learnt in the other three.

    Refitted are coefficients, trees and interpolated values. A few searched parameters, such as the
    position of a box or a correlation length, are kept from the fit to all training links.
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
        shadowing = None if SHADOWED not in names else inner.fit_shadowing(seed, learnt.shadowing)
        laws = {kind.name: fitted_law(kind, part.links, ~out, learnt.blend.laws.get(kind.name))
                for kind in LAWS if kind.name in names}
        away = _learn(inner, part, names, seed, AWAY_TREES, shadowing, laws)
        found.append(_held_out(away, inner, test, model.index[rows[test]]))
    return HeldOut.join(found)


def _quadrant(links: Links) -> np.ndarray:
    """Return the quadrant (n,) of the area in which the moving end is, 0 to 3."""
    moving_m = moving_ends(links, receivers_move(links))[0]
    above = moving_m[:, :2] > np.median(moving_m[:, :2], axis=0)
    return above @ np.array([1, 2])


def _grow_forests(fit: Fit, part: Part, seed: int, names: Collection[str],
                  trees: int = TREES) -> dict[str, Forest]:
    """Grow trees on training links: for the standardised residual (`FORESTS`) and for the level.

    Only the forests among `names` are grown. For a blank link, its expected value below the limit
    of detection is used. The receiver is no feature, since a map is for a faultless receiver.
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
