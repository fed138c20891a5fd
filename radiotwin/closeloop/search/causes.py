"""Search for causes: step by step the effect that held-out links and the evidence support most.

Candidates are fitted to all links and to each fold's others, scored on held-out links and beside
errors of the base that are correlated, and kept one by one as long as they are probable.

Some effects are probable only together. Three masts with sector antennas, or a displaced anchor and
a receiver that drifts: each explains a part of the residual, in which the other parts look like
noise. So if the likeliest effect is not probable enough, one more of its kind, or the next
likeliest, is fitted beside it, and they are judged by what they explain together. More of a kind
follow as long as they make all of them likelier.
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
from radiotwin.closeloop.verdict.intervals import why_not_borne_out
from radiotwin.closeloop.verdict.posterior import judge, probability_of_all
from radiotwin.effects.base import Effect, LimitEffect
from radiotwin.effects.registry import catalogue
from radiotwin.links.sites import site_of
from radiotwin.twin.model.fitting import prepare_additions, with_exact_levels


@dataclass(frozen=True, eq=False)
class Tried:
    """A candidate of one step.

    Attributes:
        effect: that was tried.
        trial: what held-out links say of it, or why they were not asked.
        model: with the effect where held-out links support it, else without.
        waiting: the fitted candidate, where a better one made it needless to ask held-out links.
    """

    effect: Effect
    trial: Trial
    model: CrossFit
    waiting: Candidate | None = None


def add_causes(state: SearchState, inputs: SearchInputs) -> SearchState:
    """Add causes that last, the most evident first, until none passes."""
    return forward_selection(state, [effect for effect in inputs.undeclared
                                     if not (effect.within_flights or effect.of_groups)], inputs)


def forward_selection(state: SearchState, effects: Sequence[Effect],
                      inputs: SearchInputs) -> SearchState:
    """Add to the model the effect with the most evidence, and again, until none passes.

    Args:
        state: before.
        effects: candidates: causes or (then they need not be probable) descriptions.
        inputs: of the search.
    """
    if not effects:  # nothing to ask, and so no step
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
        state = _one_more(state, available, causes, inputs)
    return replace(state, log=_told_apart(state.log))


def _one_more(state: SearchState, available: list[Effect], causes: bool,
              inputs: SearchInputs) -> SearchState:
    """Return the state after one step: with what was kept, or with the same model."""
    hypotheses = None
    if causes:
        inputs.on_progress(f"step {state.step + 1}: what the base may be wrong in")
        state, hypotheses = state.look(inputs.seed)
    tried = _try_all(state, available, hypotheses, inputs)
    if hypotheses is not None:
        state, tried = _judged(state, tried, hypotheses, inputs.criteria)
        waiting = [each.waiting for each in tried if each.waiting is not None]
        if waiting and not _passed(tried):
            # What gains most is not probable; a weaker candidate may be.
            asked = _score(state, waiting, inputs)
            tried = [*(each for each in tried if each.waiting is None), *asked]
            state, tried = _judged(state, tried, hypotheses, inputs.criteria)
        if not _passed(tried):
            together = _probable_together(state, [each for each in tried if each.trial.passed],
                                         inputs)
            if together and _all_borne_out(together[-1].model, len(together)):
                return _keep_together(state, tried, together)
    if not _passed(tried):
        return state.refuse(*(each.trial for each in tried))
    return _keep_best(state, tried, hypotheses, inputs)


def _passed(tried: list[Tried]) -> list[Tried]:
    """Return candidates that held-out links support and nothing speaks against."""
    return [each for each in tried if each.trial.passed and not each.trial.reason]


def _try_all(state: SearchState, available: list[Effect], hypotheses: Hypotheses | None,
             inputs: SearchInputs) -> list[Tried]:
    """Fit every available effect, and score it on held-out links unless a better one passed."""
    model, step = state.model, state.step
    there = [each.entry for each in model.whole.effects]
    effects = [effect for effect in available
               if effect.repeatable or not any(each is effect for each in there)]
    prepare_additions([model.whole], effects, inputs.executor)
    refused, candidates = [], []
    for effect in effects:
        inputs.on_progress(f"step {step + 1}: {effect.name}")
        fitted = fit_candidate(model, effect, inputs.criteria, hypotheses)
        if isinstance(fitted, Candidate):
            candidates.append(fitted)
        else:
            refused.append(Tried(effect, fitted, model))
    return refused + _score(state, candidates, inputs, needless=_beyond)


def _score(state: SearchState, candidates: list[Candidate], inputs: SearchInputs,
           needless: Callable[..., bool] = lambda *_: False) -> list[Tried]:
    """Score candidates of one step, but for those that are `needless` beside one that passed."""
    model, step = state.model, state.step
    tried: list[Tried] = []
    for candidate in sorted(candidates, key=lambda candidate: -candidate.gain):
        effect = candidate.effect
        better = next((each.trial for each in _passed(tried)
                       if needless(each, candidate, model, inputs.criteria)), None)
        if better is not None:
            why = (f"{better.name} gains more on held-out links than this on those that it "
                   f"is fitted to ({candidate.gain:.0f} nats)")
            trial = Trial(effect.name, reason=why, step=step, variant=effect.variant,
                          evidence_nats=candidate.evidence)
            tried.append(Tried(effect, trial, model, candidate))
            continue
        inputs.on_progress(f"step {step + 1}: {effect.name}, held out")
        trial, extended = score_candidate(model, candidate, inputs)
        tried.append(Tried(effect, trial, extended or model))
    return tried


def _judged(state: SearchState, tried: list[Tried], hypotheses: Hypotheses,
            criteria: SelectionCriteria) -> tuple[SearchState, list[Tried]]:
    """Return a step's candidates with their probabilities, and the state with what the step says.

    What earlier stages have tried beside the same model is judged again, beside these candidates.
    A probable one is refused where held-out links may show nothing of it.
    """
    step, earlier = state.step, state.log.of_step(state.step)
    judged, summary = judge([*earlier, *(each.trial for each in tried)], state.model, hypotheses,
                            criteria)
    found = []
    for each, trial in zip(tried, judged[len(earlier):], strict=True):
        if trial.passed and not trial.reason:
            trial = replace(trial, reason=why_not_borne_out(each.model, step))
        found.append(replace(each, trial=trial))
    steps = (*(each for each in state.steps if each.number < step), summary)
    log = state.log.supersede(*judged[:len(earlier)])
    return replace(state, steps=steps, log=log), found


def _all_borne_out(model: CrossFit, last: int) -> bool:
    """Return whether each of a model's last effects is larger than nothing at all."""
    count = len(model.whole.effects)
    return not any(why_not_borne_out(model, number)
                   for number in range(count - last, count))


