"""The final prediction: named physics, an interpolated rest and regressions, by weights.

Near measured places interpolation and trees know most, and far from them physics does. So each
member of the combination has a weight near measurements and one far from them, with a smooth
transition. The weights are those with the least held-out error on other folds: no reading has a
part in the members by which it is predicted, and no error of its fold has one in the weights. For a
few numbers that many readings choose, nested cross-validation is not needed (Wainer and Cawley
2021, 'Nested cross-validation when selecting classifiers is overzealous for most practical
applications', Expert Systems with Applications 182).
"""

from __future__ import annotations

import warnings
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

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
    law_db,
    laws_for,
)
from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from radiotwin.inference.held_out import combine, convex_weights
from radiotwin.inference.student import mean_if_detected
from radiotwin.links import Links
from radiotwin.propagation.laws.forest import Forest
from radiotwin.propagation.laws.kriging import RegressionKriging
from radiotwin.propagation.laws.log_distance import LogDistance
from radiotwin.runtime.processes import in_threads
from radiotwin.twin.model.blend import FORESTS, NAMED, REST, TREES_ALONE, far_share
from radiotwin.twin.model.correlated_shadowing import CorrelatedShadowing, receivers_move
from radiotwin.twin.model.model import Fit

HALF_M = 50.0  # distance to the nearest measurement at which near and far count the same
PULL = 0.01  # towards the best single member, see `convex_weights`: 2 % of the RMSE
MAX_AWAY_LINKS = 12_000  # of which quadrants are held out
AWAY_TREES = 20
MIN_LEARNT = 60  # detected links that anything is learnt from


