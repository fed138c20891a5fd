"""Search for lasting causes by forward selection: add the best effect, step by step.

Candidates are fitted to all links and without each fold, scored on held-out links and by their
evidence given correlated residuals, and kept one by one while they are probable.

Some effects are probable only together, such as three masts with sector antennas, or a displaced
anchor and a receiver that drifts: for each, the others look like noise. So if the likeliest effect
is not probable enough, it is judged together with a second one: a repeat of it, or one of the next
likeliest. Repeats follow while they make all of them more probable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.search.scoring import (
    Candidate,
    fit_and_score,
    fit_candidate,
    score_candidate,
)
from radiotwin.closeloop.search.stages import SearchInputs, SearchState
from radiotwin.closeloop.search.trials import Trial, TrialLog
from radiotwin.closeloop.verdict.criteria import (
    MAX_SECONDS,
    MIN_FIRST_SHARE,
    MIN_RIVAL_SHARE,
    SAME_DB,
    SelectionCriteria,
)
from radiotwin.closeloop.verdict.hypotheses import Hypotheses
from radiotwin.closeloop.verdict.intervals import why_not_confirmed
from radiotwin.closeloop.verdict.posterior import judge, probability_of_all
from radiotwin.effects.base import Effect, LimitEffect
from radiotwin.effects.registry import catalogue
from radiotwin.links.sites import site_of
from radiotwin.twin.model.fitting import prepare_additions, with_exact_levels


@dataclass(frozen=True, eq=False)
class Tried:
    """Result of trying one candidate in a step.

    Attributes:
        effect: the candidate.
        trial: its scores on held-out links, or the reason why it was not scored.
        model: the model with the effect if it passed, else without.
        waiting: the fitted candidate, if it was not scored because a better one passed.
    """

    effect: Effect
    trial: Trial
    model: CrossFit
    waiting: Candidate | None = None


def add_causes(state: SearchState, inputs: SearchInputs) -> SearchState:
    """Add causes that act in all flights, the most evident first, until none passes."""
    return forward_selection(state, [effect for effect in inputs.undeclared
                                     if not (effect.within_flights or effect.of_groups)], inputs)


def forward_selection(state: SearchState, effects: Sequence[Effect],
                      inputs: SearchInputs) -> SearchState:
    """Add the best candidate to the model, step by step, until none passes.

    Args:
        state: state of the search.
        effects: candidates: all causes, or all trends (curves), which need no probability.
        inputs: inputs of the search.
    """
    if not effects:
        return state
    causes = all(each.is_cause for each in effects)
    reasons = [effect.unavailable(state.model.links) for effect in effects]
    available = [effect for effect, why in zip(effects, reasons, strict=True) if not why]
    state = state.refuse(*(
        Trial(effect.name, reason=f"not looked for: {why}", variant=effect.variant)
        for effect, why in zip(effects, reasons, strict=True) if why))
    before = None
    while state.model is not before and not state.is_full(inputs.criteria):
        before = state.model
        state = _one_step(state, available, causes, inputs)
    return replace(state, log=_without_kept_rivals(state.log))


def _one_step(state: SearchState, available: list[Effect], causes: bool,
              inputs: SearchInputs) -> SearchState:
    """Try all available effects, and add the best one that passes, or a set that is probable.

    If none passes, the model stays. Only `causes` have a probability, trends need a held-out gain.
    """
    hypotheses = None
    if causes:
        inputs.on_progress(f"step {state.step + 1}: what the base may be wrong in")
        state, hypotheses = state.with_hypotheses(inputs.seed)
    tried = _try_all(state, available, hypotheses, inputs)
    if hypotheses is not None:
        state, tried = _judge_step(state, tried, hypotheses, inputs.criteria)
        waiting = [each.waiting for each in tried if each.waiting is not None]
        if waiting and not _passed(tried):
            # The candidates scored so far are improbable, so score the weaker ones after all.
            scored = _score(state, waiting, inputs)
            tried = [*(each for each in tried if each.waiting is None), *scored]
            state, tried = _judge_step(state, tried, hypotheses, inputs.criteria)
        if not _passed(tried):
            together = _probable_together(state, [each for each in tried if each.trial.passed],
                                         inputs)
            if together and _all_confirmed(together[-1].model, len(together)):
                return _keep_together(state, tried, together)
    if not _passed(tried):
        return state.refuse(*(each.trial for each in tried))
    return _keep_best(state, tried, hypotheses, inputs)


def _passed(tried: list[Tried]) -> list[Tried]:
    """Return the candidates that passed on held-out links and were not refused otherwise."""
    return [each for each in tried if each.trial.passed and not each.trial.reason]


def _try_all(state: SearchState, available: list[Effect], hypotheses: Hypotheses | None,
             inputs: SearchInputs) -> list[Tried]:
    """Fit every available effect to all links, and score it on held-out links.

    Not scored are effects that cannot be fitted plausibly, and effects whose training gain is far
    below the held-out gain of one that passed (`_clearly_better`).
    """
    model, step = state.model, state.step
    found = [each.entry for each in model.whole.effects]
    effects = [effect for effect in available
               if effect.repeatable or not any(each is effect for each in found)]
    prepare_additions([model.whole], effects, inputs.executor)
    refused, candidates = [], []
    for effect in effects:
        inputs.on_progress(f"step {step + 1}: {effect.name}")
        fitted = fit_candidate(model, effect, inputs.criteria, hypotheses)
        if isinstance(fitted, Candidate):
            candidates.append(fitted)
        else:
            refused.append(Tried(effect, fitted, model))
    return refused + _score(state, candidates, inputs, is_needless=_clearly_better)


def _score(state: SearchState, candidates: list[Candidate], inputs: SearchInputs,
           is_needless: Callable[..., bool] = lambda *_: False) -> list[Tried]:
    """Score the candidates of a step on held-out links, in the order of their training gain.

    Not scored are those that an effect that passed makes needless (`is_needless`).
    """
    model, step = state.model, state.step
    tried: list[Tried] = []
    for candidate in sorted(candidates, key=lambda candidate: -candidate.gain_nats):
        effect = candidate.effect
        better = next((each.trial for each in _passed(tried)
                       if is_needless(each, candidate, model, inputs.criteria)), None)
        if better is not None:
            why = (f"{better.name} gains more on held-out links than this on those that it "
                   f"is fitted to ({candidate.gain_nats:.0f} nats)")
            trial = Trial(effect.name, reason=why, step=step, variant=effect.variant,
                          evidence_nats=candidate.evidence_nats)
            tried.append(Tried(effect, trial, model, candidate))
            continue
        inputs.on_progress(f"step {step + 1}: {effect.name}, held out")
        trial, extended = score_candidate(model, candidate, inputs)
        tried.append(Tried(effect, trial, extended or model))
    return tried


def _judge_step(state: SearchState, tried: list[Tried], hypotheses: Hypotheses,
                criteria: SelectionCriteria) -> tuple[SearchState, list[Tried]]:
    """Compute the probabilities of a step's candidates, and refuse those that are too improbable.

    A probable candidate is refused, too, if its size on held-out links may be 0. Trials that
    earlier stages made with the same model compete as rivals and get new probabilities.
    """
    step, earlier = state.step, state.log.of_step(state.step)
    judged, summary = judge([*earlier, *(each.trial for each in tried)], state.model, hypotheses,
                            criteria)
    found = []
    for each, trial in zip(tried, judged[len(earlier):], strict=True):
        if trial.passed and not trial.reason:
            trial = replace(trial, reason=why_not_confirmed(each.model, step))
        found.append(replace(each, trial=trial))
    steps = (*(each for each in state.steps if each.number < step), summary)
    log = state.log.supersede(*judged[:len(earlier)])
    return replace(state, steps=steps, log=log), found


def _all_confirmed(model: CrossFit, last: int) -> bool:
    """Return whether held-out links confirm each of a model's `last` effects."""
    count = len(model.whole.effects)
    return not any(why_not_confirmed(model, number)
                   for number in range(count - last, count))


