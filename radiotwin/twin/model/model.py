"""Model, Fit, FittedModel: the level of a link from channel and effects, fitted and predicted.

The only place where the level of a link is computed: the channel's mean, its refitted level and
slope, and every stage of the effects. `Model` is the regression on one set of links, `Fit` adds its
coefficients, and `FittedModel` is the fit without its training links, as a twin stores it.
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
from radiotwin.links.links import FromPart, Prediction
from radiotwin.propagation.laws import ChannelModel
from radiotwin.scene.citymap import CityMap
from radiotwin.twin.model.blend import Blend
from radiotwin.twin.model.correlated_shadowing import MAX_Z as MAX_REST_Z
from radiotwin.twin.model.correlated_shadowing import CorrelatedShadowing

VIEWS = 8  # cached residuals: of a model and its folds, which every candidate effect needs
MIN_LINKS = 3  # links needed for a device's mean residual, and devices for their spread
MIN_SLOPE = 0.5  # least slope of a receiver's response at which a device's level is visible
MAX_Z = 4.0  # residuals are clipped to so many error scales
CHANNEL_DOF = 30.0  # degrees of freedom of the errors of a channel without refit: nearly normal


@dataclass(frozen=True, eq=False)
class Model:
    """The regression of a channel with effects on n links, not fitted yet.

    Attributes:
        links: n links, with the devices at the channel's positions.
        train: (n,) bool, training links.
        usable: (n,) bool, links to devices that have a position.
        channel: fitted channel.
        channel_db: (n,) mean level of the channel with declared powers and antennas [dB].
        level_columns: (n, p0) columns that refit the channel, see `ChannelModel.level_columns`.
        level_prior_sd_db: (p0,) prior standard deviations of their coefficients [dB].
        group: (n,) index of the error scale.
        groups: number of error scales, including those without a link.
        dof: degrees of freedom of the Student-t errors.
        effects: effects in the model.
        terms: regression term of each effect on the n links.
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
        """Build the regression model of a fitted channel on n links, without effects.

        Devices may be at other positions (k, 3) [m]; at NaN their links are not used. `train` (n,)
        are training links; None: all that are usable. `channel_db` (n,) is the channel's mean level
        with declared powers and antennas [dB]; None: predicted.
        """
        usable = np.ones(len(links), dtype=bool)
        if device_m is not None:
            usable = np.isfinite(device_m).all(axis=1)[links.device]
            # A placeholder for devices without a position, whose links are not used.
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
        """Return the function that predicts the channel's levels of any links."""
        return self.channel.level_at

    @property
    def effect_names(self) -> frozenset[str]:
        """Return the names of the effects in the model, without declared ones."""
        return frozenset(effect.name for effect in self.effects if not effect.is_declared)

    @property
    def corrected_map(self) -> CityMap | None:
        """Return the 3D map after the changes that effects make to it; None without a map."""
        city = self.links.city
        for effect in self.effects:
            city = None if city is None else effect.corrected_map(city)
        return city

    def with_effects(self, effects: Iterable[Effect]) -> Model:
        """Replace the effects; terms of effects that stay are not computed again."""
        known, effects = dict(zip(self.effects, self.terms, strict=True)), tuple(effects)
        return replace(self, effects=effects, terms=tuple(
            known[effect] if effect in known else effect.term(self.links, self.level_at)
            for effect in effects))

    def with_effect_at(self, place: int, effect: Effect) -> Model:
        """Replace the effect at an index; -1: the last."""
        effects = list(self.effects)
        effects[place] = effect
        return self.with_effects(effects)

    def restrict(self, rows: np.ndarray) -> Model:
        """Return the model on links `rows` (r,) only, all of them training links."""
        train = np.ones(len(rows), dtype=bool)
        return replace(
            self, links=self.links.select(rows), train=train, usable=train,
            channel_db=self.channel_db[rows], level_columns=self.level_columns[rows],
            group=self.group[rows], terms=tuple(term.select(rows) for term in self.terms))

    def regression(self, rows: np.ndarray | slice = slice(None)) -> CensoredRegression:
        """Build the regression of levels on some links; those not detected are censored."""
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
        """Return the censored regression on the training links."""
        return self.regression(self.train)

    @cached_property
    def limit_db(self) -> np.ndarray:
        """Return the limit of detection (n,) [dB], raised by effects that set it; -inf: unknown."""
        limit_db = self.links.limit_db
        for effect in self.effects:
            if isinstance(effect, LimitEffect):
                limit_db = np.maximum(limit_db, effect.limits_db(self.links))
        return limit_db

    def fit(self, start: FitResult | None = None) -> Fit:
        """Fit to the training links; an error scale without training link becomes the largest."""
        found = censored_regression.fit(self.training, start)
        trained = np.unique(self.training.group)
        scale_db = np.full(self.groups, found.scale_db[trained].max())
        scale_db[trained] = found.scale_db[trained]
        return Fit(found.coefficients, scale_db, found.objective, self)

    @property
    def coefficient_slices(self) -> list[slice]:
        """Return for each effect the slice of its coefficients among all coefficients."""
        widths = [term.columns.shape[1] for term in self.terms]
        ends = np.cumsum([self.level_columns.shape[1], *widths]).tolist()
        return [slice(first, end) for first, end in zip(ends, ends[1:], strict=False)]

    @cached_property
    def losses(self) -> Losses:
        """Return how likely effects blank or lower each reading; only the strongest lowers it."""
        losses = [effect.losses(self.links) for effect in self.effects
                  if isinstance(effect, DetectionEffect)]
        if not losses:
            return NO_LOSSES
        read = np.prod([1.0 - np.asarray(loss.blank) for loss in losses], axis=0)
        # Two effects that lower levels of the same links are not searched for.
        largest = max(losses, key=lambda loss: float(np.mean(loss.drop)))
        return Losses(1.0 - read, largest.drop, largest.drop_db)

    def _scatter_sd_db(self, rows: np.ndarray | slice) -> np.ndarray | float:
        """Return the sd (n,) by which effects say that links scatter at random [dB]."""
        return _root_sum_square([term.random_effect_sd_db for term in self.terms], rows)

    def _random_effect_sd_db(self, rows: np.ndarray | slice) -> np.ndarray | float:
        """Return the sd (n,) of random scatter and of levels of unheard devices together [dB]."""
        unheard = [term.unheard_sd_db for term in self.terms]
        return np.hypot(self._scatter_sd_db(rows), _root_sum_square(unheard, rows))

    def _response(self, stage: str, rows: np.ndarray | slice) -> Response | None:
        """Return the combined response of the effects of a stage; None without any."""
        return response([(effect, None if term.inputs is None else term.inputs[rows])
                         for effect, term in zip(self.effects, self.terms, strict=True)
                         if effect.stage == stage])


