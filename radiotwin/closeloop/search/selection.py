"""Forward selection of effects.

Candidates are fitted on training folds, scored on held-out ones and beside errors of the base that
are correlated, and kept one by one as long as they are probable.

Effects that are probable together, where none is alone.

Three masts with sector antennas, or a displaced anchor and a receiver that drifts: each explains a
part, and beside the others' parts in the residual its own is not much. So where the likeliest
effect is not probable enough, one more of its kind, or the next likeliest, is fitted beside it, and
they are judged by what they explain together. More of a kind follow as long as that makes them
likelier.

The limit of detection of a receiver that reads too much or too little, moves with its readings.

A receiver hears the same signals whatever its cable or calibration adds to what it reads. Where its
blanks begin as many decibels from the usual limit as its readings are off, that is one fault.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.search.hypotheses import Hypotheses
from radiotwin.closeloop.search.posterior import Step, judge, probability_of_all
from radiotwin.closeloop.search.scoring import (
    Candidate,
    CandidateScore,
    fit_and_score,
    fit_candidate,
    score_candidate,
    score_model,
)
from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from radiotwin.closeloop.verdict.intervals import effect_size_db, why_not_borne_out
from radiotwin.effects.base import Effect
from radiotwin.effects.catalogue.detection_limit import DetectionLimit
from radiotwin.effects.catalogue.gain_offsets import ReceiverGainOffset
from radiotwin.links import evidence_blocks
from radiotwin.links.sites import site_of
from radiotwin.runtime.execution import Executor
from radiotwin.twin.model.correlated_shadowing import NAME as SHADOWING
from radiotwin.twin.model.correlated_shadowing import CorrelatedShadowing
from radiotwin.twin.model.fitting import prepare_additions, with_exact_levels

MIN_SHARE = 0.5  # of the probability that is needed, for the first of two
MAX_SECONDS = 2  # effects that are tried beside it
SAME_DB = 1.5  # between what the limit and what the readings are off
MIN_RIVAL_SHARE = 0.5  # of what the best gains, for several of a kind to be tried in its place
Outdone = list[tuple[Candidate, CandidateScore]]
"""Candidates that were not scored, and why not."""


@dataclass(frozen=True, eq=False)
class Passed:
    """A candidate that held-out links support: its effect, score, and the model with it."""

    effect: Effect
    score: CandidateScore
    model: CrossFit


def probable_together(passed: Sequence[Passed], before: CrossFit, step: Step,
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
        hypotheses = Hypotheses.of(model.whole, seed)
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


def with_moved_limits(model: CrossFit) -> CrossFit:
    """Return a model in which limits are moved by the offsets of receivers that were kept last.

    Args:
        model: of n links; any other last effect leaves it as it is.
    """
    whole = model.whole
    offsets = whole.effects[-1]
    if not isinstance(offsets.effect, ReceiverGainOffset):
        return model
    limits = DetectionLimit().propose(whole.view)
    own_db = whole.coefficients_of(-1)
    off_db = dict(zip(offsets.params.members, own_db - np.median(own_db), strict=True))
    limit_db = model.links.limit_db.copy()
    for receiver, found_db in (limits[0].receivers if limits else {}).items():
        mine = model.links.receiver == receiver
        if abs(found_db - np.median(limit_db[mine]) - off_db.get(receiver, np.inf)) <= SAME_DB:
            limit_db[mine] = found_db
    if np.array_equal(limit_db, model.links.limit_db):
        return model
    return model.map(lambda fit: replace(
        fit.model, links=fit.links.with_columns(limit_db=limit_db)).fit(fit))


@dataclass(eq=False)
class SelectionResult:
    """Result of the forward selection.

    Attributes:
        model: base and effects; kept effects are in the order of the steps.
        criteria: thresholds that decided.
        scores: candidates, step by step, and effects that the data do not allow to be looked for.
            Of faults those kept and, once no more passed, the last ones refused; of effects beside
            another (pairs, more of a kind) those kept.
        notes: what was found about effects that are declared, a sentence each.
        rivals: of each kept effect, names of those that the data cannot tell from it.
        steps: what each step's residual says, the first step first; the last is of what is left.
        explained: the model before any last resort.
        looked_at: the model that was looked at last, and the hypotheses about what it lacks.
        executor: where candidates are fitted.
    """

    model: CrossFit
    criteria: SelectionCriteria = field(default_factory=SelectionCriteria)
    scores: list[CandidateScore] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    rivals: list[list[str]] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    explained: CrossFit | None = None
    looked_at: tuple[CrossFit, Hypotheses] | None = None
    executor: Executor = field(default_factory=Executor)

    @property
    def is_full(self) -> bool:
        """Whether no more effects may be added."""
        return len(self.model.whole.effects) >= self.criteria.max_effects

    def hypotheses(self, seed: int) -> Hypotheses:
        """Return the hypotheses about what the model lacks, made once for each model."""
        if self.looked_at is None or self.looked_at[0] is not self.model:
            found = Hypotheses.of(self.model.whole, seed)
            self.looked_at = self.model, found
        return self.looked_at[1]

    def keep(self, score: CandidateScore, model: CrossFit) -> None:
        """Take over a model with one more effect; it may have been scored in other folds."""
        self.model = model
        self.scores.append(replace(score, kept=True, rmse_db=model.rmse_db()))
        self.rivals.append([])


def forward_selection(result: SelectionResult, effects: list[Effect], seed: int,
                      on_progress: Callable[[str], None]) -> None:
    """Add to the model the effect with the most evidence, and again, until none passes.

    Args:
        result: is extended.
        effects: candidates, causes or (then they need not be probable) descriptions.
        seed: of permutations.
        on_progress: called with what is being done.
    """
    if not effects:  # nothing to ask, and so no step
        return
    block = evidence_blocks(result.model.links)
    available = []
    for effect in effects:
        why = effect.unavailable(result.model.links)
        if why:
            result.scores.append(CandidateScore(effect.name, reason=f"not looked for: {why}",
                                                variant=effect.variant))
        else:
            available.append(effect)
    causes = all(effect.is_cause for effect in effects)
    while not result.is_full:
        step = len(result.model.whole.effects)
        hypotheses, judged = None, []
        if causes:
            on_progress(f"step {step + 1}: what the base may be wrong in")
            hypotheses = result.hypotheses(seed)
        passed, outdone = _score_all(result, available, block, hypotheses, seed, on_progress)
        if hypotheses is not None:
            judged = _judged(result, passed, hypotheses, step)
            passed = [each for each in judged if not each.score.reason]
            if not passed and outdone:
                # What gains most is not probable; what it has outdone may be.
                unasked = {id(score) for _, score in outdone}
                result.scores = [each for each in result.scores if id(each) not in unasked]
                judged += _score(result, [candidate for candidate, _ in outdone], available, block,
                                 seed, on_progress)[0]
                judged = _judged(result, judged, hypotheses, step)
                passed = [each for each in judged if not each.score.reason]
            if not passed:
                together = probable_together(judged, result.model, result.steps[-1], block,
                                             len(available), seed, result.criteria, result.executor,
                                             on_progress)
                if together and _all_borne_out(together[-1].model, len(together)):
                    _keep_together(result, together, step)
                    continue
        if not passed:
            break
        _keep_best(result, passed, judged, block, hypotheses, seed, step, on_progress)
    # A rival that gains beside the effect is another effect; else it is another name for it.
    last = max((entry.step for entry in result.scores), default=0)
    alive = {entry.name for entry in result.scores
             if entry.kept or (entry.step == last and entry.reason == "")}
    result.rivals = [sorted(set(rivals) - alive) for rivals in result.rivals]


def _score_all(result: SelectionResult, available: list[Effect], block: np.ndarray,
               hypotheses: Hypotheses | None, seed: int,
               on_progress: Callable[[str], None]) -> tuple[list[Passed], Outdone]:
    """Score every available effect in one step.

    Returns:
        those that pass, and those beside which a better one made it needless to ask held-out links.
    """
    step = len(result.model.whole.effects)
    candidates: list[Candidate] = []
    here = [each.effect for each in result.model.whole.effects]
    tried = [effect for effect in available
             if effect.repeatable or not any(each is effect for each in here)]
    prepare_additions([result.model.whole], tried, result.executor)
    for effect in tried:
        on_progress(f"step {step + 1}: {effect.name}")
        candidate = fit_candidate(result.model, effect, step, result.criteria, hypotheses)
        if isinstance(candidate, CandidateScore):
            result.scores.append(candidate)
        else:
            candidates.append(candidate)
    return _score(result, candidates, available, block, seed, on_progress, needless=_beyond)


def _score(result: SelectionResult, candidates: list[Candidate], available: list[Effect],
           block: np.ndarray, seed: int, on_progress: Callable[[str], None],
           needless: Callable[..., bool] = lambda *_: False) -> tuple[list[Passed], Outdone]:
    """Score candidates of one step, but for those that are `needless` beside one that passed."""
    step = len(result.model.whole.effects)
    passed: list[Passed] = []
    outdone: Outdone = []
    for candidate in sorted(candidates, key=lambda candidate: -candidate.gain):
        effect = candidate.effect
        better = next((each for each in passed
                       if needless(each, candidate, result.model, result.criteria)), None)
        if better is None:
            on_progress(f"step {step + 1}: {effect.name}, held out")
            # One more of a kind needs no correction: that there is such a thing has been shown.
            more = any(each.effect is effect for each in result.model.whole.effects)
            corrected_for = 1 if more else len(available)
            score, extended = score_candidate(result.model, candidate, block, corrected_for, step,
                                              seed, result.criteria, result.executor)
        else:
            why = (f"{better.score.name} gains more on held-out links than this on those that it "
                   f"is fitted to ({candidate.gain:.0f} nats)")
            score, extended = CandidateScore(effect.name, reason=why, step=step,
                                             evidence_nats=candidate.evidence,
                                             variant=effect.variant), None
            outdone.append((candidate, score))
        result.scores.append(score)
        if extended is not None:
            passed.append(Passed(effect, score, extended))
    return passed, outdone


def _judged(result: SelectionResult, passed: list[Passed], hypotheses: Hypotheses,
            step: int) -> list[Passed]:
    """Give all scores of a step their probabilities; return what passed with its own.

    What is probable is refused where held-out links may show nothing of it.
    """
    here = [i for i, entry in enumerate(result.scores) if entry.step == step]
    judged, summary = judge([result.scores[i] for i in here], result.model,
                            hypotheses, result.criteria)
    result.steps = [*(each for each in result.steps if each.number < step), summary]
    place = {id(result.scores[i]): n for n, i in enumerate(here)}
    found = []
    for each in passed:
        score = judged[place[id(each.score)]]
        if not score.reason:
            why = why_not_borne_out(effect_size_db(each.model, step))
            score = judged[place[id(each.score)]] = replace(score, reason=why)
        found.append(replace(each, score=score))
    for i, score in zip(here, judged, strict=True):
        result.scores[i] = score
    return found


def _all_borne_out(model: CrossFit, last: int) -> bool:
    """Return whether each of a model's last effects is larger than nothing at all."""
    count = len(model.whole.effects)
    return not any(why_not_borne_out(effect_size_db(model, number))
                   for number in range(count - last, count))


