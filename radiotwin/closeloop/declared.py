"""What the tables declare, before anything is looked for that they do not."""

from __future__ import annotations

from collections.abc import Callable

from radiotwin.closeloop.scoring import fit_and_score
from radiotwin.closeloop.selection import SelectionResult
from radiotwin.effects.base import Effect
from radiotwin.links import evidence_blocks


def take_declared(result: SelectionResult, effects: list[Effect], seed: int,
                  on_progress: Callable[[str], None]) -> list[Effect]:
    """Add what is declared to the base, where held-out links gain by it.

    That it is there needs no evidence, only that the declaration is right: links that take no part
    in the fit of its numbers have to agree. What they contradict is left out, and told.

    Args:
        result: of a base alone; is extended.
        effects: candidates.
        seed: of permutations.
        on_progress: called with what is being done.

    Returns:
        the other effects.
    """
    block = evidence_blocks(result.model.links)
    for effect in effects:
        if not effect.is_declared or effect.unavailable(result.model.links):
            continue
        on_progress(effect.variant)
        before, step = result.model, len(result.model.whole.effects)
        score, extended = fit_and_score(before, effect, block, 1, step, seed, result.criteria)
        if extended is None:
            result.scores.append(score)
            result.model.links.notes.append(
                f"{effect.variant} do not agree with the readings and are left out: {score.reason}")
            continue
        result.keep(score, extended)
        result.model.links.notes.append(
            f"{effect.variant} are part of the base: the RMSE on held-out links is "
            f"{score.rmse_db:.2f} dB, and {before.rmse_db():.2f} dB without them")
    return [effect for effect in effects if not effect.is_declared]
