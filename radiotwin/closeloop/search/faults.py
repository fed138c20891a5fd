"""Search for faults within flights and for changes between flights.

If flights are held out, a fault of one flight is never in the training links. So faults (of a
flight, episodes, bursts) are scored on held-out devices, which the same receiver measured at the
same times; with few anchors, on blocks of ground that are held out in all flights. They are
searched for before all other causes, which would explain the faulty readings by walls and
positions.

A change after the first flight cannot be learnt if that flight is held out. So changes between
flights are scored on blocks of ground, with the effects that were found already. The usual
tolerance between flights is part of the evidence (`radiotwin.closeloop.verdict.hypotheses`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from radiotwin.closeloop.crossfit import (
    CrossFit,
    cross_validate,
    make_folds,
    match_effects,
)
from radiotwin.closeloop.search.scoring import (
    Candidate,
    fit_candidate,
    score_and_judge,
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
from radiotwin.links.correlation import devices_move
from radiotwin.twin.model.model import Fit, Model


def add_changes(state: SearchState, inputs: SearchInputs) -> SearchState:
    """Add changes of receivers, then of devices, between flights one by one, until none passes.

    Only if whole flights are held out, so that training links may lack such a change.
    """
    changes = [each for effect in inputs.effects if (each := effect.between_flights()) is not None]
    for effect in sorted(changes, key=lambda each: not each.of_receiver):  # receivers first
        if inputs.folds.by == "flight" and not effect.unavailable(inputs.links):
            state = _add_changes_of(state, effect, inputs)
    return state


def _add_changes_of(state: SearchState, effect: Effect, inputs: SearchInputs) -> SearchState:
    """Add changes of one effect between flights, scored on held-out ground, until none passes."""
    model = None
    while not state.is_full(inputs.criteria):
        state, hypotheses = state.with_hypotheses(inputs.seed)
        candidate = fit_candidate(state.model, effect, inputs.criteria, hypotheses)
        if isinstance(candidate, Trial):
            return state
        inputs.on_progress(f"{effect.name}, held out by block")
        if model is None:
            model = within_flights(state.model, inputs, "block")
        trial, extended = score_with_fixed_parameters(model, candidate, [], hypotheses, inputs)
        if extended is None:
            return state.refuse(trial)
        model = extended
        # The folds of the search are kept: their fits learn the change as far as they show it.
        state = state.keep(trial, with_candidate(state.model, candidate, inputs.executor))
    return state


def score_with_fixed_parameters(model: CrossFit, candidate: Candidate, others: Sequence[float],
                                hypotheses: Hypotheses, inputs: SearchInputs
                                ) -> tuple[Trial, CrossFit | None]:
    """Score a candidate by other folds than those of the search, such as parts of flights.

    `model` has these folds. The candidate's parameters were fitted to all links, and are kept.
    """
    found = candidate.whole.effects[-1]
    whole = model.whole.with_effects([*model.whole.effects, found])
    return score_and_judge(model, replace(candidate, whole=whole), others, hypotheses, inputs)


def add_faults(state: SearchState, inputs: SearchInputs) -> SearchState:
    """Add faults that act at certain times of a flight one by one, until none passes.

    They are scored in folds that hold out a part of every flight (`within_flights`). In each round
    the candidates are tried by their training gain, and the first one that passes is added.
    """
    timed = [effect for effect in inputs.undeclared
             if effect.within_flights and not effect.unavailable(state.model.links)]
    criteria, model = inputs.criteria, None
    while timed and not state.is_full(criteria):
        step = state.step
        state, hypotheses = state.with_hypotheses(inputs.seed)
        fitted = [fit_candidate(state.model, effect, criteria, hypotheses) for effect in timed]
        fitted = _refuse_lasting(fitted, state, inputs)
        candidates = [each for each in fitted if isinstance(each, Candidate)]
        refused = [each for each in fitted if isinstance(each, Trial)]
        for candidate in sorted(candidates, key=lambda each: -each.gain_nats):
            inputs.on_progress(f"step {step + 1}: {candidate.effect.name}, held out within flights")
            if model is None:
                model = within_flights(state.model, inputs)
            trial, extended = score_with_fixed_parameters(model, candidate, [], hypotheses, inputs)
            if extended is not None:
                model = extended
                state = state.keep(trial, with_fault(state.model, candidate))
                break
            refused.append(trial)
        else:
            return state.refuse(*refused)
    return state


def _refuse_lasting(faults: list[Candidate | Trial], state: SearchState,
                    inputs: SearchInputs) -> list[Candidate | Trial]:
    """Refuse faults of single flights if a lasting effect fits the same links as well or better.

    A receiver that changed for good also looks faulty in each window of time afterwards. Only
    effects that the faults name as `confused_with` are fitted as rivals. A rival that gains at
    least as many nats on the training links, and acts on at least the share `MIN_SHARED` of the
    fault's links, wins, and the fault becomes a refused `Trial`.
    """
    rivals = {name for each in faults if isinstance(each, Candidate)
              for name in each.effect.confused_with}
    fitted = [fit_candidate(state.model, effect, inputs.criteria)
              for effect in inputs.undeclared if effect.name in rivals
              and not effect.within_flights and not effect.unavailable(state.model.links)]
    lasting = [each for each in fitted if isinstance(each, Candidate)]
    left = list(faults)
    for place, fault in enumerate(faults):
        if isinstance(fault, Trial):
            continue
        faulty = _affected_links(fault)
        rival = next((each for each in lasting if each.effect.name in fault.effect.confused_with
                      and each.gain_nats >= fault.gain_nats
                      and _affected_links(each)[faulty].mean() >= MIN_SHARED), None)
        if rival is not None:
            left[place] = Trial(fault.effect.name, step=state.step, variant=fault.effect.variant,
                                reason=(f"{rival.effect.name} explains as much: "
                                        f"{rival.gain_nats:.0f} nats of the links that it is "
                                        f"fitted to, and this {fault.gain_nats:.0f}"))
    return left


def _affected_links(candidate: Candidate) -> np.ndarray:
    """Return (n,) bool, the links a candidate acts on; all links for effects on detection."""
    blanks = isinstance(candidate.effect, DetectionEffect)
    return blanks | candidate.whole.model.terms[-1].acts


def drop_idle_faults(state: SearchState, inputs: SearchInputs) -> SearchState:
    """Remove faults, and changes between flights, that effects found later explain.

    Example: an emitter explains what looked like an episode of a receiver. A fault is removed if,
    with the later effects in the model, it gains less than `min_training_gain_nats`, or if its
    search does not find it again and it is not the likeliest cause of an anomaly.
    """
    for number in reversed(range(state.step)):
        model, whole = state.model, state.model.whole
        effect = whole.effects[number]
        timed = effect.within_flights or effect.between_flights() is not None
        if not timed:
            continue
        others = _without(whole.model, number).fit()
        gain = others.objective - whole.objective
        is_found = _is_cause_of_anomaly(state, number) or _is_proposed_again(whole, number, others)
        if gain >= inputs.criteria.min_training_gain_nats and is_found:
            continue
        folds = [_without(each.model, match_effects(whole, each)[number]).fit()
                 for each in model.folds]
        taken_back = state.log.kept[number].refuse("what was found later explains it", rivals=())
        state = replace(state, model=model.with_fits(others, folds),
                        log=state.log.supersede(taken_back))
    return state


def _is_cause_of_anomaly(state: SearchState, number: int) -> bool:
    """Return whether an effect (index) is the likeliest cause of an anomaly of links it acts on."""
    effect, acts = state.model.whole.effects[number], state.model.whole.model.terms[number].acts
    return any(max(each.causes, key=lambda name: each.causes[name]) == effect.name
               and acts[each.rows].mean() >= MIN_SHARED
               for each in state.anomalies if each.causes)


def _is_proposed_again(fit: Fit, number: int, without: Fit) -> bool:
    """Return whether the search for an effect finds it again in a fit without it (`without`).

    A proposal is the same fault if at least the share `MIN_SHARED` of all links on which either
    acts is common to both. Always true for changes between flights, which have no such search.
    """
    effect, acts, model = fit.effects[number], fit.model.terms[number].acts, without.model
    if not effect.within_flights:
        return True
    again = [effect.with_params(params).term(model.links, model.level_at).acts
             for params in effect.entry.propose(without.view)]
    return any((acts & each).sum() >= MIN_SHARED * (acts | each).sum() for each in again)


def _without(model: Model, number: int | None) -> Model:
    """Return a model without the effect of an index; None: with all."""
    return model.with_effects([each for index, each in enumerate(model.effects)
                               if index != number])


def within_flights(model: CrossFit, inputs: SearchInputs, by: str = "") -> CrossFit:
    """Cross-validate a model again, with the same effects, holding out a part of every flight.

    So the training links show a fault of one flight. Devices that the base located count as
    anchors, so that they can be held out.

    Args:
        model: cross-validated fit.
        inputs: inputs of the search.
        by: what is held out; "": devices if at least `MIN_HELD_OUT_DEVICES` are anchors and fixed,
            else blocks of ground.
    """
    device_m = inputs.base.device_m(model.twin)
    located = np.isfinite(device_m).all(axis=1)
    links = inputs.links.with_devices(np.where(located[:, None], device_m, inputs.links.device_m))
    links = links.with_ends(anchors=frozenset(np.flatnonzero(located).tolist()) | links.anchors)
    links = links.with_columns(evidence=model.links.evidence)
    by_device = len(links.anchors & set(links.device.tolist())) >= MIN_HELD_OUT_DEVICES
    by = by or ("device" if by_device and not devices_move(links) else "block")
    folds = make_folds(links, inputs.seed, by)
    other = cross_validate(links, inputs.base, folds)
    for effect in model.whole.effects:  # one by one, so that each fit starts from the one before
        other = other.map(lambda fit, effect=effect: fit.with_effects([*fit.effects, effect]))
    return other


def with_fault(model: CrossFit, candidate: Candidate) -> CrossFit:
    """Add a fault to the fit to all links, and to each fold whose own training links show it."""
    found = candidate.whole.effects[-1]

    def extend(fold: Fit) -> Fit:
        params = found.propose_for_fold(fold.view)
        return fold.with_effects([*fold.effects, found.with_params(params[0])]) if params else fold

    return model.with_fits(candidate.whole, [extend(fold) for fold in model.folds])
