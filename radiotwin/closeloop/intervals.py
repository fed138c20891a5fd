"""Intervals of the parameters of effects that still hold when some of the data are left out.

Of each parameter the wider of two intervals: from the curvature of the likelihood and the scores of
places and flights (`radiotwin.effects.uncertainty`), and from its values in the models that were
fitted without one fold each (delete-a-group jackknife; Efron and Tibshirani 1993, 'An introduction
to the bootstrap', Sec. 11.5), for which everything, the base as well, was fitted again.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import t

from radiotwin.closeloop.cross_validation import CrossValidatedModel
from radiotwin.effects.fold_model import FoldModel
from radiotwin.effects.params import Estimate, Parameter
from radiotwin.effects.uncertainty import estimates
from radiotwin.inference.censored_regression import FitResult

QUANTILE = 0.95  # upper end of a 90 % interval
MAX_SHARE = 0.5  # of what is allowed, which an interval may span: more is less than one bit learnt
LEVELS_DB = 120.0  # span of changes of a level that can be at all, where no bounds are given
MIN_FOLDS = 0.5  # share of the folds that must have found the parameter, too


def effect_parameters(model: CrossValidatedModel) -> list[dict[str, Parameter]]:
    """Return the parameters of each effect with intervals that hold out of the data they are from.

    Args:
        model: of all links, and of those outside each fold.
    """
    of_whole = estimates(model.whole, model.fits[0])
    return [{name: _checked(_widened(parameter, values), len(values), len(model.folds))
             for name, (parameter, values) in _with_fold_values(model, number, estimate).items()}
            for number, estimate in enumerate(of_whole)]


def _with_fold_values(model: CrossValidatedModel, number: int, estimate: Estimate,
                      ) -> dict[str, tuple[Parameter, np.ndarray]]:
    """Return each parameter of an effect, and its value in each of the folds that have it."""
    applied = model.whole.effects[number]
    reported = applied.effect.parameters(model.links, applied.params, estimate)
    folds = [_values(fold, fit, model.whole, number)
             for fold, fit in zip(model.folds, model.fits[1:], strict=True)]
    return {name: (parameter, np.array([fold[name] for fold in folds if name in fold]))
            for name, parameter in reported.items()}


def _values(fold: FoldModel, fit: FitResult, whole: FoldModel, number: int) -> dict[str, float]:
    """Return the values of an effect's parameters in one fold; empty where it was not found."""
    place = same_effects(whole, fold)[number]
    if place is None:
        return {}
    applied, effect = fold.effects[place], whole.effects[number].effect
    coefficients = fit.coefficients[fold.coefficient_slices[place]]
    variation = effect.variation(applied.params)
    count = 0 if variation is None else len(variation.values)
    certain = Estimate(coefficients, np.zeros((len(coefficients), len(coefficients))),
                       np.zeros((2, count)))
    params = effect.like(applied.params, whole.effects[number].params)
    return {name: each.value
            for name, each in effect.parameters(fold.links, params, certain).items()}


def same_effects(whole: FoldModel, fold: FoldModel) -> list[int | None]:
    """Return the place in a fold of each effect of the whole; None for what it has not found."""
    places: list[int | None] = []
    place = 0
    for each in whole.effects:
        there = place < len(fold.effects) and fold.effects[place].effect is each.effect
        places.append(place if there else None)
        place += there
    return places


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
    span = min(span, LEVELS_DB) if parameter.unit == "dB" else span
    determined = bool(np.ptp(ends) <= MAX_SHARE * span) and found >= MIN_FOLDS * folds
    return replace(parameter, low=low, high=high, determined=determined)
