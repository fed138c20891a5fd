"""Uncertainty of all coefficients and parameters of a model's effects together.

The mean level is linear in the coefficients; in the other parameters it is linearised by secants
about as wide as they are uncertain, because over a map it is not smooth. So parameters that trade
off with each other, such as the width of a building and its distance, have wide intervals, although
each is well known where the others are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array, hstack, issparse, vstack

from radiotwin.effects.base import DetectionEffect, LimitEffect
from radiotwin.effects.params import NEAR_SHARE, Estimate, Variation
from radiotwin.inference.censored_regression import CensoredRegression, Linearisation
from radiotwin.inference.sandwich import Scores
from radiotwin.links import evidence_blocks, places
from radiotwin.twin.model.model import Fit

MIN_FLIGHTS = 4  # that clusters of flights are made of
STEP_SHARES = (0.02, 3.0)  # of `Variation.steps`, least and greatest secant


@dataclass(frozen=True, eq=False)
class Secant:
    """How n readings change with a number.

    Attributes:
        mean_db, log_scale: (n,) change for each unit of it.
        score: (n,) slope of the log-likelihood, where only the probability of blanks changes.
        precision: of its prior.
        sides: how much wider its interval is below and above it than on average.
    """

    mean_db: np.ndarray
    log_scale: np.ndarray
    score: np.ndarray
    precision: float = 0.0
    sides: tuple[float, float] = (1.0, 1.0)

    def moved(self, own: np.ndarray, wanted: np.ndarray) -> Secant:
        """Return the secant of other links of the same m, as if what it lacks did not change.

        Args:
            own: (m,) bool, its links.
            wanted: (m,) bool, those of the secant returned.
        """
        def on_wanted(values: np.ndarray) -> np.ndarray:
            every = np.zeros(len(own))
            every[own] = values
            return every[wanted]
        return replace(self, mean_db=on_wanted(self.mean_db),
                       log_scale=on_wanted(self.log_scale), score=on_wanted(self.score))


@dataclass(frozen=True, eq=False)
class Linearised:
    """A fitted model whose readings are linear in all coefficients and numbers.

    Attributes:
        fit: the model's, of quick levels where numbers vary quickly.
        design_effect: of its training links.
        variations: of each effect.
        secants: of each effect's numbers, on the training links.
    """

    fit: Fit
    design_effect: float
    variations: list[Variation | None]
    secants: list[list[Secant]]


def linearise(fit: Fit, known: Mapping[int, list[Secant]] | None = None) -> Linearised:
    """Return how the readings of a model's training links change with its effects' numbers.

    Args:
        fit: of the model with its effects.
        known: secants of effects, by their place in the model, that are not computed again.
    """
    variations = [each.variation() for each in fit.effects]
    fit = _as_varied(fit, variations)
    # A design effect of the whole stands in for what each prior counts beside links.
    design_effect = fit.view.design_effect
    known = known or {}
    secants = [known[number] if number in known
               else _secants(fit, number, variation, design_effect)
               for number, variation in enumerate(variations)]
    return Linearised(fit, design_effect, variations, secants)


def estimates(linearised: Linearised) -> list[Estimate]:
    """Return the uncertainty of each effect, in view of places and flights that err alike."""
    fit = linearised.fit
    scores = _scores(fit, [each for of_effect in linearised.secants for each in of_effect],
                     linearised.design_effect)
    links = fit.links.select(fit.train)
    clusterings = [evidence_blocks(links), places(links)]
    if len(np.unique(links.flight)) >= MIN_FLIGHTS:
        clusterings.append(links.flight)
    covariances = scores.covariances(clusterings)
    every_sd = np.sqrt(np.max([np.diag(each) for each in covariances], axis=0))
    first, found = len(fit.coefficients), []
    for own, of_effect, variation in zip(fit.model.coefficient_slices, linearised.secants,
                                         linearised.variations, strict=True):
        sd = every_sd[first:first + len(of_effect)]
        if variation is not None:
            sd = np.hypot(sd, variation.resolution_sd)
        sides = np.reshape([each.sides for each in of_effect], (-1, 2)).T
        found.append(Estimate(fit.coefficients[own],
                              [each[own, own] for each in covariances], sd * sides))
        first += len(of_effect)
    return found


def _as_varied(fit: Fit, variations: list[Variation | None]) -> Fit:
    """Return the model as its variations have it: of quick levels, where those vary quickly."""
    varied = [each if variation is None else variation.effect(variation.values)
              for each, variation in zip(fit.effects, variations, strict=True)]
    effects = [old if old.is_same(new) else new
               for new, old in zip(varied, fit.effects, strict=True)]
    if all(new is old for new, old in zip(effects, fit.effects, strict=True)):
        return fit
    return fit.with_effects(effects)


def _secants(fit: Fit, number: int, variation: Variation | None,
             design_effect: float) -> list[Secant]:
    """Return a secant of each number of an effect, about as wide as it is uncertain by itself."""
    if variation is None:
        return []
    found = []
    # Of paths first those that folds have asked for, too.
    steps = (NEAR_SHARE if variation.follows_paths else 1.0) * variation.steps
    for i, (step, usual) in enumerate(zip(steps.tolist(), variation.steps.tolist(), strict=True)):
        secant = _secant(fit, number, variation, i, step)
        information = _information(fit, secant)
        sd = np.sqrt(design_effect / (information + design_effect * secant.precision))
        wanted = float(np.clip(sd, *(share * usual for share in STEP_SHARES)))
        if not 0.5 < wanted / step < 2.0:
            secant = _secant(fit, number, variation, i, wanted)
        found.append(secant)
    return found


def _secant(fit: Fit, number: int, variation: Variation, i: int, step: float) -> Secant:
    model = fit.model
    effect, problem = model.effects[number], model.training
    blanking = isinstance(effect, DetectionEffect | LimitEffect)
    here = problem.predict(fit)
    nll, prior = problem.nll(fit), effect.neg_log_prior()
    n = len(nll)
    sides, priors = [], []
    for sign in (-1.0, 1.0):
        numbers = variation.values.copy()
        numbers[i] = np.clip(numbers[i] + sign * step, variation.low[i], variation.high[i])
        moved_by = numbers[i] - variation.values[i]
        if moved_by == 0:
            continue
        other = variation.effect(numbers)
        moved = model.with_effect_at(number, other).training
        there = moved.predict(fit)
        change = np.zeros((3, n))
        if blanking:
            change[2] = nll - moved.nll(fit)
        else:
            change[0] = there.mean_db - here.mean_db
            change[1] = np.log(there.scale_db / here.scale_db)
        sides.append(change / moved_by)
        priors.append(other.neg_log_prior() - prior)
    if not sides:
        return Secant(np.zeros(n), np.zeros(n), np.zeros(n))
    mean_db, log_scale, score = np.mean(sides, axis=0)
    # A normal prior rises by (step / sd)² / 2 to each side on average; bounds are a flat one.
    precision = max(2 * float(np.mean(priors)) / step**2, 0.0)
    precision += 12.0 / (variation.high[i] - variation.low[i])**2
    secant = Secant(mean_db, log_scale, score, precision)
    if len(sides) < 2:
        return secant
    own = [_information(fit, Secant(side[0], side[1], side[2])) + precision
           for side in sides]
    below, above = (float(np.sqrt(np.mean(own) / each)) for each in own)
    return replace(secant, sides=(below, above))


def _information(fit: Fit, secant: Secant) -> float:
    """Return the information of all links on a number, if all else were known."""
    problem = fit.model.training
    curvature, scale_curvature = _curvatures(problem, problem.predict(fit))[2:]
    return float((curvature * secant.mean_db**2 + scale_curvature * secant.log_scale**2
                  + secant.score**2).sum())


def _curvatures(problem: CensoredRegression, predicted: Linearisation,
                ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return slopes of the log-likelihood in mean and log scale (n,), and the information on both.

    The information of the scale of Student's t is that of Lange et al. (1989), App. B.
    """
    slope, curvature, scale_slope = problem.reading_law(
        predicted.mean_db, predicted.scale_db).derivatives(problem.level_db)
    seen = np.isfinite(problem.level_db)
    expected = (problem.dof + 1) / (problem.dof + 3) / predicted.scale_db**2
    return (slope, scale_slope, np.where(seen, expected, curvature),
            2 * problem.dof / (problem.dof + 3) * seen)


