"""Faults at certain times: flights, episodes and bursts, which other flights cannot show.

Held out by flight, what happens on one flight is never learnt. So these candidates are scored on
devices that are held out, which the same receiver read at the same times; where there are few
devices, on blocks of ground that are held out in all flights at once. They come before all other
candidates, or these would explain the faulty readings by walls and positions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from radiotwin.closeloop.bases import Base
from radiotwin.closeloop.change_points import located_links, with_effect
from radiotwin.closeloop.cross_validation import (
    CrossValidatedModel,
    cross_validate,
    same_effects,
    training_parts,
)
from radiotwin.closeloop.effect_size import effect_size_db, why_not_borne_out
from radiotwin.closeloop.folds import Folds, make_folds
from radiotwin.closeloop.posterior import judge
from radiotwin.closeloop.scoring import (
    Candidate,
    CandidateScore,
    fit_and_score,
    fit_candidate,
)
from radiotwin.closeloop.selection import SelectionResult
from radiotwin.effects.base import DetectionEffect, Effect
from radiotwin.effects.fold_model import AppliedEffect, FoldModel
from radiotwin.effects.gain_drift import DeviceDrift, ReceiverDrift
from radiotwin.inference.censored_regression import FitResult
from radiotwin.links import LinkData, evidence_blocks
from radiotwin.links.correlation import devices_move

MIN_SHARED = 0.5  # of a fault's links, on which what is held against it, or the same, acts
MIN_DEVICES = 4  # of known position, to hold some of them out


def select_faults(result: SelectionResult, effects: list[Effect], links: LinkData, base: Base,
                  seed: int, on_progress: Callable[[str], None]) -> None:
    """Add the effects that act at certain times, one after the other, until none passes.

    Args:
        result: is extended.
        effects: candidates; those that are not `within_flights` are passed over.
        links: n links.
        base: of the model.
        seed: of folds and permutations.
        on_progress: called with what is being done.
    """
    timed = [effect for effect in effects
             if effect.within_flights and not effect.unavailable(result.model.links)]
    model: CrossValidatedModel | None = None
    while timed and not result.is_full:
        step, refused = len(result.model.whole.effects), []
        hypotheses = result.hypotheses(seed)
        fitted = [fit_candidate(result.model, effect, step, result.criteria, hypotheses)
                  for effect in timed]
        fitted = _against_lasting(fitted, effects, step, result)
        candidates = [each for each in fitted if isinstance(each, Candidate)]
        refused += [each for each in fitted if isinstance(each, CandidateScore)]
        kept = None
        for candidate in sorted(candidates, key=lambda each: -each.gain):
            on_progress(f"step {step + 1}: {candidate.effect.name}, held out within flights")
            model = model or _within_flights(result, links, base, seed)
            score, extended = fit_and_score(model, candidate.effect, evidence_blocks(model.links),
                                            len(timed), step, seed, result.criteria,
                                            result.executor)
            if extended is not None:
                score = replace(score, evidence_nats=candidate.evidence)
                score = judge([score], model, hypotheses, result.criteria)[0][0]
            if extended is not None and not score.reason:
                size_db = effect_size_db(extended, step)
                why = why_not_borne_out(size_db)
                score = replace(score, passed=not why, reason=why)
            if extended is not None and not score.reason:
                kept = candidate
                model = extended
                result.keep(score, _adopted(result.model, candidate))
                break
            refused.append(score)
        if kept is None:
            result.scores += refused
            return


def _against_lasting(faults: list[Candidate | CandidateScore], effects: list[Effect], step: int,
                     result: SelectionResult) -> list[Candidate | CandidateScore]:
    """Return faults, or why one is none: an effect that lasts explains as much of all links.

    A receiver that has changed reads less from then on, and so it does in the window that ends
    where the links do not show it. That another one has changed is no reason.
    """
    rivals = {name for each in faults if isinstance(each, Candidate)
              for name in each.effect.confused_with}
    fitted = [fit_candidate(result.model, effect, step, result.criteria) for effect in effects
              if effect.name in rivals and not effect.within_flights
              and not effect.unavailable(result.model.links)]
    lasting = [each for each in fitted if isinstance(each, Candidate)]
    return [_unless_outdone(each, lasting, step) if isinstance(each, Candidate) else each
            for each in faults]


def _unless_outdone(fault: Candidate, lasting: list[Candidate],
                    step: int) -> Candidate | CandidateScore:
    here = _acts(fault)
    rival = next((each for each in lasting if each.effect.name in fault.effect.confused_with
                  and each.gain >= fault.gain and _acts(each)[here].mean() >= MIN_SHARED), None)
    if rival is None:
        return fault
    return CandidateScore(fault.effect.name, step=step, variant=fault.effect.variant, reason=(
        f"{rival.effect.name} explains as much: {rival.gain:.0f} nats of the links that it is "
        f"fitted to, and this {fault.gain:.0f}"))


def _acts(candidate: Candidate) -> np.ndarray:
    """Return (n,) bool, the links that a candidate says something of."""
    applied = candidate.whole.effects[-1]
    blanks = isinstance(applied.effect, DetectionEffect)
    return blanks | applied.acts


def drop_idle_faults(result: SelectionResult) -> None:
    """Take back what the effects that were found later explain: an emitter is no episode.

    Faults and steps in time come first, and are held against no other effect.

    Args:
        result: is changed where one gains nothing any more on the links that it is fitted to, or
            where its search would not find it beside the others.
    """
    for number in reversed(range(len(result.model.whole.effects))):
        whole, applied = result.model.whole, result.model.whole.effects[number]
        timed = applied.effect.within_flights or isinstance(applied.effect,
                                                            ReceiverDrift | DeviceDrift)
        if not timed:
            continue
        alone = whole.with_effects([each for each in whole.effects if each is not applied])
        fit = alone.fit()
        gain = fit.objective - result.model.fits[0].objective
        if gain >= result.criteria.min_training_gain_nats and _is_found(applied, alone, fit):
            continue
        folds = [_without(each, same_effects(whole, each)[number]) for each in result.model.folds]
        fits = [fit, *(each.fit() for each in folds)]
        result.model = result.model.extended([alone, *folds], fits)
        kept = [i for i, score in enumerate(result.scores) if score.kept][number]
        result.scores[kept] = replace(result.scores[kept], kept=False,
                                      reason="what was found later explains it")
        del result.rivals[number]


def _is_found(applied: AppliedEffect, model: FoldModel, fit: FitResult) -> bool:
    """Return whether the search of a fault finds it in what a model without it leaves.

    Steps in time have no search of their own.
    """
    effect = applied.effect
    if not effect.within_flights:
        return True
    again = [model.apply(effect, params).acts for params in effect.propose(model.view(fit))]
    return any((applied.acts & acts).sum() >= MIN_SHARED * (applied.acts | acts).sum()
               for acts in again)


def _without(model: FoldModel, place: int | None) -> FoldModel:
    """Return a fold without the effect at a place; None: it has none of it."""
    return model.with_effects([each for number, each in enumerate(model.effects)
                               if number != place])


def _within_flights(result: SelectionResult, links: LinkData, base: Base,
                    seed: int) -> CrossValidatedModel:
    """Return the model as it is, fitted to folds that leave part of each flight."""
    links = located_links(result.model, links, base)
    folds = _folds(links, seed)
    model = cross_validate(links, base, folds, training_parts(links, folds))
    for each in result.model.whole.effects:
        model = with_effect(model, each.effect, each.params)
    return model


def _folds(links: LinkData, seed: int) -> Folds:
    by_device = len(links.anchors & set(links.device.tolist())) >= MIN_DEVICES
    return make_folds(links, seed, "device" if by_device and not devices_move(links) else "block")


def _adopted(model: CrossValidatedModel, candidate: Candidate) -> CrossValidatedModel:
    """Return a model with the effect; a fold has it as far as its own training links show it."""
    effect, like = candidate.effect, candidate.whole.effects[-1].params
    models, fits = [candidate.whole], [candidate.fit]
    for each, fit in zip(model.folds, model.fits[1:], strict=True):
        own: list[Any] = effect.propose_like(each.view(fit), like)
        if own:
            each = each.with_effects([*each.effects, each.apply(effect, own[0])])
            fit = each.fit(fit)
        models.append(each)
        fits.append(fit)
    return model.extended(models, fits)
