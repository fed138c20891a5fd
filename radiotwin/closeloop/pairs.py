"""Effects that are probable together, where none is alone.

Three masts with sector antennas, or a displaced anchor and a receiver that drifts: each explains a
part, and beside the others' parts in the residual its own is not much. So where the likeliest
effect is not probable enough, one more of its kind, or the next likeliest, is fitted beside it, and
they are judged by what they explain together. More of a kind follow as long as that makes them
likelier.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from radiotwin.closeloop.criteria import SelectionCriteria
from radiotwin.closeloop.cross_validation import CrossValidatedModel
from radiotwin.closeloop.hypotheses import Hypotheses
from radiotwin.closeloop.posterior import Step, probability_of_all
from radiotwin.closeloop.scoring import CandidateScore, fit_and_score
from radiotwin.effects.base import Effect
from radiotwin.execution import Executor

MIN_SHARE = 0.5  # of the probability that is needed, for the first of two
MAX_SECONDS = 2  # effects that are tried beside it


@dataclass(frozen=True, eq=False)
class Passed:
    """A candidate that held-out links support: its effect, score, and the model with it."""

    effect: Effect
    score: CandidateScore
    model: CrossValidatedModel


def probable_together(passed: Sequence[Passed], before: CrossValidatedModel, step: Step,
                      block: np.ndarray, tried: int, seed: int, criteria: SelectionCriteria,
                      executor: Executor, on_progress: Callable[[str], None]) -> list[Passed]:
    """Return effects that are probable together, in order; none where there are none.

    Args:
        passed: candidates of a step, none of which is probable enough.
        before: the model without them.
        step: what the residual says without them.
        block: (n,) piece of evidence of each link.
        tried: number of candidates.
        seed: of permutations.
        criteria: that decide.
        executor: where folds are fitted.
        on_progress: called with what is being done.
    """
    ranked = sorted(passed, key=lambda each: -each.score.probability)
    if not ranked or ranked[0].score.probability < MIN_SHARE * criteria.min_probability:
        return []
    first = ranked[0]
    on_progress(f"step {step.number + 1}: {first.score.name}, beside another effect")

    def beside(found: list[Passed], effects: list[Effect]) -> list[list[Passed]]:
        """Return what was found with one more effect, for each that held-out links support."""
        model, number = found[-1].model, step.number + len(found)
        if number >= criteria.max_effects:
            return []
        hypotheses = Hypotheses.of(model.whole, model.fits[0], seed)
        longer = []
        for effect in effects:
            score, extended = fit_and_score(model, effect, block, tried, number, seed, criteria,
                                            executor, hypotheses)
            if extended is not None:
                longer.append([*found, Passed(effect, score, extended)])
        return longer

    def probability(found: list[Passed]) -> float:
        names = {each.score.name for each in found}
        others = [each.score.held_out_nats for each in ranked if each.score.name not in names]
        return probability_of_all([each.score for each in found], max([0.0, *others]), before,
                                  step.rest_db / step.noise_db)

    seconds = ([first.effect] if first.effect.repeatable else []) + [
        each.effect for each in ranked[1:] if each.effect is not first.effect]
    best = max(beside([first], seconds[:MAX_SECONDS]), key=probability, default=[])
    while best and probability(best) < criteria.min_probability:
        kind = {each.effect for each in best}
        more = beside(best, [first.effect]) \
            if len(kind) == 1 and len(best) < criteria.max_repeats else []
        best = more[0] if more and probability(more[0]) > probability(best) else []
    chance = probability(best) if best else 0.0
    return [replace(each, score=replace(each.score, reason="", probability=chance))
            for each in best]
