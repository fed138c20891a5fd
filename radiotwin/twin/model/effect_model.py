"""A channel with refitted levels and fitted effects, for any links: the result of `close-loop`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.inference.student import detection_probability
from radiotwin.links import Links
from radiotwin.links.links import Prediction
from radiotwin.propagation.laws import ChannelModel
from radiotwin.twin.model.blend import Blend
from radiotwin.twin.model.correlated_shadowing import CorrelatedShadowing
from radiotwin.twin.model.fold_model import Fit, FittedEffect, FoldModel

MIN_LINKS = 3  # of a device whose mean residual is known
MIN_SLOPE = 0.5  # of a receiver's response that passes a device's own level on
MAX_Z = 4.0  # an outlier counts as this many scales


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
        """Return that of devices without a training link; None if each has one.

        Args:
            fit: of a model.
            device_sd_db: as of `EffectModel` [dB].
        """
        links, own_db, declared = fit.links, np.zeros(len(fit.links)), set[int]()
        for number, each in enumerate(fit.effects):
            if each.effect.is_declared:
                declared |= set(getattr(each.params, "devices", ()))
            elif each.effect.of_device:
                own_db += each.term.offset_db + each.term.columns @ fit.coefficients_of(number)
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
class EffectModel:
    """A fitted channel with effects, ready for links that were not among the training links.

    Attributes:
        channel: fitted.
        effects: fitted; they count devices and receivers by their rows at the fit.
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
    effects: tuple[FittedEffect, ...]
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
    def of(cls, fit: Fit) -> EffectModel:
        """Return what was learnt from the training links of a model."""
        model, sd_db = fit.model, device_sd_db(fit)
        return cls(model.channel, fit.fitted_effects,
                   fit.coefficients[:model.level_columns.shape[1]], fit.scale_db, model.dof,
                   model.links.device_m, tuple(model.links.receiver_names), model.links.first_s,
                   sd_db, unheard=Unheard.of(fit, sd_db))

    def for_positions(self) -> EffectModel:
        """Return the same without what takes too long for each place where a device may be.

        That is what the base says of errors of a map, for which each link is followed over nine
        maps, and effects that follow paths. Curves without a cause go, too: they describe what is
        left on links of devices whose positions are known. How far their lack displaces devices is
        in `radius_factor`.
        """
        return replace(self, effects=tuple(each for each in self.effects
                                           if each.effect.is_cause and not each.effect.in_paths))

    def on_links(self, links: Links) -> Fit:
        """Return the fit with any links (n,) in place of those that it has learnt from.

        Where the links have no receivers (a map's have none) those are faultless: effects of
        receivers are left out.
        """
        effects = [each for each in self.effects
                   if links.receiver_names or each.effect.is_on_maps(each.params)]
        model = FoldModel.build(links, self.channel, self.dof)
        model = model.with_effects([model.apply(each.effect, each.params) for each in effects])
        coefficients = [self.level_coefficients, *(each.coefficients for each in effects)]
        needed = [model.level_columns, *(each.term.columns for each in model.effects)]
        for own, columns in zip(coefficients, needed, strict=True):
            if len(own) != columns.shape[1]:
                raise BadInput(f"the twin has {len(own)} coefficients where {columns.shape[1]} are "
                               "needed for these links; run `radiotwin fit` again")
        return Fit(np.concatenate(coefficients), self.scale_db, np.nan, model)

    def predict(self, links: Links) -> Prediction:
        """Return the levels that are expected of links, see `Prediction`."""
        fit = self.on_links(links)
        model = fit.model
        mean_db, scale_db, unheard_db = fit.reading_parts()
        if self.unheard is not None:
            of_them = np.isin(links.device, self.unheard.devices)
            mean_db = mean_db + self.unheard.mean_db * of_them
            unheard_db = np.hypot(unheard_db, self.unheard.sd_db * of_them)
        shift, left = np.zeros(len(links)), np.ones(len(links))
        if self.shadowing is not None and self.shadowing.receivers_move:
            shift, left = self.shadowing.at(links)
        if self.blend is not None:
            mean_db, scale_db = self.blend.apply(model.links, mean_db, scale_db, shift)
        else:
            mean_db = mean_db + shift * scale_db
            scale_db = scale_db * left
        return Prediction(
            mean_db, np.hypot(scale_db * np.sqrt(self.dof / (self.dof - 2)), unheard_db),
            detection_probability(mean_db, np.hypot(scale_db, unheard_db), model.limit_db, self.dof,
                                  model.losses))


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
