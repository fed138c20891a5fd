"""Posterior probabilities: of an effect, of nothing, and of a cause that is not in the catalogue.

A logistic regression turns four kinds of numbers into a probability (Platt 1999, 'Probabilistic
outputs for support vector machines'): the evidence given correlated residuals, the held-out gain,
the ratio of place-bound residual to noise, and whether another kind of effect was found already. It
was fitted to ray-traced cases with known effects (`tests/undeclared`, and the foreign cities for
calibration; `python -m studies foreign` tests it on other cities). The weights are in
`calibration.json`, made by `python -m studies.calibration`.
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
    """Evidence and probabilities of causes at one step of the search.

    Attributes:
        number: number of effects found before.
        unnamed_nats: evidence for an unnamed curve over each variable.
        rest_db: standard deviation of the unexplained place-bound residual [dB].
        noise_db: standard deviation of noise [dB].
        probabilities: probability of each effect that was scored on held-out links, of `NONE` and
            of `OTHER`; they sum to 1.
    """

    number: int
    unnamed_nats: dict[str, float]
    rest_db: float
    noise_db: float
    probabilities: dict[str, float]

    @property
    def best_unnamed_nats(self) -> float:
        """Evidence for the best unnamed curve, at least 0 [nats]."""
        return max([0.0, *self.unnamed_nats.values()])


def judge(scores: Sequence[Trial], model: CrossFit, hypotheses: Hypotheses,
          criteria: SelectionCriteria) -> tuple[list[Trial], Step]:
    """Compute the probability of every candidate of a step, and refuse the improbable ones.

    Args:
        scores: trials of all candidates; those without held-out scores stay as they are.
        model: the fit without any candidate.
        hypotheses: evidence for further effects of that fit.
        criteria: a candidate that passed is refused below `min_probability`.

    Returns:
        the trials with probabilities, and the summary of the step.
    """
    rest_db, noise_db = hypotheses.rest_and_noise_db
    step = Step(len(model.whole.effects), hypotheses.unnamed_nats, rest_db, noise_db, {})
    judged = []
    for score in scores:
        if score.gain_by_fold.size:
            # Effects on levels do not compete with effects on detection.
            by_levels = bool(np.isfinite(score.evidence_nats))
            others = [each.nats for each in scores if each.name != score.name
                      and each.held_out_nats > 0
                      and (by_levels or not np.isfinite(each.evidence_nats))]
            score = with_probability(score, others, model, rest_db / noise_db, criteria)
        judged.append(score)
    return judged, replace(step, probabilities=_probabilities(judged, step.best_unnamed_nats,
                                                              rest_db, noise_db))


def with_probability(score: Trial, others: Sequence[float], model: CrossFit,
                     rest_over_noise: float, criteria: SelectionCriteria) -> Trial:
    """Compute the probability of an effect from its trial, and refuse the effect if it is too low.

    Args:
        score: trial of a candidate that was scored on held-out links.
        others: evidence for rival effects, by which the candidate is less probable [nats].
        model: the fit without the candidate.
        rest_over_noise: sd of the residual that depends on the place over the sd of noise.
        criteria: a candidate that passed is refused below `min_probability`.
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
    """Return `none` or `undecided` for a search that named no cause.

    `none` if the first step finds it probable that nothing is hidden, and the residual that depends
    on the place has a standard deviation of at most `max_rest_db`.

    Args:
        steps: summaries of the search; empty if no cause was searched for.
        criteria: thresholds.
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
    """Return the five features from which a logistic regression predicts an effect's probability.

    Args:
        nats: evidence given correlated residuals, gain on held-out links, and lead of the evidence
            over the best other effect that passed [nats].
        rest_over_noise: sd of the residual that depends on the place over the sd of noise.
        is_another_kind: whether an effect of another name was found already.
    """
    return (*np.arcsinh(np.array(nats) / NATS).tolist(),
            float(np.log(max(rest_over_noise, LEAST_RATIO))), float(is_another_kind))


def probability_of_all(scores: Sequence[Trial], other: float, before: CrossFit,
                       rest_over_noise: float) -> float:
    """Return the probability that several effects are all present, from the sum of their evidence.

    Args:
        scores: trials of the effects, each made with those before it in the model.
        other: evidence for the best other effect [nats].
        before: the fit without any of the effects.
        rest_over_noise: sd of the residual that depends on the place over the sd of noise, before.
    """
    evidence, held_out = (sum(each.nats for each in scores),
                          sum(each.held_out_nats for each in scores))
    kinds = {each.name for each in scores} | before.whole.model.effect_names
    values = features((evidence, held_out, evidence - other), rest_over_noise, len(kinds) > 1)
    return min(probability_of(each.name, values) for each in scores)


def probability_of(name: str, values: tuple[float, ...]) -> float:
    """Return the probability of an effect, given its name and its `features`."""
    weights = calibration()["effect"]
    return float(expit(weights["intercept"] + _calibrated_log_odds(name)
                       + np.dot(weights["weights"], values)))


@cache
def _calibrated_log_odds(name: str) -> float:
    """Return the log odds that the calibration adds for an effect of this name; the average is 0.

    An effect without a calibration has that of the effect named by `calibrated_like`, or else 0.
    """
    names = calibration()["effect"]["names"]
    return names[name] if name in names else max(
        (names.get(each.calibrated_like, 0.0) for each in effects_named(name)), default=0.0)


def _probabilities(scores: Sequence[Trial], unnamed_nats: float, rest_db: float,
                   noise_db: float) -> dict[str, float]:
    """Return probabilities by effect, of `NONE` and of `OTHER`, that sum to 1.

    `NONE`: nothing is hidden in the residual; `OTHER`: a cause that is not in the catalogue. An
    effect with several trials counts with its most probable one. The other arguments are those of
    `_probability_of_nothing`.
    """
    found: dict[str, float] = {}
    for score in scores:
        if np.isfinite(score.probability):
            found[score.name] = max(found.get(score.name, 0.0), score.probability)
    total = sum(found.values())
    missing = float(np.prod([1 - each for each in found.values()]))
    best = max([0.0, *(score.nats for score in scores if np.isfinite(score.nats))])
    none = missing * _probability_of_nothing(best, unnamed_nats, rest_db, noise_db)
    # Several effects may be present at once: their probabilities are scaled to the remaining share.
    named = {name: each * (1 - missing) / total for name, each in found.items()} if total else {}
    return named | {NONE: none, OTHER: missing - none}


def _probability_of_nothing(named_nats: float, unnamed_nats: float, rest_db: float,
                            noise_db: float) -> float:
    """Return the probability that nothing is hidden, if no effect of the catalogue is present.

    The evidence is for the best effect of the catalogue and for the best unnamed curve.
    """
    weights = calibration()["nothing"]
    values = [*np.arcsinh(np.array([named_nats, unnamed_nats]) / NATS), np.log(max(rest_db, 0.1)),
              np.log(max(noise_db, 0.1))]
    return float(expit(weights["intercept"] + np.dot(weights["weights"], values)))


@cache
def calibration() -> Mapping[str, dict]:
    """Return the weights of the logistic regressions: `effect`, and `nothing`."""
    return json.loads(files(__package__).joinpath("calibration.json").read_text(encoding="utf-8"))
