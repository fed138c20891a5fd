"""Find causes of anomalies: fit the effects that can act on such a group of links.

Each effect of the catalogue that can act on a group of that family is fitted to it, with all other
links as the reference. The effects are compared by their evidence on all readings, with an unnamed
cause of the same links as a further hypothesis and equal prior probabilities. The likeliest one is
judged as any other candidate (`radiotwin.closeloop.verdict.posterior`), and named if its
probability is high enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import softmax

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.families import Readings
from radiotwin.closeloop.scan import Anomaly, scan
from radiotwin.closeloop.search.faults import (
    score_with_fixed_parameters,
    with_fault,
    within_flights,
)
from radiotwin.closeloop.search.scoring import (
    Candidate,
    fit_candidate,
    score_and_judge,
    with_candidate,
)
from radiotwin.closeloop.search.stages import SearchInputs, SearchState
from radiotwin.closeloop.search.trials import Trial
from radiotwin.closeloop.verdict.criteria import MIN_RIVAL_SHARE, MIN_SHARED, MIN_SURE
from radiotwin.closeloop.verdict.hypotheses import Hypotheses
from radiotwin.effects.base import Effect

ANOTHER = "another"  # name of a cause that is not in the catalogue


def add_causes_of_anomalies(state: SearchState, inputs: SearchInputs) -> SearchState:
    """Search for the cause of each anomaly that is real with a probability of at least `MIN_SURE`.

    After a cause was added to the model, the residual is scanned again. Anomalies that are gone
    from it get the causes found last; only those that remain are searched for.
    """
    explained: list[Anomaly] = []
    remaining, latest = list(state.anomalies), None
    for anomaly in state.anomalies:
        if anomaly.probability >= MIN_SURE and not state.is_full(inputs.criteria):
            if latest is not None and not any(
                    each.rows[anomaly.rows].mean() >= MIN_SHARED for each in remaining):
                anomaly = replace(anomaly, causes=latest)  # that cause removed it
            else:
                before = state.model
                state, causes = _with_cause(state, anomaly, inputs)
                anomaly = replace(anomaly, causes=causes)
                if state.model is not before:
                    remaining, latest = scan(Readings.of(state.model)), causes
        explained.append(anomaly)
    return replace(state, anomalies=tuple(explained))


def _with_cause(state: SearchState, anomaly: Anomaly, inputs: SearchInputs
                ) -> tuple[SearchState, dict[str, float]]:
    """Search for the cause of an anomaly, a group of links that reads otherwise than its peers.

    The effects that can act on such a group are fitted to it and compared by their evidence. The
    likeliest is named if it reaches `min_probability` and passes on held-out links, else the next.
    """
    model, criteria = state.model, inputs.criteria
    ends = [name for names in anomaly.members.values() for name in names]
    inputs.on_progress("causes of what " + (" × ".join(ends) or f"one {anomaly.family}") + " reads")
    state, hypotheses = state.with_hypotheses(inputs.seed)
    group = anomaly.rows[model.whole.train]
    if not group.any():
        return state, {}
    candidates: list[Candidate] = []
    for effect in _acting_on(anomaly, model, inputs):
        # Following paths takes longest, so it is left out for effects that gain little by the
        # quick law.
        best_nats = max((each.gain_nats for each in candidates), default=0.0)
        fitted = fit_candidate(model, effect, criteria, hypotheses, group,
                               MIN_RIVAL_SHARE * best_nats)
        if isinstance(fitted, Candidate) and np.isfinite(fitted.evidence_nats):
            candidates.append(fitted)
    another = hypotheses.group_evidence_nats(group)
    while True:
        causes = _cause_probabilities(candidates, another)
        best = max(candidates, key=lambda each: each.evidence_nats, default=None)
        if best is None or causes[best.effect.name] < criteria.min_probability:
            return state, causes
        candidates.remove(best)
        others = [another, *(each.evidence_nats for each in candidates)]
        trial, extended = _judge_cause(model, best, others, hypotheses, inputs)
        if extended is not None:
            return state.keep(trial, extended), causes
        state = state.refuse(trial)
        if trial.passed:  # the calibrated probability is lower than that among the causes
            causes[ANOTHER] += causes[best.effect.name] - trial.probability
            return state, causes | {best.effect.name: trial.probability}


def _cause_probabilities(candidates: Sequence[Candidate], another_nats: float) -> dict[str, float]:
    """Return the probability of each cause and of `ANOTHER`, an unnamed one, highest first.

    They follow from the evidence [nats] with equal prior odds; variants of one effect are summed.
    """
    names = [*(each.effect.name for each in candidates), ANOTHER]
    nats = [*(each.evidence_nats for each in candidates), another_nats]
    causes: dict[str, float] = {}
    for name, share in sorted(zip(names, softmax(nats), strict=True), key=lambda each: -each[1]):
        causes[name] = causes.get(name, 0.0) + float(share)
    return causes


def _acting_on(anomaly: Anomaly, model: CrossFit, inputs: SearchInputs) -> list[Effect]:
    """Return the effects that can act on an anomaly's family; those that follow paths come last."""
    return sorted((effect for effect in inputs.undeclared if anomaly.family in effect.acts_on
                   and not effect.unavailable(model.links)), key=lambda each: each.always_exact)


def _judge_cause(model: CrossFit, candidate: Candidate, others: Sequence[float],
            hypotheses: Hypotheses, inputs: SearchInputs) -> tuple[Trial, CrossFit | None]:
    """Score a cause on held-out links and compute its probability, as `score_and_judge`.

    A fault of one flight, or a change between two, cannot be learnt from other flights. So it is
    scored in folds that hold out a part of every flight.
    """
    effect = candidate.effect
    changes = inputs.folds.by == "flight" and effect.between_flights() is not None
    if not (effect.within_flights or changes):
        return score_and_judge(model, candidate, others, hypotheses, inputs)
    trial, extended = score_with_fixed_parameters(
        within_flights(model, inputs, "block" if changes else ""), candidate, others, hypotheses,
        inputs)
    if extended is None:
        return trial, None
    return trial, (with_candidate(model, candidate, inputs.executor) if changes
                   else with_fault(model, candidate))
