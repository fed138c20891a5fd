"""Finding the parameters of one more effect: proposals, a search, exact levels.

Varying the numbers of one more effect for a better fit to the training links.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from radiotwin.effects.arrays import subsample
from radiotwin.effects.base import Effect
from radiotwin.effects.params import NEAR_SHARE, Variation
from radiotwin.inference import censored_regression
from radiotwin.inference.censored_regression import FitResult
from radiotwin.links import Links
from radiotwin.propagation.laws.base import ANY_LEVEL_SD_DB
from radiotwin.runtime.execution import Executor, Job, Resources
from radiotwin.runtime.pieces import KeptParts, Piece, keeps, kept
from radiotwin.runtime.processes import resident_bytes
from radiotwin.twin.model.fold_model import AppliedEffect, FoldModel, response

EVALUATIONS = 25  # of the objective for each number, in one descent
DESCENTS = 2  # a simplex that has collapsed too early starts anew; one for a fold, which is near
MAX_LINKS, MAX_LINKS_OF_MEMBER = 5000, 1500  # that numbers are refined on
OUTSIDE_NATS = 10.0  # penalty of a step outside the bounds
EXTREMES_DB = (-200.0, 100.0)  # levels at which whatever a receiver does to them shows
EXACT_EVALUATIONS, MAX_EXACT_LINKS = 8, 1500  # of `refine`, where each value follows paths
MAX_FOLLOWED_LINKS = 5000  # that an effect changes: to follow paths of more takes many minutes
MIN_EXACT_GAIN_NATS = 10.0  # that exact levels must gain to be refined on, and each descent
MAX_EXACT_NUMBERS = 3  # of an effect whose paths are followed whatever its quick levels say
MAX_EXACT_DESCENTS = 3  # the objective is rough, as paths open and close: a simplex stops early
MAX_PROPOSALS = 4  # of one effect that are fitted
MIN_GAIN_NATS = 5.0  # that a proposal must gain to be refined
WORKER_BYTES = 2 * 2**30  # of a process that fits effects, at least


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

    def changed(links: Links, numbers: np.ndarray) -> AppliedEffect:
        params = variation.params(np.clip(numbers, variation.low, variation.high))
        return AppliedEffect(last.effect, params, last.effect.term(links, params, model.level_at))

    def acted_db(links: Links, numbers: np.ndarray) -> np.ndarray:
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
                      links: Links = links, others: list[AppliedEffect] = others,
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


def add_effect(model: FoldModel, effect: Effect, result: FitResult,
               like: Any = None) -> tuple[FoldModel, FitResult] | None:
    """Find the best parameters of an effect on the training links, beside the effects there are.

    On all links with quick levels, which `along_paths` replaces; on those of a fold with exact ones
    where `like` has them.

    Args:
        model: what is learnt from.
        effect: what is added.
        result: the fit without it.
        like: parameters that were found on all links, where the model is of a fold.

    Returns:
        the model with the effect, and its fit; None where nothing in the residual looks like the
        effect.
    """
    return kept("effect", (model, effect, result, like),
                lambda: _best_addition(model, effect, result, like), _write_addition,
                _reader(model, effect))


def along_paths(model: FoldModel, result: FitResult,
                without: FitResult) -> tuple[FoldModel, FitResult]:
    """Search on for the parameters of the last effect with levels of the channel's own paths.

    Args:
        model: that `add_effect` found.
        result: its fit.
        without: the fit without the last effect.

    Returns:
        the model with exact levels in its last effect, and its fit, where these are better; what
        was given where they are not, or may not be asked for (`Effect.always_exact`).
    """
    effect, gain = model.effects[-1].effect, without.objective - result.objective
    if not effect.always_exact or gain < MIN_GAIN_NATS or not _changes_few(model):
        return model, result
    found = kept("effect-along-paths", (model, result, without),
                 lambda: _best_along_paths(model, result, without), _write_addition,
                 _reader(model.with_effects(model.effects[:-1]), effect))
    return found or (model, result)


def prepare_additions(models: Sequence[FoldModel], results: Sequence[FitResult],
                      effects: Sequence[Effect], executor: Executor, like: Any = None) -> None:
    """Compute what `add_effect` will be asked, on the workers of an executor.

    The results are among the finished parts (`radiotwin.runtime.pieces`), from where `add_effect`
    has them, equal to the bit. Where no parts are kept, nothing is done.

    Args:
        models: k models.
        results: their fits.
        effects: to be added to each of them.
        executor: where it runs.
        like: as of `add_effect`.
    """
    if not executor.is_worth_it or not keeps():
        return
    pieces = [(model, effect) for model in range(len(models)) for effect in range(len(effects))]
    parts: KeptParts[tuple[int, int], Piece | None] = KeptParts(
        "effect", lambda piece: (models[piece[0]], effects[piece[1]], results[piece[0]], like),
        lambda found: found, lambda arrays, content: (arrays, content))
    function = _Addition(list(models), list(results), list(effects), like)
    # A worker holds links, map and models as this process does, and no more.
    memory_bytes = max(WORKER_BYTES, resident_bytes(os.getpid()))
    job: Job[tuple[int, int], Piece | None] = Job("fitting effects", function,
                                                  Resources(memory_bytes, False))
    executor.run_ahead(job, pieces, parts)


@dataclass(frozen=True)
class _Addition:
    """Adds effects to models, by the number of each; arguments as of `prepare_additions`."""

    models: list[FoldModel]
    results: list[FitResult]
    effects: list[Effect]
    like: Any

    def __call__(self, piece: tuple[int, int]) -> Piece | None:
        model, effect = self.models[piece[0]], self.effects[piece[1]]
        return _write_addition(_best_addition(model, effect, self.results[piece[0]], self.like))


def _write_addition(found: tuple[FoldModel, FitResult] | None) -> Piece | None:
    """Return what `add_effect` found, without the terms; None if JSON cannot hold it."""
    if found is None:
        return {}, None
    model, fitted = found
    params = [each.params.model_dump(mode="json") for each in model.effects]
    for each, written in zip(model.effects, params, strict=True):
        if each.params.model_validate(json.loads(json.dumps(written))) != each.params:
            return None
    return ({"coefficients": fitted.coefficients, "scale_db": fitted.scale_db},
            {"params": params, "objective": float(fitted.objective)})


def _reader(model: FoldModel, effect: Effect) -> Callable[..., tuple[FoldModel, FitResult] | None]:
    """Return what reads a model with one more effect."""
    def read(arrays: dict[str, np.ndarray], content: Any) -> tuple[FoldModel, FitResult] | None:
        if content is None:
            return None
        before = [*model.effects, None]
        effects = [_read_applied(model, each.effect if each else effect, each, params)
                   for each, params in zip(before, content["params"], strict=True)]
        fitted = FitResult(arrays["coefficients"], arrays["scale_db"], content["objective"])
        return model.with_effects(effects), fitted
    return read


def _read_applied(model: FoldModel, effect: Effect, before: AppliedEffect | None,
                  written: Any) -> AppliedEffect:
    """Return an effect with its parameters; that of before where they are the same."""
    params = effect.Params.model_validate(written)
    same = before is not None and before.params == params
    return before if before is not None and same else model.apply(effect, params)


def _best_addition(model: FoldModel, effect: Effect, result: FitResult,
                   like: Any) -> tuple[FoldModel, FitResult] | None:
    view = model.view(result)
    proposals = effect.propose(view) if like is None else effect.propose_like(view, like)
    kinds: dict[Any, list[Any]] = {}
    for params in proposals:
        kinds.setdefault(effect.kind(params), []).append(params)
    exactly = like is not None and effect.always_exact and like == effect.exact(like)
    found = [_best_of_a_kind(model, effect, result, each, like is not None)
             for each in kinds.values()]
    if not found:
        return None
    best = min(found, key=lambda each: each[1].objective)
    if not exactly or result.objective - best[1].objective < MIN_GAIN_NATS:
        return best
    best = with_exact_levels(*best)
    near = _near(model, effect, result, like)
    return near if near[1].objective < best[1].objective else best


def _best_along_paths(model: FoldModel, result: FitResult,
                      without: FitResult) -> tuple[FoldModel, FitResult]:
    best = with_exact_levels(*_over_known_paths(model, result))
    if not _is_exact(best[0]) and model.channel.follows_paths:
        best = _exactly_beside(*best)
    variation = best[0].effects[-1].effect.variation(best[0].effects[-1].params)
    if variation is None or not variation.follows_paths:
        return best
    before = without.objective
    for _ in range(MAX_EXACT_DESCENTS):
        if not _is_exact(best[0]) or before - best[1].objective < MIN_EXACT_GAIN_NATS:
            break
        before = best[1].objective
        best = refine(*best, evaluations=EXACT_EVALUATIONS, descents=1, max_links=MAX_EXACT_LINKS)
    return best


def _best_of_a_kind(model: FoldModel, effect: Effect, result: FitResult, proposals: list[Any],
                    is_fold: bool) -> tuple[FoldModel, FitResult]:
    """Return the best of some proposals, refined where it gains."""
    view, applied = model.view(result), [model.apply(effect, params) for params in proposals]
    if effect.stage == "gain" and len(applied) > MAX_PROPOSALS:  # only gains have a score
        applied.sort(key=lambda each: -view.score(each.term.select(model.train)))
        applied = applied[:MAX_PROPOSALS]
    tried = [model.with_effects([*model.effects, each]) for each in applied]
    best = min(((each, each.fit(result)) for each in tried), key=lambda each: each[1].objective)
    if result.objective - best[1].objective < MIN_GAIN_NATS:
        return best
    return refine(*best, descents=1 if is_fold else DESCENTS)


def _changes_few(model: FoldModel) -> bool:
    """Return whether the last effect changes so few links that their paths can be followed."""
    return int(np.count_nonzero(model.effects[-1].term.offset_db)) <= MAX_FOLLOWED_LINKS


def _is_exact(model: FoldModel) -> bool:
    """Return whether the last effect has exact levels."""
    last = model.effects[-1]
    return bool(last.params == last.effect.exact(last.params))


def _with_params(model: FoldModel, result: FitResult,
                 params: Any) -> tuple[FoldModel, FitResult]:
    """Return the model with other parameters in its last effect, and its fit."""
    last = model.apply(model.effects[-1].effect, params)
    tried = model.with_effects([*model.effects[:-1], last])
    return tried, tried.fit(result)


def _exactly_beside(model: FoldModel, result: FitResult) -> tuple[FoldModel, FitResult]:
    """Look for better exact levels of the last effect, where those of its quick optimum are not.

    The optimum of both need not be the same. Only of few numbers, such as a position: each value
    that is tried follows paths.
    """
    last = model.effects[-1]
    variation = last.effect.variation(last.params)
    if variation is None or len(variation.values) > MAX_EXACT_NUMBERS:
        return model, result
    start = _with_params(model, result, last.effect.exact(last.params))
    beside = refine(*start, evaluations=EXACT_EVALUATIONS, descents=1, max_links=MAX_EXACT_LINKS)
    return beside if beside[1].objective < result.objective else (model, result)


def _over_known_paths(model: FoldModel, result: FitResult,
                      is_near: bool = False) -> tuple[FoldModel, FitResult]:
    """Search for exact parameters of the last effect with levels that are nearly exact.

    Those of known paths (`missing_obstacle`), of which a value takes milliseconds.

    Args:
        model: that is searched from; returned where it is better, or the effect knows none.
        result: its fit.
        is_near: whether it is known to be near the best.
    """
    last = model.effects[-1]
    exact = last.effect.exact(last.params) if model.channel.follows_paths else None
    variation = None if exact is None else last.effect.variation(exact)
    if variation is None or variation.follows_paths:
        return model, result
    start = _with_params(model, result, variation.params(variation.values))
    found, _ = refine(*start, descents=1, anywhere=not is_near)
    exactly = _with_params(model, result, last.effect.exact(found.effects[-1].params))
    return exactly if exactly[1].objective < result.objective else (model, result)


def _near(model: FoldModel, effect: Effect, result: FitResult,
          like: Any) -> tuple[FoldModel, FitResult]:
    """Return the best fit to a fold around the parameters that were found on all links.

    Each number by itself a share of its step to both sides, and all that gain together: every fold
    asks for the same exact levels, which are kept.
    """
    def fitted(params: Any) -> tuple[FoldModel, FitResult]:
        tried = model.with_effects([*model.effects, model.apply(effect, params)])
        return tried, tried.fit(result)

    variation, best = effect.variation(like), fitted(like)
    if variation is None:
        return best
    if not variation.follows_paths:
        return _over_known_paths(*best, is_near=True)
    start, numbers = best[1].objective, variation.values.copy()
    for number, step in enumerate(variation.steps):
        least = start
        for shift in (-NEAR_SHARE * step, NEAR_SHARE * step):
            values = variation.values.copy()
            values[number] += shift
            moved = fitted(variation.params(np.clip(values, variation.low, variation.high)))
            if moved[1].objective < least:
                least, numbers[number] = moved[1].objective, values[number]
            best = min(best, moved, key=lambda each: each[1].objective)
    together = fitted(variation.params(np.clip(numbers, variation.low, variation.high)))
    return min(best, together, key=lambda each: each[1].objective)


def with_exact_levels(model: FoldModel, result: FitResult) -> tuple[FoldModel, FitResult]:
    """Replace quick levels by the channel's exact ones in each effect, where that is better."""
    if not model.channel.follows_paths:
        return model, result
    for number, each in enumerate(model.effects):
        params = each.effect.exact(each.params)
        if params is None or params == each.params:
            continue
        effects = list(model.effects)
        effects[number] = model.apply(each.effect, params)
        other = model.with_effects(effects)
        fitted = other.fit(result)
        if fitted.objective < result.objective:
            model, result = other, fitted
    return model, result