def _probable_together(state: SearchState, supported: Sequence[Tried],
                      inputs: SearchInputs) -> list[Tried]:
    """Return effects that are probable together, in order; none where there are none.

    Of a step none of whose candidates is probable enough by itself.
    """
    criteria, step = inputs.criteria, state.steps[-1]
    ranked = sorted(supported, key=lambda each: -each.trial.probability)
    if not ranked or ranked[0].trial.probability < MIN_FIRST_SHARE * criteria.min_probability:
        return []
    first = ranked[0]
    inputs.on_progress(f"step {step.number + 1}: {first.trial.name}, beside another effect")

    def beside(found: list[Tried], effects: list[Effect]) -> list[list[Tried]]:
        """Return what was found with one more effect, for each that held-out links support."""
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
    """Keep effects that are probable together; the first of them is among those of the step."""
    first = found[0]
    log = state.log.record(
        *(first.trial.keep() if each.effect is first.effect else each.trial for each in tried),
        *(each.trial.keep() for each in found[1:]))
    return replace(state, model=_settled(found[-1].model), log=log)


def _keep_best(state: SearchState, tried: list[Tried], hypotheses: Hypotheses | None,
               inputs: SearchInputs) -> SearchState:
    """Keep the best of the candidates that passed, or several of one kind that are better.

    Of a kind that held-out links support, though one alone is not probable beside the best: groves
    beside an offset of each device.
    """
    criteria, step = inputs.criteria, state.step
    passed = sorted(_passed(tried), key=lambda each: -each.trial.nats)
    # Of those that the data cannot tell apart the one with the least error.
    most_nats = passed[0].trial.nats
    close = [each for each in passed if _alike(most_nats, each.trial.nats, criteria)]
    passed.sort(key=lambda each: each.trial.rmse_db if each in close else np.inf)
    first = passed[0]
    kept, least = [first], first.trial.nats
    rival = next((each for each in passed[1:] if each.effect.repeatable), None)
    if rival is None and not first.effect.repeatable:
        rival = max((each for each in tried if each.trial.passed and each.effect.repeatable
                     and each.trial.nats >= MIN_RIVAL_SHARE * least),
                    key=lambda each: each.trial.nats, default=None)
    most = criteria.max_repeats if not first.effect.repeatable else _on_one_mast(first.model)
    if rival is not None and most > 1:
        inputs.on_progress(f"step {step + 1}: more of {rival.trial.name}")
        several = _several(rival, hypotheses, least, most, inputs)
        if several and rival.trial.reason:
            several = _if_likelier(state, several, first.trial, criteria)
        kept = several or kept
    best, nats = kept[0], sum(each.trial.nats for each in kept)
    name = best.trial.name
    rivals = tuple(each.trial.name for each in passed
                   if each.trial.name != name and _alike(nats, each.trial.nats, criteria))
    less = f"{name} explains more"
    trials = [best.trial.keep(rivals=rivals) if each.effect is best.effect
              else each.trial.refuse(less) if each.trial.is_open else each.trial for each in tried]
    earlier = [each.refuse(less) for each in state.log.of_step(step) if each.is_open]
    log = state.log.supersede(*earlier).record(*trials, *(each.trial.keep() for each in kept[1:]))
    inputs.on_progress(f"step {step + 1}: {name}, exactly")
    return replace(state, model=_settled(kept[-1].model), log=log)


