"""Fit one more effect to a model: proposals, search over its parameters, exact path levels."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from radiotwin.effects.arrays import subsample
from radiotwin.effects.base import Effect, Term
from radiotwin.effects.params import NEAR_SHARE, Variation
from radiotwin.inference import censored_regression
from radiotwin.links import Links
from radiotwin.propagation.laws.base import ANY_LEVEL_SD_DB
from radiotwin.runtime.execution import Executor, Job, Resources
from radiotwin.runtime.pieces import Piece, ResultCache, cached, keeps
from radiotwin.runtime.processes import resident_bytes
from radiotwin.twin.model.model import Fit, Model, response

EVALUATIONS = 25  # evaluations of the objective for each parameter, in one descent
DESCENTS = 2  # restarts of a simplex that may have collapsed; a fold, which starts near, has one
MAX_LINKS, MAX_LINKS_OF_MEMBER = 5000, 1500  # links on which parameters are refined
OUTSIDE_NATS = 10.0  # penalty of a step outside the bounds
EXTREMES_DB = (-200.0, 100.0)  # levels at which any receiver response is visible
EXACT_EVALUATIONS, MAX_EXACT_LINKS = 8, 1500  # the same two for exact levels, which trace paths
MAX_FOLLOWED_LINKS = 5000  # most links that an effect may change: tracing more takes many minutes
MIN_EXACT_GAIN_NATS = 10.0  # likelihood that exact levels, and each descent, must gain to go on
MAX_EXACT_NUMBERS = 3  # most parameters searched with exact levels if quick levels fit better
MAX_EXACT_DESCENTS = 3  # the objective is rough, as paths open and close: a simplex stops early
MAX_PROPOSALS = 4  # proposals of one effect that are fitted
MIN_GAIN_NATS = 5.0  # likelihood that a proposal must gain to be refined
WORKER_BYTES = 2 * 2**30  # least memory of a process that fits effects


def refine(fit: Fit, evaluations: int = EVALUATIONS, descents: int = DESCENTS,
           max_links: int = MAX_LINKS, anywhere: bool = False) -> Fit:
    """Search better parameters of the last effect by descents on the training links' likelihood.

    A descent has `evaluations` for each parameter, on at most `max_links`; with `anywhere` descents
    also start at `Variation.starts`. Returns the given fit if the new one is not better.
    """
    model, last = fit.model, fit.effects[-1]
    variation = last.variation()
    if variation is None or not len(variation.values):
        return fit
    if variation.members is not None:
        return _refine_members(fit, last, variation)
    train, reached = model.train, last.reach(model.links)
    train = train if reached is None else train & reached
    rows = subsample(np.flatnonzero(train), max_links)
    if not len(rows):
        return fit
    design_effect = fit.view.design_effect * len(rows) / max(train.sum(), 1)
    small = model.with_effects(model.effects[:-1]).restrict(rows)
    without = small.regression()
    # An effect without coefficients hardly changes those of the others: keep them in the search.
    keep_coefficients = last.stage == "gain" and not len(model.terms[-1].prior_sd_db)
    latest = fit

    def objective(numbers: np.ndarray) -> float:
        nonlocal latest
        inside = np.clip(numbers, variation.low, variation.high)
        effect = variation.effect(inside)
        tried = small.with_effects([*small.effects, effect])
        if keep_coefficients:
            moved = replace(without, gain_db=without.gain_db + tried.terms[-1].offset_db)
            misfit = moved.nll(fit).sum()
        else:
            latest = tried.fit(latest)
            misfit = latest.objective
        outside = np.abs((numbers - inside) / variation.steps).sum()
        return float(misfit + design_effect * effect.neg_log_prior() + OUTSIDE_NATS * outside)

    numbers = variation.values
    if anywhere:
        found = [_descend(objective, start, variation.steps, evaluations)
                 for start in (numbers, *variation.starts)]
        numbers = min(found, key=objective)
    for _ in range(descents):
        numbers = _descend(objective, numbers, variation.steps, evaluations)
    return _better(fit, last, variation, numbers)


def _refine_members(fit: Fit, last: Effect, variation: Variation) -> Fit:
    """Search the parameters of an effect for each member separately, on the links it changes.

    Members have parameters of their own, for example single devices. The rest of the model stays as
    it is, except for a common level of these links.
    """
    model, numbers = fit.model, variation.values.copy()
    arriving_db = model.regression().arriving(fit.coefficients)[0] - model.terms[-1].offset_db

    def changed(links: Links, numbers: np.ndarray) -> tuple[Effect, Term]:
        effect = variation.effect(np.clip(numbers, variation.low, variation.high))
        return effect, effect.term(links, model.level_at)

    def effect_db(links: Links, numbers: np.ndarray) -> np.ndarray:
        effect, term = changed(links, numbers)
        if effect.stage != "receiver":
            return term.offset_db
        respond = response([(effect, term.inputs)])
        assert respond is not None
        return sum((respond(np.full(len(links), level_db))[0] for level_db in EXTREMES_DB),
                   start=np.zeros(len(links)))

    train_rows = np.flatnonzero(model.train)
    trained = model.links.select(train_rows)
    for member in variation.members or ():
        moved, step = numbers.copy(), variation.steps[member]
        moved[member] += np.where(numbers[member] + step > variation.high[member], -step, step)
        affected = effect_db(trained, moved) != effect_db(trained, numbers)
        rows = subsample(train_rows[affected], MAX_LINKS_OF_MEMBER)
        if not len(rows):
            continue
        latest = None
        links = model.links.select(rows)
        others = [(effect, None if term.inputs is None else term.inputs[rows])
                  for effect, term in zip(model.effects[:-1], model.terms, strict=False)
                  if effect.stage == "receiver"]
        level_only = replace(model.with_effects([]).regression(rows),
                             law_columns=np.ones((len(rows), 1)),
                             prior_sd_db=np.full(1, ANY_LEVEL_SD_DB))

        def objective(values: np.ndarray, member: np.ndarray = member, rows: np.ndarray = rows,
                      links: Links = links, others: list[tuple[Effect, Any]] = others,
                      level_only: censored_regression.CensoredRegression = level_only) -> float:
            nonlocal latest
            tried = numbers.copy()
            tried[member] = np.clip(values, variation.low[member], variation.high[member])
            effect, term = changed(links, tried)
            varied = [(effect, term.inputs)] if effect.stage == "receiver" else []
            outside = np.abs((values - tried[member]) / variation.steps[member]).sum()
            latest = censored_regression.fit(
                replace(level_only, law_db=arriving_db[rows] + term.offset_db,
                        receiver=response([*others, *varied])), latest)
            return latest.objective + OUTSIDE_NATS * outside

        numbers[member] = _descend(objective, numbers[member], variation.steps[member])
    return _better(fit, last, variation, numbers)


def _descend(objective: Callable[[np.ndarray], float], values: np.ndarray, steps: np.ndarray,
             evaluations: int = EVALUATIONS) -> np.ndarray:
    """Minimise an objective by Brent's method, or Nelder and Mead (1965) for several parameters."""
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