def _probable_together(state: SearchState, supported: Sequence[Tried],
                      inputs: SearchInputs) -> list[Tried]:
    """Search for a set of effects that is probable, though none is by itself; else return [].

    The most probable of the effects that held-out links support is extended by a second one, then
    by repeats of itself while they make the set more probable.
    """
    criteria, step = inputs.criteria, state.steps[-1]
    ranked = sorted(supported, key=lambda each: -each.trial.probability)
    if not ranked or ranked[0].trial.probability < MIN_FIRST_SHARE * criteria.min_probability:
        return []
    first = ranked[0]
    inputs.on_progress(f"step {step.number + 1}: {first.trial.name}, beside another effect")

    def beside(found: list[Tried], effects: list[Effect]) -> list[list[Tried]]:
        """Return the set `found` plus one effect, for each of `effects` that passes with it."""
        model = found[-1].model
        if len(model.whole.effects) >= criteria.max_effects:
            return []
        hypotheses = Hypotheses.of(model.whole, inputs.seed)
        longer = []
        for effect in effects:
            trial, extended = fit_and_score(model, effect, inputs, hypotheses)
            if extended is not None:
                longer.append([*found, Tried(effect, trial, extended)])
        return longer

    def probability(found: list[Tried]) -> float:
        """Return the probability that a set of effects is present."""
        names = {each.trial.name for each in found}
        others = [each.trial.nats for each in ranked if each.trial.name not in names]
        return probability_of_all([each.trial for each in found], max([0.0, *others]), state.model,
                                  step.rest_db / step.noise_db)

    seconds = ([first.effect] if first.effect.repeatable else []) + [
        each.effect for each in ranked[1:] if each.effect is not first.effect]
    best = max(beside([first], seconds[:MAX_SECONDS]), key=probability, default=[])
    while best and probability(best) < criteria.min_probability:
        kind = {each.effect for each in best}
        more = beside(best, [first.effect]) \
            if len(kind) == 1 and len(best) < criteria.max_repeats else []
        best = more[0] if more and probability(more[0]) > probability(best) else []
    chance = probability(best) if best else 0.0
    return [replace(each, trial=replace(each.trial, reason="", probability=chance))
            for each in best]