def _if_likelier(state: SearchState, several: list[Tried], best: Trial,
                 criteria: SelectionCriteria) -> list[Tried]:
    """Return several of a kind with the probability that all are there, if it exceeds the best's.

    Else none.
    """
    step = state.steps[-1]
    chance = probability_of_all([each.trial for each in several], best.nats, state.model,
                                step.rest_db / step.noise_db)
    if chance < max(best.probability, criteria.min_probability):
        return []
    return [replace(each, trial=replace(each.trial, reason="", probability=chance))
            for each in several]


def _beyond(passed: Tried, candidate: Candidate, model: CrossFit,
            criteria: SelectionCriteria) -> bool:
    """Return whether an effect that passed gains so much that another need not be scored.

    On held-out links the other can hardly gain more than on those that it is fitted to. One of a
    kind of which there may be several gets its chance, and so does one with more evidence.
    """
    lead = passed.trial.nll_gain - candidate.gain
    design_effect = model.whole.view.design_effect
    clear = lead > criteria.indistinguishable_nats * design_effect
    more = candidate.evidence > passed.trial.evidence_nats
    return clear and not more and (passed.effect.repeatable or not candidate.effect.repeatable)


def _alike(nats: float, other_nats: float, criteria: SelectionCriteria) -> bool:
    """Return whether the data cannot tell an effect with other nats from the best, `nats`."""
    return nats - other_nats < criteria.indistinguishable_nats


def _on_one_mast(model: CrossFit) -> int:
    """Return how many devices the last effect acts on, if they are all on one mast; else 0."""
    links = model.links
    devices = np.unique(links.device[model.whole.model.terms[-1].acts])
    on_mast = len(devices) and set(devices) <= set(site_of(links, devices[0]))
    return len(devices) if on_mast else 0


def _several(rival: Tried, hypotheses: Hypotheses | None, min_nats: float, most: int,
             inputs: SearchInputs) -> list[Tried]:
    """Add an effect of which a step finds one again and again, until all have more than `min_nats`.

    Such as groves or towers, each seen from few devices, against an offset for each device; or
    antennas against another position of the mast that carries them. None where they do not.
    """
    found, model = [rival], rival.model
    while len(model.whole.effects) < inputs.criteria.max_effects and len(found) < most:
        if hypotheses is not None:
            hypotheses = Hypotheses.of(model.whole, inputs.seed)
        trial, extended = fit_and_score(model, rival.effect, inputs, hypotheses)
        if extended is None:
            return []
        model, trial = extended, replace(trial, probability=rival.trial.probability)
        found.append(Tried(rival.effect, trial, model))
        if sum(each.trial.nats for each in found) > min_nats:
            return found if _all_borne_out(model, len(found)) else []
    return []


def _told_apart(log: TrialLog) -> TrialLog:
    """Return the log with rivals that gain beside the effect no longer called by its name.

    A rival that gains beside the effect is another effect; else it is another name for it.
    """
    last = max((each.step for each in log.trials), default=0)
    alive = {each.name for each in log.trials if each.kept or (each.step == last and each.is_open)}
    return log.supersede(*(replace(each, rivals=tuple(sorted(set(each.rivals) - alive)))
                           for each in log.kept if each.rivals))


def _settled(model: CrossFit) -> CrossFit:
    """Return a model with exact levels where these explain its training links better."""
    return _with_moved_limits(model.map(with_exact_levels))


def _with_moved_limits(model: CrossFit) -> CrossFit:
    """Return a model in which limits are moved by the offsets of receivers that were kept last.

    A receiver hears the same signals whatever its cable or calibration adds to its readings. Where
    its blanks begin as many decibels from the usual limit as its readings are off, that is one
    fault. A last effect without such offsets leaves the model as it is.
    """
    whole = model.whole
    last = whole.effects[-1]
    off_db = last.reading_offsets_db(whole.coefficients_of(-1))
    if not off_db:
        return model
    found_db = np.full(len(model.links), -np.inf)
    for limit in (effect() for effect in catalogue() if issubclass(effect, LimitEffect)):
        for params in limit.propose(whole.view)[:1]:
            found_db = np.maximum(found_db, limit.with_params(params).limits_db(model.links))
    limit_db = model.links.limit_db.copy()
    for receiver, each_db in off_db.items():
        of_receiver = model.links.receiver == receiver
        own_db, usual_db = np.median(found_db[of_receiver]), np.median(limit_db[of_receiver])
        if np.isfinite(own_db) and abs(own_db - usual_db - each_db) <= SAME_DB:
            limit_db[of_receiver] = own_db
    if np.array_equal(limit_db, model.links.limit_db):
        return model
    return model.map(lambda fit: replace(
        fit.model, links=fit.links.with_columns(limit_db=limit_db)).fit(fit))
