"""One model of all links and one of each fold's others, side by side."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.optimize import linear_sum_assignment

from radiotwin.closeloop.bases import Base
from radiotwin.closeloop.folds import Folds
from radiotwin.effects.correlated_shadowing import CorrelatedShadowing
from radiotwin.effects.fold_model import AppliedEffect, FoldModel
from radiotwin.inference.censored_regression import FitResult
from radiotwin.inference.student import mean_if_detected
from radiotwin.links import LinkData, with_evidence
from radiotwin.twin.fit_paths import best_dof
from radiotwin.twin.twin import Twin


@dataclass(eq=False)
class CrossValidatedModel:
    """A base with effects, of all links and of each fold's others.

    Attributes:
        whole: learnt from all links.
        folds: learnt from all but one fold each.
        fits: the whole's fit, then the folds'.
        index: (n,) fold of each link.
        twin: the base as it was fitted to all links.
        shadowing: the whole's, then the folds', of what all effects leave over; empty = none.
    """

    whole: FoldModel
    folds: list[FoldModel]
    fits: list[FitResult]
    index: np.ndarray
    twin: Twin
    shadowing: list[CorrelatedShadowing] = field(default_factory=list)

    @property
    def models(self) -> list[FoldModel]:
        """The whole, then the folds."""
        return [self.whole, *self.folds]

    @property
    def links(self) -> LinkData:
        """The n links, with the devices where the base has them."""
        return self.whole.links

    def extended(self, models: list[FoldModel], fits: list[FitResult]) -> CrossValidatedModel:
        """Return the same base with other effects: the whole, then the folds."""
        return CrossValidatedModel(models[0], models[1:], fits, self.index, self.twin)

    def with_shadowing(self, shadowing: list[CorrelatedShadowing]) -> CrossValidatedModel:
        """Return the same with interpolated shadowing: the whole's, then the folds'."""
        return CrossValidatedModel(self.whole, self.folds, self.fits, self.index, self.twin,
                                   shadowing)

    def held_out(self, of: Callable[[FoldModel, FitResult], np.ndarray]) -> np.ndarray:
        """Return a value (n,) of each link, from the fold that has not seen it."""
        result = np.full(len(self.index), np.nan)
        for number, (model, fit) in enumerate(zip(self.folds, self.fits[1:], strict=True)):
            own = self.index == number
            result[own] = of(model, fit)[own]
        return result

    @cached_property
    def held_out_reading(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) predicted reading and (n,) its error scale [dB], with shadowing; NaN = none."""
        mean_db, scale_db, unheard_db = self._held_out_parts
        shift, left = self.held_out_shadowing
        return mean_db + shift * scale_db, np.hypot(scale_db * left, unheard_db)

    @property
    def held_out_scales(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) error scale without shadowing, and (n,) sd of unheard levels [dB]; NaN = none."""
        return self._held_out_parts[1:]

    @cached_property
    def _held_out_parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        mean_db, scale_db, unheard_db = np.full((3, len(self.index)), np.nan)
        for number, (model, fit) in enumerate(zip(self.folds, self.fits[1:], strict=True)):
            own = self.index == number
            mean_db[own], scale_db[own], unheard_db[own] = (
                each[own] for each in model.predict_parts(fit))
        return mean_db, scale_db, unheard_db

    @cached_property
    def held_out_nll(self) -> np.ndarray:
        """(n,) negative log-likelihood [nats]; NaN where there is none."""
        reading = self.held_out_reading
        return self.held_out(lambda model, fit: np.where(
            model.usable, model.regression().nll_at(*reading), np.nan))

    @cached_property
    def held_out_mean_db(self) -> np.ndarray:
        """(n,) predicted level of a link that is detected [dB]; NaN where there is none."""
        reading = self.held_out_reading
        return self.held_out(lambda model, fit: np.where(
            model.usable, mean_if_detected(*reading, model.limit_db, model.dof,
                                           model.losses), np.nan))

    @cached_property
    def unforeseen(self) -> np.ndarray:
        """(n,) bool, links on which a fault acts that was not there when their fold learnt.

        What happens on a flight cannot be known before it: such links say nothing of the rest.
        """
        found = np.zeros(len(self.index), dtype=bool)
        for number, fold in enumerate(self.folds):
            for applied, place in zip(self.whole.effects, same_effects(self.whole, fold),
                                      strict=True):
                if applied.effect.within_flights and place is None:
                    found |= (self.index == number) & applied.acts
        return found

    def rmse_db(self, rows: np.ndarray | None = None) -> float:
        """Return the held-out RMSE of the detected links of a mask (n,), or of all [dB]."""
        error = self.links.level_db - self.held_out_mean_db
        error = error if rows is None else error[rows]
        return float(np.sqrt(np.nanmean(error**2))) if np.isfinite(error).any() else np.nan

    @cached_property
    def held_out_shadowing(self) -> tuple[np.ndarray, np.ndarray]:
        """(n,) what shadowing adds [error scales], and (n,) the share left of the scale."""
        shift, left = np.zeros(len(self.index)), np.ones(len(self.index))
        for number, shadowing in enumerate(self.shadowing[1:]):
            own = np.flatnonzero(self.index == number)
            shift[own], left[own] = shadowing.at(self.folds[number].links.select(own))
        return shift, left


def same_effects(whole: FoldModel, fold: FoldModel) -> list[int | None]:
    """Return the place in a fold of each effect of the whole; None for what it has not found.

    Of several of a kind those are the same that act on the same links: one faulty flight is not
    another. Where a fold has as many, each is one of them, if in another order.
    """
    places: list[int | None] = [None] * len(whole.effects)
    for effect in dict.fromkeys(each.effect for each in whole.effects):
        of_whole, of_fold = ([place for place, each in enumerate(model.effects)
                              if each.effect is effect] for model in (whole, fold))
        for place, found in _on_the_same_links(whole, fold, of_whole, of_fold):
            places[place] = found
    return places


def _on_the_same_links(whole: FoldModel, fold: FoldModel, of_whole: list[int],
                       of_fold: list[int]) -> list[tuple[int, int]]:
    """Return pairs of places of one kind of effect whose links overlap most, all in all."""
    as_many = len(of_whole) == len(of_fold)
    if as_many and len(of_whole) == 1:
        return [(of_whole[0], of_fold[0])]
    # Where nothing tells them apart, the order in which they were found does.
    shared = np.eye(len(of_whole), len(of_fold)) * 1e-9
    for row, place in enumerate(of_whole):
        acts = whole.effects[place].acts
        for column, found in enumerate(of_fold):
            others = fold.effects[found].acts
            shared[row, column] += (acts & others).sum() / max((acts | others).sum(), 1)
    return [(of_whole[row], of_fold[column])
            for row, column in zip(*linear_sum_assignment(shared, maximize=True), strict=True)
            if as_many or shared[row, column] > 1e-9]


def without_quality(model: CrossValidatedModel) -> CrossValidatedModel:
    """Return a model whose links do not know their own quality, as no map does.

    Each has the median of its fold's training links instead; nothing is fitted again.
    """
    if model.links.quality is None:
        return model

    def blind(each: FoldModel) -> FoldModel:
        quality = each.links.quality
        assert quality is not None
        known = quality[each.train & np.isfinite(quality)]
        usual = float(np.median(known)) if len(known) else np.nan
        links = replace(each.links, quality=np.full(len(quality), usual))
        effects = [applied if "quality" not in applied.effect.uses
                   else AppliedEffect(applied.effect, applied.params, applied.effect.term(
                       links, applied.params, each.level_at)) for applied in each.effects]
        return replace(each, links=links, effects=effects)

    models = [blind(each) for each in model.models]
    return model.extended(models, model.fits).with_shadowing(model.shadowing)


def training_parts(links: LinkData, folds: Folds) -> list[LinkData]:
    """Return the links outside each fold; the same objects serve every base."""
    return [links.select(folds.index != number) for number in range(folds.count)]


def cross_validate(links: LinkData, base: Base, folds: Folds,
                   parts: list[LinkData]) -> CrossValidatedModel:
    """Fit a base to all links, and to those outside each fold.

    Args:
        links: n links.
        base: kind of model.
        folds: of the links.
        parts: `training_parts` of both.

    Raises:
        BadInput: links that the base cannot be fitted to.
    """
    twin = base.fit(links)
    device_m = base.device_m(twin)
    dof = best_dof(links, twin.channel, device_m)
    whole = FoldModel.build(links, twin.channel, dof, device_m=device_m)
    links = _with_evidence(links, whole)
    whole = replace(whole, links=replace(whole.links, evidence=links.evidence, notes=links.notes,
                                         known_los=whole.links.los))
    models = []
    for number, part in enumerate(parts):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the fit to all links has warned already
            fitted = base.fit(part)
        models.append(FoldModel.build(links, fitted.channel, dof, device_m=base.device_m(fitted),
                                      train=folds.index != number))
    fits = [model.fit() for model in (whole, *models)]
    return CrossValidatedModel(whole, models, fits, folds.index, twin)


def _with_evidence(links: LinkData, whole: FoldModel) -> LinkData:
    """Return links with pieces of evidence that fit the base's residual, if they have none yet."""
    if links.evidence is not None:
        return links
    view, z = whole.view(whole.fit()), np.full(len(links), np.nan)
    z[whole.train] = view.residual_db / view.scale_db
    located = with_evidence(whole.links, z)
    return replace(links, evidence=located.evidence, notes=located.notes)
