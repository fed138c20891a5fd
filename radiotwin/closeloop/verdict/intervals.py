"""Intervals of an effect's parameters and of its size, which hold when data are left out.

The interval of a parameter is the wider of two: from the curvature of the likelihood and the scores
of places and flights (`radiotwin.twin.model.uncertainty`), and from its values in the models that
were fitted without one fold each (delete-a-group jackknife; Efron and Tibshirani 1993, 'An
introduction to the bootstrap', Sec. 11.5), for which everything, the base as well, was fitted
again. A fold whose other links do not tell a parameter, such as that of the flight on which
something happened, has only the prior's value of it, and does not count.

The size of an effect in decibels is that of held-out links. What the effect changes in the
prediction, once all else has been fitted again without it, is compared with what the link lacks
without it. The slope of that regression is 1 where the effect is as it was fitted, and 0 where
there is no such thing (the calibration slope of Cox 1958, 'Two further applications of a model
for binary regression', Biometrika 45).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import t

from radiotwin.closeloop.crossfit import CrossFit, same_effects
from radiotwin.closeloop.verdict.criteria import MIN_CLUSTERS, MIN_FOLDS
from radiotwin.effects.params import Parameter
from radiotwin.inference.sandwich import MAX_WIDTH
from radiotwin.inference.student import DOF
from radiotwin.links import evidence_blocks
from radiotwin.twin.model.model import Fit
from radiotwin.twin.model.uncertainty import Linearised, Secant, estimates, linearise

QUANTILE = 0.95  # upper end of a 90 % interval
MIN_CHANGE_DB = 1e-6  # of a reading that an effect acts on


def effect_parameters(model: CrossFit) -> list[dict[str, Parameter]]:
    """Return the parameters of each effect with intervals that hold out of the data they are from.

    Args:
        model: of all links, and of those outside each fold.
    """
    whole = linearise(model.whole)
    of_whole = estimates(whole)
    of_folds = [estimates(linearise(fold, _as_followed(whole, fold))) for fold in model.folds]
    found, places = [], [same_effects(model.whole, fold) for fold in model.folds]
    for number, (effect, estimate) in enumerate(zip(model.whole.effects, of_whole, strict=True)):
        folds = [fold.effects[place].like(effect).parameters(fold.links, own[place])
                 for fold, own, there in zip(model.folds, of_folds, places, strict=True)
                 if (place := there[number]) is not None]
        found.append({name: _with_folds(parameter, [fold[name] for fold in folds if name in fold],
                                        len(model.folds))
                      for name, parameter in effect.parameters(model.links, estimate).items()})
    return found


def _as_followed(whole: Linearised, fold: Fit) -> dict[int, list[Secant]]:
    """Return secants for a fold, by the place of the effect, of paths that the whole followed.

    Following them anew around each fold's values takes minutes, and of a fold's own uncertainty
    no more is asked than whether it knows a number at all.
    """
    known = {}
    for number, place in enumerate(same_effects(whole.fit, fold)):
        own = whole.variations[number]
        if place is None or own is None or not own.follows_paths:
            continue
        other = fold.effects[place].variation()
        if other is not None and other.follows_paths and len(other.values) == len(own.values):
            known[place] = [each.moved(whole.fit.train, fold.train)
                            for each in whole.secants[number]]
    return known


def _with_folds(parameter: Parameter, folds: list[Parameter], count: int) -> Parameter:
    """Return a parameter in view of what it is in those of some folds that have it."""
    most = MAX_WIDTH * _width(parameter)
    values = [each.value for each in folds if not most > 0 or _width(each) <= most]
    return _checked(_widened(parameter, np.array(values)), len(folds), count)


def _width(parameter: Parameter) -> float:
    """Return the width of a parameter's interval, of its logarithm where ratios count."""
    ends = np.array([parameter.low, parameter.high])
    with np.errstate(invalid="ignore", divide="ignore"):
        return float(np.diff(np.log(ends) if parameter.allowed.is_log else ends)[0])


