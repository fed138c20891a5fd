"""Size of an effect in decibels, by links that took no part in finding it.

Of each held-out link: what the effect changes in the prediction, once all else has been fitted
again without it, against what the link lacks without it. The slope of that regression is 1 where
the effect is as it was fitted, and 0 where there is no such thing (the calibration slope of Cox
1958, 'Two further applications of a model for binary regression', Biometrika 45).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import t

from radiotwin.closeloop.cross_validation import CrossValidatedModel, same_effects
from radiotwin.closeloop.intervals import QUANTILE
from radiotwin.effects.fold_model import FoldModel
from radiotwin.effects.params import Parameter
from radiotwin.inference.censored_regression import FitResult
from radiotwin.links import evidence_blocks

MIN_CHANGE_DB = 1e-6  # of a reading that an effect acts on
MIN_CLUSTERS = 3  # effective ones, of which a spread can be told
DOF = 4.0  # degrees of freedom of the errors, by which outliers count less


def effect_size_db(model: CrossValidatedModel, number: int) -> Parameter:
    """Return the size of an effect: the RMS of what it changes in the readings that it acts on.

    Args:
        model: with its effects.
        number: which of them.

    Returns:
        The size that held-out links bear out [dB]. Its 90 % interval is of a regression over
        places, flights and folds that err alike, whichever is widest: where it includes 0, there
        may be no such effect. NaN where the effect changes no level (only which links are blank).
    """
    change_db, lacking_db, scale_db, acts = _held_out(model, number)
    rows = np.flatnonzero(acts & np.isfinite(lacking_db) & np.isfinite(change_db))
    if not len(rows) or not (change_db[rows]**2).sum():
        return Parameter(np.nan, np.nan, np.nan, "dB")
    change_db, lacking_db, scale_db = change_db[rows], lacking_db[rows], scale_db[rows]
    z = (lacking_db - change_db) / scale_db
    weight = (DOF + 1) / (DOF + z * z) / scale_db**2
    total = weight @ change_db**2
    slope = weight @ (change_db * lacking_db) / total
    links = model.links.select(rows)
    pull = weight * change_db * (lacking_db - slope * change_db) / total
    share = weight * change_db**2 / total
    reach = max((_reach(pull, share, label) for label in
                 (np.arange(len(rows)), evidence_blocks(links), links.flight, model.index[rows])),
                default=0.0)
    rms_db = float(np.sqrt(np.mean(change_db**2)))
    low, value, high = rms_db * (slope + reach * np.array([-1.0, 0.0, 1.0]))
    return Parameter(float(value), float(low), float(high), "dB")


def why_not_borne_out(size_db: Parameter) -> str:
    """Return why an effect of this size is not named; "" where there is no reason."""
    if size_db.low > 0 or np.isnan(size_db.value):
        return ""
    return ("links that are held out may show nothing of it: "
            f"{size_db.value:.1f} dB ({size_db.low:.1f} to {size_db.high:.1f})")


def _held_out(model: CrossValidatedModel, number: int
              ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the terms of the regression in `effect_size_db` for each link (n,), by its fold.

    Returns:
        what the effect changes, what is lacking without it, the error scale [dB], and whether the
        effect acts on the link.
    """
    change_db, lacking_db, scale_db = np.full((3, len(model.index)), np.nan)
    acts = np.zeros(len(model.index), dtype=bool)
    for fold, (each, fit) in enumerate(zip(model.folds, model.fits[1:], strict=True)):
        own = (model.index == fold) & each.usable
        place = same_effects(model.whole, each)[number]
        if place is None:  # nothing in the other folds looks like it: no link here bears it out
            continue
        with_it = each.predict(fit)
        rest, taken_away = _without(each, fit, place)
        without_db = rest.predict(rest.fit(taken_away)).mean_db
        change_db[own] = (with_it.mean_db - without_db)[own]
        lacking_db[own] = (each.links.level_db - without_db)[own]
        scale_db[own] = with_it.scale_db[own]
        moved_db = with_it.mean_db - rest.predict(taken_away).mean_db
        acts[own] = np.abs(moved_db[own]) > MIN_CHANGE_DB
    return change_db, lacking_db, scale_db, acts


def _without(model: FoldModel, fit: FitResult, place: int) -> tuple[FoldModel, FitResult]:
    """Return a model from which an effect is taken away and nothing else is changed."""
    coefficients = np.delete(fit.coefficients, model.coefficient_slices[place])
    rest = model.with_effects([*model.effects[:place], *model.effects[place + 1:]])
    return rest, replace(fit, coefficients=coefficients)


def _reach(pull: np.ndarray, share: np.ndarray, label: np.ndarray) -> float:
    """Return half the width of the slope's 90 % interval, where links (n,) of a label err alike.

    Args:
        pull: (n,) what each link moves the slope by.
        share: (n,) of the information on it.
        label: (n,) cluster of each link.
    """
    own = np.unique(label, return_inverse=True)[1].ravel()
    shares = np.bincount(own, weights=share)
    clusters = shares.sum()**2 / (shares**2).sum()
    if clusters < MIN_CLUSTERS:
        return 0.0
    sd = np.sqrt((np.bincount(own, weights=pull)**2).sum() * clusters / (clusters - 1))
    return float(sd * t.ppf(QUANTILE, clusters - 1))
