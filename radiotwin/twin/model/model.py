"""A channel with effects, its fit to training links, and what that predicts of any links.

This is the one place where the level of a link is put together: the channel's mean, its refitted
level and slope, and every stage of the effects. `Model` is the regression on one set of links,
`Fit` has its coefficients, and `FittedModel` is the fit without its links, as a twin keeps it.
Selection, localisation, maps and reports all predict by it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from radiotwin.effects.base import DetectionEffect, Effect, LevelAt, LimitEffect, ResidualView, Term
from radiotwin.errors import BadInput
from radiotwin.inference import censored_regression
from radiotwin.inference.censored_regression import (
    CensoredRegression,
    FitResult,
    Linearisation,
    Response,
)
from radiotwin.inference.student import NO_LOSSES, Losses, ReadingLaw, sd_of_scale
from radiotwin.links import Links
from radiotwin.links.links import Prediction
from radiotwin.propagation.laws import ChannelModel
from radiotwin.scene.citymap import CityMap
from radiotwin.twin.model.blend import Blend
from radiotwin.twin.model.correlated_shadowing import MAX_Z as MAX_REST_Z
from radiotwin.twin.model.correlated_shadowing import CorrelatedShadowing

VIEWS = 8  # that are remembered: of a model and its folds, which every candidate asks for
MIN_LINKS = 3  # of a device whose mean residual is known
MIN_SLOPE = 0.5  # of a receiver's response that passes a device's own level on
MAX_Z = 4.0  # an outlier counts as this many scales
CHANNEL_DOF = 30.0  # degrees of freedom of the errors that a channel states: nearly normal


@dataclass(frozen=True, eq=False)
class Model:
    """A channel and effects on n links, of which those in `train` are learnt from; not fitted yet.

    Attributes:
        links: n links, with the devices where the channel has them.
        train: (n,) bool, links that are learnt from.
        usable: (n,) bool, links to devices that have a position.
        channel: fitted already.
        channel_db: (n,) its mean level, with what is declared of the devices [dB].
        level_columns: (n, p0) what is fitted again of the channel: `ChannelModel.level_columns`.
        level_prior_sd_db: (p0,) prior standard deviations of it.
        group: (n,) index of the error scale.
        groups: number of these, also where no link is of one.
        dof: degrees of freedom of the errors.
        effects: found so far.
        terms: what each of them adds to the n links.
    """

    links: Links
    train: np.ndarray
    usable: np.ndarray
    channel: ChannelModel
    channel_db: np.ndarray
    level_columns: np.ndarray
    level_prior_sd_db: np.ndarray
    group: np.ndarray
    groups: int
    dof: float
    effects: tuple[Effect, ...] = ()
    terms: tuple[Term, ...] = ()

    @classmethod
    def build(cls, links: Links, channel: ChannelModel, dof: float, *,
              device_m: np.ndarray | None = None, train: np.ndarray | None = None,
              channel_db: np.ndarray | None = None) -> Model:
        """Return a model without effects.

        Args:
            links: n links.
            channel: fitted.
            dof: degrees of freedom of the errors.
            device_m: (k, 3) where the channel has the devices [m], NaN for one that it has nowhere;
                None: where the links have them.
            train: (n,) bool, links to learn from; None: all.
            channel_db: (n,) mean level by the channel and by what is declared of the devices, where
                it is known already [dB].
        """
        usable = np.ones(len(links), dtype=bool)
        if device_m is not None:
            usable = np.isfinite(device_m).all(axis=1)[links.device]
            # A stand-in for devices that are nowhere, whose links are not looked at.
            links = links.with_devices(np.where(np.isfinite(device_m), device_m, 0.0))
        geometry = links.geometry
        if channel_db is None:
            channel_db = channel.predict(geometry)[0] + channel.declared_db(links)
        columns, prior_sd_db = channel.level_columns(geometry)
        return cls(links, usable if train is None else train & usable, usable, channel, channel_db,
                   columns, prior_sd_db, channel.error_group(geometry),
                   channel.error_groups(geometry), dof)

    @property
    def level_at(self) -> LevelAt:
        """The channel's levels of any links, quickly or exactly."""
        return self.channel.level_at

    @property
    def effect_names(self) -> frozenset[str]:
        """Names of the effects found so far, without those that were declared."""
        return frozenset(each.name for each in self.effects if not each.is_declared)

    @property
    def corrected_map(self) -> CityMap | None:
        """The map with what effects add to it and take from it; None without a map."""
        city = self.links.city
        for each in self.effects:
            city = None if city is None else each.corrected_map(city)
        return city

    def with_effects(self, effects: Iterable[Effect]) -> Model:
        """Return the same with other effects; terms of those that it has are not made again."""
        known, effects = dict(zip(self.effects, self.terms, strict=True)), tuple(effects)
        return replace(self, effects=effects, terms=tuple(
            known[each] if each in known else each.term(self.links, self.level_at)
            for each in effects))

    def with_effect_at(self, place: int, effect: Effect) -> Model:
        """Return the same with another effect at a place; -1: the last."""
        effects = list(self.effects)
        effects[place] = effect
        return self.with_effects(effects)

    def restrict(self, rows: np.ndarray) -> Model:
        """Return the model of some links (r,), all to be learnt from."""
        everything = np.ones(len(rows), dtype=bool)
        return replace(
            self, links=self.links.select(rows), train=everything, usable=everything,
            channel_db=self.channel_db[rows], level_columns=self.level_columns[rows],
            group=self.group[rows], terms=tuple(term.select(rows) for term in self.terms))

    def regression(self, rows: np.ndarray | slice = slice(None)) -> CensoredRegression:
        """Return the regression on the links of a mask, an index array or a slice."""
        links, terms = self.links, self.terms
        n = len(self.channel_db[rows])
        return CensoredRegression(
            links.level_db[rows], self.limit_db[rows],
            self.channel_db[rows], self.level_columns[rows], self._response("paths", rows),
            sum((term.offset_db[rows] for term in terms), np.zeros(n)),
            censored_regression.design([term.columns[rows] for term in terms], n),
            np.concatenate([self.level_prior_sd_db, *(term.prior_sd_db for term in terms)]),
            self.group[rows], self._response("receiver", rows), self.dof,
            self.losses.select(rows), self._random_effect_sd_db(rows))

    @cached_property
    def training(self) -> CensoredRegression:
        """The regression on the training links."""
        return self.regression(self.train)

    @cached_property
    def limit_db(self) -> np.ndarray:
        """(n,) level below which a link is blank [dB]; -inf where none is known."""
        limit_db = self.links.limit_db
        for each in self.effects:
            if isinstance(each, LimitEffect):
                limit_db = np.maximum(limit_db, each.limits_db(self.links))
        return limit_db

    def fit(self, start: FitResult | None = None) -> Fit:
        """Fit to the training links; a class that none of them is of has another one's scale."""
        found = censored_regression.fit(self.training, start)
        there = np.unique(self.training.group)
        scale_db = np.full(self.groups, found.scale_db[there].max())
        scale_db[there] = found.scale_db[there]
        return Fit(found.coefficients, scale_db, found.objective, self)

    @property
    def coefficient_slices(self) -> list[slice]:
        """Of each effect: where its coefficients are among all."""
        widths = [term.columns.shape[1] for term in self.terms]
        ends = np.cumsum([self.level_columns.shape[1], *widths]).tolist()
        return [slice(first, end) for first, end in zip(ends, ends[1:], strict=False)]

    @cached_property
    def losses(self) -> Losses:
        """Losses of all links whatever their level."""
        every = [each.losses(self.links) for each in self.effects
                 if isinstance(each, DetectionEffect)]
        if not every:
            return NO_LOSSES
        kept = np.prod([1.0 - np.asarray(each.blank) for each in every], axis=0)
        # Two effects that lower levels of the same links are not looked for.
        most = max(every, key=lambda each: float(np.mean(each.drop)))
        return Losses(1.0 - kept, most.drop, most.drop_db)

    def _scatter_sd_db(self, rows: np.ndarray | slice) -> np.ndarray | float:
        return _joined_sd_db([term.random_effect_sd_db for term in self.terms], rows)

    def _random_effect_sd_db(self, rows: np.ndarray | slice) -> np.ndarray | float:
        """Return (n,) the sd of all that is not learnt of a link; 0 where there is none."""
        unheard = [term.unheard_sd_db for term in self.terms]
        return np.hypot(self._scatter_sd_db(rows), _joined_sd_db(unheard, rows))

    def _response(self, stage: str, rows: np.ndarray | slice) -> Response | None:
        """Return what effects of a stage do to levels, one after the other; None without any."""
        return response([(each, None if term.inputs is None else term.inputs[rows])
                         for each, term in zip(self.effects, self.terms, strict=True)
                         if each.stage == stage])


