"""The combination of a loop as a twin keeps it: fitted to all links."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls
from scipy.stats import t as student

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.predict.baselines import LAWS, Part, fitted_law
from radiotwin.closeloop.predict.predictor import HALF_M, CombinedPrediction, grown_forests
from radiotwin.twin.model.blend import FORESTS, NAMED, REST, TREES_ALONE, Blend, sd_factor
from radiotwin.twin.model.correlated_shadowing import MAX_Z, receivers_move

MIN_WEIGHT = 0.02  # a member that has less, near and far, is left out
MIN_SD_RATIO = 0.05
SAME_M = 0.1  # measured places closer together are one


def make_blend(model: CrossFit, prediction: CombinedPrediction,
               seed: int) -> Blend | None:
    """Return what predicts beside named effects.

    None where these are best, or receivers do not move.

    Args:
        model: with all effects that have a name.
        prediction: whose weights are taken.
        seed: of the trees.
    """
    whole = model.whole
    weights = _members(prediction)
    if _is_physics_alone(model, prediction):
        return None
    total = np.sum(list(weights.values()), axis=0)
    grown = set(weights) & set(FORESTS + TREES_ALONE)
    forests = grown_forests(whole, Part(whole.links), seed, names=grown) if grown else {}
    laws = {kind.name: fitted_law(kind, whole.links, whole.train)
            for kind in LAWS if kind.name in weights}
    places = np.column_stack([np.round(whole.links.receiver_m / SAME_M) * SAME_M,
                              whole.links.device])[whole.train]
    places = np.unique(places, axis=0)
    declared = np.flatnonzero(np.isfinite(whole.links.boresight_deg))
    near, far = _sd_ratio(model, prediction)
    return Blend({name: (float(pair[0]), float(pair[1])) for name, pair in
                  ((name, pair / total) for name, pair in weights.items())},
                 HALF_M, (near, far), places[:, :3], places[:, 3].astype(int),
                 forests, laws,
                 np.column_stack([declared, whole.links.boresight_deg[declared]]))


def needs_rest(prediction: CombinedPrediction) -> bool:
    """Return whether the interpolated rest has a weight."""
    return REST in prediction.names and bool(
        prediction.weights[:, prediction.names.index(REST)].max() >= MIN_WEIGHT)


def held_out_coverage(model: CrossFit, prediction: CombinedPrediction) -> float:
    """Return the share of held-out readings in the central 90 % intervals of a twin's prediction.

    How wide those of a fold are is learnt from the other folds. Arguments as of `make_blend`.

    Returns:
        in 0..1; NaN where no reading is predicted.
    """
    half = student.ppf(0.95, model.whole.model.dof)
    if _is_physics_alone(model, prediction):
        mean_db, scale_db = model.held_out_reading
    else:
        mean_db, (scale_db, unheard_db) = prediction.mean_db, model.held_out_scales
        factor = np.ones(len(scale_db))
        for number in range(len(model.folds)):
            out = model.index == number
            factor[out] = sd_factor(prediction.share[out], _sd_ratio(model, prediction, number))
        scale_db = np.hypot(scale_db * factor, unheard_db)
    z = np.abs(model.links.level_db - mean_db) / scale_db
    known = np.isfinite(z)
    return float((z[known] <= half).mean()) if known.any() else np.nan


def _members(prediction: CombinedPrediction) -> dict[str, np.ndarray]:
    """Return the weights (2,) of the members that count, by name."""
    return {name: pair for name, pair in zip(prediction.names, prediction.weights.T, strict=True)
            if pair.max() >= MIN_WEIGHT}


def _is_physics_alone(model: CrossFit, prediction: CombinedPrediction) -> bool:
    return set(_members(prediction)) == {NAMED} or not receivers_move(model.links)


def _sd_ratio(model: CrossFit, prediction: CombinedPrediction,
              but: int = -1) -> tuple[float, float]:
    """Return the error's sd over that of named effects, near and far.

    The greater of two estimates each: from held-out links, and from these and whole quadrants
    that were held out. A map extrapolates, and few places do not tell what that costs. Links of
    the fold `but` have no part in it.
    """
    scale_db, unheard_db = model.held_out_scales
    # What levels that nobody knows are off by is not the combination's error.
    square = (model.links.level_db - prediction.mean_db) ** 2 - unheard_db**2
    z = np.sqrt(np.maximum(square, 0.0)) / scale_db
    here = np.column_stack([z, prediction.share])[np.isfinite(z) & (model.index != but)]
    if not len(here):
        return 1.0, 1.0
    away = prediction.away[prediction.away[:, 2] != but, :2]
    ratios = [_fitted_ratio(links, model.whole.model.dof)
              for links in (here, np.vstack([here, away]))]
    near, far = np.max(ratios, axis=0)
    return float(near), float(far)


def _fitted_ratio(links: np.ndarray, dof: float) -> np.ndarray:
    """Return the sd ratio near and far (2,), from links (n, 2): error over scale, and far share."""
    z, share = links.T
    columns = np.column_stack([1 - share, share])
    square = np.clip(z, -MAX_Z, MAX_Z) ** 2 * (dof - 2) / dof
    # Where there is little far away, as near; where nearly nothing is, as much as is known.
    prior = 1e-2 * len(square) * np.eye(2)
    found, _ = nnls(np.vstack([columns, prior]), np.concatenate(
        [square, prior.sum(axis=1) * square.mean()]))
    return np.sqrt(np.maximum(found, MIN_SD_RATIO**2))
