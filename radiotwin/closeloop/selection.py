"""Forward selection of effects.

Candidates are fitted on training folds, scored on held-out ones, and kept one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from radiotwin.closeloop.criteria import SelectionCriteria
from radiotwin.closeloop.cross_validation import CrossValidatedModel
from radiotwin.effects.base import Effect
from radiotwin.effects.correlated_shadowing import NAME as SHADOWING
from radiotwin.effects.correlated_shadowing import CorrelatedShadowing
from radiotwin.effects.fitting import add_effect, with_exact_levels
from radiotwin.effects.fold_model import FoldModel
from radiotwin.inference.censored_regression import FitResult
from radiotwin.inference.evidence import cross_fit_p_value, sign_flip_p_value
from radiotwin.links import evidence_blocks
from radiotwin.links.sites import site_of


@dataclass(frozen=True, eq=False)
class CandidateScore:
    """A candidate of one step, and what held-out links say of it.

    Attributes:
        name: of the effect.
        kept: whether it was added.
        reason: why not; empty where it was.
        nll_gain: held-out likelihood gained [nats]; NaN where it was not tried.
        rmse_db: held-out RMSE with it [dB].
        p_value: of no gain, links that err alike counted as one, corrected for the candidates.
        step: number of effects that were there before.
        gain_by_fold: (folds,) `nll_gain` of each fold over the number of links that count as one;
            empty where it was not tried.
    """

    name: str
    kept: bool = False
    reason: str = ""
    nll_gain: float = np.nan
    rmse_db: float = np.nan
    p_value: float = np.nan
    step: int = 0
    gain_by_fold: np.ndarray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class Candidate:
    """An effect fitted to all links, and how much likelier they are with it [nats]."""

    effect: Effect
    whole: FoldModel
    fit: FitResult
    gain: float


@dataclass(eq=False)
class SelectionResult:
    """Result of the forward selection.

    Attributes:
        model: base and kept effects.
        criteria: that decided.
        scores: every candidate of every step.
        rivals: of each kept effect, names of those that the data cannot tell from it.
        explained: the model before any last resort.
    """

    model: CrossValidatedModel
    criteria: SelectionCriteria = field(default_factory=SelectionCriteria)
    scores: list[CandidateScore] = field(default_factory=list)
    rivals: list[list[str]] = field(default_factory=list)
    explained: CrossValidatedModel | None = None

    @property
    def is_full(self) -> bool:
        """Whether no more effects may be added."""
        return len(self.model.whole.effects) >= self.criteria.max_effects

    @property
    def named(self) -> CrossValidatedModel:
        """Base and what has a name, with the rest if it was interpolated of that alone."""
        named = self.explained or self.model
        same = len(named.whole.effects) == len(self.model.whole.effects)
        return self.model if same else named

    def keep(self, score: CandidateScore, model: CrossValidatedModel) -> None:
        """Take over a model with one more effect."""
        self.model = model
        self.scores.append(replace(score, kept=True))
        self.rivals.append([])


@dataclass(frozen=True, eq=False)
class _Passed:
    """A candidate that passed: its effect, score, and the model with it."""

    effect: Effect
    score: CandidateScore
    model: CrossValidatedModel


def forward_selection(result: SelectionResult, effects: list[Effect], seed: int,
                      on_progress: Callable[[str], None]) -> None:
    """Add to the model the effect that gains most, and again, until none passes.

    Args:
        result: is extended.
        effects: candidates.
        seed: of permutations.
        on_progress: called with what is being done.
    """
    block = evidence_blocks(result.model.links)
    available = []
    for effect in effects:
        why = effect.unavailable(result.model.links)
        if why:
            result.scores.append(CandidateScore(effect.name, reason=f"not looked for: {why}"))
        else:
            available.append(effect)
    while not result.is_full:
        step = len(result.model.whole.effects)
        passed = _score_all(result, available, block, seed, on_progress)
        if not passed:
            break
        _keep_best(result, passed, block, seed, step, on_progress)
    # A rival that gains beside the effect is another effect; else it is another name for it.
    last = max((entry.step for entry in result.scores), default=0)
    alive = {entry.name for entry in result.scores
             if entry.kept or (entry.step == last and entry.reason == "")}
    result.rivals = [sorted(set(rivals) - alive) for rivals in result.rivals]


def _score_all(result: SelectionResult, available: list[Effect], block: np.ndarray, seed: int,
               on_progress: Callable[[str], None]) -> list[_Passed]:
    """Score every available effect in one step; return those that pass."""
    step = len(result.model.whole.effects)
    candidates: list[Candidate] = []
    for effect in available:
        on_progress(f"step {step + 1}: {effect.name}")
        here = [each.effect for each in result.model.whole.effects]
        if not effect.repeatable and any(each is effect for each in here):
            continue
        candidate = fit_candidate(result.model, effect, step, result.criteria)
        if isinstance(candidate, CandidateScore):
            result.scores.append(candidate)
        else:
            candidates.append(candidate)
    passed: list[_Passed] = []
    for candidate in sorted(candidates, key=lambda candidate: -candidate.gain):
        effect = candidate.effect
        better = next((each for each in passed
                       if _beyond(each, candidate, result.model, result.criteria)), None)
        if better is None:
            on_progress(f"step {step + 1}: {effect.name}, held out")
            # One more of a kind needs no correction: that there is such a thing has been shown.
            more = any(each.effect is effect for each in result.model.whole.effects)
            tried = 1 if more else len(available)
            score, extended = score_candidate(result.model, candidate, block, tried, step, seed,
                                              result.criteria)
        else:
            why = (f"{better.score.name} gains more on held-out links than this on those that it "
                   f"is fitted to ({candidate.gain:.0f} nats)")
            score, extended = CandidateScore(effect.name, reason=why, step=step), None
        result.scores.append(score)
        if extended is not None:
            passed.append(_Passed(effect, score, extended))
    return passed


def _keep_best(result: SelectionResult, passed: list[_Passed], block: np.ndarray, seed: int,
               step: int, on_progress: Callable[[str], None]) -> None:
    """Keep the best of the candidates that passed, or several of one kind that are better."""
    criteria, alike = result.criteria, partial(_alike, criteria=result.criteria)
    passed.sort(key=lambda each: -each.score.nll_gain)
    # Of those that the data cannot tell apart the one with the least error.
    close = [each for each in passed if alike(passed[0].score, each.score)]
    passed.sort(key=lambda each: each.score.rmse_db if each in close else np.inf)
    first = passed[0]
    steps = [(first.score, first.model)]
    rival = next((each for each in passed[1:] if each.effect.repeatable), None)
    most = criteria.max_repeats if not first.effect.repeatable else _on_one_mast(first.model)
    if rival is not None and most > 1:
        on_progress(f"step {step + 1}: more of {rival.score.name}")
        steps = _several(rival, block, seed, first.score.nll_gain, most, criteria) or steps
    best = steps[0][0]
    rivals = [each.score.name for each in passed
              if each.score.name != best.name and alike(best, each.score)]
    for i, entry in enumerate(result.scores):
        if entry.step == step and entry.reason == "":
            reason = "" if entry is best else f"{best.name} gains more"
            result.scores[i] = replace(entry, kept=entry is best, reason=reason)
    result.scores += [replace(score, kept=True) for score, _ in steps[1:]]
    result.rivals += [rivals, *([] for _ in steps[1:])]
    on_progress(f"step {step + 1}: {best.name}, exactly")
    result.model = _exactly(steps[-1][1])


def _beyond(passed: _Passed, candidate: Candidate, model: CrossValidatedModel,
            criteria: SelectionCriteria) -> bool:
    """Return whether an effect that passed gains so much that another need not be scored.

    On held-out links the other can hardly gain more than on those that it is fitted to. One of a
    kind of which there may be several gets its chance.
    """
    lead = passed.score.nll_gain - candidate.gain
    design_effect = model.whole.view(model.fits[0]).design_effect
    clear = lead > criteria.indistinguishable_nats * design_effect
    return clear and (passed.effect.repeatable or not candidate.effect.repeatable)


def _alike(best: CandidateScore, other: CandidateScore, criteria: SelectionCriteria) -> bool:
    lead = best.gain_by_fold.sum() - other.gain_by_fold.sum()
    return lead < criteria.indistinguishable_nats


def _on_one_mast(model: CrossValidatedModel) -> int:
    """Return how many devices the last effect acts on, if they are all on one mast; else 0."""
    applied, links = model.whole.effects[-1], model.links
    acts = (applied.term.offset_db != 0) | (applied.term.columns != 0).any(axis=1)
    devices = np.unique(links.device[acts])
    on_mast = len(devices) and set(devices) <= set(site_of(links, devices[0]))
    return len(devices) if on_mast else 0


def _several(rival: _Passed, block: np.ndarray, seed: int, min_gain: float, most: int,
             criteria: SelectionCriteria,
             ) -> list[tuple[CandidateScore, CrossValidatedModel]] | None:
    """Add an effect of which a step finds one again and again, until it gains more than `min_gain`.

    Such as groves or towers, each seen from few devices, against an offset for each device; or
    antennas against another position of the mast that carries them. None where it does not.
    """
    steps = [(rival.score, rival.model)]
    score, extended = steps[0]
    while len(extended.whole.effects) < criteria.max_effects and len(steps) < most:
        candidate = fit_candidate(extended, rival.effect, score.step + 1, criteria)
        if isinstance(candidate, CandidateScore):
            return None
        score, more = score_candidate(extended, candidate, block, 1, score.step + 1, seed, criteria)
        if more is None:
            return None
        extended = more
        steps.append((score, extended))
        if sum(score.nll_gain for score, _ in steps) > min_gain:
            return steps
    return None


def _exactly(model: CrossValidatedModel) -> CrossValidatedModel:
    """Ask each model's channel for exact levels, where these explain its training links better."""
    exact = [with_exact_levels(each, fit)
             for each, fit in zip(model.models, model.fits, strict=True)]
    return model.extended([each for each, _ in exact], [fit for _, fit in exact])


