"""Finding the parameters of one more effect: proposals, a search over its numbers, exact levels."""

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
from radiotwin.runtime.pieces import KeptParts, Piece, keeps, kept
from radiotwin.runtime.processes import resident_bytes
from radiotwin.twin.model.model import Fit, Model, response

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


def refine(fit: Fit, evaluations: int = EVALUATIONS, descents: int = DESCENTS,
           max_links: int = MAX_LINKS, anywhere: bool = False) -> Fit:
    """Vary the last effect's parameters for a better fit to the training links.

    Args:
        fit: of the model.
        evaluations: of the objective for each number, in one descent.
        descents: one after the other.
        max_links: that the objective is of.
        anywhere: whether the search also begins at `Variation.starts`.
    """
    model, last = fit.model, fit.effects[-1]
    variation = last.variation()
    if variation is None or not len(variation.values):
        return fit
    if variation.members is not None:
        return _refine_members(fit, last, variation)
    train, near = model.train, last.reach(model.links)
    train = train if near is None else train & near
    rows = subsample(np.flatnonzero(train), max_links)
    if not len(rows):
        return fit
    design_effect = fit.view.design_effect * len(rows) / max(train.sum(), 1)
    small = model.with_effects(model.effects[:-1]).restrict(rows)
    rest = small.regression()
    # What has no coefficients of its own moves those of the others little: they stay meanwhile.
    alone = last.stage == "gain" and not len(model.terms[-1].prior_sd_db)
    latest = fit

    def objective(numbers: np.ndarray) -> float:
        nonlocal latest
        inside = np.clip(numbers, variation.low, variation.high)
        effect = variation.effect(inside)
        tried = small.with_effects([*small.effects, effect])
        if alone:
            moved = replace(rest, gain_db=rest.gain_db + tried.terms[-1].offset_db)
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
    """Vary the numbers of each member by themselves, on the links that they act on.

    Only a level of its own is fitted beside them.
    """
    model, numbers = fit.model, variation.values.copy()
    arriving_db = model.regression().arriving(fit.coefficients)[0] - model.terms[-1].offset_db

    def changed(links: Links, numbers: np.ndarray) -> tuple[Effect, Term]:
        effect = variation.effect(np.clip(numbers, variation.low, variation.high))
        return effect, effect.term(links, model.level_at)

    def acted_db(links: Links, numbers: np.ndarray) -> np.ndarray:
        effect, term = changed(links, numbers)
        if effect.stage != "receiver":
            return term.offset_db
        through = response([(effect, term.inputs)])
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
        others = [(each, None if term.inputs is None else term.inputs[rows])
                  for each, term in zip(model.effects[:-1], model.terms, strict=False)
                  if each.stage == "receiver"]
        alone = replace(model.with_effects([]).regression(rows),
                        law_columns=np.ones((len(rows), 1)),
                        prior_sd_db=np.full(1, ANY_LEVEL_SD_DB))

        def objective(values: np.ndarray, member: np.ndarray = member, rows: np.ndarray = rows,
                      links: Links = links, others: list[tuple[Effect, Any]] = others,
                      alone: censored_regression.CensoredRegression = alone) -> float:
            nonlocal latest
            tried = numbers.copy()
            tried[member] = np.clip(values, variation.low[member], variation.high[member])
            effect, term = changed(links, tried)
            own = [(effect, term.inputs)] if effect.stage == "receiver" else []
            outside = np.abs((values - tried[member]) / variation.steps[member]).sum()
            latest = censored_regression.fit(
                replace(alone, law_db=arriving_db[rows] + term.offset_db,
                        receiver=response([*others, *own])), latest)
            return latest.objective + OUTSIDE_NATS * outside

        numbers[member] = _descend(objective, numbers[member], variation.steps[member])
    return _better(fit, last, variation, numbers)


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


def _better(fit: Fit, last: Effect, variation: Variation, numbers: np.ndarray) -> Fit:
    """Return the fit with the last effect's numbers changed, where that is better."""
    effect = variation.effect(np.clip(numbers, variation.low, variation.high))
    better = fit.with_effect_at(-1, effect)
    prior = last.neg_log_prior() - effect.neg_log_prior()
    gain = fit.objective - better.objective + fit.view.design_effect * prior
    return better if gain > 0 else fit


