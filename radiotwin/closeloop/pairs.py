"""Two effects that are probable together, where neither is alone.

Two masts with sector antennas, or a displaced anchor and a receiver that drifts: each explains a
part, and beside the other's part in the residual its own is not much. So where the likeliest effect
is not probable enough, one more of its kind, or the next likeliest, is fitted beside it, and the
two are judged by what they explain together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from radiotwin.closeloop.criteria import SelectionCriteria
from radiotwin.closeloop.cross_validation import CrossValidatedModel
from radiotwin.closeloop.hypotheses import Hypotheses
from radiotwin.closeloop.posterior import Step, probability_of_both
from radiotwin.closeloop.scoring import CandidateScore, fit_candidate, score_candidate
from radiotwin.effects.base import Effect

MIN_SHARE = 0.5  # of the probability that is needed, for the first of two
MAX_SECONDS = 2  # effects that are tried beside it


@dataclass(frozen=True, eq=False)
class Passed:
    """A candidate that held-out links support: its effect, score, and the model with it."""

    effect: Effect
    score: CandidateScore
    model: CrossValidatedModel


def probable_pair(passed: Sequence[Passed], before: CrossValidatedModel, step: Step,
                  block: np.ndarray, tried: int, seed: int, criteria: SelectionCriteria,
                  on_progress: Callable[[str], None]) -> list[Passed]:
    """Return two effects that are probable together, in order; none where there are none.

    Args:
        passed: candidates of a step, none of which is probable enough.
        before: the model without them.
        step: what the residual says without them.
        block: (n,) piece of evidence of each link.
        tried: number of candidates.
        seed: of permutations.
        criteria: that decide.
        on_progress: called with what is being done.
    """
    ranked = sorted(passed, key=lambda each: -each.score.probability)
    if not ranked or ranked[0].score.probability < MIN_SHARE * criteria.min_probability:
        return []
    first, number = ranked[0], step.number + 1
    if number >= criteria.max_effects:
        return []
    seconds = ([first.effect] if first.effect.repeatable else []) + [
        each.effect for each in ranked[1:] if each.effect is not first.effect]
    on_progress(f"step {number}: {first.score.name}, beside another effect")
    hypotheses = Hypotheses.of(first.model.whole, first.model.fits[0], seed)
    found: list[Passed] = []
    for effect in seconds[:MAX_SECONDS]:
        candidate = fit_candidate(first.model, effect, number, criteria, hypotheses)
        if isinstance(candidate, CandidateScore):
            continue
        score, model = score_candidate(first.model, candidate, block, tried, number, seed, criteria)
        if model is None:
            continue
        others = [each.score.held_out_nats for each in ranked
                  if each.score.name not in (first.score.name, score.name)]
        probability = probability_of_both(first.score, score, max([0.0, *others]),
                                          step.best_unnamed, before.rmse_db(),
                                          step.rest_db / step.noise_db)
        if probability >= max([criteria.min_probability,
                               *(each.score.probability for each in found)]):
            found = [replace(first, score=replace(first.score, reason="", probability=probability)),
                     Passed(effect, replace(score, probability=probability), model)]
    return found