def _keep_together(result: SelectionResult, found: list[Passed], step: int) -> None:
    """Keep effects that are probable together."""
    first = found[0].score
    for i, entry in enumerate(result.scores):
        same = (entry.name, entry.variant) == (first.name, first.variant)
        if entry.step == step and same and entry.passed:
            result.scores[i] = replace(first, kept=True)
            break
    result.scores += [replace(each.score, kept=True) for each in found[1:]]
    result.rivals += [[] for _ in found]
    result.model = _settled(found[-1].model)


def _keep_best(result: SelectionResult, passed: list[Passed], supported: list[Passed],
               block: np.ndarray, hypotheses: Hypotheses | None, seed: int, step: int,
               on_progress: Callable[[str], None]) -> None:
    """Keep the best of the candidates that passed, or several of one kind that are better.

    Of a kind that held-out links support, though one alone is not probable beside the best: groves
    beside an offset of each device.
    """
    criteria = result.criteria
    passed.sort(key=lambda each: -each.score.held_out_nats)
    # Of those that the data cannot tell apart the one with the least error.
    most_nats = passed[0].score.held_out_nats
    close = [each for each in passed if _alike(most_nats, each.score, criteria)]
    passed.sort(key=lambda each: each.score.rmse_db if each in close else np.inf)
    first = passed[0]
    steps = [(first.score, first.model)]
    least = first.score.held_out_nats
    rival = next((each for each in passed[1:] if each.effect.repeatable), None)
    if rival is None and not first.effect.repeatable:
        rival = max((each for each in supported if each.effect.repeatable
                     and each.score.held_out_nats >= MIN_RIVAL_SHARE * least),
                    key=lambda each: each.score.held_out_nats, default=None)
    most = criteria.max_repeats if not first.effect.repeatable else _on_one_mast(first.model)
    if rival is not None and most > 1:
        on_progress(f"step {step + 1}: more of {rival.score.name}")
        several = _several(result, rival, block, hypotheses, seed, least, most)
        if several and rival.score.reason:
            several = _if_likelier(result, several, first.score)
        steps = several or steps
    best, nats = steps[0][0], sum(score.held_out_nats for score, _ in steps)
    rivals = [each.score.name for each in passed
              if each.score.name != best.name and _alike(nats, each.score, criteria)]
    for i, entry in enumerate(result.scores):
        # A step's number comes twice where a fault that was kept before it was taken back.
        if entry.step == step and entry.reason == "" and not entry.kept:
            reason = "" if entry is best else f"{best.name} explains more"
            result.scores[i] = replace(entry, kept=entry is best, reason=reason)
    result.scores += [replace(score, kept=True) for score, _ in steps[1:]]
    result.rivals += [rivals, *([] for _ in steps[1:])]
    on_progress(f"step {step + 1}: {best.name}, exactly")
    result.model = _settled(steps[-1][1])