def add_shadowing(result: SelectionResult, seed: int) -> None:
    """Interpolate the rest over the ground; keep that if it predicts held-out links better."""
    model = result.model
    step = len(model.whole.effects)
    fields = [CorrelatedShadowing.fit(each, fit, seed)
              for each, fit in zip(model.models, model.fits, strict=True)]
    # Where what it learnt does not return on held-out flights, its mean may be right and its
    # certainty is not.
    for tried in (fields, [replace(each, certain=False) for each in fields]):
        extended = model.with_shadowing(tried)
        score = _score(model, extended, CandidateScore(SHADOWING, step=step), None, 1, seed,
                       result.criteria, nlos_only=True)
        if not score.reason:
            result.scores.append(replace(score, kept=True))
            result.model = extended
            return
    result.scores.append(score)


def fit_candidate(model: CrossValidatedModel, effect: Effect, step: int,
                  criteria: SelectionCriteria) -> Candidate | CandidateScore:
    """Fit a candidate to all links; return a score with the reason if that refuses it already."""
    refused = CandidateScore(effect.name, step=step)
    whole = add_effect(model.whole, effect, model.fits[0])
    if whole is None:
        return replace(refused, reason="nothing in the residual looks like it")
    coefficients = whole[1].coefficients[whole[0].coefficient_slices[-1]]
    why = effect.implausible(whole[0].effects[-1].params, coefficients)
    if why:
        return replace(refused, reason=why)
    gain = model.fits[0].objective - whole[1].objective
    if gain < criteria.min_training_gain_nats:
        return replace(refused, reason=f"gains less than {criteria.min_training_gain_nats:.0f} "
                       "nats even on the links that it is fitted to")
    return Candidate(effect, *whole, gain)


