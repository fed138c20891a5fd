"""What tables declare, and what every map has: added to the base before the search for causes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from radiotwin.closeloop.search.scoring import fit_and_score
from radiotwin.closeloop.search.selection import SelectionResult
from radiotwin.effects.base import Effect
from radiotwin.links import evidence_blocks


def take_declared(result: SelectionResult, effects: list[Effect], seed: int,
                  on_progress: Callable[[str], None]) -> list[Effect]:
    """Add what is declared to the base, where held-out links gain by it.

    That it is there needs no evidence, only that the declaration is right: links that take no part
    in the fit of its numbers have to agree. A contradicted declaration is left out, with a note.
    What is no cause claims nothing, so that it only has to make these links likelier.

    Args:
        result: of a base alone; is extended.
        effects: candidates.
        seed: of permutations.
        on_progress: called with what is being done.

    Returns:
        the other effects.
    """
    block = evidence_blocks(result.model.links)
    declared = [effect for effect in effects if effect.is_declared]
    for name in dict.fromkeys(effect.name for effect in declared):
        forms = [effect for effect in declared if effect.name == name
                 and not effect.unavailable(result.model.links)]
        _take_best(result, forms, block, seed, on_progress)
    return [effect for effect in effects if not effect.is_declared]


def _take_best(result: SelectionResult, forms: list[Effect], block: np.ndarray, seed: int,
               on_progress: Callable[[str], None]) -> None:
    """Add the form of one declared effect that held-out links gain most by, if they gain."""
    before, step = result.model, len(result.model.whole.effects)
    tried, passed = [], []
    for effect in forms:
        on_progress(effect.variant)
        criteria = result.criteria if effect.is_cause else result.criteria.of_no_claim
        score, extended = fit_and_score(before, effect, block, len(forms), step, seed, criteria,
                                        result.executor)
        tried.append(score)
        if extended is not None:
            passed.append((effect, score, extended))
    if passed:
        effect, best, extended = max(passed, key=lambda each: each[1].held_out_nats)
        result.keep(best, extended)
        result.scores += [replace(each, reason=each.reason or f"{effect.variant} gain more")
                          for each in tried if each is not best]
        result.notes.append(f"{effect.variant} are part of the base: the RMSE on held-out links "
                            f"is {best.rmse_db:.2f} dB, and {before.rmse_db():.2f} dB without them")
        return
    result.scores += tried
    if tried and forms[0].is_cause:
        result.notes.append(f"{forms[0].variant} do not agree with the readings and are left "
                            f"out: {tried[0].reason}")