def _widened(parameter: Parameter, values: np.ndarray) -> Parameter:
    """Return a parameter whose interval is at least that of the jackknife over its fold values."""
    count, allowed = len(values), parameter.allowed
    if count < 2 or not np.isfinite(parameter.low):
        return parameter
    if allowed.is_log:
        change = np.log(values / parameter.value)
    else:
        change = values - parameter.value
    if np.isfinite(allowed.period):
        change -= allowed.period * np.round(change / allowed.period)
    sd = np.sqrt((count - 1) / count * ((change - change.mean())**2).sum())
    reach = float(sd * t.ppf(QUANTILE, count - 1))
    ends = parameter.value * np.exp([-reach, reach]) if allowed.is_log \
        else parameter.value + np.array([-reach, reach])
    return replace(parameter, low=min(parameter.low, float(ends[0])),
                   high=max(parameter.high, float(ends[1])))


def _checked(parameter: Parameter, found: int, folds: int) -> Parameter:
    """Return a parameter within its bounds, and whether the data determine it."""
    allowed = parameter.allowed
    if not np.isfinite([parameter.low, parameter.high]).all():
        return parameter
    # A value beyond its bounds stays: effects that cannot be are refused elsewhere.
    low = max(parameter.low, min(allowed.low, parameter.value))
    high = min(parameter.high, max(allowed.high, parameter.value))
    within = replace(parameter, low=low, high=high)
    return replace(within, determined=within.is_narrow and found >= MIN_FOLDS * folds)


def effect_size_db(model: CrossFit, number: int) -> Parameter:
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
    size_db = Parameter(float(value), float(low), float(high), "dB")
    return replace(size_db, determined=size_db.is_narrow)


def why_not_borne_out(model: CrossFit, number: int) -> str:
    """Return why an effect of a model is not named; "" where there is no reason.

    One that makes readings scatter need not change their level.
    """
    size_db = effect_size_db(model, number)
    scatter_sd_db = model.whole.model.terms[number].random_effect_sd_db
    if size_db.low > 0 or np.isnan(size_db.value) or scatter_sd_db is not None:
        return ""
    return ("links that are held out may show nothing of it: "
            f"{size_db.value:.1f} dB ({size_db.low:.1f} to {size_db.high:.1f})")


def _held_out(model: CrossFit, number: int
              ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the terms of the regression in `effect_size_db` for each link (n,), by its fold.

    Returns:
        what the effect changes, what is lacking without it, the error scale [dB], and whether the
        effect acts on the link.
    """
    change_db, lacking_db, scale_db = np.full((3, len(model.index)), np.nan)
    acts = np.zeros(len(model.index), dtype=bool)
    for fold, each in enumerate(model.folds):
        own = (model.index == fold) & each.usable
        place = same_effects(model.whole, each)[number]
        if place is None:  # nothing in the other folds looks like it: no link here bears it out
            continue
        with_it, taken_away = each.readings(), each.without(place)
        without_db = taken_away.model.fit(taken_away).readings().mean_db
        change_db[own] = (with_it.mean_db - without_db)[own]
        lacking_db[own] = (each.links.level_db - without_db)[own]
        scale_db[own] = with_it.scale_db[own]
        moved_db = with_it.mean_db - taken_away.readings().mean_db
        acts[own] = np.abs(moved_db[own]) > MIN_CHANGE_DB
    return change_db, lacking_db, scale_db, acts


def _reach(pull: np.ndarray, share: np.ndarray, label: np.ndarray) -> float:
    """Return half the width of the slope's 90 % interval, where links (n,) of a label err alike.

    Each moves the slope by its `pull`, and has a `share` of the information on it.
    """
    own = np.unique(label, return_inverse=True)[1].ravel()
    shares = np.bincount(own, weights=share)
    clusters = shares.sum()**2 / (shares**2).sum()
    if clusters < MIN_CLUSTERS:
        return 0.0
    sd = np.sqrt((np.bincount(own, weights=pull)**2).sum() * clusters / (clusters - 1))
    return float(sd * t.ppf(QUANTILE, clusters - 1))