@dataclass(frozen=True, eq=False)
class Fit(FitResult):
    """A model with the coefficients, error scales and objective of its fit to the training links.

    Attributes:
        model: that was fitted.
        shadowing: what is interpolated over the ground of what it leaves; None = nothing.
    """

    model: Model
    shadowing: CorrelatedShadowing | None = None

    @property
    def links(self) -> Links:
        """All n links of the model, learnt from or not."""
        return self.model.links

    @property
    def train(self) -> np.ndarray:
        """(n,) bool, links that it has learnt from."""
        return self.model.train

    @property
    def usable(self) -> np.ndarray:
        """(n,) bool, links to devices that have a position."""
        return self.model.usable

    @property
    def channel(self) -> ChannelModel:
        """Fitted to the training links."""
        return self.model.channel

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Of the model."""
        return self.model.effects

    @property
    def view(self) -> ResidualView:
        """The training links as an effect sees them; the same object if asked again."""
        return _view(self)

    def coefficients_of(self, number: int) -> np.ndarray:
        """Return the coefficients (q,) of one of the effects."""
        return self.coefficients[self.model.coefficient_slices[number]]

    def with_effects(self, effects: Iterable[Effect]) -> Fit:
        """Return the model with other effects, fitted again from these coefficients."""
        return self.model.with_effects(effects).fit(self)

    def with_effect_at(self, place: int, effect: Effect) -> Fit:
        """Return the same with another effect at a place, fitted again; -1: the last."""
        return self.model.with_effect_at(place, effect).fit(self)

    def for_map(self, rows: np.ndarray) -> Fit:
        """Return the fit of some links (r,) at faultless receivers, as a map has them."""
        fit = self.on_rows(rows)
        for place in reversed(range(len(fit.effects))):
            if _is_off_maps(fit.effects[place]):
                fit = fit.without(place)
        nobody = np.full(len(fit.links), -1)
        return replace(fit, model=replace(fit.model, links=fit.links.with_columns(receiver=nobody)))

    def on_rows(self, rows: np.ndarray) -> Fit:
        """Return the fit of some links (r,), whose effects' terms are not made again."""
        return replace(self, model=self.model.restrict(rows))

    def without(self, place: int) -> Fit:
        """Return the fit with one effect taken away; nothing else is changed."""
        rest = self.model.with_effects([*self.effects[:place], *self.effects[place + 1:]])
        own = self.model.coefficient_slices[place]
        return replace(self, coefficients=np.delete(self.coefficients, own), model=rest)

    @cached_property
    def learnt(self) -> FittedModel:
        """What was learnt, without the training links."""
        model, sd_db = self.model, device_sd_db(self)
        return FittedModel(
            model.channel, model.effects,
            tuple(self.coefficients_of(number) for number in range(len(model.effects))),
            self.coefficients[:model.level_columns.shape[1]],
            self.scale_db, model.dof, model.links.device_m, tuple(model.links.receiver_names),
            model.links.first_s, sd_db, shadowing=self.shadowing, unheard=Unheard.of(self, sd_db))

    @property
    def training_z(self) -> np.ndarray:
        """(m,) residuals of the training links [error scales]; outliers are clipped."""
        return np.clip(self.view.residual_db / self.view.scale_db, -MAX_REST_Z, MAX_REST_Z)

    def rest(self, seed: int, like: CorrelatedShadowing | None = None) -> CorrelatedShadowing:
        """Return what interpolates the residuals of the training links, see `like` there."""
        return CorrelatedShadowing.fit(self.links, self.train, self.training_z, seed, like)

    def predict(self, links: Links) -> Prediction:
        """Return the levels that are expected of any links, with the same devices and receivers."""
        return self.learnt.predict(links)

    def readings(self) -> Linearisation:
        """Return mean and scale of the readings of all links, before the limit of detection."""
        return self.model.regression().predict(self)

    def reading_parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return mean of the readings, error scale without unheard levels, and sd of these [dB].

        (n,) each. What is interpolated counts in units of the second; with the third it makes the
        scale of `readings`.
        """
        reading = self.readings()
        mean_db, whole = reading.mean_db, reading.scale_db
        if all(term.unheard_sd_db is None for term in self.model.terms):
            return mean_db, whole, np.zeros(len(whole))
        scatter_sd_db = self.model._scatter_sd_db(slice(None))
        known = replace(self.model.regression(), random_effect_sd_db=scatter_sd_db)
        scale_db = known.predict(self).scale_db
        return mean_db, scale_db, np.sqrt(np.maximum(whole**2 - scale_db**2, 0.0))


def _joined_sd_db(parts: list[np.ndarray | None], rows: np.ndarray | slice) -> np.ndarray | float:
    return np.sqrt(sum(each[rows] ** 2 for each in parts if each is not None))


def response(effects: Sequence[tuple[Effect, Any]]) -> Response | None:
    """Return what effects make of levels, one after the other; None without any.

    Args:
        effects: each with the inputs (n, …) of its term.
    """
    if not effects:
        return None

    def chained(level_db: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope = np.ones_like(level_db)
        for each, inputs in effects:
            level_db, own = each.response(level_db, inputs)  # type: ignore[attr-defined]
            slope = slope * own
        return level_db, slope
    return chained


@lru_cache(maxsize=VIEWS)
def _view(fit: Fit) -> ResidualView:
    model = fit.model
    predicted = model.training.predict(fit)
    # All links stay the same object, of which things are remembered.
    links = model.links if model.train.all() else model.links.select(model.train)
    return ResidualView(links, model.training.residual_db(fit),
                        predicted.scale_db, predicted.mean_db, model.level_at,
                        model.effects)


@dataclass(frozen=True, eq=False)
class Unheard:
    """Mean and spread of the others' antennas and offsets, for devices without a reading.

    Attributes:
        devices: by their rows at the fit, without those whose antennas are declared.
        mean_db: of what the other devices' own effects add to their links [dB].
        sd_db: standard deviation of that, and of what devices have in common beside it [dB].
    """

    devices: tuple[int, ...]
    mean_db: float
    sd_db: float

    @classmethod
    def of(cls, fit: Fit, device_sd_db: float) -> Unheard | None:
        """Return that of devices without a training link; None if each has one."""
        links, own_db, declared = fit.links, np.zeros(len(fit.links)), set[int]()
        for number, (each, term) in enumerate(zip(fit.effects, fit.model.terms, strict=True)):
            if each.is_declared:
                declared |= set(getattr(each.params, "devices", ()))
            elif each.of_device:
                own_db += term.offset_db + term.columns @ fit.coefficients_of(number)
        device = links.device[fit.train]
        heard = np.unique(device)
        devices = sorted(set(range(len(links.device_m))) - set(heard.tolist()) - declared)
        if not devices or not len(heard):
            return None
        # Each device counts the same, however many readings it has.
        weight = 1.0 / np.bincount(device)[device] / len(heard)
        mean_db = float(weight @ own_db[fit.train])
        spread_db = np.sqrt(weight @ (own_db[fit.train] - mean_db) ** 2)
        return cls(tuple(devices), mean_db, float(np.hypot(spread_db, device_sd_db)))


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A fitted channel with effects, ready for links that were not among the training links.

    Attributes:
        channel: fitted.
        effects: as they were found; they count devices and receivers by their rows at the fit.
        coefficients: (q,) of the columns of each effect's term.
        level_coefficients: (p0,) of `ChannelModel.level_columns`.
        scale_db: (groups,) error scales [dB].
        dof: degrees of freedom of the errors.
        device_m: (k, 3) positions of the devices at the fit [m].
        receivers: names of the receivers at the fit.
        first_s: time of the first measurement that it was fitted to [s]; NaN without times.
        device_sd_db: standard deviation of what all links of a device have in common [dB].
        likelihood_power: power of the likelihood in localisation, see
            `radiotwin.twin.localize.calibration`.
        shadowing: what is interpolated over the ground; None = nothing.
        radius_factor: by which 90 % radii of located devices are wider than by the likelihood.
        typical_misfit: of the links of located devices where it was learnt; NaN = not known.
            Both are of `radiotwin.twin.localize.calibration`.
        blend: what predicts together with it, by weights; None = named effects and shadowing alone.
        unheard: what is known of devices without a reading; None = there are none.
    """

    channel: ChannelModel
    effects: tuple[Effect, ...]
    coefficients: tuple[np.ndarray, ...]
    level_coefficients: np.ndarray
    scale_db: np.ndarray
    dof: float
    device_m: np.ndarray
    receivers: tuple[str, ...]
    first_s: float
    device_sd_db: float
    likelihood_power: float = 1.0
    shadowing: CorrelatedShadowing | None = None
    radius_factor: float = 1.0
    typical_misfit: float = np.nan
    blend: Blend | None = None
    unheard: Unheard | None = None

    @classmethod
    def of_channel(cls, channel: ChannelModel) -> FittedModel:
        """Return a channel alone, with errors of the sizes that it states; it has no scales."""
        nothing = np.empty(0)
        return cls(channel, (), (), nothing, nothing, CHANNEL_DOF, np.empty((0, 3)), (), np.nan,
                   0.0)

    @property
    def is_channel_alone(self) -> bool:
        """Whether nothing was fitted upon the channel."""
        return not len(self.scale_db)

    def for_positions(self) -> FittedModel:
        """Return the same without what takes too long for each place where a device may be.

        Left out are effects that follow paths, among them errors of the map (nine maps for each
        link), and curves without a cause, which describe devices whose positions are known. How far
        their lack displaces devices is in `radius_factor`.
        """
        return self._without(lambda each: not each.is_cause or each.in_paths)

    def _without(self, left_out: Callable[[Effect], bool]) -> FittedModel:
        kept = [number for number, each in enumerate(self.effects) if not left_out(each)]
        return replace(self, effects=tuple(self.effects[number] for number in kept),
                       coefficients=tuple(self.coefficients[number] for number in kept))

    def on_links(self, links: Links) -> Fit:
        """Return these coefficients on other links (n,), all of which are in `train`.

        Where the links have no receivers (a map's have none) those are faultless: effects of
        receivers are left out.
        """
        own = self if links.receiver_names else self._without(_is_off_maps)
        model = Model.build(links, self.channel, self.dof).with_effects(own.effects)
        coefficients = [self.level_coefficients, *own.coefficients]
        needed = [model.level_columns, *(term.columns for term in model.terms)]
        for given, columns in zip(coefficients, needed, strict=True):
            if len(given) != columns.shape[1]:
                raise BadInput(f"the twin has {len(given)} coefficients where {columns.shape[1]} "
                               "are needed for these links; run `radiotwin fit` again")
        return Fit(np.concatenate(coefficients), self.scale_db, np.nan, model)

    def predict(self, links: Links) -> Prediction:
        """Return the levels that are expected of links, see `Prediction`."""
        law = self.law(links)
        return Prediction(law.mean_db, law.sd_db, law.detection_probability, law.reading_db)

    def law(self, links: Links) -> ReadingLaw:
        """Return the distribution of the levels of links."""
        if not self.is_channel_alone:
            return self.law_on(self.on_links(links))
        mean_db, sd_db = self.channel.predict(links.geometry)
        return ReadingLaw(mean_db + self.channel.declared_db(links), sd_db / sd_of_scale(self.dof),
                          links.limit_db, self.dof)

    def law_on(self, fit: Fit) -> ReadingLaw:
        """Return the distribution of the levels of a fit's links.

        Twins predict by it, and folds predict the links that they have not seen.

        Args:
            fit: of these coefficients to n links; `on_links` makes one for any links.
        """
        mean_db, scale_db, unheard_db = self._named(fit)
        shift, left = rest = self._rest_at(fit.links)
        if self.blend is not None:
            mean_db, scale_db = self.blend.apply(fit.links, mean_db, scale_db, self.dof, rest)
        else:
            mean_db, scale_db = mean_db + shift * scale_db, scale_db * left
        return ReadingLaw(mean_db, np.hypot(scale_db, unheard_db), fit.model.limit_db, self.dof,
                          fit.model.losses)

    def members_on(self, fit: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what `law_on` combines, of a fit's n links.

        Returns:
            (n, k) level and (n, k) error scale of each member of the blend, and (n,) standard
            deviation of what is unheard [dB].
        """
        assert self.blend is not None
        mean_db, scale_db, unheard_db = self._named(fit)
        return *self.blend.members_db(fit.links, mean_db, scale_db, self.dof,
                                      self._rest_at(fit.links)), unheard_db

    def _named(self, fit: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return `Fit.reading_parts`, with what is known of devices without a reading."""
        mean_db, scale_db, unheard_db = fit.reading_parts()
        if self.unheard is not None:
            of_them = np.isin(fit.links.device, self.unheard.devices)
            mean_db = mean_db + self.unheard.mean_db * of_them
            # The spread of all own effects of a device holds that of its offset.
            unheard_db = np.maximum(unheard_db, self.unheard.sd_db * of_them)
        return mean_db, scale_db, unheard_db

    def _rest_at(self, links: Links) -> tuple[np.ndarray, np.ndarray]:
        if self.shadowing is None:
            return np.zeros(len(links)), np.ones(len(links))
        return self.shadowing.at(links)


def _is_off_maps(effect: Effect) -> bool:
    return not effect.is_on_maps()


def device_sd_db(fit: Fit) -> float:
    """Return the standard deviation of what the training links of a device have in common [dB].

    Beyond what the scatter of single links makes of their mean (method of moments).
    """
    problem = fit.model.training
    reading = problem.predict(fit)
    slope = np.broadcast_to(reading.slope, problem.level_db.shape)
    # At a receiver that passes little on a device's own level does not show.
    seen = np.isfinite(problem.level_db) & (slope > MIN_SLOPE)
    rest_db = (problem.residual_db(fit) / slope)[seen]
    scale_db = (reading.scale_db / slope)[seen]
    device = fit.links.device[fit.train][seen]
    rest_db = np.clip(rest_db, -MAX_Z * scale_db, MAX_Z * scale_db)
    count = np.bincount(device)
    enough = count >= MIN_LINKS
    if enough.sum() < MIN_LINKS:
        return 0.0
    mean_db = np.bincount(device, weights=rest_db)[enough] / count[enough]
    within = np.bincount(device, weights=rest_db**2)[enough] / count[enough] - mean_db**2
    noise = (within / (count[enough] - 1)).mean()
    return float(np.sqrt(max(mean_db.var(ddof=1) - noise, 0.0)))
