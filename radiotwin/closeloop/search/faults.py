"""Faults at certain times: flights, episodes and bursts, which other flights cannot show.

Held out by flight, what happens on one flight is never learnt. So these candidates are scored on
devices that are held out, which the same receiver read at the same times; where there are few
devices, on blocks of ground that are held out in all flights at once. They come before all other
candidates, or these would explain the faulty readings by walls and positions.

Changes between flights: a held-out flight cannot show them, positions in all flights can.

Where a receiver or a device changed after its first flight, that flight held out leaves nothing
that shows it, and the others held out are predicted well by each other. So these candidates are
scored on blocks of ground that are held out in all flights at once, with the effects that were
found already. A warm-up over the first flight and ageing change the level between flights, too:
the form is the one that explains most. Positions cannot tell a change from flights that differ
anyhow, so it must also be larger than flights of all receivers, or all devices, differ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import t

from radiotwin.closeloop.crossfit import (
    Base,
    CrossFit,
    Folds,
    cross_validate,
    make_folds,
    same_effects,
    training_parts,
)
from radiotwin.closeloop.search.posterior import judge
from radiotwin.closeloop.search.scoring import (
    Candidate,
    CandidateScore,
    fit_and_score,
    fit_candidate,
    score_candidate,
    with_candidate,
)
from radiotwin.closeloop.search.selection import SelectionResult
from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from radiotwin.closeloop.verdict.intervals import effect_size_db, why_not_borne_out
from radiotwin.effects.base import DetectionEffect, Effect
from radiotwin.effects.catalogue.gain_drift import DeviceDrift, ReceiverDrift
from radiotwin.links import Links, evidence_blocks
from radiotwin.links.correlation import devices_move
from radiotwin.twin.model.fold_model import AppliedEffect, Fit, FoldModel

MIN_SHARED = 0.5  # of a fault's links, on which what is held against it, or the same, acts
MIN_DEVICES = 4  # of known position, to hold some of them out


def select_change_points(result: SelectionResult, links: Links, base: Base, folds: Folds,
                         seed: int, on_progress: Callable[[str], None]) -> None:
    """Add changes in time to a model whose folds are flights, one by one, until none passes.

    Args:
        result: is extended.
        links: n links.
        base: of the model.
        folds: of the model.
        seed: of folds and permutations.
        on_progress: called with what is being done.
    """
    for effect in (ReceiverDrift(between_flights=True), DeviceDrift(between_flights=True)):
        if folds.by == "flight" and not effect.unavailable(links):
            _select_one_kind(result, effect, links, base, seed, on_progress)


def _select_one_kind(result: SelectionResult, effect: ReceiverDrift | DeviceDrift, links: Links,
                     base: Base, seed: int, on_progress: Callable[[str], None]) -> None:
    """Add changes of receivers, or of devices."""
    criteria = result.criteria
    first = fit_candidate(result.model, effect, 0, criteria)
    if not _stands_out(result.model, first, criteria):
        return
    on_progress(f"{effect.name}, held out by block")
    links = located_links(result.model, links, base)
    folds = make_folds(links, seed, "block")
    model = cross_validate(links, base, folds, training_parts(links, folds))
    for each in result.model.whole.effects:
        model = with_effect(model, each.effect, each.params)
    block = evidence_blocks(model.links)
    while not result.is_full:
        step = len(result.model.whole.effects)
        candidate = fit_candidate(model, effect, step, criteria)
        if isinstance(candidate, CandidateScore) or not _stands_out(model, candidate, criteria):
            return
        score, extended = score_candidate(model, candidate, block, 1, step, seed, criteria,
                                          result.executor)
        if extended is None:
            result.scores.append(score)
            return
        why = why_not_borne_out(effect_size_db(extended, step))
        if why:
            result.scores.append(replace(score, passed=False, reason=why))
            return
        model = extended
        params = candidate.whole.effects[-1].params
        there = replace(candidate, whole=with_effect(result.model, effect, params).whole)
        # When it was, a flight that is held out does not tell.
        result.keep(score, with_candidate(result.model, there, result.executor))


def located_links(model: CrossFit, links: Links, base: Base) -> Links:
    """Return the links with the devices that the base has located as anchors there."""
    device_m = base.device_m(model.twin)
    known = np.isfinite(device_m).all(axis=1)
    device_m = np.where(known[:, None], device_m, links.device_m)
    anchors = frozenset(np.flatnonzero(known).tolist()) | links.anchors
    links = links.with_devices(device_m).with_ends(anchors=anchors)
    return links.with_columns(evidence=model.links.evidence)


def _stands_out(model: CrossFit, candidate: Candidate | CandidateScore,
                criteria: SelectionCriteria) -> bool:
    """Return whether a change is larger than flights of all receivers, or all devices, differ.

    Student's t with their pooled standard deviation, corrected for the number of ends and of
    intervals between flights.
    """
    if not isinstance(candidate, Candidate):
        return False
    effect, params = candidate.effect, candidate.whole.effects[-1].params
    assert isinstance(effect, ReceiverDrift | DeviceDrift)
    ((changed, drift),) = effect.drifts(params).items()
    view = model.whole.view
    links = view.links
    seen = np.isfinite(links.level_db) & np.isfinite(links.time_s)
    end = effect.index(links)
    # Flights are before or after it, whole: a warm-up is over, by two thirds, after its constant.
    when_s = drift.number + (links.first_s if drift.form == "warm_up" else 0.0)
    begins_s = pd.Series(links.time_s[seen]).groupby(links.flight[seen]).transform("min")
    group = np.where((end[seen] == changed) & (begins_s >= when_s), -1, end[seen])
    cells, cell = np.unique(np.column_stack([group, links.flight[seen]]), axis=0,
                            return_inverse=True)
    # Plain means: where all of a flight is off, its links are no outliers.
    mean_db = np.bincount(cell.ravel(), weights=view.residual_db[seen]) / np.bincount(cell.ravel())
    groups, member = np.unique(cells[:, 0], return_inverse=True)
    flights = np.bincount(member)
    level_db = np.bincount(member, weights=mean_db) / flights
    freedom = len(mean_db) - len(groups)
    if freedom < 1 or not {-1, changed} <= set(groups):
        return False
    sd_db = np.sqrt(((mean_db - level_db[member]) ** 2).sum() / freedom)
    after, before = np.flatnonzero(groups == -1)[0], np.flatnonzero(groups == changed)[0]
    gap_db = abs(level_db[after] - level_db[before])
    error_db = max(sd_db * np.sqrt(1 / flights[after] + 1 / flights[before]), 1e-9)
    intervals = len(np.unique(end)) * max(len(np.unique(links.flight)) - 1, 1)
    p_value = 2 * t.sf(gap_db / error_db, freedom) * intervals
    return bool(p_value <= criteria.max_p_value)


def with_effect(model: CrossFit, effect: Effect, params: Any) -> CrossFit:
    """Return a model with one more effect in the whole and every fold, its parameters given."""
    return model.map(lambda fit: fit.with_effects([*fit.effects, fit.model.apply(effect, params)]))


def select_faults(result: SelectionResult, effects: list[Effect], links: Links, base: Base,
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
    model: CrossFit | None = None
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
        alone = whole.model.with_effects([each for each in whole.effects
                                          if each is not applied]).fit()
        gain = alone.objective - whole.objective
        if gain >= result.criteria.min_training_gain_nats and _is_found(applied, alone):
            continue
        folds = [_without(each.model, same_effects(whole, each)[number]).fit()
                 for each in result.model.folds]
        result.model = result.model.extended(alone, folds)
        kept = [i for i, score in enumerate(result.scores) if score.kept][number]
        result.scores[kept] = replace(result.scores[kept], kept=False,
                                      reason="what was found later explains it")
        del result.rivals[number]


def _is_found(applied: AppliedEffect, without: Fit) -> bool:
    """Return whether the search of a fault finds it in what a fit without it leaves.

    Steps in time have no search of their own.
    """
    effect = applied.effect
    if not effect.within_flights:
        return True
    again = [without.model.apply(effect, params).acts for params in effect.propose(without.view)]
    return any((applied.acts & acts).sum() >= MIN_SHARED * (applied.acts | acts).sum()
               for acts in again)


def _without(model: FoldModel, place: int | None) -> FoldModel:
    """Return a fold without the effect at a place; None: it has none of it."""
    return model.with_effects([each for number, each in enumerate(model.effects)
                               if number != place])


def _within_flights(result: SelectionResult, links: Links, base: Base,
                    seed: int) -> CrossFit:
    """Return the model as it is, fitted to folds that leave part of each flight."""
    links = located_links(result.model, links, base)
    folds = _folds(links, seed)
    model = cross_validate(links, base, folds, training_parts(links, folds))
    for each in result.model.whole.effects:
        model = with_effect(model, each.effect, each.params)
    return model


def _folds(links: Links, seed: int) -> Folds:
    by_device = len(links.anchors & set(links.device.tolist())) >= MIN_DEVICES
    return make_folds(links, seed, "device" if by_device and not devices_move(links) else "block")


def _adopted(model: CrossFit, candidate: Candidate) -> CrossFit:
    """Return a model with the effect; a fold has it as far as its own training links show it."""
    effect, like = candidate.effect, candidate.whole.effects[-1].params
    def adopted(fold: Fit) -> Fit:
        own: list[Any] = effect.propose_like(fold.view, like)
        return fold.with_effects([*fold.effects, fold.model.apply(effect, own[0])]) if own else fold

    return model.extended(candidate.whole, [adopted(fold) for fold in model.folds])
