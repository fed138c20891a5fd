"""Varying the numbers of one more effect for a better fit to the training links."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from radiotwin.channel.base import ANY_LEVEL_SD_DB
from radiotwin.effects.arrays import subsample
from radiotwin.effects.fold_model import AppliedEffect, FoldModel, response
from radiotwin.effects.params import Variation
from radiotwin.inference import censored_regression
from radiotwin.inference.censored_regression import FitResult
from radiotwin.links import LinkData

EVALUATIONS = 25  # of the objective for each number, in one descent
DESCENTS = 2  # a simplex that has collapsed too early starts anew; one for a fold, which is near
MAX_LINKS, MAX_LINKS_OF_MEMBER = 5000, 1500  # that numbers are refined on
OUTSIDE_NATS = 10.0  # penalty of a step outside the bounds
EXTREMES_DB = (-200.0, 100.0)  # levels at which whatever a receiver does to them shows


def refine(model: FoldModel, result: FitResult, evaluations: int = EVALUATIONS,
            descents: int = DESCENTS, max_links: int = MAX_LINKS,
            anywhere: bool = False) -> tuple[FoldModel, FitResult]:
    """Vary the last effect's parameters for a better fit to the training links.

    Args:
        model: what is learnt from.
        result: its fit.
        evaluations: of the objective for each number, in one descent.
        descents: one after the other.
        max_links: that the objective is of.
        anywhere: whether the search also begins at `Variation.starts`.
    """
    last = model.effects[-1]
    variation = last.effect.variation(last.params)
    if variation is None or not len(variation.values):
        return model, result
    if variation.members is not None:
        return _refine_members(model, result, last, variation)
    train, near = model.train, last.effect.reach(model.links, last.params)
    train = train if near is None else train & near
    rows = subsample(np.flatnonzero(train), max_links)
    if not len(rows):
        return model, result
    design_effect = model.view(result).design_effect * len(rows) / max(train.sum(), 1)
    small = model.restrict(rows, model.effects[:-1])
    rest = small.regression()
    # What has no coefficients of its own moves those of the others little: they stay meanwhile.
    alone = last.effect.stage == "gain" and not len(last.term.prior_sd_db)
    latest = result

    def objective(numbers: np.ndarray) -> float:
        nonlocal latest
        inside = np.clip(numbers, variation.low, variation.high)
        params = variation.params(inside)
        tried = small.apply(last.effect, params)
        if alone:
            moved = replace(rest, gain_db=rest.gain_db + tried.term.offset_db)
            misfit = moved.nll(result).sum()
        else:
            latest = small.with_effects([*small.effects, tried]).fit(latest)
            misfit = latest.objective
        outside = np.abs((numbers - inside) / variation.steps).sum()
        return float(misfit + design_effect * last.effect.neg_log_prior(params)
                     + OUTSIDE_NATS * outside)

    numbers = variation.values
    if anywhere:
        found = [_descend(objective, start, variation.steps, evaluations)
                 for start in (numbers, *variation.starts)]
        numbers = min(found, key=objective)
    for _ in range(descents):
        numbers = _descend(objective, numbers, variation.steps, evaluations)
    return _better(model, result, last, variation, numbers)


def _refine_members(model: FoldModel, result: FitResult, last: AppliedEffect,
                    variation: Variation) -> tuple[FoldModel, FitResult]:
    """Vary the numbers of each member by themselves, on the links that they act on.

    Only a level of its own is fitted beside them.
    """
    numbers = variation.values.copy()
    arriving_db = model.regression().arriving(result.coefficients)[0] - last.term.offset_db

    def changed(links: LinkData, numbers: np.ndarray) -> AppliedEffect:
        params = variation.params(np.clip(numbers, variation.low, variation.high))
        return AppliedEffect(last.effect, params, last.effect.term(links, params, model.level_at))

    def acted_db(links: LinkData, numbers: np.ndarray) -> np.ndarray:
        there = changed(links, numbers)
        if last.effect.stage != "receiver":
            return there.term.offset_db
        through = response([there], "receiver", slice(None))
        assert through is not None
        return sum((through(np.full(len(links), level_db))[0] for level_db in EXTREMES_DB),
                   start=np.zeros(len(links)))

    every = np.flatnonzero(model.train)
    trained = model.links.select(every)
    for member in variation.members or ():
        moved, step = numbers.copy(), variation.steps[member]
        moved[member] += np.where(numbers[member] + step > variation.high[member], -step, step)
        acts = acted_db(trained, moved) != acted_db(trained, numbers)
        rows = subsample(every[acts], MAX_LINKS_OF_MEMBER)
        if not len(rows):
            continue
        latest = None
        links = model.links.select(rows)
        others = [replace(each, term=each.term.select(rows)) for each in model.effects[:-1]]
        alone = replace(model.with_effects([]).regression(rows),
                        law_columns=np.ones((len(rows), 1)),
                        prior_sd_db=np.full(1, ANY_LEVEL_SD_DB))

        def objective(values: np.ndarray, member: np.ndarray = member, rows: np.ndarray = rows,
                      links: LinkData = links, others: list[AppliedEffect] = others,
                      alone: censored_regression.CensoredRegression = alone) -> float:
            nonlocal latest
            tried = numbers.copy()
            tried[member] = np.clip(values, variation.low[member], variation.high[member])
            there = changed(links, tried)
            outside = np.abs((values - tried[member]) / variation.steps[member]).sum()
            latest = censored_regression.fit(
                replace(alone, law_db=arriving_db[rows] + there.term.offset_db,
                        receiver=response([*others, there], "receiver", slice(None))), latest)
            return latest.objective + OUTSIDE_NATS * outside

        numbers[member] = _descend(objective, numbers[member], variation.steps[member])
    return _better(model, result, last, variation, numbers)


def _descend(objective: Callable[[np.ndarray], float], values: np.ndarray, steps: np.ndarray,
             evaluations: int = EVALUATIONS) -> np.ndarray:
    """Minimise by Brent's method, or that of Nelder and Mead (1965) for more than one number."""
    if len(values) == 1:
        around = (values[0] - steps[0], values[0] + steps[0])
        return minimize_scalar(lambda value: objective(np.array([value])), around, method="brent",
                               options={"xtol": 1e-3, "maxiter": evaluations}).x[None]
    simplex = np.vstack([values / steps, values / steps + np.eye(len(values))])
    options = {"initial_simplex": simplex, "maxfev": evaluations * len(simplex), "xatol": 2e-2,
               "fatol": 0.1}
    found = minimize(lambda shares: objective(shares * steps), simplex[0], method="Nelder-Mead",
                     options=options)
    return found.x * steps


def _better(model: FoldModel, result: FitResult, last: AppliedEffect, variation: Variation,
            numbers: np.ndarray) -> tuple[FoldModel, FitResult]:
    """Return the model with the last effect's numbers changed, where that is better."""
    params = variation.params(np.clip(numbers, variation.low, variation.high))
    better = model.with_effects([*model.effects[:-1], model.apply(last.effect, params)])
    fitted = better.fit(result)
    prior = last.effect.neg_log_prior(last.params) - last.effect.neg_log_prior(params)
    gain = result.objective - fitted.objective + model.view(result).design_effect * prior
    return (better, fitted) if gain > 0 else (model, result)
