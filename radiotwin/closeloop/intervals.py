"""Intervals of the parameters of effects that still hold when some of the data are left out.

Of each parameter the wider of two intervals: from the curvature of the likelihood and the scores of
places and flights (`radiotwin.effects.uncertainty`), and from its values in the models that were
fitted without one fold each (delete-a-group jackknife; Efron and Tibshirani 1993, 'An introduction
to the bootstrap', Sec. 11.5), for which everything, the base as well, was fitted again. A fold
whose other links do not tell a parameter, such as that of the flight on which something happened,
has only the prior's value of it, and does not count.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import t

from radiotwin.closeloop.cross_validation import CrossValidatedModel, same_effects
from radiotwin.effects.fold_model import FoldModel
from radiotwin.effects.params import Estimate, Parameter
from radiotwin.effects.uncertainty import Linearised, Secant, estimates, linearise
from radiotwin.inference.sandwich import MAX_WIDTH

QUANTILE = 0.95  # upper end of a 90 % interval
MAX_SHARE = 0.5  # of what is allowed, which an interval may span: more is less than one bit learnt
LEVELS_DB = 120.0  # span of changes of a level that can be at all, where no bounds are given
MIN_FOLDS = 0.5  # share of the folds that must have found the parameter, too


def effect_parameters(model: CrossValidatedModel) -> list[dict[str, Parameter]]:
    """Return the parameters of each effect with intervals that hold out of the data they are from.

    Args:
        model: of all links, and of those outside each fold.
    """
    whole = linearise(model.whole, model.fits[0])
    of_whole = estimates(whole)
    of_folds = [estimates(linearise(fold, fit, _as_followed(whole, fold)))
                for fold, fit in zip(model.folds, model.fits[1:], strict=True)]
    found = []
    for number, (applied, estimate) in enumerate(zip(model.whole.effects, of_whole, strict=True)):
        reported = applied.effect.parameters(model.links, applied.params, estimate)
        folds = [_of_fold(fold, own, model.whole, number)
                 for fold, own in zip(model.folds, of_folds, strict=True)]
        found.append({name: _with_folds(parameter, [fold[name] for fold in folds if name in fold],
                                        len(folds)) for name, parameter in reported.items()})
    return found


def _as_followed(whole: Linearised, fold: FoldModel) -> dict[int, list[Secant]]:
    """Return secants for a fold, by the place of the effect, of paths that the whole followed.

    Following them anew around each fold's values takes minutes, and of a fold's own uncertainty
    no more is asked than whether it knows a number at all.
    """
    known = {}
    for number, place in enumerate(same_effects(whole.model, fold)):
        own = whole.variations[number]
        if place is None or own is None or not own.follows_paths:
            continue
        applied = fold.effects[place]
        other = applied.effect.variation(applied.params)
        if other is not None and other.follows_paths and len(other.values) == len(own.values):
            known[place] = [each.moved(whole.model.train, fold.train)
                            for each in whole.secants[number]]
    return known


def _of_fold(fold: FoldModel, own: list[Estimate], whole: FoldModel,
             number: int) -> dict[str, Parameter]:
    """Return an effect's parameters in one fold; empty where it was not found."""
    place = same_effects(whole, fold)[number]
    if place is None:
        return {}
    effect = whole.effects[number].effect
    params = effect.like(fold.effects[place].params, whole.effects[number].params)
    return effect.parameters(fold.links, params, own[place])


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
    ends, bounds = np.array([low, high]), np.array([allowed.low, allowed.high])
    if allowed.is_log:
        with np.errstate(divide="ignore"):
            ends, bounds = np.log(ends), np.log(bounds)
    span = min(np.ptp(bounds), allowed.period) if np.isfinite(bounds).all() else allowed.period
    span = min(span, LEVELS_DB) if parameter.unit in ("dB", "dBm") else span
    determined = bool(np.ptp(ends) <= MAX_SHARE * span) and found >= MIN_FOLDS * folds
    return replace(parameter, low=low, high=high, determined=determined)
