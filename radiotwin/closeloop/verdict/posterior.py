"""How probable it is that an effect is there, that nothing is, or something that has no name.

Nats are worth what they turned out to be worth: a logistic regression, fitted on traced cases
(`tests/undeclared`, of the foreign worlds the cities for calibration; `python -m studies foreign`
judges it on the others), turns evidence beside a correlated rest, what held-out links gain, how
much of the rest belongs to places (a map that is wrong, or none), and whether an effect of another
kind is there already (two are rarer than one) into a probability (Platt 1999, 'Probabilistic
outputs for support vector machines'). Its few numbers are in `calibration.json`, made by
`python -m studies.calibration`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files

import numpy as np
from scipy.special import expit

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.search.trials import Trial
from radiotwin.closeloop.verdict.criteria import LEAST_RATIO, NATS, SelectionCriteria
from radiotwin.closeloop.verdict.hypotheses import Hypotheses
from radiotwin.effects.registry import effects_named

NONE, OTHER = "none", "not in the catalogue"


@dataclass(frozen=True)
class Step:
    """Evidence in the residual at one step.

    Attributes:
        number: of effects that were there.
        unnamed_nats: evidence for a curve without a name over each variable.
        rest_db: standard deviation of what belongs to places and has no name [dB].
        noise_db: and of what belongs to nothing.
        probabilities: of each effect that was scored on held-out links, passed or not, of `NONE`
            and of `OTHER`; they sum to 1.
    """

    number: int
    unnamed_nats: dict[str, float]
    rest_db: float
    noise_db: float
    probabilities: dict[str, float]

    @property
    def best_unnamed(self) -> float:
        """Most evidence for a curve without a name, at least 0 [nats]."""
        return max([0.0, *self.unnamed_nats.values()])


def judge(scores: Sequence[Trial], model: CrossFit, hypotheses: Hypotheses,
          criteria: SelectionCriteria) -> tuple[list[Trial], Step]:
    """Return a step's scores with their probabilities, and what the step says.

    Args:
        scores: of every candidate of the step.
        model: without any of them.
        hypotheses: about what it lacks.
        criteria: a candidate that passed is refused below `min_probability`.
    """
    rest_db, noise_db = hypotheses.sizes_db
    step = Step(len(model.whole.effects), hypotheses.unnamed_nats, rest_db, noise_db, {})
    judged = []
    for score in scores:
        if score.gain_by_fold.size:
            # What makes links blank has no rival among what changes levels, nor among curves.
            by_levels = bool(np.isfinite(score.evidence_nats))
            others = [each.nats for each in scores if each.name != score.name
                      and each.held_out_nats > 0
                      and (by_levels or not np.isfinite(each.evidence_nats))]
            score = with_probability(score, others, model, rest_db / noise_db, criteria)
        judged.append(score)
    return judged, replace(step, probabilities=_probabilities(judged, step.best_unnamed, rest_db,
                                                              noise_db))


def with_probability(score: Trial, others: Sequence[float], model: CrossFit,
                     rest_over_noise: float, criteria: SelectionCriteria) -> Trial:
    """Return a score with the probability of its effect; refused where that is too low.

    Args:
        score: of a candidate that was scored on held-out links.
        others: evidence for its rivals [nats].
        model: without it.
        rest_over_noise: standard deviations of what belongs to places and of noise.
        criteria: one that passed is refused below `min_probability`.
    """
    nats = score.nats, score.held_out_nats, score.nats - max([0.0, *others])
    is_another_kind = bool(model.whole.model.effect_names - {score.name})
    score = replace(score, features=features(nats, rest_over_noise, is_another_kind))
    probability = probability_of(score.name, score.features)
    low = probability < criteria.min_probability
    why = (f"it is not probable enough ({probability:.2f}; {criteria.min_probability:g} is "
           "needed)") if low else ""
    return replace(score, probability=probability, reason=why if score.passed else score.reason)


def verdict_without_effect(steps: Sequence[Step], criteria: SelectionCriteria) -> str:
    """Return `none` or `undecided`, where no cause was named.

    It is `none` where it is probable that nothing is hidden and no more than `max_rest_db` belongs
    to places. The first step decides: descriptions of the rest have no part in it.

    Args:
        steps: what the residual says; none where no cause was looked for.
        criteria: that decide.
    """
    if not steps:
        return "undecided"
    first = steps[0]
    likeliest = max(first.probabilities, key=lambda name: first.probabilities[name])
    if likeliest == OTHER or first.rest_db > criteria.max_rest_db:
        return "undecided"
    return "none" if first.probabilities[NONE] >= criteria.min_probability else "undecided"


def features(nats: tuple[float, float, float], rest_over_noise: float,
             is_another_kind: bool) -> tuple[float, ...]:
    """Return what a candidate's probability depends on, (5,).

    Args:
        nats: its evidence beside a correlated rest, its gain on held-out links, and the lead of its
            evidence over that of the best other effect that held-out links support [nats].
        rest_over_noise: standard deviations of what belongs to places and of noise.
        is_another_kind: whether an effect of another name is there already.
    """
    return (*np.arcsinh(np.array(nats) / NATS).tolist(),
            float(np.log(max(rest_over_noise, LEAST_RATIO))), float(is_another_kind))


def probability_of_all(scores: Sequence[Trial], other: float, before: CrossFit,
                       rest_over_noise: float) -> float:
    """Return the probability that several effects are there, from what they explain together.

    Args:
        scores: each of a model with those before it.
        other: most evidence for any other effect [nats].
        before: the model without any of them.
        rest_over_noise: standard deviations of what belongs to places and of noise, without them.
    """
    evidence, held_out = (sum(each.nats for each in scores),
                          sum(each.held_out_nats for each in scores))
    kinds = {each.name for each in scores} | before.whole.model.effect_names
    values = features((evidence, held_out, evidence - other), rest_over_noise, len(kinds) > 1)
    return min(probability_of(each.name, values) for each in scores)


def probability_of(name: str, values: tuple[float, ...]) -> float:
    """Return the probability that an effect is there, from its `features`."""
    weights = calibration()["effect"]
    own = _log_odds_of(name)
    return float(expit(weights["intercept"] + own + np.dot(weights["weights"], values)))


@cache
def _log_odds_of(name: str) -> float:
    """Return how much likelier an effect is, for the same evidence, than effects are on the whole.

    Of one without a calibration as of the effect that it is `calibrated_like`, or else 0, the mean
    around which the calibration was fitted.
    """
    names = calibration()["effect"]["names"]
    return names[name] if name in names else max(
        (names.get(each.calibrated_like, 0.0) for each in effects_named(name)), default=0.0)


def _probabilities(scores: Sequence[Trial], unnamed: float, rest_db: float,
                   noise_db: float) -> dict[str, float]:
    found: dict[str, float] = {}
    for score in scores:
        if np.isfinite(score.probability):
            found[score.name] = max(found.get(score.name, 0.0), score.probability)
    total = sum(found.values())
    missing = float(np.prod([1 - each for each in found.values()]))
    best = max([0.0, *(score.nats for score in scores if np.isfinite(score.nats))])
    none = missing * _probability_of_nothing(best, unnamed, rest_db, noise_db)
    # Two effects may both be there: shares of what is not "none" nor without a name.
    named = {name: each * (1 - missing) / total for name, each in found.items()} if total else {}
    return named | {NONE: none, OTHER: missing - none}


def _probability_of_nothing(best: float, unnamed: float, rest_db: float, noise_db: float) -> float:
    """Return the probability that nothing is hidden where no effect of the catalogue is.

    From the most evidence for an effect, and for a curve without a name [nats].
    """
    weights = calibration()["nothing"]
    values = [*np.arcsinh(np.array([best, unnamed]) / NATS), np.log(max(rest_db, 0.1)),
              np.log(max(noise_db, 0.1))]
    return float(expit(weights["intercept"] + np.dot(weights["weights"], values)))


@cache
def calibration() -> Mapping[str, dict]:
    """Return the numbers of both logistic regressions."""
    return json.loads(files(__package__).joinpath("calibration.json").read_text(encoding="utf-8"))
