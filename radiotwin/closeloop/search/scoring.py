"""Fit a candidate to all links and to each fold's others, and score it on held-out links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.search.stages import SearchInputs
from radiotwin.closeloop.search.trials import Trial
from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from radiotwin.closeloop.verdict.hypotheses import Hypotheses, is_judged_by_levels
from radiotwin.closeloop.verdict.intervals import why_not_borne_out
from radiotwin.closeloop.verdict.posterior import with_probability
from radiotwin.effects.base import Effect
from radiotwin.links import Links
from radiotwin.runtime.execution import Executor
from radiotwin.twin.model.fitting import add_effect, along_paths, prepare_additions
from radiotwin.twin.model.model import Fit


def ends_of(effect: Effect, coefficients: np.ndarray,
            links: Links) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the devices and of the receivers that an effect belongs to.

    Where each end has a coefficient, and few are off, that is the one that is off most.

    Args:
        effect: that was found.
        coefficients: (q,) of its term.
        links: that it was fitted to.

    Returns:
        names of devices, names of receivers; both empty for an effect of all links.
    """
    params = effect.params
    if effect.sparse and hasattr(params, "members"):
        off = np.abs(coefficients - np.median(coefficients))
        most = [params.members[int(off.argmax())]]
        return (_names(most, links.device_names) if effect.of_device else (),
                _names(most, links.receiver_names) if effect.of_receiver else ())
    return (_names(_indices(params, "device"), links.device_names),
            _names(_indices(params, "receiver"), links.receiver_names))


def _indices(params: object, end: str) -> list[int]:
    """Return the indices in `device` or `devices`, whatever an effect has."""
    one, many = getattr(params, end, None), getattr(params, f"{end}s", ())
    return [each for each in (one, *many) if isinstance(each, int)]