def score_candidate(model: CrossValidatedModel, candidate: Candidate, block: np.ndarray, tried: int,
                    step: int, seed: int, criteria: SelectionCriteria,
                    ) -> tuple[CandidateScore, CrossValidatedModel | None]:
    """Fit a candidate to each fold's training links, and score it on the others.

    Args:
        model: without it.
        candidate: fitted to all links.
        block: (n,) piece of evidence of each link.
        tried: number of candidates, that the p-value is corrected for.
        step: number of effects that are there.
        seed: of permutations.
        criteria: that decide.

    Returns:
        the score, and the model with it; None where it does not pass.
    """
    models, fits = [candidate.whole], [candidate.fit]
    like = candidate.whole.effects[-1].params
    for each, fit in zip(model.folds, model.fits[1:], strict=True):
        extended_fold, extended_fit = add_effect(each, candidate.effect, fit, like) or (each, fit)
        models.append(extended_fold)
        fits.append(extended_fit)
    extended = model.extended(models, fits)
    score = _score(model, extended, CandidateScore(candidate.effect.name, step=step), block, tried,
                   seed, criteria, nlos_only=candidate.effect.nlos_only)
    return score, None if score.reason else extended


def _score(model: CrossValidatedModel, extended: CrossValidatedModel, score: CandidateScore,
           block: np.ndarray | None, tried: int, seed: int, criteria: SelectionCriteria,
           nlos_only: bool = False) -> CandidateScore:
    """Return what held-out links say of an extended model; with the reason where it is refused.

    Without pieces of evidence `block` (n,) the gain may hang on a few positions.
    """
    gain = model.held_out_nll - extended.held_out_nll
    usable, los = np.isfinite(gain), model.links.los
    if not usable.any():
        return replace(score, reason="no held-out link can be judged with it")
    design_effect = model.whole.view(model.fits[0]).design_effect

    def by_fold(rows: np.ndarray) -> np.ndarray:
        own = np.bincount(model.index[rows], weights=gain[rows], minlength=len(model.folds))
        return own / design_effect

    total, shares = float(gain[usable].sum()), by_fold(usable)
    per_link = max(gain[rows].mean() for rows in (usable, usable & los) if rows.any())
    p_value, after_db = min(tried * cross_fit_p_value(shares), 1.0), extended.rmse_db(usable)
    few_p = 0.0
    if block is not None:
        few_p = sign_flip_p_value(np.bincount(block[usable], weights=gain[usable]), seed)
    los_p = 0.0
    if los.any() and not los.all() and not nlos_only:
        los_p = cross_fit_p_value(by_fold(usable & los))
    reason = ""
    if total < criteria.min_gain_nats:
        reason = (f"gains {total:.0f} nats on held-out links, {criteria.min_gain_nats:.0f} are "
                  "needed")
    elif p_value > criteria.max_p_value:
        reason = f"its gain may be chance (p = {p_value:.2g} after correction)"
    elif few_p > criteria.max_sign_flip_p_value:
        reason = f"its gain hangs on a few places (p = {few_p:.2g} if signs are flipped)"
    elif (shares > 0).mean() < criteria.min_gaining_folds:
        reason = f"gains in {(shares > 0).sum()} of {len(shares)} folds only"
    elif per_link < criteria.min_gain_per_link_nats \
            and after_db > criteria.max_rmse_ratio * model.rmse_db(usable):
        reason = (f"gains {per_link:.3f} nats a link only, {criteria.min_gain_per_link_nats} are "
                  "needed")
    elif los_p > criteria.max_los_p_value:
        reason = ("links with line of sight, where the base is surest, do not support it "
                  f"(p = {los_p:.2g})")
    return replace(score, reason=reason, nll_gain=total, rmse_db=after_db, p_value=p_value,
                   gain_by_fold=shares)
