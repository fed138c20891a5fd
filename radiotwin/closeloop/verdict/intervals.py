"""90 % intervals of an effect's parameters and of its size on held-out links.

The interval of a parameter is the wider of two: the sandwich estimate, clustered by place and
flight (`radiotwin.twin.model.uncertainty`), and the delete-a-group jackknife over fits without one
fold, base included (Efron and Tibshirani 1993, 'An introduction to the bootstrap', Sec. 11.5). A
fold whose training links do not determine a parameter does not count: it only has the prior's
value.

The size of an effect [dB] is estimated on held-out links. The change of the prediction by the
effect, relative to a refit without it, is regressed on the residual of that refit. The slope is 1
if the effect is as fitted and 0 if there is none (calibration slope of Cox 1958, 'Two further
applications of a model for binary regression', Biometrika 45).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.stats import t

from radiotwin.closeloop.crossfit import CrossFit, match_effects
from radiotwin.closeloop.verdict.criteria import MIN_CLUSTERS, MIN_FOLDS
from radiotwin.effects.params import Parameter
from radiotwin.inference.sandwich import MAX_WIDTH
from radiotwin.inference.student import DOF
from radiotwin.links import evidence_blocks
from radiotwin.twin.model.model import Fit
from radiotwin.twin.model.uncertainty import Linearised, ReadingDerivative, estimates, linearise

QUANTILE = 0.95  # upper end of a 90 % interval
MIN_CHANGE_DB = 1e-6  # smaller changes of a reading are rounding errors: the effect does not act


def effect_parameters(model: CrossFit) -> list[dict[str, Parameter]]:
    """Return the parameters of each effect, by name, with sandwich and jackknife intervals.

    Args:
        model: fit to all links, and without each fold.
    """
    whole = linearise(model.whole)
    whole_estimates = estimates(whole)
    fold_estimates = [estimates(linearise(fold, _path_derivatives(whole, fold)))
                      for fold in model.folds]
    found, matches = [], [match_effects(model.whole, fold) for fold in model.folds]
    for number, (effect, estimate) in enumerate(zip(model.whole.effects, whole_estimates,
                                                    strict=True)):
        folds = [fold.effects[match].like(effect).parameters(fold.links, in_fold[match])
                 for fold, in_fold, of_effects in zip(model.folds, fold_estimates, matches,
                                                      strict=True)
                 if (match := of_effects[number]) is not None]
        found.append({name: _with_jackknife(parameter,
                                            [fold[name] for fold in folds if name in fold],
                                            len(model.folds))
                      for name, parameter in effect.parameters(model.links, estimate).items()})
    return found


def _path_derivatives(whole: Linearised, fold: Fit) -> dict[int, list[ReadingDerivative]]:
    """Copy derivatives of readings along paths from the fit to all links, by a fold's effect index.

    Following paths around each fold's values would take minutes, and a fold's derivatives only tell
    whether its links determine a parameter.
    """
    known = {}
    for number, match in enumerate(match_effects(whole.fit, fold)):
        variation = whole.variations[number]
        if match is None or variation is None or not variation.follows_paths:
            continue
        other = fold.effects[match].variation()
        if other is not None and other.follows_paths and len(other.values) == len(variation.values):
            known[match] = [each.moved(whole.fit.train, fold.train)
                            for each in whole.derivatives[number]]
    return known


def _with_jackknife(parameter: Parameter, folds: list[Parameter], count: int) -> Parameter:
    """Widen the interval of a parameter to the spread of its estimates in the `folds` that have it.

    Folds whose own interval is more than `MAX_WIDTH` times as wide are ignored. `determined` is set
    as in `_checked`; `count` is the number of all folds.
    """
    max_width = MAX_WIDTH * _width(parameter)
    values = [each.value for each in folds if not max_width > 0 or _width(each) <= max_width]
    return _checked(_widened(parameter, np.array(values)), len(folds), count)


def _width(parameter: Parameter) -> float:
    """Return the width of a parameter's interval; of its logarithm if `is_log`."""
    ends = np.array([parameter.low, parameter.high])
    with np.errstate(invalid="ignore", divide="ignore"):
        return float(np.diff(np.log(ends) if parameter.allowed.is_log else ends)[0])


def _widened(parameter: Parameter, values: np.ndarray) -> Parameter:
    """Widen a parameter's interval to contain the 90 % jackknife interval of its `values` (folds,).

    Logarithmic parameters vary by a factor, periodic ones (angles) by the shorter way round.
    """
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
    """Clip a parameter's interval to its allowed range, and set whether the data determine it.

    They do if the interval is narrow, and at least `MIN_FOLDS` of the folds `found` the effect.
    """
    allowed = parameter.allowed
    if not np.isfinite([parameter.low, parameter.high]).all():
        return parameter
    # The value itself is not clipped: implausible effects are refused by the search.
    low = max(parameter.low, min(allowed.low, parameter.value))
    high = min(parameter.high, max(allowed.high, parameter.value))
    within = replace(parameter, low=low, high=high)
    return replace(within, determined=within.is_narrow and found >= MIN_FOLDS * folds)


