"""Fit a candidate effect to all links and without each fold, and score it on held-out links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.search.stages import SearchInputs
from radiotwin.closeloop.search.trials import Trial
from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from radiotwin.closeloop.verdict.hypotheses import Hypotheses, changes_levels
from radiotwin.closeloop.verdict.intervals import why_not_confirmed
from radiotwin.closeloop.verdict.posterior import with_probability
from radiotwin.effects.base import Effect
from radiotwin.links import Links
from radiotwin.runtime.execution import Executor
from radiotwin.twin.model.fitting import add_effect, along_paths, prepare_additions
from radiotwin.twin.model.model import Fit


def ends_of(effect: Effect, coefficients: np.ndarray,
            links: Links) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the devices and of the receivers that an effect acts on.

    A sparse effect has one coefficient for each device (or receiver). Of these only the one whose
    coefficient is farthest from the median is named.

    Args:
        effect: the effect with its parameters.
        coefficients: (q,) coefficients of its term.
        links: the links it was fitted to.

    Returns:
        names of devices, names of receivers; both empty for an effect on all links.
    """
    params = effect.params
    if effect.sparse and hasattr(params, "members"):
        deviation = np.abs(coefficients - np.median(coefficients))
        extreme = [params.members[int(deviation.argmax())]]
        return (_names(extreme, links.device_names) if effect.of_device else (),
                _names(extreme, links.receiver_names) if effect.of_receiver else ())
    return (_names(_indices(params, "device"), links.device_names),
            _names(_indices(params, "receiver"), links.receiver_names))


def _indices(params: object, end: str) -> list[int]:
    """Return the indices in a parameter `device` or `devices` (`end`: device or receiver)."""
    one, many = getattr(params, end, None), getattr(params, f"{end}s", ())
    return [each for each in (one, *many) if isinstance(each, int)]


