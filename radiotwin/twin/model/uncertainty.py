"""Joint uncertainty (covariance) of the coefficients and parameters of a model's effects.

The mean level is linear in the coefficients. In the other parameters it is linearised by secants
about as wide as their uncertainty, because over a map it is not smooth. Parameters that trade off
with each other, such as the width of a building and its distance, get wide intervals, although each
would be well known if the others were.
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

MIN_FLIGHTS = 4  # flights needed to use them as clusters
STEP_SHARES = (0.02, 3.0)  # least and greatest width of a secant, over `Variation.steps`


@dataclass(frozen=True, eq=False)
class ReadingDerivative:
    """Derivative of n readings with respect to one parameter, by finite differences.

    Attributes:
        mean_db: (n,) change of the mean for a unit of the parameter [dB].
        log_scale: (n,) change of the logarithm of the error scale.
        score: (n,) change of the log-likelihood, if only the probability of blanks changes [nats].
        precision: precision of the parameter's prior.
        sides: width of the interval below, and above, the estimate, over the mean width.
    """

    mean_db: np.ndarray
    log_scale: np.ndarray
    score: np.ndarray
    precision: float = 0.0
    sides: tuple[float, float] = (1.0, 1.0)

    def moved(self, known: np.ndarray, wanted: np.ndarray) -> ReadingDerivative:
        """Return the derivative on links `wanted` (n,) bool; 0 outside links `known` (n,) bool."""
        def on_wanted(values: np.ndarray) -> np.ndarray:
            on_all = np.zeros(len(known))
            on_all[known] = values
            return on_all[wanted]
        return replace(self, mean_db=on_wanted(self.mean_db),
                       log_scale=on_wanted(self.log_scale), score=on_wanted(self.score))


@dataclass(frozen=True, eq=False)
class Linearised:
    """A fitted model, linearised in all coefficients and parameters.

    Attributes:
        fit: the fit, with quick levels for effects that are varied with quick levels.
        design_effect: design effect of its training links.
        variations: variable parameters of each effect; None: it has none.
        derivatives: derivatives of each effect's parameters, on the training links.
    """

    fit: Fit
    design_effect: float
    variations: list[Variation | None]
    derivatives: list[list[ReadingDerivative]]


def linearise(fit: Fit, known: Mapping[int, list[ReadingDerivative]] | None = None) -> Linearised:
    """Linearise the readings of a model's training links in the parameters of its effects.

    Derivatives known before are given by index of the effect.
    """
    variations = [effect.variation() for effect in fit.effects]
    fit = _with_varied_effects(fit, variations)
    # Priors are weighted by the design effect of all links, as if these were independent.
    design_effect = fit.view.design_effect
    known = known or {}
    derivatives = [known[number] if number in known
                   else _derivatives(fit, number, variation, design_effect)
                   for number, variation in enumerate(variations)]
    return Linearised(fit, design_effect, variations, derivatives)


def estimates(linearised: Linearised) -> list[Estimate]:
    """Return coefficients, cluster-robust covariances, parameter sds (below, above) of each effect.

    Clusters of correlated errors are blocks of ground, places, and flights; the largest variance
    over these clusterings counts.
    """
    fit = linearised.fit
    scores = _scores(fit, [each for of_effect in linearised.derivatives for each in of_effect],
                     linearised.design_effect)
    links = fit.links.select(fit.train)
    clusterings = [evidence_blocks(links), places(links)]
    if len(np.unique(links.flight)) >= MIN_FLIGHTS:
        clusterings.append(links.flight)
    covariances = scores.covariances(clusterings)
    all_sd = np.sqrt(np.max([np.diag(covariance) for covariance in covariances], axis=0))
    first, found = len(fit.coefficients), []
    for columns, derivatives, variation in zip(fit.model.coefficient_slices, linearised.derivatives,
                                           linearised.variations, strict=True):
        sd = all_sd[first:first + len(derivatives)]
        if variation is not None:
            sd = np.hypot(sd, variation.resolution_sd)
        sides = np.reshape([each.sides for each in derivatives], (-1, 2)).T
        found.append(Estimate(fit.coefficients[columns],
                              [covariance[columns, columns] for covariance in covariances],
                              sd * sides))
        first += len(derivatives)
    return found


def _with_varied_effects(fit: Fit, variations: list[Variation | None]) -> Fit:
    """Return the fit with effects as their `variation` builds them, fitted again if they differ."""
    varied = [effect if variation is None else variation.effect(variation.values)
              for effect, variation in zip(fit.effects, variations, strict=True)]
    effects = [old if old.is_same(new) else new
               for new, old in zip(varied, fit.effects, strict=True)]
    if all(new is old for new, old in zip(effects, fit.effects, strict=True)):
        return fit
    return fit.with_effects(effects)


def _derivatives(fit: Fit, number: int, variation: Variation | None,
                 design_effect: float) -> list[ReadingDerivative]:
    """Compute the derivative of readings in each parameter, by steps as wide as its uncertainty."""
    if variation is None:
        return []
    found = []
    # Along paths, begin with the steps that folds use, too: their levels are cached.
    steps = (NEAR_SHARE if variation.follows_paths else 1.0) * variation.steps
    for i, (step, usual) in enumerate(zip(steps.tolist(), variation.steps.tolist(), strict=True)):
        derivative = _derivative(fit, number, variation, i, step)
        information = _information(fit, derivative)
        sd = np.sqrt(design_effect / (information + design_effect * derivative.precision))
        wanted = float(np.clip(sd, *(share * usual for share in STEP_SHARES)))
        if not 0.5 < wanted / step < 2.0:
            derivative = _derivative(fit, number, variation, i, wanted)
        found.append(derivative)
    return found


def _derivative(fit: Fit, number: int, variation: Variation, i: int, step: float
                ) -> ReadingDerivative:
    """Compute the derivative of readings in parameter `i` of an effect, by steps to both sides."""
    model = fit.model
    effect, problem = model.effects[number], model.training
    blanking = isinstance(effect, DetectionEffect | LimitEffect)
    predicted = problem.predict(fit)
    nll, prior = problem.nll(fit), effect.neg_log_prior()
    n = len(nll)
    sides, priors = [], []
    for sign in (-1.0, 1.0):
        numbers = variation.values.copy()
        numbers[i] = np.clip(numbers[i] + sign * step, variation.low[i], variation.high[i])
        moved_by = numbers[i] - variation.values[i]
        if moved_by == 0:
            continue
        varied = variation.effect(numbers)
        moved = model.with_effect_at(number, varied).training
        after = moved.predict(fit)
        change = np.zeros((3, n))
        if blanking:
            change[2] = nll - moved.nll(fit)
        else:
            change[0] = after.mean_db - predicted.mean_db
            change[1] = np.log(after.scale_db / predicted.scale_db)
        sides.append(change / moved_by)
        priors.append(varied.neg_log_prior() - prior)
    if not sides:
        return ReadingDerivative(np.zeros(n), np.zeros(n), np.zeros(n))
    mean_db, log_scale, score = np.mean(sides, axis=0)
    # A normal prior rises by (step / sd)² / 2 to each side on average; bounds are a uniform prior.
    precision = max(2 * float(np.mean(priors)) / step**2, 0.0)
    precision += 12.0 / (variation.high[i] - variation.low[i])**2
    derivative = ReadingDerivative(mean_db, log_scale, score, precision)
    if len(sides) < 2:
        return derivative
    informations = [_information(fit, ReadingDerivative(side[0], side[1], side[2])) + precision
                    for side in sides]
    below, above = (float(np.sqrt(np.mean(informations) / information))
                    for information in informations)
    return replace(derivative, sides=(below, above))


def _information(fit: Fit, derivative: ReadingDerivative) -> float:
    """Return the Fisher information of all links on one parameter, if all others are known."""
    problem = fit.model.training
    curvature, scale_curvature = _curvatures(problem, problem.predict(fit))[2:]
    return float((curvature * derivative.mean_db**2 + scale_curvature * derivative.log_scale**2
                  + derivative.score**2).sum())


def _curvatures(problem: CensoredRegression, predicted: Linearisation,
                ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return slopes of the log-likelihood in mean and log error scale, and the information on both.

    (n,) each, of the training links; for a Student-t scale by Lange et al. (1989), App. B.
    """
    slope, curvature, scale_slope = problem.reading_law(
        predicted.mean_db, predicted.scale_db).derivatives(problem.level_db)
    detected = np.isfinite(problem.level_db)
    expected = (problem.dof + 1) / (problem.dof + 3) / predicted.scale_db**2
    return (slope, scale_slope, np.where(detected, expected, curvature),
            2 * problem.dof / (problem.dof + 3) * detected)


