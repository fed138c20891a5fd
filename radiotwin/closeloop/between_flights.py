"""Steps in time that lie between flights: a held-out flight cannot tell them, the places of all flights can.

Where a receiver or a device changed after its first flight, that flight held out leaves nothing that speaks of it, and
the others held out are predicted well by each other. So these candidates are judged on blocks of ground that are held
out in all flights at once, with the effects that were found already. Places cannot tell a step from flights that differ
anyhow, so it must also stand out from how much all flights differ, of all receivers or all devices.
"""

from collections.abc import Callable

import numpy as np
from scipy.stats import t

from radiotwin.closeloop.bases import Base
from radiotwin.closeloop.folds import Folds, evidence_blocks, make_folds
from radiotwin.closeloop.model import Side
from radiotwin.closeloop.regression import Solution
from radiotwin.closeloop.search import (
    MOST_EFFECTS,
    SIGNIFICANCE,
    Judged,
    Look,
    Model,
    Search,
    judge,
    look_at,
    make_model,
)
from radiotwin.effects.base import Effect, Setting
from radiotwin.effects.gain_drift import DeviceDrift, ReceiverDrift


def search_between_flights(search: Search, base: Base, folds: Folds, seed: int, tell: Callable[[str], None]) -> None:
    """Add steps in time to a model whose folds are flights, one after the other, until none passes."""
    for effect in (ReceiverDrift(steps_only=True), DeviceDrift(steps_only=True)):
        if folds.by == "flight" and not effect.lacks(search.model.whole.records):
            _search_one_kind(search, effect, base, seed, tell)


def _search_one_kind(search: Search, effect: ReceiverDrift | DeviceDrift, base: Base, seed: int,
                     tell: Callable[[str], None]) -> None:
    """The same for receivers, or for devices."""
    records = search.model.whole.records
    if not _stands_out(search.model, look_at(search.model, effect, 0)):
        return
    tell(f"{effect.name}, held out by block")
    model = make_model(records, base, make_folds(records, seed, "block"))
    for part in search.model.whole.parts:
        model = _with(model, part.effect, part.setting)
    block = evidence_blocks(records)
    while len(search.model.whole.parts) < MOST_EFFECTS:
        step = len(search.model.whole.parts)
        look = look_at(model, effect, step)
        if isinstance(look, Judged) or not _stands_out(model, look):
            return
        judged, extended = judge(model, look, block, 1, step, seed)
        if extended is None:
            search.log.append(judged)
            return
        model = extended
        search.keep(judged, _with(search.model, effect, look.whole.parts[-1].setting))


def _stands_out(model: Model, look) -> bool:
    """Whether a step is larger than flights of all receivers, or of all devices, let expect: Student's t with their
    pooled spread, as many times as there are of them and places between flights."""
    if not isinstance(look, Look):
        return False
    effect, setting = look.effect, look.whole.parts[-1].setting
    assert isinstance(effect, ReceiverDrift | DeviceDrift)
    ((changed, (_, when_s)),) = setting[effect.ends].items()
    view = model.whole.view(model.fits[0])
    records, seen = view.records, np.isfinite(view.records.level_db) & np.isfinite(view.records.time_s)
    end = effect.index(records)
    group = np.where((end == int(changed)) & (records.time_s >= when_s), -1, end)[seen]
    cells, cell = np.unique(np.column_stack([group, records.flight[seen]]), axis=0, return_inverse=True)
    # Plain means: where all of a flight is off, its links are no outliers.
    mean_db = np.bincount(cell.ravel(), weights=view.residual_db[seen]) / np.bincount(cell.ravel())
    groups, member = np.unique(cells[:, 0], return_inverse=True)
    flights = np.bincount(member)
    level_db = np.bincount(member, weights=mean_db) / flights
    freedom = len(mean_db) - len(groups)
    if freedom < 1 or not {-1, int(changed)} <= set(groups):
        return False
    spread_db = np.sqrt(((mean_db - level_db[member]) ** 2).sum() / freedom)
    after, before = np.flatnonzero(groups == -1)[0], np.flatnonzero(groups == int(changed))[0]
    gap_db = abs(level_db[after] - level_db[before])
    error_db = max(spread_db * np.sqrt(1 / flights[after] + 1 / flights[before]), 1e-9)
    places = len(np.unique(end)) * max(len(np.unique(records.flight)) - 1, 1)
    return bool(2 * t.sf(gap_db / error_db, freedom) * places <= SIGNIFICANCE)


def _with(model: Model, effect: Effect, setting: Setting) -> Model:
    """A model with one more effect in every side, its setting given."""
    def extended(side: Side, fit: Solution) -> tuple[Side, Solution]:
        other = side.with_parts([*side.parts, side.part(effect, setting)])
        return other, other.fit(fit)
    whole, *sides = [extended(side, fit) for side, fit in zip(model.sides, model.fits)]
    return Model(whole[0], [side for side, _ in sides], [whole[1], *(fit for _, fit in sides)], model.index)