def _scores(fit: Fit, secants: list[Secant], design_effect: float) -> Scores:
    """Return how links and priors bear on all coefficients, then on all numbers."""
    problem = fit.model.training
    predicted = problem.predict(fit)
    law = problem.law_columns
    if predicted.law_slope is not None:
        law = law * predicted.law_slope[:, None]
    n = len(law)
    mean, log_scale, score = (
        np.reshape([getattr(each, name) for each in secants], (len(secants), n)).T
        for name in ("mean_db", "log_scale", "score"))
    growth = np.broadcast_to(predicted.growth, n)[:, None]
    passed = np.broadcast_to(predicted.slope, n)[:, None]
    arriving = _beside([law, problem.gain_columns])
    zeros = np.zeros(arriving.shape)
    slope, scale_slope, curvature, scale_curvature = (
        each[:, None] for each in _curvatures(problem, predicted))
    columns = _beside([arriving * passed, mean])
    scored, roots = columns * slope, [columns * np.sqrt(curvature)]
    if predicted.growth.any() or log_scale.any():
        columns = _beside([arriving * growth, log_scale])
        scored = scored + columns * scale_slope
        roots.append(columns * np.sqrt(scale_curvature))
    if score.any():
        columns = _beside([zeros, score])
        scored = scored + columns
        roots.append(columns)
    coefficient_precision = 1.0 / np.square(problem.prior_sd_db)
    precision = design_effect * np.array([each.precision for each in secants])
    root = vstack(roots, format="csr") if issparse(roots[0]) else np.vstack(roots)
    return Scores(scored, root, np.concatenate([coefficient_precision, precision]),
                  np.concatenate([coefficient_precision, design_effect * precision]))


def _beside(parts: list[np.ndarray | csr_array]) -> np.ndarray | csr_array:
    """Return columns side by side; sparse if any of them is."""
    if any(issparse(each) for each in parts):
        return csr_array(hstack(parts))
    return np.hstack(parts)