def add_effect(fit: Fit, effect: Effect, like: Effect | None = None,
               group: np.ndarray | None = None) -> Fit | None:
    """Find the best parameters of an effect on the training links, beside the effects there are.

    On all links with quick levels, which `along_paths` replaces; on those of a fold with exact ones
    where `like` has them.

    Args:
        fit: without it.
        effect: what is added.
        like: what was found of it on all links, where the fit is of a fold.
        group: (m,) bool, training links that it is to explain, see `ResidualView.of_group`.

    Returns:
        the fit with the effect; None where nothing in the residual looks like the effect.
    """
    inputs = (fit, effect, like) if group is None else (fit, effect, like, group)
    return kept("effect", inputs, lambda: _best_addition(fit, effect, like, group),
                _write_addition, _reader(fit.model, effect))


def along_paths(fit: Fit, without: Fit) -> Fit:
    """Search on for the parameters of the last effect with levels of the channel's own paths.

    Args:
        fit: that `add_effect` found.
        without: the fit without the last effect.

    Returns:
        the fit with exact levels in its last effect where these are better; what was given where
        they are not, or may not be asked for (`Effect.always_exact`).
    """
    effect, gain = fit.effects[-1], without.objective - fit.objective
    changes_few = np.count_nonzero(fit.model.terms[-1].offset_db) <= MAX_FOLLOWED_LINKS
    if not effect.always_exact or gain < MIN_GAIN_NATS or not changes_few:
        return fit
    found = kept("effect-along-paths", (fit, without), lambda: _best_along_paths(fit, without),
                 _write_addition, _reader(fit.model.with_effects(fit.effects[:-1]), effect))
    return found or fit


def prepare_additions(without: Sequence[Fit], effects: Sequence[Effect], executor: Executor,
                      like: Effect | None = None) -> None:
    """Compute what `add_effect` will be asked, on the workers of an executor.

    The results are among the finished parts (`radiotwin.runtime.pieces`), from where `add_effect`
    has them, equal to the bit. Where no parts are kept, nothing is done.

    Args:
        without: k fits, to each of which the effects are added.
        effects: one at a time.
        executor: where it runs.
        like: as of `add_effect`.
    """
    if not executor.is_worth_it or not keeps():
        return
    pieces = [(fit, effect) for fit in range(len(without)) for effect in range(len(effects))]
    parts: KeptParts[tuple[int, int], Piece | None] = KeptParts(
        "effect", lambda piece: (without[piece[0]], effects[piece[1]], like),
        lambda found: found, lambda arrays, content: (arrays, content))
    function = partial(_added, list(without), list(effects), like)
    # A worker holds links, map and models as this process does, and no more.
    memory_bytes = max(WORKER_BYTES, resident_bytes(os.getpid()))
    job: Job[tuple[int, int], Piece | None] = Job("fitting effects", function,
                                                  Resources(memory_bytes, False))
    executor.run_ahead(job, pieces, parts)


def _added(without: list[Fit], effects: list[Effect], like: Effect | None,
           piece: tuple[int, int]) -> Piece | None:
    """Add an effect to a fit, by the number of each."""
    return _write_addition(_best_addition(without[piece[0]], effects[piece[1]], like))


def _write_addition(found: Fit | None) -> Piece | None:
    """Return what `add_effect` found, without the terms; None if JSON cannot hold it."""
    if found is None:
        return {}, None
    effects = [(each.params.model_dump(mode="json"), each.levels) for each in found.effects]
    for each, (written, _) in zip(found.effects, effects, strict=True):
        if each.params.model_validate(json.loads(json.dumps(written))) != each.params:
            return None
    return ({"coefficients": found.coefficients, "scale_db": found.scale_db},
            {"effects": effects, "objective": float(found.objective)})


def _reader(model: Model, effect: Effect) -> Callable[..., Fit | None]:
    """Return what reads the fit of a model with one more effect."""
    def read(arrays: dict[str, np.ndarray], content: Any) -> Fit | None:
        if content is None:
            return None
        effects = []
        for before, (written, levels) in zip((*model.effects, effect), content["effects"],
                                             strict=True):
            found = before.with_params(before.Params.model_validate(written), levels)
            # The terms of those that are as they were need not be made again.
            effects.append(before if before in model.effects and before.is_same(found) else found)
        return Fit(arrays["coefficients"], arrays["scale_db"], content["objective"],
                   model.with_effects(effects))
    return read