def _names(indices: list[int], names: Sequence[str]) -> tuple[str, ...]:
    return tuple(str(names[each]) for each in indices if 0 <= each < len(names))


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect fitted to all links, and how much likelier they are with it [nats].

    `gain` counts every link, `evidence` knows that the base may be wrong (NaN: not looked at).
    """

    effect: Effect
    whole: Fit
    gain: float
    evidence: float = np.nan


def fit_candidate(model: CrossFit, effect: Effect, criteria: SelectionCriteria,
                  hypotheses: Hypotheses | None = None, group: np.ndarray | None = None,
                  min_gain: float = 0.0) -> Candidate | Trial:
    """Fit a candidate to all links; return a trial with the reason if that refuses it already.

    Args:
        model: without it.
        effect: that is tried.
        criteria: that decide.
        hypotheses: about what the model lacks; None: not to be looked at.
        group: (m,) bool, training links that it is to explain; None: any.
        min_gain: nats with quick levels, below which no paths are followed for it.
    """
    refused = Trial(effect.name, step=len(model.whole.effects), variant=effect.variant)
    whole = add_effect(model.whole, effect, group=group)
    if whole is None:
        return replace(refused, reason="nothing in the residual looks like it")
    links, city = model.links.select(model.whole.usable), model.whole.model.corrected_map
    if city is not links.city:  # what was found is part of what is known
        links = links.with_city(city)
    why = whole.effects[-1].contradicted(links)
    if why:
        return replace(refused, reason=why)
    if model.whole.objective - whole.objective >= min_gain:
        whole = along_paths(whole, model.whole)
    found = whole.effects[-1]
    why = found.implausible(whole.coefficients_of(-1)) or found.contradicted(links)
    if why:
        return replace(refused, reason=why)
    gain = model.whole.objective - whole.objective
    if gain < criteria.min_training_gain_nats:
        return replace(refused, reason=f"gains less than {criteria.min_training_gain_nats:.0f} "
                       "nats even on the links that it is fitted to")
    if hypotheses is None or not is_judged_by_levels(effect):
        return Candidate(effect, whole, gain)
    return Candidate(effect, whole, gain, hypotheses.of_named(whole))


def score_candidate(model: CrossFit, candidate: Candidate,
                    inputs: SearchInputs) -> tuple[Trial, CrossFit | None]:
    """Fit a candidate to each fold's training links, and score it on the others.

    Args:
        model: without it.
        candidate: fitted to all links.
        inputs: of the search.

    Returns:
        the trial, and the model with it; None where it does not pass.
    """
    found = candidate.whole.effects[-1]
    devices, receivers = ends_of(found, candidate.whole.coefficients_of(-1), model.links)
    extended = with_candidate(model, candidate, inputs.executor)
    trial = Trial(candidate.effect.name, step=len(model.whole.effects), params=found.params,
                  evidence_nats=candidate.evidence, variant=candidate.effect.variant,
                  devices=devices, receivers=receivers)
    is_judged = found.is_cause or found.is_declared
    trial = score_model(model, extended, trial, inputs.criteria,
                        0.0 if is_judged else inputs.criteria.min_gain_nats)
    return trial, None if trial.reason else extended


def with_candidate(model: CrossFit, candidate: Candidate, executor: Executor) -> CrossFit:
    """Return a model with a candidate; a fold has it as its own training links show it."""
    effect, like = candidate.effect, candidate.whole.effects[-1]
    prepare_additions(model.folds, [effect], executor, like)
    return model.extended(candidate.whole, [add_effect(fold, effect, like) or fold
                                            for fold in model.folds])


def judged(model: CrossFit, candidate: Candidate, others: Sequence[float],
           hypotheses: Hypotheses, inputs: SearchInputs) -> tuple[Trial, CrossFit | None]:
    """Return what held-out links and the evidence say of a candidate, with its probability.

    Args:
        model: without it.
        candidate: fitted to all links.
        others: evidence for its rivals [nats].
        hypotheses: that the evidence is of.
        inputs: of the search.

    Returns:
        the trial, and the model with it; None where it is refused.
    """
    trial, extended = score_candidate(model, candidate, inputs)
    if extended is None:
        return trial, None
    rest_db, noise_db = hypotheses.sizes_db
    trial = with_probability(trial, others, model, rest_db / noise_db, inputs.criteria)
    if trial.reason:
        return trial, None
    why = why_not_borne_out(extended, len(model.whole.effects))
    return (trial.refuse(why, passed=False), None) if why else (trial, extended)


def fit_and_score(model: CrossFit, effect: Effect, inputs: SearchInputs,
                  hypotheses: Hypotheses | None = None) -> tuple[Trial, CrossFit | None]:
    """Return `score_candidate` of `fit_candidate`; of one that is refused, no model."""
    candidate = fit_candidate(model, effect, inputs.criteria, hypotheses)
    if isinstance(candidate, Trial):
        return candidate, None
    return score_candidate(model, candidate, inputs)


def score_model(model: CrossFit, extended: CrossFit, trial: Trial, criteria: SelectionCriteria,
                min_gain_nats: float = 0.0) -> Trial:
    """Return what held-out links say of an extended model; with the reason where it is refused.

    They refuse what does not return: what makes them no likelier (a description by less than
    `min_gain_nats`), or their error larger.
    """
    gain = model.held_out_nll - extended.held_out_nll
    known = np.isfinite(gain)
    usable = known & ~model.unforeseen
    if not usable.any():
        return replace(trial, reason="no held-out link can be judged with it")
    total = float(gain[usable].sum())
    shares = np.bincount(model.index[usable], gain[usable], len(model.folds))
    after_db, reason = extended.rmse_db(usable), ""
    if total <= min_gain_nats:
        reason = f"gains too little on held-out links: {total:.0f} nats"
    elif after_db > criteria.max_rmse_rise * model.rmse_db(usable):
        reason = (f"the error of held-out links would rise to {after_db:.2f} dB, though they "
                  "become likelier")
    return replace(trial, reason=reason, passed=not reason, nll_gain=total,
                   rmse_db=extended.rmse_db(known),
                   gain_by_fold=shares / model.whole.view.design_effect)