def _keep_together(state: SearchState, tried: list[Tried], found: list[Tried]) -> SearchState:
    """Add a set of effects from `_probable_together`, and log the trials of the step (`tried`)."""
    first = found[0]
    log = state.log.record(
        *(first.trial.keep() if each.effect is first.effect else each.trial for each in tried),
        *(each.trial.keep() for each in found[1:]))
    return replace(state, model=_refit_exactly(found[-1].model), log=log)


def _keep_best(state: SearchState, tried: list[Tried], hypotheses: Hypotheses | None,
               inputs: SearchInputs) -> SearchState:
    """Add the candidate with the most evidence, or repeats of a weaker one that explain more.

    Repeats (groves, towers) are tried of the best other candidate that passed, or of one that was
    refused only as too improbable, with at least `MIN_RIVAL_SHARE` of the best evidence.
    """
    criteria, step = inputs.criteria, state.step
    passed = sorted(_passed(tried), key=lambda each: -each.trial.nats)
    # Among candidates that the evidence cannot tell apart, the least held-out RMSE comes first.
    max_nats = passed[0].trial.nats
    close = [each for each in passed
             if max_nats - each.trial.nats < criteria.indistinguishable_nats]
    passed.sort(key=lambda each: each.trial.rmse_db if each in close else np.inf)
    first = passed[0]
    kept, first_nats = [first], first.trial.nats
    rival = next((each for each in passed[1:] if each.effect.repeatable), None)
    if rival is None and not first.effect.repeatable:
        rival = max((each for each in tried if each.trial.passed and each.effect.repeatable
                     and each.trial.nats >= MIN_RIVAL_SHARE * first_nats),
                    key=lambda each: each.trial.nats, default=None)
    max_repeats = (criteria.max_repeats if not first.effect.repeatable
                   else _devices_on_one_mast(first.model))
    if rival is not None and max_repeats > 1:
        inputs.on_progress(f"step {step + 1}: more of {rival.trial.name}")
        repeats = _add_repeats(rival, hypotheses, first_nats, max_repeats, inputs)
        if repeats and rival.trial.reason:
            repeats = _if_more_probable(state, repeats, first.trial, criteria)
        kept = repeats or kept
    best, nats = kept[0], sum(each.trial.nats for each in kept)
    name = best.trial.name
    rivals = tuple(each.trial.name for each in passed if each.trial.name != name
                   and nats - each.trial.nats < criteria.indistinguishable_nats)
    less = f"{name} explains more"
    trials = [best.trial.keep(rivals=rivals) if each.effect is best.effect
              else each.trial.refuse(less) if each.trial.is_open else each.trial for each in tried]
    earlier = [each.refuse(less) for each in state.log.of_step(step) if each.is_open]
    log = state.log.supersede(*earlier).record(*trials, *(each.trial.keep() for each in kept[1:]))
    inputs.on_progress(f"step {step + 1}: {name}, exactly")
    return replace(state, model=_refit_exactly(kept[-1].model), log=log)


def _if_more_probable(state: SearchState, repeats: list[Tried], best: Trial,
                      criteria: SelectionCriteria) -> list[Tried]:
    """Return repeats with their joint probability; [] if it is too low or below that of `best`."""
    step = state.steps[-1]
    probability = probability_of_all([each.trial for each in repeats], best.nats, state.model,
                                     step.rest_db / step.noise_db)
    if probability < max(best.probability, criteria.min_probability):
        return []
    return [replace(each, trial=replace(each.trial, reason="", probability=probability))
            for each in repeats]