def _if_likelier(result: SelectionResult, several: list[tuple[CandidateScore, CrossFit]],
                 best: CandidateScore) -> list[tuple[CandidateScore, CrossFit]]:
    """Return several of a kind with the probability that all are there, if it exceeds the best's.

    Of the first, what is among the scores is replaced.
    """
    scores, step = [score for score, _ in several], result.steps[-1]
    chance = probability_of_all(scores, best.held_out_nats, result.model,
                                step.rest_db / step.noise_db)
    if chance < max(best.probability, result.criteria.min_probability):
        return []
    found = [(replace(score, reason="", probability=chance), model) for score, model in several]
    result.scores = [found[0][0] if score is scores[0] else score for score in result.scores]
    return found


def _beyond(passed: Passed, candidate: Candidate, model: CrossFit,
            criteria: SelectionCriteria) -> bool:
    """Return whether an effect that passed gains so much that another need not be scored.

    On held-out links the other can hardly gain more than on those that it is fitted to. One of a
    kind of which there may be several gets its chance, and so does one with more evidence.
    """
    lead = passed.score.nll_gain - candidate.gain
    design_effect = model.whole.view.design_effect
    clear = lead > criteria.indistinguishable_nats * design_effect
    more = candidate.evidence > passed.score.evidence_nats
    return clear and not more and (passed.effect.repeatable or not candidate.effect.repeatable)