def _names(indices: list[int], names: Sequence[str]) -> tuple[str, ...]:
    """Return the names at indices; indices out of range are skipped."""
    return tuple(str(names[each]) for each in indices if 0 <= each < len(names))


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect of the catalogue, fitted to all links.

    Attributes:
        effect: the effect without parameters.
        whole: fit to all links with the effect.
        gain_nats: gain of the training objective; links count as independent.
        evidence_nats: evidence given correlated residuals, see `Hypotheses`; NaN if not computed.
    """

    effect: Effect
    whole: Fit
    gain_nats: float
    evidence_nats: float = np.nan


def fit_candidate(model: CrossFit, effect: Effect, criteria: SelectionCriteria,
                  hypotheses: Hypotheses | None = None, group: np.ndarray | None = None,
                  min_path_gain_nats: float = 0.0) -> Candidate | Trial:
    """Fit an effect to all links; return a refused trial with the reason if it is not plausible.

    It is refused if it proposes no parameters, if the effect itself finds these implausible or
    contradicted by links, or if it gains less than `min_training_gain_nats`.

    Args:
        model: cross-validated fit without the effect.
        effect: the effect to try.
        criteria: thresholds.
        hypotheses: computes the evidence for the effect; None: no evidence.
        group: (m,) bool, training links that the effect has to explain; None: all.
        min_path_gain_nats: least gain, with levels by the quick law, from which the levels are
            computed along paths, which takes longer.
    """
    refused = Trial(effect.name, step=len(model.whole.effects), variant=effect.variant)
    whole = add_effect(model.whole, effect, group=group)
    if whole is None:
        return replace(refused, reason="nothing in the residual looks like it")
    links, city = model.links.select(model.whole.usable), model.whole.model.corrected_map
    if city is not links.city:  # the map is corrected by effects found before
        links = links.with_city(city)
    why = whole.effects[-1].contradicted(links)
    if why:
        return replace(refused, reason=why)
    if model.whole.objective - whole.objective >= min_path_gain_nats:
        whole = along_paths(whole, model.whole)
    found = whole.effects[-1]
    why = found.implausible(whole.coefficients_of(-1)) or found.contradicted(links)
    if why:
        return replace(refused, reason=why)
    gain = model.whole.objective - whole.objective
    if gain < criteria.min_training_gain_nats:
        return replace(refused, reason=f"gains less than {criteria.min_training_gain_nats:.0f} "
                       "nats even on the links that it is fitted to")
    if hypotheses is None or not changes_levels(effect):
        return Candidate(effect, whole, gain)
    return Candidate(effect, whole, gain, hypotheses.effect_evidence_nats(whole))


def score_candidate(model: CrossFit, candidate: Candidate,
                    inputs: SearchInputs) -> tuple[Trial, CrossFit | None]:
    """Fit a candidate to each fold's training links, and score it on the held-out links.

    It passes if these become likelier; trends need a gain of `min_gain_nats` in sum.

    Args:
        model: cross-validated fit without the candidate.
        candidate: effect fitted to all links.
        inputs: inputs of the search.

    Returns:
        the trial, and the model with the effect; None instead of the model if it does not pass.
    """
    found = candidate.whole.effects[-1]
    devices, receivers = ends_of(found, candidate.whole.coefficients_of(-1), model.links)
    extended = with_candidate(model, candidate, inputs.executor)
    trial = Trial(candidate.effect.name, step=len(model.whole.effects), params=found.params,
                  evidence_nats=candidate.evidence_nats, variant=candidate.effect.variant,
                  devices=devices, receivers=receivers)
    is_judged = found.is_cause or found.is_declared
    trial = score_model(model, extended, trial, inputs.criteria,
                        0.0 if is_judged else inputs.criteria.min_gain_nats)
    return trial, None if trial.reason else extended


def with_candidate(model: CrossFit, candidate: Candidate, executor: Executor) -> CrossFit:
    """Add a candidate to the fit to all links, and fit it anew to each fold's training links.

    A fold whose training links do not show the effect stays without it.
    """
    effect, like = candidate.effect, candidate.whole.effects[-1]
    prepare_additions(model.folds, [effect], executor, like)
    return model.with_fits(candidate.whole, [add_effect(fold, effect, like) or fold
                                            for fold in model.folds])


def score_and_judge(model: CrossFit, candidate: Candidate, others: Sequence[float],
           hypotheses: Hypotheses, inputs: SearchInputs) -> tuple[Trial, CrossFit | None]:
    """Score a candidate on held-out links, and compute its probability beside its rivals.

    Args:
        model: cross-validated fit without the candidate.
        candidate: effect fitted to all links.
        others: evidence for rival causes [nats].
        hypotheses: of the model, with which the evidence was computed.
        inputs: inputs of the search.

    Returns:
        the trial, and the model with the effect; None instead of the model if it is refused.
    """
    trial, extended = score_candidate(model, candidate, inputs)
    if extended is None:
        return trial, None
    rest_db, noise_db = hypotheses.rest_and_noise_db
    trial = with_probability(trial, others, model, rest_db / noise_db, inputs.criteria)
    if trial.reason:
        return trial, None
    why = why_not_confirmed(extended, len(model.whole.effects))
    return (trial.refuse(why, passed=False), None) if why else (trial, extended)


def fit_and_score(model: CrossFit, effect: Effect, inputs: SearchInputs,
                  hypotheses: Hypotheses | None = None) -> tuple[Trial, CrossFit | None]:
    """Fit an effect, score it on held-out links; return the trial, and the model unless refused."""
    candidate = fit_candidate(model, effect, inputs.criteria, hypotheses)
    if isinstance(candidate, Trial):
        return candidate, None
    return score_candidate(model, candidate, inputs)


def score_model(model: CrossFit, extended: CrossFit, trial: Trial, criteria: SelectionCriteria,
                min_gain_nats: float = 0.0) -> Trial:
    """Compare an extended model with the one before on held-out links, and complete its trial.

    Links that a fault affects, but that no training link of their fold shows, are not scored.

    Args:
        model: cross-validated fit before.
        extended: the fit with one more effect or with shadowing.
        trial: trial of the extension, without scores.
        criteria: thresholds; refused if the RMSE rises by more than the factor `max_rmse_rise`.
        min_gain_nats: refused up to this gain of held-out log likelihood, summed over links.

    Returns:
        the trial with gains and RMSE, and a reason if it is refused.
    """
    gain = model.held_out_nll - extended.held_out_nll
    known = np.isfinite(gain)
    usable = known & ~model.not_learnable
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
