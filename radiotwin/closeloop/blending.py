"""The combination of a loop as a twin keeps it: fitted to all links."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

from radiotwin.closeloop.baselines import LAWS, Part, fitted_law
from radiotwin.closeloop.cross_validation import CrossValidatedModel
from radiotwin.closeloop.predictor import HALF_M, CombinedPrediction, residual_forests
from radiotwin.effects.blend import FORESTS, NAMED, REST, Blend
from radiotwin.effects.correlated_shadowing import MAX_Z, receivers_move

MIN_WEIGHT = 0.02  # a member that has less, near and far, is left out
MIN_SD_RATIO = 0.05
SAME_M = 0.1  # measured places closer together are one


def make_blend(model: CrossValidatedModel, prediction: CombinedPrediction,
               seed: int) -> Blend | None:
    """Return what predicts beside named effects.

    None where these are best, or receivers do not move.

    Args:
        model: with all effects that have a name.
        prediction: whose weights are taken.
        seed: of the trees.
    """
    whole, fit = model.whole, model.fits[0]
    weights = {name: pair for name, pair in zip(prediction.names, prediction.weights.T, strict=True)
               if pair.max() >= MIN_WEIGHT}
    if set(weights) == {NAMED} or not receivers_move(whole.links):
        return None
    total = np.sum(list(weights.values()), axis=0)
    forests = {}
    if set(weights) & set(FORESTS):
        forests = residual_forests(whole, fit, Part(whole.links), seed)
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
                 {name: forest for name, forest in forests.items() if name in weights}, laws,
                 np.column_stack([declared, whole.links.boresight_deg[declared]]))


def needs_rest(prediction: CombinedPrediction) -> bool:
    """Return whether the interpolated rest has a weight."""
    return REST in prediction.names and bool(
        prediction.weights[:, prediction.names.index(REST)].max() >= MIN_WEIGHT)


def _sd_ratio(model: CrossValidatedModel, prediction: CombinedPrediction) -> tuple[float, float]:
    """Return the error's sd over that of named effects, near and far, from held-out links."""
    scale_db = model.held_out(lambda fold, fit: fold.predict(fit).scale_db)
    z = (model.links.level_db - prediction.mean_db) / scale_db
    known = np.isfinite(z)
    if not known.any():
        return 1.0, 1.0
    share = prediction.share[known]
    columns = np.column_stack([1 - share, share])
    dof = model.whole.dof
    square = np.clip(z[known], -MAX_Z, MAX_Z) ** 2 * (dof - 2) / dof
    # Where there is little far away, as near; where nearly nothing is, as much as is known.
    prior = 1e-2 * len(square) * np.eye(2)
    found, _ = nnls(np.vstack([columns, prior]), np.concatenate(
        [square, prior.sum(axis=1) * square.mean()]))
    near, far = np.sqrt(np.maximum(found, MIN_SD_RATIO**2))
    return float(near), float(far)
