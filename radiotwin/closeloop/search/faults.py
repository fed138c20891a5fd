"""Faults and changes in time, which a flight that is held out cannot show.

Held out by flight, what happens on one flight is never learnt. So faults (of a flight, episodes,
bursts) are scored on devices that are held out, which the same receiver read at the same times;
where there are few devices, on blocks of ground that are held out in all flights at once. They come
before all other candidates, or these would explain the faulty readings by walls and positions.

Where a receiver or a device changed after its first flight, that flight held out leaves nothing
that shows it, and the others held out are predicted well by each other. So changes between flights
are scored on blocks of ground, with the effects that were found already. A warm-up over the first
flight and ageing change the level between flights, too: the form is the one that explains most.
How much flights differ anyhow is a part of the evidence (`radiotwin.closeloop.verdict.hypotheses`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from radiotwin.closeloop.crossfit import (
    Base,
    CrossFit,
    Folds,
    cross_validate,
    make_folds,
    same_effects,
    training_parts,
)
from radiotwin.closeloop.search.scoring import (
    Candidate,
    fit_candidate,
    judged,
    with_candidate,
)
from radiotwin.closeloop.search.stages import SearchInputs, SearchState
from radiotwin.closeloop.search.trials import Trial
from radiotwin.closeloop.verdict.criteria import (
    MIN_HELD_OUT_DEVICES,
    MIN_SHARED,
)
from radiotwin.closeloop.verdict.hypotheses import Hypotheses
from radiotwin.effects.base import DetectionEffect, Effect
from radiotwin.links import Links
from radiotwin.links.correlation import devices_move
from radiotwin.twin.model.model import Fit, Model


def add_changes(state: SearchState, inputs: SearchInputs) -> SearchState:
    """Add changes between flights, where flights are held out, one by one until none passes."""
    changes = [each for effect in inputs.effects if (each := effect.between_flights()) is not None]
    for effect in sorted(changes, key=lambda each: not each.of_receiver):  # receivers first
        if inputs.folds.by == "flight" and not effect.unavailable(inputs.links):
            state = _with_one_kind(state, effect, inputs)
    return state


def _with_one_kind(state: SearchState, effect: Effect, inputs: SearchInputs) -> SearchState:
    """Add changes of receivers, or of devices."""
    model = None
    while not state.is_full(inputs.criteria):
        state, hypotheses = state.look(inputs.seed)
        candidate = fit_candidate(state.model, effect, inputs.criteria, hypotheses)
        if isinstance(candidate, Trial):
            return state
        inputs.on_progress(f"{effect.name}, held out by block")
        if model is None:
            model = within_flights(state.model, inputs, "block")
        trial, extended = judged_elsewhere(model, candidate, [], hypotheses, inputs)
        if extended is None:
            return state.refuse(trial)
        model = extended
        # A flight that is held out does not tell when the change was.
        state = state.keep(trial, with_candidate(state.model, candidate, inputs.executor))
    return state


def judged_elsewhere(model: CrossFit, candidate: Candidate, others: Sequence[float],
                     hypotheses: Hypotheses, inputs: SearchInputs
                     ) -> tuple[Trial, CrossFit | None]:
    """Return `judged` of a candidate that was fitted in other folds than those of the model."""
    found = candidate.whole.effects[-1]
    whole = model.whole.with_effects([*model.whole.effects, found])
    return judged(model, replace(candidate, whole=whole), others, hypotheses, inputs)


def located_links(model: CrossFit, links: Links, base: Base) -> Links:
    """Return the links with the devices that the base has located as anchors there."""
    device_m = base.device_m(model.twin)
    known = np.isfinite(device_m).all(axis=1)
    device_m = np.where(known[:, None], device_m, links.device_m)
    anchors = frozenset(np.flatnonzero(known).tolist()) | links.anchors
    links = links.with_devices(device_m).with_ends(anchors=anchors)
    return links.with_columns(evidence=model.links.evidence)


def with_effect(model: CrossFit, effect: Effect) -> CrossFit:
    """Return a model with one more effect, as it was found, in the whole and every fold."""
    return model.map(lambda fit: fit.with_effects([*fit.effects, effect]))


def add_faults(state: SearchState, inputs: SearchInputs) -> SearchState:
    """Add effects that act at certain times, one after the other, until none passes."""
    timed = [effect for effect in inputs.undeclared
             if effect.within_flights and not effect.unavailable(state.model.links)]
    criteria, model = inputs.criteria, None
    while timed and not state.is_full(criteria):
        step = state.step
        state, hypotheses = state.look(inputs.seed)
        fitted = [fit_candidate(state.model, effect, criteria, hypotheses) for effect in timed]
        fitted = _against_lasting(fitted, state, inputs)
        candidates = [each for each in fitted if isinstance(each, Candidate)]
        refused = [each for each in fitted if isinstance(each, Trial)]
        for candidate in sorted(candidates, key=lambda each: -each.gain):
            inputs.on_progress(f"step {step + 1}: {candidate.effect.name}, held out within flights")
            if model is None:
                model = within_flights(state.model, inputs)
            trial, extended = judged_elsewhere(model, candidate, [], hypotheses, inputs)
            if extended is not None:
                model = extended
                state = state.keep(trial, adopted(state.model, candidate))
                break
            refused.append(trial)
        else:
            return state.refuse(*refused)
    return state


def _against_lasting(faults: list[Candidate | Trial], state: SearchState,
                     inputs: SearchInputs) -> list[Candidate | Trial]:
    """Return faults, or why one is none: an effect that lasts explains as much of all links.

    A receiver that has changed reads less from then on, and so it does in the window that ends
    where the links do not show it. That another one has changed is no reason.
    """
    rivals = {name for each in faults if isinstance(each, Candidate)
              for name in each.effect.confused_with}
    fitted = [fit_candidate(state.model, effect, inputs.criteria)
              for effect in inputs.undeclared if effect.name in rivals
              and not effect.within_flights and not effect.unavailable(state.model.links)]
    lasting = [each for each in fitted if isinstance(each, Candidate)]
    return [_unless_outdone(each, lasting, state.step) if isinstance(each, Candidate) else each
            for each in faults]


def _unless_outdone(fault: Candidate, lasting: list[Candidate],
                    step: int) -> Candidate | Trial:
    here = _acts(fault)
    rival = next((each for each in lasting if each.effect.name in fault.effect.confused_with
                  and each.gain >= fault.gain and _acts(each)[here].mean() >= MIN_SHARED), None)
    if rival is None:
        return fault
    return Trial(fault.effect.name, step=step, variant=fault.effect.variant, reason=(
        f"{rival.effect.name} explains as much: {rival.gain:.0f} nats of the links that it is "
        f"fitted to, and this {fault.gain:.0f}"))


def _acts(candidate: Candidate) -> np.ndarray:
    """Return (n,) bool, the links that a candidate says something of."""
    blanks = isinstance(candidate.effect, DetectionEffect)
    return blanks | candidate.whole.model.terms[-1].acts


def drop_idle_faults(state: SearchState, inputs: SearchInputs) -> SearchState:
    """Take back faults and changes that effects found later explain: an emitter is no episode.

    They come first, when no other effect is there to compare them with. One is taken back if it
    gains nothing any more on the links that it is fitted to, or if its search would not find it
    beside the others.
    """
    for number in reversed(range(state.step)):
        model, whole = state.model, state.model.whole
        effect = whole.effects[number]
        timed = effect.within_flights or effect.between_flights() is not None
        if not timed:
            continue
        others = _without(whole.model, number).fit()
        gain = others.objective - whole.objective
        is_found = _is_cause_of_anomaly(state, number) or _is_found(whole, number, others)
        if gain >= inputs.criteria.min_training_gain_nats and is_found:
            continue
        folds = [_without(each.model, same_effects(whole, each)[number]).fit()
                 for each in model.folds]
        taken_back = state.log.kept[number].refuse("what was found later explains it", rivals=())
        state = replace(state, model=model.extended(others, folds),
                        log=state.log.supersede(taken_back))
    return state


def _is_cause_of_anomaly(state: SearchState, number: int) -> bool:
    """Return whether an effect is the likeliest cause of a group that stands out."""
    effect, acts = state.model.whole.effects[number], state.model.whole.model.terms[number].acts
    return any(max(each.causes, key=lambda name: each.causes[name]) == effect.name
               and acts[each.rows].mean() >= MIN_SHARED
               for each in state.anomalies if each.causes)


def _is_found(fit: Fit, number: int, without: Fit) -> bool:
    """Return whether the search of a fault finds it in what a fit without it leaves.

    Steps in time have no search of their own.
    """
    effect, acts, model = fit.effects[number], fit.model.terms[number].acts, without.model
    if not effect.within_flights:
        return True
    again = [effect.with_params(params).term(model.links, model.level_at).acts
             for params in effect.entry.propose(without.view)]
    return any((acts & each).sum() >= MIN_SHARED * (acts | each).sum() for each in again)


def _without(model: Model, place: int | None) -> Model:
    """Return a fold without the effect at a place; None: it has none of it."""
    return model.with_effects([each for number, each in enumerate(model.effects)
                               if number != place])


def _in_other_folds(model: CrossFit, links: Links, base: Base, folds: Folds) -> CrossFit:
    """Return the base with a model's effects as they are, fitted to other folds."""
    other = cross_validate(links, base, folds, training_parts(links, folds))
    for each in model.whole.effects:
        other = with_effect(other, each)
    return other


def within_flights(model: CrossFit, inputs: SearchInputs, by: str = "") -> CrossFit:
    """Return the base with a model's effects in folds that leave part of each flight.

    Of devices, where enough are known, or of blocks; `by` says which.
    """
    links = located_links(model, inputs.links, inputs.base)
    by_device = len(links.anchors & set(links.device.tolist())) >= MIN_HELD_OUT_DEVICES
    by = by or ("device" if by_device and not devices_move(links) else "block")
    return _in_other_folds(model, links, inputs.base, make_folds(links, inputs.seed, by))


def adopted(model: CrossFit, candidate: Candidate) -> CrossFit:
    """Return a model with the effect; a fold has it as far as its own training links show it."""
    found = candidate.whole.effects[-1]

    def of_fold(fold: Fit) -> Fit:
        own = found.propose_like(fold.view)
        return fold.with_effects([*fold.effects, found.with_params(own[0])]) if own else fold

    return model.extended(candidate.whole, [of_fold(fold) for fold in model.folds])
