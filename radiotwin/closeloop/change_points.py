"""Changes between flights: a held-out flight cannot show them, positions in all flights can.

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

from radiotwin.closeloop.bases import Base
from radiotwin.closeloop.criteria import SelectionCriteria
from radiotwin.closeloop.cross_validation import (
    CrossValidatedModel,
    cross_validate,
    training_parts,
)
from radiotwin.closeloop.effect_size import effect_size_db, why_not_borne_out
from radiotwin.closeloop.folds import Folds, make_folds
from radiotwin.closeloop.scoring import (
    Candidate,
    CandidateScore,
    fit_candidate,
    score_candidate,
    with_candidate,
)
from radiotwin.closeloop.selection import SelectionResult
from radiotwin.effects.base import Effect
from radiotwin.effects.gain_drift import DeviceDrift, ReceiverDrift
from radiotwin.links import LinkData, evidence_blocks


def select_change_points(result: SelectionResult, links: LinkData, base: Base, folds: Folds,
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


def _select_one_kind(result: SelectionResult, effect: ReceiverDrift | DeviceDrift, links: LinkData,
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
        whole = with_effect(result.model, effect, params)
        there = replace(candidate, whole=whole.whole, fit=whole.fits[0])
        # When it was, a flight that is held out does not tell.
        result.keep(score, with_candidate(result.model, there, result.executor))


def located_links(model: CrossValidatedModel, links: LinkData, base: Base) -> LinkData:
    """Return the links with the devices that the base has located as anchors there."""
    device_m = base.device_m(model.twin)
    known = np.isfinite(device_m).all(axis=1)
    device_m = np.where(known[:, None], device_m, links.device_m)
    anchors = frozenset(np.flatnonzero(known).tolist()) | links.anchors
    return replace(links.with_devices(device_m), anchors=anchors, evidence=model.links.evidence)


def _stands_out(model: CrossValidatedModel, candidate: Candidate | CandidateScore,
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
    view = model.whole.view(model.fits[0])
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


def with_effect(model: CrossValidatedModel, effect: Effect, params: Any) -> CrossValidatedModel:
    """Return a model with one more effect in the whole and every fold, its parameters given."""
    models = [each.with_effects([*each.effects, each.apply(effect, params)])
              for each in model.models]
    fits = [each.fit(fit) for each, fit in zip(models, model.fits, strict=True)]
    return model.extended(models, fits)