@dataclass(frozen=True, eq=False)
class Fit(FitResult):
    """A model with the coefficients, error scales and objective of its fit to the training links.

    Some attributes of the model are also those of the fit: `fit.links`.

    Attributes:
        model: the model.
        shadowing: interpolation of its residuals over the ground; None: none.
    """

    model: Model
    shadowing: CorrelatedShadowing | None = None

    links = FromPart[Links]("model")
    train = FromPart[np.ndarray]("model")
    usable = FromPart[np.ndarray]("model")
    channel = FromPart[ChannelModel]("model")
    effects = FromPart[tuple[Effect, ...]]("model")

    @property
    def view(self) -> ResidualView:
        """Return the residuals of the training links, from which effects are proposed (cached)."""
        return _view(self)

    def coefficients_of(self, number: int) -> np.ndarray:
        """Return the coefficients (q,) of an effect, by its index."""
        return self.coefficients[self.model.coefficient_slices[number]]

    def with_effects(self, effects: Iterable[Effect]) -> Fit:
        """Replace the effects and fit again, starting from these coefficients."""
        return self.model.with_effects(effects).fit(self)

    def with_effect_at(self, place: int, effect: Effect) -> Fit:
        """Replace the effect at an index and fit again; -1: the last."""
        return self.model.with_effect_at(place, effect).fit(self)

    def for_map(self, rows: np.ndarray) -> Fit:
        """Restrict the fit to links `rows` (r,) and leave out receiver effects, as in a map."""
        fit = self.on_rows(rows)
        for place in reversed(range(len(fit.effects))):
            if not fit.effects[place].is_on_maps():
                fit = fit.without(place)
        no_receiver = np.full(len(fit.links), -1)
        links = fit.links.with_columns(receiver=no_receiver)
        return replace(fit, model=replace(fit.model, links=links))

    def on_rows(self, rows: np.ndarray) -> Fit:
        """Restrict the fit to links `rows` (r,); terms of effects are not computed again."""
        return replace(self, model=self.model.restrict(rows))

    def without(self, place: int) -> Fit:
        """Remove the effect at an index without fitting again."""
        model = self.model.with_effects([*self.effects[:place], *self.effects[place + 1:]])
        removed = self.model.coefficient_slices[place]
        return replace(self, coefficients=np.delete(self.coefficients, removed), model=model)

    @cached_property
    def learnt(self) -> FittedModel:
        """Return the fitted model without the training links, to predict any links."""
        model, sd_db = self.model, device_sd_db(self)
        return FittedModel(
            model.channel, model.effects,
            tuple(self.coefficients_of(number) for number in range(len(model.effects))),
            self.coefficients[:model.level_columns.shape[1]],
            self.scale_db, model.dof, model.links.device_m, tuple(model.links.receiver_names),
            model.links.first_s, sd_db, shadowing=self.shadowing, unheard=Unheard.of(self, sd_db))

    @property
    def training_z(self) -> np.ndarray:
        """Return residuals (m,) of the training links in error scales, clipped to MAX_REST_Z."""
        return np.clip(self.view.residual_db / self.view.scale_db, -MAX_REST_Z, MAX_REST_Z)

    def fit_shadowing(self, seed: int,
                      like: CorrelatedShadowing | None = None) -> CorrelatedShadowing:
        """Fit `shadowing` to the training links' residuals, with the correlation of `like`."""
        return CorrelatedShadowing.fit(self.links, self.train, self.training_z, seed, like)

    def predict(self, links: Links) -> Prediction:
        """Predict the levels of any links with the same devices and receivers."""
        return self.learnt.predict(links)

    def readings(self) -> Linearisation:
        """Return mean and error scale of all links' readings, ignoring the limit of detection."""
        return self.model.regression().predict(self)

    def reading_parts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Split the prediction of all links into mean, error scale, and spread of unheard devices.

        All are (n,) [dB]. The scale without that spread is the unit of interpolated residuals.
        """
        reading = self.readings()
        mean_db, total_db = reading.mean_db, reading.scale_db
        if all(term.unheard_sd_db is None for term in self.model.terms):
            return mean_db, total_db, np.zeros(len(total_db))
        scatter_sd_db = self.model._scatter_sd_db(slice(None))
        problem = replace(self.model.regression(), random_effect_sd_db=scatter_sd_db)
        scale_db = problem.predict(self).scale_db
        return mean_db, scale_db, np.sqrt(np.maximum(total_db**2 - scale_db**2, 0.0))


def _root_sum_square(sds_db: list[np.ndarray | None], rows: np.ndarray | slice
                     ) -> np.ndarray | float:
    """Combine independent standard deviations (n,) of links [dB]; None: none."""
    return np.sqrt(sum(sd_db[rows] ** 2 for sd_db in sds_db if sd_db is not None))


def response(effects: Sequence[tuple[Effect, Any]]) -> Response | None:
    """Chain the responses of effects, which change a level by a function of it; None: no effect.

    With each effect are the inputs (n, …) of its term. The function takes levels (n,) [dB] to
    changed levels (n,) [dB] and their slope (n,).
    """
    if not effects:
        return None

    def chained(level_db: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope = np.ones_like(level_db)
        for effect, inputs in effects:
            level_db, effect_slope = effect.response(  # type: ignore[attr-defined]
                level_db, inputs)
            slope = slope * effect_slope
        return level_db, slope
    return chained


@lru_cache(maxsize=VIEWS)
def _view(fit: Fit) -> ResidualView:
    """Compute the residuals of the training links, see `Fit.view`."""
    model = fit.model
    predicted = model.training.predict(fit)
    # If all are training links, keep the object, which caches results.
    links = model.links if model.train.all() else model.links.select(model.train)
    return ResidualView(links, model.training.residual_db(fit),
                        predicted.scale_db, predicted.mean_db, model.level_at,
                        model.effects)


@dataclass(frozen=True, eq=False)
class Unheard:
    """Population of device offsets: what to expect of devices without a reading.

    Attributes:
        devices: rows, at the fit, of devices without training link and without declared antenna.
        mean_db: mean over the other devices of what device effects add to their links [dB].
        sd_db: standard deviation of that over links and devices, with the device's own level [dB].
    """

    devices: tuple[int, ...]
    mean_db: float
    sd_db: float

    @classmethod
    def of(cls, fit: Fit, device_sd_db: float) -> Unheard | None:
        """Estimate mean and spread of trained devices' offsets; None: all are trained, or none."""
        links, device_db, declared = fit.links, np.zeros(len(fit.links)), set[int]()
        for number, (effect, term) in enumerate(zip(fit.effects, fit.model.terms, strict=True)):
            if effect.is_declared:
                declared |= set(getattr(effect.params, "devices", ()))
            elif effect.of_device:
                device_db += term.offset_db + term.columns @ fit.coefficients_of(number)
        device = links.device[fit.train]
        trained = np.unique(device)
        devices = sorted(set(range(len(links.device_m))) - set(trained.tolist()) - declared)
        if not devices or not len(trained):
            return None
        # Each device counts the same, however many readings it has.
        weight = 1.0 / np.bincount(device)[device] / len(trained)
        mean_db = float(weight @ device_db[fit.train])
        spread_db = np.sqrt(weight @ (device_db[fit.train] - mean_db) ** 2)
        return cls(tuple(devices), mean_db, float(np.hypot(spread_db, device_sd_db)))


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A fitted channel with effects, without its training links; predicts any links.

    Attributes:
        channel: fitted channel.
        effects: effects; their parameters refer to devices and receivers by row at the fit.
        coefficients: (q,) coefficients of each effect's term.
        level_coefficients: (p0,) coefficients of `ChannelModel.level_columns`.
        scale_db: (groups,) error scales [dB].
        dof: degrees of freedom of the Student-t errors.
        device_m: (k, 3) positions of the devices at the fit [m].
        receivers: names of the receivers at the fit.
        first_s: time of the first training measurement [s]; NaN without times.
        device_sd_db: standard deviation of a device's own level, common to all its links [dB].
        likelihood_power: power of the likelihood in localisation, see
            `radiotwin.twin.localize.calibration`.
        shadowing: interpolation of residuals over the ground; None: none.
        radius_factor: factor on 90 % radii of located devices, see the same module.
        typical_misfit: `misfit` of located devices in the training data, see the same module; NaN:
            unknown.
        blend: weights of other predictors beside this model; None: none.
        unheard: population of device offsets, for devices without a reading; None: no such device.
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
        """Return a model without refit or effects, with the errors that the channel states."""
        nothing = np.empty(0)
        return cls(channel, (), (), nothing, nothing, CHANNEL_DOF, np.empty((0, 3)), (), np.nan,
                   0.0)

    @property
    def is_channel_alone(self) -> bool:
        """Return True if neither levels nor effects were fitted to the channel."""
        return not len(self.scale_db)

    def for_positions(self) -> FittedModel:
        """Drop the effects that take too long to predict for every candidate position of a device.

        These are effects that follow paths, including map errors (nine maps for each link), and
        curves without a physical cause, which describe devices whose positions are known.
        `radius_factor` includes the position errors that their absence causes.
        """
        return self._filtered(lambda effect: effect.is_cause and not effect.in_paths)

    def _filtered(self, keep: Callable[[Effect], bool]) -> FittedModel:
        """Return the model with only the effects for which `keep` is True."""
        kept = [number for number, effect in enumerate(self.effects) if keep(effect)]
        return replace(self, effects=tuple(self.effects[number] for number in kept),
                       coefficients=tuple(self.coefficients[number] for number in kept))

    def on_links(self, links: Links) -> Fit:
        """Apply the model to other links (n,); in the result all count as training links.

        Links without receivers, such as those of a map, leave out the effects of receivers.
        """
        applied = self if links.receiver_names else self._filtered(
            lambda effect: effect.is_on_maps())
        model = Model.build(links, self.channel, self.dof).with_effects(applied.effects)
        coefficients = [self.level_coefficients, *applied.coefficients]
        needed = [model.level_columns, *(term.columns for term in model.terms)]
        for given, columns in zip(coefficients, needed, strict=True):
            if len(given) != columns.shape[1]:
                raise BadInput(f"the twin has {len(given)} coefficients where {columns.shape[1]} "
                               "are needed for these links; run `radiotwin fit` again")
        return Fit(np.concatenate(coefficients), self.scale_db, np.nan, model)

    def predict(self, links: Links) -> Prediction:
        """Predict mean, standard deviation and detection probability of links."""
        law = self.reading_law(links)
        return Prediction(law.mean_db, law.sd_db, law.detection_probability, law.reading_db)

    def reading_law(self, links: Links) -> ReadingLaw:
        """Return the predictive distribution of the readings of any links, with all effects."""
        if not self.is_channel_alone:
            return self.reading_law_on(self.on_links(links))
        mean_db, sd_db = self.channel.predict(links.geometry)
        return ReadingLaw(mean_db + self.channel.declared_db(links), sd_db / sd_of_scale(self.dof),
                          links.limit_db, self.dof)

    def reading_law_on(self, fit: Fit) -> ReadingLaw:
        """Return the predictive distribution of the links of this model's `on_links`.

        It has interpolated residuals. Twins use it for maps, folds for held-out links.
        """
        mean_db, scale_db, unheard_db = self._by_effects(fit)
        shift, remaining = shadowing = self._shadowing_at(fit.links)
        if self.blend is not None:
            mean_db, scale_db = self.blend.apply(fit.links, mean_db, scale_db, self.dof, shadowing)
        else:
            mean_db, scale_db = mean_db + shift * scale_db, scale_db * remaining
        return ReadingLaw(mean_db, np.hypot(scale_db, unheard_db), fit.model.limit_db, self.dof,
                          fit.model.losses)

    def predictions_on(self, fit: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return levels and error scales (n, k) [dB] of the models of the blend, for a fit's links.

        The third is the standard deviation (n,) of the levels of devices never heard [dB].
        """
        assert self.blend is not None
        mean_db, scale_db, unheard_db = self._by_effects(fit)
        return *self.blend.predictions(fit.links, mean_db, scale_db, self.dof,
                                       self._shadowing_at(fit.links)), unheard_db

    def _by_effects(self, fit: Fit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return `Fit.reading_parts`; unheard devices get mean offset and spread of the others."""
        mean_db, scale_db, unheard_db = fit.reading_parts()
        if self.unheard is not None:
            is_unheard = np.isin(fit.links.device, self.unheard.devices)
            mean_db = mean_db + self.unheard.mean_db * is_unheard
            # The spread of all device effects includes that of the device's offset.
            unheard_db = np.maximum(unheard_db, self.unheard.sd_db * is_unheard)
        return mean_db, scale_db, unheard_db

    def _shadowing_at(self, links: Links) -> tuple[np.ndarray, np.ndarray]:
        """Return interpolated residual (n,), and the share (n,) of the error scale that remains."""
        if self.shadowing is None:
            return np.zeros(len(links)), np.ones(len(links))
        return self.shadowing.at(links)


def device_sd_db(fit: Fit) -> float:
    """Estimate the standard deviation of devices' mean residuals [dB] (method of moments).

    The part that the scatter of single links explains is subtracted; 0 of few devices or links.
    """
    problem = fit.model.training
    reading = problem.predict(fit)
    slope = np.broadcast_to(reading.slope, problem.level_db.shape)
    # Where a receiver's response is flat, a device's own level is not visible.
    seen = np.isfinite(problem.level_db) & (slope > MIN_SLOPE)
    residual_db = (problem.residual_db(fit) / slope)[seen]
    scale_db = (reading.scale_db / slope)[seen]
    device = fit.links.device[fit.train][seen]
    residual_db = np.clip(residual_db, -MAX_Z * scale_db, MAX_Z * scale_db)
    count = np.bincount(device)
    enough = count >= MIN_LINKS
    if enough.sum() < MIN_LINKS:
        return 0.0
    mean_db = np.bincount(device, weights=residual_db)[enough] / count[enough]
    within = np.bincount(device, weights=residual_db**2)[enough] / count[enough] - mean_db**2
    noise = (within / (count[enough] - 1)).mean()
    return float(np.sqrt(max(mean_db.var(ddof=1) - noise, 0.0)))
