"""Causes of groups of links that stand out: only effects that act on such groups are tried.

The scan says where; here each effect of the catalogue that may act on a group of that family is
fitted to it, with all other links as the reference. They are compared by their evidence on all
readings, beside a cause without a name that acts on the same links; all are equally probable
before. The likeliest is judged as every other candidate
(`radiotwin.closeloop.verdict.posterior`). One that is more probable than not is named, and what it
explains is no open question any more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import softmax

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.scan import Anomaly, scan
from radiotwin.closeloop.search.faults import adopted, judged_elsewhere, within_flights
from radiotwin.closeloop.search.scoring import Candidate, fit_candidate, judged, with_candidate
from radiotwin.closeloop.search.stages import SearchInputs, SearchState
from radiotwin.closeloop.search.trials import Trial
from radiotwin.closeloop.verdict.criteria import MIN_RIVAL_SHARE, MIN_SHARED, MIN_SURE
from radiotwin.closeloop.verdict.hypotheses import Hypotheses
from radiotwin.effects.base import Effect

ANOTHER = "another"  # name of a cause that the catalogue does not have


def add_causes_of_anomalies(state: SearchState, inputs: SearchInputs) -> SearchState:
    """Name causes of groups that surely stand out, most evident first."""
    explained: list[Anomaly] = []
    left, latest = list(state.anomalies), None
    for anomaly in state.anomalies:
        if anomaly.probability >= MIN_SURE and not state.is_full(inputs.criteria):
            if latest is not None and not any(_is_same(anomaly, each) for each in left):
                anomaly = replace(anomaly, causes=latest)  # what was named explains this one, too
            else:
                before = state.model
                state, causes = _with_cause(state, anomaly, inputs)
                anomaly = replace(anomaly, causes=causes)
                if state.model is not before:
                    left, latest = scan(state.model), causes
        explained.append(anomaly)
    return replace(state, anomalies=tuple(explained))


def _is_same(anomaly: Anomaly, other: Anomaly) -> bool:
    """Return whether most links of an anomaly are in another one."""
    return bool(other.rows[anomaly.rows].mean() >= MIN_SHARED)


def _with_cause(state: SearchState, anomaly: Anomaly, inputs: SearchInputs
                ) -> tuple[SearchState, dict[str, float]]:
    """Return the state with the cause of a group, if one is named, and the probability of each."""
    model, criteria = state.model, inputs.criteria
    inputs.on_progress("causes of what " + _named(anomaly) + " reads")
    state, hypotheses = state.look(inputs.seed)
    group = anomaly.rows[model.whole.train]
    if not group.any():
        return state, {}
    candidates: list[Candidate] = []
    for effect in _acting_on(anomaly, model, inputs):
        # Following paths takes longest, and what explains little without them is no rival.
        most = max((each.gain for each in candidates), default=0.0)
        fitted = fit_candidate(model, effect, criteria, hypotheses, group, MIN_RIVAL_SHARE * most)
        if isinstance(fitted, Candidate) and np.isfinite(fitted.evidence):
            candidates.append(fitted)
    another = hypotheses.of_group(group)
    while True:
        causes = _shares(candidates, another)
        best = max(candidates, key=lambda each: each.evidence, default=None)
        if best is None or causes[best.effect.name] < criteria.min_probability:
            return state, causes
        candidates.remove(best)
        others = [another, *(each.evidence for each in candidates)]
        trial, extended = _judged(model, best, others, hypotheses, inputs)
        if extended is not None:
            return state.keep(trial, extended), causes
        state = state.refuse(trial)
        if trial.passed:  # so much evidence is often found where there is no such cause
            causes[ANOTHER] += causes[best.effect.name] - trial.probability
            return state, causes | {best.effect.name: trial.probability}


def _shares(candidates: Sequence[Candidate], another: float) -> dict[str, float]:
    """Return the probability of each cause, and of `ANOTHER` with such evidence [nats]."""
    names = [*(each.effect.name for each in candidates), ANOTHER]
    nats = [*(each.evidence for each in candidates), another]
    causes: dict[str, float] = {}
    for name, share in sorted(zip(names, softmax(nats), strict=True), key=lambda each: -each[1]):
        causes[name] = causes.get(name, 0.0) + float(share)
    return causes


def _named(anomaly: Anomaly) -> str:
    ends = [name for names in anomaly.members.values() for name in names]
    return " × ".join(ends) or f"one {anomaly.family}"


def _acting_on(anomaly: Anomaly, model: CrossFit, inputs: SearchInputs) -> list[Effect]:
    """Return the effects that may act on a group of that family; those along paths come last."""
    return sorted((effect for effect in inputs.undeclared if anomaly.family in effect.acts_on
                   and not effect.unavailable(model.links)), key=lambda each: each.always_exact)


def _judged(model: CrossFit, candidate: Candidate, others: Sequence[float],
            hypotheses: Hypotheses, inputs: SearchInputs) -> tuple[Trial, CrossFit | None]:
    """Return a cause with its probability, and the model with it unless it is refused.

    What happened on a flight, or changed between two, does not return on others: it is judged
    within flights.
    """
    effect = candidate.effect
    changes = inputs.folds.by == "flight" and effect.between_flights() is not None
    if not (effect.within_flights or changes):
        return judged(model, candidate, others, hypotheses, inputs)
    trial, there = judged_elsewhere(within_flights(model, inputs, "block" if changes else ""),
                                    candidate, others, hypotheses, inputs)
    if there is None:
        return trial, None
    return trial, (with_candidate(model, candidate, inputs.executor) if changes
                   else adopted(model, candidate))
