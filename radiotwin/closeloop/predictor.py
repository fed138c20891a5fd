"""The final prediction: named physics, an interpolated rest and regressions, by weights.

Near measured places interpolation and trees know most, and far from them physics does. So each
member of the combination has a weight near measurements and one far from them, with a smooth
transition. The weights are those with the least held-out error, and no reading has a part in the
weights, the rest or the trees by which it is predicted: within the links outside a fold, folds of
the same kind are held out in turn (nested cross-validation).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from radiotwin.channel.regression_kriging import RegressionKriging
from radiotwin.closeloop.baselines import (
    EXTRA_TREES,
    LAWS,
    TREES,
    Part,
    grow_trees,
    held_out_baselines,
    law_db,
    laws_for,
    trees_db,
)
from radiotwin.closeloop.criteria import SelectionCriteria
from radiotwin.closeloop.cross_validation import CrossValidatedModel
from radiotwin.effects.correlated_shadowing import (
    CorrelatedShadowing,
    receivers_move,
    standardised_residual,
)
from radiotwin.effects.fold_model import FoldModel
from radiotwin.inference.censored_regression import FitResult
from radiotwin.inference.stacking import combine, convex_weights
from radiotwin.inference.student import mean_if_detected
from radiotwin.links import LinkData

NAMED, REST, LEARNT = "named", "named_and_rest", "named_and_trees"
HALF_M = 50.0  # distance to the nearest measurement at which near and far count the same
PULL = 0.01  # towards the best single member, see `convex_weights`: 2 % of the RMSE
INNER_FOLDS = 3  # that are held out within the links outside a fold
MAX_INNER_LINKS = 12_000  # that they are a sample of
INNER_TREES = 20


@dataclass(frozen=True, eq=False)
class CombinedPrediction:
    """Held-out prediction by all that was learnt, and by other models alone.

    Attributes:
        mean_db: (n,) level of a link that is detected [dB]; NaN where there is none.
        names: of the k members.
        weights: (2, k) near measurements, and far from them; from all folds.
        members: (n, k) held-out prediction of each member [dB].
        baselines: (n,) held-out prediction of other models [dB], by name.
    """

    mean_db: np.ndarray
    names: list[str]
    weights: np.ndarray
    members: np.ndarray
    baselines: dict[str, np.ndarray] = field(default_factory=dict)


def far_share(links: LinkData, train: np.ndarray, test: np.ndarray) -> np.ndarray:
    """Return how far some links are from all measured ones, in 0..1.

    d / (d + `HALF_M`), where d is the distance of the end that moves to where it was measured with
    the same other end; 1 where that was not measured at all.

    Args:
        links: n links.
        train: (n,) bool or rows, measured.
        test: (m,) rows.

    Returns:
        (m,)
    """
    device_m = links.device_m[links.device]
    moving_m, other = (links.receiver_m, links.device) if receivers_move(links) else (
        device_m, links.receiver)
    away_m = np.full(len(test), np.inf)
    learnt = np.arange(len(links))[train]
    for label in np.unique(other[test]):
        mine = np.flatnonzero(other[test] == label)
        known = learnt[other[learnt] == label]
        if len(known):
            away_m[mine] = cKDTree(moving_m[known]).query(moving_m[test[mine]])[0]
    return 1 - HALF_M / (away_m + HALF_M)


def combined_prediction(model: CrossValidatedModel, with_rest: bool, criteria: SelectionCriteria,
                        seed: int) -> CombinedPrediction:
    """Return the held-out prediction by all that was learnt.

    Boosting is no member: trees upon the physics predict as well, and it takes as long as all.

    Args:
        model: with all effects that have a name.
        with_rest: whether to interpolate the rest, too, where the model does not yet.
        criteria: when kriging takes too long.
        seed: of trees and samples.
    """
    links = model.links
    parts = [Part(each.links) for each in model.folds]
    baselines, kriging = held_out_baselines(model, parts, criteria, seed)
    of_links = [kind.name for kind in laws_for(links, criteria)[1:]] + [EXTRA_TREES]
    names = [NAMED, LEARNT, *([REST] if with_rest or model.shadowing else []), *of_links]
    members, share = np.full((len(links), len(names)), np.nan), np.ones(len(links))
    mean_db = np.full(len(links), np.nan)
    for number, (fold, fit, part) in enumerate(zip(model.folds, model.fits[1:], parts,
                                                   strict=True)):
        rest = None
        if REST in names:
            rest = model.shadowing[number + 1] if model.shadowing else CorrelatedShadowing.fit(
                fold, fit, seed)
        test = np.flatnonzero((model.index == number) & fold.usable)
        share[test] = far_share(part.links, fold.train, test)
        members[test] = np.column_stack([
            physics_db(fold, fit, rest, part.features, test, seed),
            *(baselines[name][test] for name in of_links)])
        inner = _inner(model, number, rest, kriging[number] if kriging else None, part, of_links,
                       seed)
        mean_db[test] = combine(members[test], share[test], _weights(*inner, names))
    error_db = links.level_db[:, None] - members
    return CombinedPrediction(mean_db, names, _weights(error_db, share, names), members, baselines)


def _weights(error_db: np.ndarray, share: np.ndarray, names: list[str]) -> np.ndarray:
    known = np.isfinite(error_db).all(axis=1)
    if not known.any():  # nothing could be held out
        return np.tile(np.array(names) == NAMED, (2, 1)).astype(float)
    return convex_weights(error_db[known], share[known], PULL)


def physics_db(model: FoldModel, fit: FitResult, rest: CorrelatedShadowing | None, features: np.ndarray,
               test: np.ndarray, seed: int, trees: int = TREES) -> np.ndarray:
    """Return what named effects predict, alone, with trees upon them, and with the rest [dB].

    Args:
        model: n links, of which some are learnt from.
        fit: to these.
        rest: interpolated, of these; None: not asked for.
        features: (n, p) that the trees are told.
        test: (m,) rows.
        seed: of the trees.
        trees: number of them.

    Returns:
        (m, 2), or (m, 3) with the rest, level of a link that is detected.
    """
    reading = model.predict(fit)
    mean_db, scale_db, limit_db = (each[test] for each in (
        reading.mean_db, reading.scale_db, model.limit_db))
    rows = np.flatnonzero(model.train)
    forest = grow_trees(EXTRA_TREES, features[rows], standardised_residual(model, fit), seed, trees)
    added: list[tuple] = [(0.0, 1.0), (forest.predict(features[test]), 1.0)]
    if rest is not None:
        added.append(rest.at(model.links.select(test)))
    return np.column_stack([
        mean_if_detected(mean_db + shift * scale_db, scale_db * left, limit_db, model.dof)
        for shift, left in added])


def _inner(model: CrossValidatedModel, number: int, rest: CorrelatedShadowing | None,
           kriging: RegressionKriging | None, part: Part, of_links: list[str], seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return errors (r, k) of all members on held-out links outside a fold, and their `far_share`.

    Of the physics the coefficients are fitted again, and of the rest the values; what is left of
    the links that are held out is the place of a box, or the correlation's length.
    """
    fold, fit = model.folds[number], model.fits[number + 1]
    rows = np.flatnonzero(fold.train)
    if len(rows) > MAX_INNER_LINKS:
        rng = np.random.default_rng(seed)
        rows = np.sort(rng.choice(rows, MAX_INNER_LINKS, replace=False))
    index, count = model.index[rows], len(model.folds)
    own = Part(part.links.select(rows))
    own.__dict__["features"] = part.features[rows]
    whole = fold.restrict(rows, fold.effects)
    laws = {kind.name: kind for kind in LAWS}
    errors, shares = [np.zeros((0, 2 + (rest is not None) + len(of_links)))], [np.zeros(0)]
    for step in range(1, min(INNER_FOLDS, count - 1) + 1):
        held_out = index == (number + step) % count
        test = np.flatnonzero(held_out & np.isfinite(own.links.level_db))
        if not len(test) or held_out.all():
            continue
        inner = replace(whole, train=~held_out)
        refitted = inner.fit(fit)
        physics = physics_db(inner, refitted, rest and rest.refit(inner, refitted), own.features,
                             test, seed, INNER_TREES)
        others = [law_db(laws[name], own.links, ~held_out, test, kriging) if name in laws else
                  trees_db(name, own, ~held_out, test, seed, INNER_TREES) for name in of_links]
        errors.append(own.links.level_db[test, None] - np.column_stack([physics, *others]))
        shares.append(far_share(own.links, ~held_out, test))
    return np.concatenate(errors), np.concatenate(shares)