def _better(fit: Fit, last: Effect, variation: Variation, numbers: np.ndarray) -> Fit:
    """Fit with new parameters of the last effect; return the given fit if that is not better."""
    effect = variation.effect(np.clip(numbers, variation.low, variation.high))
    better = fit.with_effect_at(-1, effect)
    prior_nats = last.neg_log_prior() - effect.neg_log_prior()
    gain_nats = fit.objective - better.objective + fit.view.design_effect * prior_nats
    return better if gain_nats > 0 else fit


def add_effect(fit: Fit, effect: Effect, like: Effect | None = None,
               group: np.ndarray | None = None) -> Fit | None:
    """Add an effect to a fitted model with its likeliest parameters, or load the earlier result.

    The effect takes the channel's quick levels, those of its fast law; `along_paths` replaces them
    by exact ones, from tracing paths. If `fit` is of a fold, `like` is the effect as fitted to all
    links; exact levels of `like` give exact levels in the fold. The effect should explain the
    training links `group` (m,), see `ResidualView.of_group`. None: it proposes no parameters.
    """
    inputs = (fit, effect, like) if group is None else (fit, effect, like, group)
    return cached("effect", inputs, lambda: _best_addition(fit, effect, like, group),
                  _write_addition, _reader(fit.model, effect))