def _best_addition(fit: Fit, effect: Effect, like: Effect | None,
                   group: np.ndarray | None = None) -> Fit | None:
    view = fit.view if group is None else fit.view.of_group(group)
    proposals = effect.propose(view) if like is None else like.propose_like(view)
    kinds: dict[Any, list[Effect]] = {}
    for params in proposals:
        proposed = effect.with_params(params)
        kinds.setdefault(proposed.kind(), []).append(proposed)
    found = [_best_of_a_kind(fit, each, like is not None) for each in kinds.values()]
    if not found:
        return None
    best = min(found, key=attrgetter("objective"))
    exactly = like is not None and like.always_exact and like.is_same(like.exactly())
    if like is None or not exactly or fit.objective - best.objective < MIN_GAIN_NATS:
        return best
    best = with_exact_levels(best)
    near = _near(fit, like)
    return near if near.objective < best.objective else best


def _best_along_paths(fit: Fit, without: Fit) -> Fit:
    best = with_exact_levels(_over_known_paths(fit))
    if not _is_exact(best) and best.channel.follows_paths:
        best = _exactly_beside(best)
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
    tried = [fit.model.with_effects([*fit.effects, each]) for each in proposed]
    if proposed[0].stage == "gain" and len(tried) > MAX_PROPOSALS:  # only gains have a score
        tried.sort(key=lambda each: -fit.view.score(each.terms[-1].select(fit.train)))
        tried = tried[:MAX_PROPOSALS]
    best = min((each.fit(fit) for each in tried), key=attrgetter("objective"))
    if fit.objective - best.objective < MIN_GAIN_NATS:
        return best
    return refine(best, descents=1 if is_fold else DESCENTS)


def _is_exact(fit: Fit) -> bool:
    last = fit.effects[-1]
    return last.is_same(last.exactly())


def _exactly_beside(fit: Fit) -> Fit:
    """Look for better exact levels of the last effect, where those of its quick optimum are not.

    The optimum of both need not be the same. Only of few numbers, such as a position: each value
    that is tried follows paths.
    """
    last = fit.effects[-1]
    variation, exactly = last.variation(), last.exactly()
    if variation is None or exactly is None or len(variation.values) > MAX_EXACT_NUMBERS:
        return fit
    beside = refine(fit.with_effect_at(-1, exactly), evaluations=EXACT_EVALUATIONS, descents=1,
                    max_links=MAX_EXACT_LINKS)
    return beside if beside.objective < fit.objective else fit


def _over_known_paths(fit: Fit, is_near: bool = False) -> Fit:
    """Search for exact parameters of the last effect with levels that are nearly exact.

    Those of known paths (`missing_obstacle`), of which a value takes milliseconds. Where the effect
    knows none, or they are no better, the fit is returned as it is.
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


def _near(fit: Fit, like: Effect) -> Fit:
    """Return the best fit to a fold around the effect that was found on all links.

    Each number by itself a share of its step to both sides, and all that gain together: every fold
    asks for the same exact levels, which are kept.
    """
    def fitted(effect: Effect) -> Fit:
        return fit.with_effects([*fit.effects, effect])

    variation, best = like.variation(), fitted(like)
    if variation is None:
        return best
    if not variation.follows_paths:
        return _over_known_paths(best, is_near=True)
    start, numbers = best.objective, variation.values.copy()
    for number, step in enumerate(variation.steps):
        least = start
        for shift in (-NEAR_SHARE * step, NEAR_SHARE * step):
            values = variation.values.copy()
            values[number] += shift
            moved = fitted(variation.effect(np.clip(values, variation.low, variation.high)))
            if moved.objective < least:
                least, numbers[number] = moved.objective, values[number]
            best = min(best, moved, key=attrgetter("objective"))
    together = fitted(variation.effect(np.clip(numbers, variation.low, variation.high)))
    return min(best, together, key=attrgetter("objective"))


def with_exact_levels(fit: Fit) -> Fit:
    """Replace quick levels by the channel's exact ones in each effect, where that is better."""
    if not fit.channel.follows_paths:
        return fit
    for number, each in enumerate(fit.effects):
        exactly = each.exactly()
        if exactly is None or each.is_same(exactly):
            continue
        other = fit.with_effect_at(number, exactly)
        if other.objective < fit.objective:
            fit = other
    return fit