@dataclass(frozen=True, eq=False)
class CombinedPrediction:
    """Held-out prediction by all that was learnt, and by other models alone.

    Attributes:
        mean_db: (n,) level of a link that is detected [dB]; NaN where there is none.
        names: of the k members.
        weights: (2, k) near measurements, and far from them; from all links.
        members: (n, k) held-out prediction of each member [dB].
        share: (n,) how far a link is from the measurements that it was predicted by.
        baselines: (n,) held-out prediction of other models [dB], by name.
        away: (r, 3) of links with a quadrant of the area held out: error over the scale of named
            effects, how far away they are, and their fold; what extrapolation costs.
    """

    mean_db: np.ndarray
    names: list[str]
    weights: np.ndarray
    members: np.ndarray
    share: np.ndarray
    baselines: dict[str, np.ndarray] = field(default_factory=dict)
    away: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class _Learnt:
    """A model of some links, with all that is learnt beside it, and which members count."""

    fit: Fit
    rest: CorrelatedShadowing | None
    kriging: RegressionKriging | None
    part: Part
    names: list[str]

    def without_quadrants(self, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Hold out each quadrant of its training links, fit to the others, and predict.

        Of the physics the coefficients are fitted again, and of rest and kriging the values. What
        the links that are held out still decide is, of a few numbers for all: the place of a box,
        the length of a correlation.

        Returns:
            (r, k) measured minus predicted by each member [dB], (r,) far shares, (r,) error scales
            of named effects [dB], and (r,) rows of the links.
        """
        rows = np.flatnonzero(self.fit.train)
        if len(rows) > MAX_AWAY_LINKS:
            rng = np.random.default_rng(seed)
            rows = np.sort(rng.choice(rows, MAX_AWAY_LINKS, replace=False))
        part, quadrant = self.part.select(rows), _quadrant(self.fit.links)[rows]
        whole = self.fit.model.restrict(rows)
        found = [(np.zeros((0, len(self.names))), np.zeros(0), np.zeros(0), rows[:0])]
        for each in range(4):
            out = quadrant == each
            test = np.flatnonzero(out & np.isfinite(part.links.level_db))
            if not len(test) or np.isfinite(part.links.level_db[~out]).sum() < MIN_LEARNT:
                continue
            fit = replace(whole, train=~out).fit(self.fit)
            rest = self.rest and fit.rest(0, self.rest)
            inner = _Learnt(fit, rest, self.kriging, part, self.names)
            found.append((part.links.level_db[test, None] - inner.members_db(test, seed),
                          _shares_of(part.links, ~out, test), fit.reading_parts()[1][test],
                          rows[test]))
        errors_db, shares, scales_db, tested = (np.concatenate(each) for each in zip(*found))
        return errors_db, shares, scales_db, tested

    def members_db(self, test: np.ndarray, seed: int) -> np.ndarray:
        """Return predictions (m, k) of rows (m,), by few trees and known correlations [dB]."""
        physics = _physics_db(self.fit, self.rest, self.part, test, seed, AWAY_TREES)
        links = self.part.links
        laws = [law_db(fitted_law(kind, links, self.fit.train, self.kriging), links, test)
                for kind in LAWS if kind.name in self.names]
        return np.column_stack([physics, *laws])


def combined_prediction(model: CrossFit, with_rest: bool, criteria: SelectionCriteria,
                        seed: int) -> CombinedPrediction:
    """Return the held-out prediction by all that was learnt.

    Trees upon the physics are members, and trees alone, too: a pattern that fits what was measured
    may be wrong beyond.

    Args:
        model: with all effects that have a name.
        with_rest: whether to interpolate the rest, too, where the model does not yet.
        criteria: when kriging takes too long.
        seed: of trees and samples.
    """
    links, count = model.links, len(model.folds)
    parts = [Part(each.links) for each in model.folds]
    baselines, kriging = held_out_baselines(model, parts, criteria, seed)
    laws = [kind.name for kind in laws_for(links, criteria) if kind is not LogDistance]
    rest_too = [REST] if with_rest or model.whole.shadowing else []
    names = [NAMED, *FORESTS, *TREES_ALONE, *rest_too, *laws]

    def of_fold(number: int) -> tuple[_Learnt, np.ndarray, np.ndarray, np.ndarray]:
        """Return what is learnt outside a fold; its rows (m,), their members and far shares."""
        fold, part, rest = model.folds[number], parts[number], None
        if REST in names:
            rest = fold.shadowing or fold.rest(seed)
        learnt = _Learnt(fold, rest, kriging[number] if kriging else None, part, names)
        test = np.flatnonzero((model.index == number) & fold.usable)
        members = np.column_stack([_physics_db(fold, rest, part, test, seed),
                                   *(baselines[name][test] for name in laws)])
        return learnt, test, members, _shares_of(part.links, fold.train, test)

    members, share = np.full((len(links), len(names)), np.nan), np.ones(len(links))
    with warnings.catch_warnings():  # whose filters threads leave as another one had them
        folds = in_threads(of_fold, range(count))
    for _, test, own_members, own_share in folds:
        members[test], share[test] = own_members, own_share
    far_db, far_share, far_scale_db, far_rows = folds[-1][0].without_quadrants(seed)

    def weights_of(here: np.ndarray) -> np.ndarray:
        """Return the weights (2, k) of some of the links, (n,) bool."""
        away = here[far_rows]
        error_db = links.level_db[here, None] - members[here]
        return _weights(np.vstack([error_db, far_db[away]]),
                        np.concatenate([share[here], far_share[away]]), names)

    mean_db = np.full(len(links), np.nan)
    for number in range(count):
        own = model.index == number
        mean_db[own] = combine(members[own], share[own], weights_of(~own))
    weights = weights_of(np.ones(len(links), dtype=bool))
    away = np.column_stack([combine(far_db, far_share, weights) / far_scale_db, far_share,
                            model.index[far_rows]])
    return CombinedPrediction(mean_db, names, weights, members, share, baselines, away)


def _quadrant(links: Links) -> np.ndarray:
    """Return the quadrant (n,) of the area that the end that moves is in.

    With one left out, as much is extrapolated as by a map of more than was measured.
    """
    moving_m = links.receiver_m if receivers_move(links) else links.device_m[links.device]
    above = moving_m[:, :2] > np.median(moving_m[:, :2], axis=0)
    return above @ np.array([1, 2])


def _shares_of(links: Links, train: np.ndarray, test: np.ndarray) -> np.ndarray:
    """Return how far rows (m,) of links are from the measured ones, in 0..1, see `far_share`.

    By the end that moves, from where it was measured with the same other end.
    """
    moving_m, other = (links.receiver_m, links.device) if receivers_move(links) else (
        links.device_m[links.device], links.receiver)
    away_m = np.full(len(test), np.inf)
    learnt = np.arange(len(links))[train]
    for label in np.unique(other[test]):
        mine = np.flatnonzero(other[test] == label)
        known = learnt[other[learnt] == label]
        if len(known):
            away_m[mine] = cKDTree(moving_m[known]).query(moving_m[test[mine]])[0]
    return far_share(away_m, HALF_M)


def _weights(error_db: np.ndarray, share: np.ndarray, names: list[str]) -> np.ndarray:
    known = np.isfinite(error_db).all(axis=1)
    if not known.any():  # nothing could be held out
        return np.tile(np.array(names) == NAMED, (2, 1)).astype(float)
    return convex_weights(error_db[known], share[known], PULL)


def grown_forests(fit: Fit, part: Part, seed: int, trees: int = TREES,
                  names: Collection[str] = (*FORESTS, *TREES_ALONE)) -> dict[str, Forest]:
    """Grow trees on training links: on the standardised residual (`FORESTS`), and on the levels.

    A blank counts as the named effects' mean below the limit. The receiver is no feature of
    theirs: its effects have names, and a map has none.

    Args:
        fit: to some of n links.
        part: the links, with the features of trees.
        seed: of the trees.
        trees: number of them.
        names: those that are asked for.
    """
    rows = np.flatnonzero(fit.train)
    z = fit.training_z
    mean_db, scale_db, _ = fit.reading_parts()
    level_db = mean_db[rows] + z * scale_db[rows]
    return {name: grow_trees(kind, part.common[rows], target, seed, trees)
            for both, target in ((FORESTS, z), (TREES_ALONE, level_db))
            for name, kind in zip(both, (EXTRA_TREES, BOOSTING), strict=True) if name in names}


def _physics_db(fit: Fit, rest: CorrelatedShadowing | None, part: Part, test: np.ndarray,
               seed: int, trees: int = TREES) -> np.ndarray:
    """Return levels by named effects and trees, alone and together, and with the rest [dB].

    Of rows (m,) of links, if they are detected: (m, 5), or (m, 6) with the rest.
    """
    limit_db, mean_db, scale_db, unheard_db = (each[test] for each in (
        fit.model.limit_db, *fit.reading_parts()))
    losses = fit.model.losses.select(test)
    added: list[tuple] = [(0.0, 1.0)]
    for name, forest in grown_forests(fit, part, seed, trees).items():
        predicted = forest.predict(part.common[test])
        alone = name in TREES_ALONE
        added.append(((predicted - mean_db) / scale_db if alone else predicted, 1.0))
    if rest is not None:
        added.append(rest.at(fit.links.select(test)))
    return np.column_stack([
        mean_if_detected(mean_db + shift * scale_db, np.hypot(scale_db * left, unheard_db),
                         limit_db, fit.model.dof, losses)
        for shift, left in added])