def along_paths(fit: Fit, without: Fit) -> Fit:
    """Refine the last effect with exact levels, from tracing paths again, in place of quick ones.

    `without` is the fit without this effect. The given fit is returned if exact levels are worse or
    unused (`Effect.always_exact`), or the effect gains too little or changes too many links.
    """
    effect, gain_nats = fit.effects[-1], without.objective - fit.objective
    changes_few = np.count_nonzero(fit.model.terms[-1].offset_db) <= MAX_FOLLOWED_LINKS
    if not effect.always_exact or gain_nats < MIN_GAIN_NATS or not changes_few:
        return fit
    found = cached("effect-along-paths", (fit, without), lambda: _best_along_paths(fit, without),
                   _write_addition, _reader(fit.model.with_effects(fit.effects[:-1]), effect))
    return found or fit


def prepare_additions(without: Sequence[Fit], effects: Sequence[Effect], executor: Executor,
                      like: Effect | None = None) -> None:
    """Run `add_effect` for all pairs of fits and effects ahead of time, on an executor's workers.

    The results are cached (`radiotwin.runtime.pieces`), where `add_effect` finds them, equal to the
    bit. Without a cache, nothing is done.
    """
    if not executor.is_worth_it or not keeps():
        return
    pieces = [(fit, effect) for fit in range(len(without)) for effect in range(len(effects))]
    parts: ResultCache[tuple[int, int], Piece | None] = ResultCache(
        "effect", lambda piece: (without[piece[0]], effects[piece[1]], like),
        lambda found: found, lambda arrays, content: (arrays, content))
    function = partial(_added, list(without), list(effects), like)
    # A worker holds the same links, map and models as this process.
    memory_bytes = max(WORKER_BYTES, resident_bytes(os.getpid()))
    job: Job[tuple[int, int], Piece | None] = Job("fitting effects", function,
                                                  Resources(memory_bytes, False))
    executor.run_ahead(job, pieces, parts)


def _added(without: list[Fit], effects: list[Effect], like: Effect | None,
           piece: tuple[int, int]) -> Piece | None:
    """Add effect `piece[1]` to fit `piece[0]`, and encode the result for the cache."""
    return _write_addition(_best_addition(without[piece[0]], effects[piece[1]], like))


def _write_addition(found: Fit | None) -> Piece | None:
    """Encode a result of `add_effect` for the cache; None if JSON cannot hold its parameters."""
    if found is None:
        return {}, None
    effects = [(effect.params.model_dump(mode="json"), effect.levels) for effect in found.effects]
    for effect, (written, _) in zip(found.effects, effects, strict=True):
        if effect.params.model_validate(json.loads(json.dumps(written))) != effect.params:
            return None
    return ({"coefficients": found.coefficients, "scale_db": found.scale_db},
            {"effects": effects, "objective": float(found.objective)})


def _reader(model: Model, effect: Effect) -> Callable[..., Fit | None]:
    """Return the function that decodes `_write_addition`: `model` plus one effect, fitted."""
    def read(arrays: dict[str, np.ndarray], content: Any) -> Fit | None:
        if content is None:
            return None
        effects = []
        for before, (written, levels) in zip((*model.effects, effect), content["effects"],
                                             strict=True):
            found = before.with_params(before.Params.model_validate(written), levels)
            # Terms of unchanged effects need not be computed again.
            effects.append(before if before in model.effects and before.is_same(found) else found)
        return Fit(arrays["coefficients"], arrays["scale_db"], content["objective"],
                   model.with_effects(effects))
    return read


def _best_addition(fit: Fit, effect: Effect, like: Effect | None,
                   group: np.ndarray | None = None) -> Fit | None:
    """Compute the result of `add_effect`: fit all proposed parameters, return the likeliest fit."""
    view = fit.view if group is None else fit.view.of_group(group)
    proposals = effect.propose(view) if like is None else like.propose_for_fold(view)
    kinds: dict[Any, list[Effect]] = {}
    for params in proposals:
        proposed = effect.with_params(params)
        kinds.setdefault(proposed.kind(), []).append(proposed)
    found = [_best_of_a_kind(fit, same_kind, like is not None) for same_kind in kinds.values()]
    if not found:
        return None
    best = min(found, key=attrgetter("objective"))
    exactly = like is not None and like.always_exact and like.is_same(like.exactly())
    if like is None or not exactly or fit.objective - best.objective < MIN_GAIN_NATS:
        return best
    best = with_exact_levels(best)
    near = _refine_in_fold(fit, like)
    return near if near.objective < best.objective else best