def _clearly_better(passed: Tried, candidate: Candidate, model: CrossFit,
                    criteria: SelectionCriteria) -> bool:
    """Return whether a candidate need not be scored, since an effect that passed gains far more.

    A candidate hardly gains more on held-out links than on training links, so its training gain is
    compared with the held-out gain of the effect. A candidate with more evidence, or one that is
    repeatable while the effect is not, is scored in any case.
    """
    lead_nats = passed.trial.nll_gain - candidate.gain_nats
    clear = lead_nats > criteria.indistinguishable_nats * model.whole.view.design_effect
    more_evidence = candidate.evidence_nats > passed.trial.evidence_nats
    return clear and not more_evidence and (passed.effect.repeatable
                                            or not candidate.effect.repeatable)


def _devices_on_one_mast(model: CrossFit) -> int:
    """Return the number of devices on which the last effect acts; 0 if not all are on one mast."""
    links = model.links
    devices = np.unique(links.device[model.whole.model.terms[-1].acts])
    on_mast = len(devices) and set(devices) <= set(site_of(links, devices[0]))
    return len(devices) if on_mast else 0


def _add_repeats(rival: Tried, hypotheses: Hypotheses | None, min_nats: float, max_repeats: int,
                 inputs: SearchInputs) -> list[Tried]:
    """Add an effect of one kind again until all repeats together have more than `min_nats`.

    Examples: groves, each seen from few devices, instead of an offset of each device; antennas
    instead of another position of their mast.

    Returns:
        the repeats, `rival` first; [] if a further one does not pass on held-out links, if the
        limits of their number are reached, or if held-out links do not confirm each of them.
    """
    found, model = [rival], rival.model
    while len(model.whole.effects) < inputs.criteria.max_effects and len(found) < max_repeats:
        if hypotheses is not None:
            hypotheses = Hypotheses.of(model.whole, inputs.seed)
        trial, extended = fit_and_score(model, rival.effect, inputs, hypotheses)
        if extended is None:
            return []
        model, trial = extended, replace(trial, probability=rival.trial.probability)
        found.append(Tried(rival.effect, trial, model))
        if sum(each.trial.nats for each in found) > min_nats:
            return found if _all_confirmed(model, len(found)) else []
    return []


def _without_kept_rivals(log: TrialLog) -> TrialLog:
    """Remove from the rivals of each kept effect the names that turned out to be separate effects.

    A rival is an effect that the data could not tell from the kept one. It is separate if it was
    kept as well, or if the last step did not refuse it: it gains in addition to the kept one.
    """
    last = max((each.step for each in log.trials), default=0)
    separate = {each.name for each in log.trials
                if each.kept or (each.step == last and each.is_open)}
    return log.supersede(*(replace(each, rivals=tuple(sorted(set(each.rivals) - separate)))
                           for each in log.kept if each.rivals))


def _refit_exactly(model: CrossFit) -> CrossFit:
    """Refit a model with levels along exact paths where they fit better, and move limits."""
    return _with_moved_limits(model.map(with_exact_levels))


def _with_moved_limits(model: CrossFit) -> CrossFit:
    """Move receivers' limits of detection by the reading offsets of the last effect, and refit.

    A calibration offset shifts a receiver's readings and its apparent limit by as much. A limit is
    moved if its apparent shift agrees with the offset within `SAME_DB`. Without such an offset the
    model is returned as it is.
    """
    whole = model.whole
    offsets_db = whole.effects[-1].reading_offsets_db(whole.coefficients_of(-1))
    if not offsets_db:
        return model
    found_db = np.full(len(model.links), -np.inf)
    for limit in (effect() for effect in catalogue() if issubclass(effect, LimitEffect)):
        for params in limit.propose(whole.view)[:1]:
            found_db = np.maximum(found_db, limit.with_params(params).limits_db(model.links))
    limit_db = model.links.limit_db.copy()
    for receiver, offset_db in offsets_db.items():
        rows = model.links.receiver == receiver
        receiver_db, usual_db = np.median(found_db[rows]), np.median(limit_db[rows])
        if np.isfinite(receiver_db) and abs(receiver_db - usual_db - offset_db) <= SAME_DB:
            limit_db[rows] = receiver_db
    if np.array_equal(limit_db, model.links.limit_db):
        return model
    return model.map(lambda fit: replace(
        fit.model, links=fit.links.with_columns(limit_db=limit_db)).fit(fit))