def _scores(fit: Fit, derivatives: list[ReadingDerivative], design_effect: float) -> Scores:
    """Return each link's score (derivative of its log-likelihood), its information, and priors.

    Columns are all coefficients, those of the channel first, then the varied parameters.
    """
    problem = fit.model.training
    predicted = problem.predict(fit)
    law = problem.law_columns
    if predicted.law_slope is not None:
        law = law * predicted.law_slope[:, None]
    n = len(law)
    mean, log_scale, score = (
        np.reshape([getattr(each, name) for each in derivatives], (len(derivatives), n)).T
        for name in ("mean_db", "log_scale", "score"))
    growth = np.broadcast_to(predicted.growth, n)[:, None]
    response_slope = np.broadcast_to(predicted.slope, n)[:, None]
    arriving = _beside([law, problem.gain_columns])
    zeros = np.zeros(arriving.shape)
    slope, scale_slope, curvature, scale_curvature = (
        values[:, None] for values in _curvatures(problem, predicted))
    columns = _beside([arriving * response_slope, mean])
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
    precision = design_effect * np.array([each.precision for each in derivatives])
    root = vstack(roots, format="csr") if issparse(roots[0]) else np.vstack(roots)
    return Scores(scored, root, np.concatenate([coefficient_precision, precision]),
                  np.concatenate([coefficient_precision, design_effect * precision]))


def _beside(parts: list[np.ndarray | csr_array]) -> np.ndarray | csr_array:
    """Concatenate columns; sparse if any part is."""
    if any(issparse(part) for part in parts):
        return csr_array(hstack(parts))
    return np.hstack(parts)