def _alike(nats: float, other: CandidateScore, criteria: SelectionCriteria) -> bool:
    """Return whether an effect gains about as much on held-out links as others, `nats`."""
    return nats - other.held_out_nats < criteria.indistinguishable_nats


def _on_one_mast(model: CrossFit) -> int:
    """Return how many devices the last effect acts on, if they are all on one mast; else 0."""
    applied, links = model.whole.effects[-1], model.links
    devices = np.unique(links.device[applied.acts])
    on_mast = len(devices) and set(devices) <= set(site_of(links, devices[0]))
    return len(devices) if on_mast else 0


def _several(result: SelectionResult, rival: Passed, block: np.ndarray,
             hypotheses: Hypotheses | None, seed: int, min_nats: float, most: int,
             ) -> list[tuple[CandidateScore, CrossFit]] | None:
    """Add an effect of which a step finds one again and again, until all have more than `min_nats`.

    Such as groves or towers, each seen from few devices, against an offset for each device; or
    antennas against another position of the mast that carries them. None where it does not.
    """
    steps = [(rival.score, rival.model)]
    score, extended = steps[0]
    while len(extended.whole.effects) < result.criteria.max_effects and len(steps) < most:
        if hypotheses is not None:
            hypotheses = Hypotheses.of(extended.whole, seed)
        score, more = fit_and_score(extended, rival.effect, block, 1, score.step + 1, seed,
                                    result.criteria, result.executor, hypotheses)
        if more is None:
            return None
        extended = more
        score = replace(score, probability=rival.score.probability)
        steps.append((score, extended))
        if sum(score.held_out_nats for score, _ in steps) > min_nats:
            return steps if _all_borne_out(extended, len(steps)) else None
    return None


def _settled(model: CrossFit) -> CrossFit:
    """Return a model with exact levels where these explain its training links better."""
    return with_moved_limits(model.map(with_exact_levels))


def add_shadowing(result: SelectionResult, seed: int) -> None:
    """Interpolate the rest over the ground; keep that if it predicts held-out links better."""
    model = result.model
    step = len(model.whole.effects)
    fields = [CorrelatedShadowing.fit(each, seed) for each in model.each]
    # Where what it learnt does not return on held-out flights, its mean may be right and its
    # certainty is not.
    for tried in (fields, [replace(each, certain=False) for each in fields]):
        extended = model.with_shadowing(tried)
        score = score_model(model, extended, CandidateScore(SHADOWING, step=step), None, 1, seed,
                       result.criteria, nlos_only=True)
        if not score.reason:
            result.scores.append(replace(score, kept=True))
            result.model = extended
            return
    result.scores.append(score)
