"""Steps in time that lie between flights: a held-out flight cannot tell them, the places of all flights can.

Where a receiver changed after its first flight, that flight held out leaves nothing that speaks of it, and the others
held out are predicted well by each other. So these candidates are judged on blocks of ground that are held out in all
flights at once, with the effects that were found already.
"""

from collections.abc import Callable

from radiotwin.closeloop.bases import Base
from radiotwin.closeloop.folds import Folds, evidence_blocks, make_folds
from radiotwin.closeloop.model import Side
from radiotwin.closeloop.regression import Solution
from radiotwin.closeloop.search import MOST_EFFECTS, Look, Model, Search, judge, look_at, make_model
from radiotwin.effects.base import Effect, Setting
from radiotwin.effects.receiver_drift import ReceiverDrift


def search_between_flights(search: Search, base: Base, folds: Folds, seed: int, tell: Callable[[str], None]) -> None:
    """Add receivers' steps in time to a model whose folds are flights, one after the other, until none passes."""
    effect, records = ReceiverDrift(steps_only=True), search.model.whole.records
    if folds.by != "flight" or effect.lacks(records) or not isinstance(look_at(search.model, effect, 0), Look):
        return
    tell("receiver_drift, held out by block")
    model = make_model(records, base, make_folds(records, seed, "block"))
    for part in search.model.whole.parts:
        model = _with(model, part.effect, part.setting)
    block = evidence_blocks(records)
    while len(search.model.whole.parts) < MOST_EFFECTS:
        step = len(search.model.whole.parts)
        look = look_at(model, effect, step)
        if not isinstance(look, Look):
            return
        judged, extended = judge(model, look, block, 1, step, seed)
        if extended is None:
            search.log.append(judged)
            return
        model = extended
        search.keep(judged, _with(search.model, effect, look.whole.parts[-1].setting))


def _with(model: Model, effect: Effect, setting: Setting) -> Model:
    """A model with one more effect in every side, its setting given."""
    def extended(side: Side) -> tuple[Side, Solution]:
        other = side.with_parts([*side.parts, side.part(effect, setting)])
        return other, other.fit()
    whole, *sides = [extended(side) for side in model.sides]
    return Model(whole[0], [side for side, _ in sides], [whole[1], *(fit for _, fit in sides)], model.index)