def _best_along_paths(fit: Fit, without: Fit) -> Fit:
    """Compute the result of `along_paths`, while each search gains MIN_EXACT_GAIN_NATS."""
    best = with_exact_levels(_refine_over_cached_paths(fit))
    if not _is_exact(best) and best.channel.follows_paths:
        best = _refine_exactly(best)
    variation = best.effects[-1].variation()
    if variation is None or not variation.follows_paths:
        return best
    before = without.objective
    for _ in range(MAX_EXACT_DESCENTS):
        if not _is_exact(best) or before - best.objective < MIN_EXACT_GAIN_NATS:
            break
        before = best.objective
        best = refine(best, evaluations=EXACT_EVALUATIONS, descents=1, max_links=MAX_EXACT_LINKS)
    return best


def _best_of_a_kind(fit: Fit, proposed: list[Effect], is_fold: bool) -> Fit:
    """Fit the effects `proposed`, which differ in parameters only, and refine the best one."""
    tried = [fit.model.with_effects([*fit.effects, effect]) for effect in proposed]
    if proposed[0].stage == "gain" and len(tried) > MAX_PROPOSALS:  # only gains have a score
        tried.sort(key=lambda model: -fit.view.score(model.terms[-1].select(fit.train)))
        tried = tried[:MAX_PROPOSALS]
    best = min((model.fit(fit) for model in tried), key=attrgetter("objective"))
    if fit.objective - best.objective < MIN_GAIN_NATS:
        return best
    return refine(best, descents=1 if is_fold else DESCENTS)


def _is_exact(fit: Fit) -> bool:
    """Return True if the last effect uses exact levels along paths."""
    last = fit.effects[-1]
    return last.is_same(last.exactly())


def _refine_exactly(fit: Fit) -> Fit:
    """Search the last effect's parameters with exact levels, if they are few: paths are traced.

    It starts at the optimum of quick levels, for the case that exact ones are worse there.
    """
    last = fit.effects[-1]
    variation, exactly = last.variation(), last.exactly()
    if variation is None or exactly is None or len(variation.values) > MAX_EXACT_NUMBERS:
        return fit
    exact = refine(fit.with_effect_at(-1, exactly), evaluations=EXACT_EVALUATIONS, descents=1,
                   max_links=MAX_EXACT_LINKS)
    return exact if exact.objective < fit.objective else fit


def _refine_over_cached_paths(fit: Fit, is_near: bool = False) -> Fit:
    """Search the last effect's parameters without tracing: cached paths give nearly exact levels.

    Returns the given fit if the effect has no such levels, or exact ones are not better there.
    """
    last = fit.effects[-1]
    exact = last.exactly() if fit.channel.follows_paths else None
    variation = None if exact is None else exact.variation()
    if variation is None or variation.follows_paths:
        return fit
    start = fit.with_effect_at(-1, variation.effect(variation.values))
    found = refine(start, descents=1, anywhere=not is_near).effects[-1].exactly()
    assert found is not None
    exactly = fit.with_effect_at(-1, found)
    return exactly if exactly.objective < fit.objective else fit


def _refine_in_fold(fit: Fit, like: Effect) -> Fit:
    """Fit an effect in a fold with exact levels, near the parameters `like` found on all links.

    As every fold tries the same values, their traced paths are cached.
    """
    def fitted(effect: Effect) -> Fit:
        return fit.with_effects([*fit.effects, effect])

    variation, best = like.variation(), fitted(like)
    if variation is None:
        return best
    if not variation.follows_paths:
        return _refine_over_cached_paths(best, is_near=True)
    start_nats, numbers = best.objective, variation.values.copy()
    for number, step in enumerate(variation.steps):
        least_nats = start_nats
        for shift in (-NEAR_SHARE * step, NEAR_SHARE * step):
            values = variation.values.copy()
            values[number] += shift
            moved = fitted(variation.effect(np.clip(values, variation.low, variation.high)))
            if moved.objective < least_nats:
                least_nats, numbers[number] = moved.objective, values[number]
            best = min(best, moved, key=attrgetter("objective"))
    together = fitted(variation.effect(np.clip(numbers, variation.low, variation.high)))
    return min(best, together, key=attrgetter("objective"))


def with_exact_levels(fit: Fit) -> Fit:
    """Take exact levels, from tracing paths, in each effect where that raises the likelihood."""
    if not fit.channel.follows_paths:
        return fit
    for number, effect in enumerate(fit.effects):
        exactly = effect.exactly()
        if exactly is None or effect.is_same(exactly):
            continue
        other = fit.with_effect_at(number, exactly)
        if other.objective < fit.objective:
            fit = other
    return fit