def effect_size_db(model: CrossFit, number: int) -> Parameter:
    """Estimate on held-out links the RMS change of readings by an effect.

    Args:
        model: cross-validated fit.
        number: index of the effect.

    Returns:
        The size [dB] with its 90 % interval: the widest of those clustered by link, place, flight
        and fold. If it includes 0, there may be no such effect. NaN for an effect that changes no
        level, only which links are blank.
    """
    change_db, lacking_db, scale_db, acts = _size_regression(model, number)
    rows = np.flatnonzero(acts & np.isfinite(lacking_db) & np.isfinite(change_db))
    if not len(rows) or not (change_db[rows]**2).sum():
        return Parameter(np.nan, np.nan, np.nan, "dB")
    change_db, lacking_db, scale_db = change_db[rows], lacking_db[rows], scale_db[rows]
    z = (lacking_db - change_db) / scale_db
    weight = (DOF + 1) / (DOF + z * z) / scale_db**2
    total = weight @ change_db**2
    slope = weight @ (change_db * lacking_db) / total
    links = model.links.select(rows)
    influence = weight * change_db * (lacking_db - slope * change_db) / total
    share = weight * change_db**2 / total
    half_width = max(_slope_half_width(influence, share, label) for label in
                     (np.arange(len(rows)), evidence_blocks(links), links.flight,
                      model.index[rows]))
    rms_db = float(np.sqrt(np.mean(change_db**2)))
    low, value, high = rms_db * (slope + half_width * np.array([-1.0, 0.0, 1.0]))
    size_db = Parameter(float(value), float(low), float(high), "dB")
    return replace(size_db, determined=size_db.is_narrow)


def why_not_confirmed(model: CrossFit, number: int) -> str:
    """Return why held-out links do not confirm an effect (given by its index); "" if they do.

    They do not if the 90 % interval of its size reaches down to 0. Effects that only add scatter,
    and those that change no level, are not tested and count as confirmed.
    """
    size_db = effect_size_db(model, number)
    scatter_sd_db = model.whole.model.terms[number].random_effect_sd_db
    if size_db.low > 0 or np.isnan(size_db.value) or scatter_sd_db is not None:
        return ""
    return ("links that are held out may show nothing of it: "
            f"{size_db.value:.1f} dB ({size_db.low:.1f} to {size_db.high:.1f})")


def _size_regression(model: CrossFit, number: int
                     ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the held-out variables of the regression in `effect_size_db`, (n,) each.

    Returns:
        prediction with the effect minus that of a refit without it [dB]; measured level minus that
        of the refit [dB]; error scale [dB]; whether the effect changes the link by over
        `MIN_CHANGE_DB`. NaN in folds whose training links do not show the effect.
    """
    change_db, lacking_db, scale_db = np.full((3, len(model.index)), np.nan)
    acts = np.zeros(len(model.index), dtype=bool)
    for fold, each in enumerate(model.folds):
        rows = (model.index == fold) & each.usable
        match = match_effects(model.whole, each)[number]
        if match is None:  # the fold's training links do not show the effect
            continue
        with_effect, removed = each.readings(), each.without(match)
        without_db = removed.model.fit(removed).readings().mean_db
        change_db[rows] = (with_effect.mean_db - without_db)[rows]
        lacking_db[rows] = (each.links.level_db - without_db)[rows]
        scale_db[rows] = with_effect.scale_db[rows]
        direct_db = with_effect.mean_db - removed.readings().mean_db
        acts[rows] = np.abs(direct_db[rows]) > MIN_CHANGE_DB
    return change_db, lacking_db, scale_db, acts


def _slope_half_width(influence: np.ndarray, share: np.ndarray, label: np.ndarray) -> float:
    """Return half the 90 % interval of the slope, with errors clustered by a label (n,).

    Each link has its influence on the estimate, and its share of the information. 0 if there are
    fewer than `MIN_CLUSTERS` effective clusters.
    """
    cluster = np.unique(label, return_inverse=True)[1].ravel()
    shares = np.bincount(cluster, weights=share)
    clusters = shares.sum()**2 / (shares**2).sum()
    if clusters < MIN_CLUSTERS:
        return 0.0
    sd = np.sqrt((np.bincount(cluster, weights=influence)**2).sum() * clusters / (clusters - 1))
    return float(sd * t.ppf(QUANTILE, clusters - 1))
