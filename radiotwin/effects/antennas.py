"""Antenna patterns that effects share: sector antennas, and patterns fixed to a receiver's body.

A sector antenna has the pattern of 3GPP TR 38.901 V17, Table 7.3-1: horizontally −min(12 (φ /
φ_3dB)², A_max), vertically −min(12 ((θ − tilt) / θ_3dB)², A_max), together no less than −A_max. The
maximum gain is part of the device's fitted level. With a 3D map each path has the gain of the
direction in which it leaves the device; the power on paths that are not followed is fitted and has
the mean gain of the pattern. If the direction of the straight line explains the levels better (e.g.
over a map with guessed heights), that direction is used.
"""

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.arrays import frequent_anchors, frequent_labels, one_hot
from radiotwin.effects.base import Effect, GainEffect, LevelAt, ResidualView, Term
from radiotwin.effects.params import (
    Allowed,
    DeviceIndex,
    EffectParams,
    Parameter,
    Variation,
    quantities,
    quantity,
)
from radiotwin.effects.places import Correction, FoundAntenna
from radiotwin.links import Links
from radiotwin.propagation.laws.followed_paths import Rays

MIN_LINKS = 100  # of a device, to fit its antenna
MAX_PROPOSE_LINKS = 300  # of a device, drawn at random for the proposal
LEVEL_SD_DB = 15.0  # prior standard deviation of the maximum gain about the channel's level
MIN_HEADING_SD = 0.05  # sd of sine plus cosine below which the heading counts as constant
# Grid of trial patterns: patterns flat in elevation, then the best of them with (tilt, beamwidth).
BEAMWIDTHS_DEG = (65.0, 110.0)
FRONT_TO_BACK_DB = (12.0, 25.0)
VERTICALS_DEG = ((0.0, 360.0), (0.0, 15.0), (-6.0, 15.0), (-12.0, 15.0), (0.0, 40.0),
                 (-10.0, 40.0), (15.0, 40.0), (40.0, 65.0))
AROUND_DEG = np.arange(0.0, 360.0, 5.0)  # azimuths over which a pattern is averaged


def vary_patterns(effect: Effect, end: str) -> Variation:
    """Put the pattern parameters of all devices, or receivers, into one vector for the search.

    Args:
        effect: the effect with its patterns.
        end: "devices" or "receivers": the parameter that holds the patterns by index.
    """
    patterns = getattr(effect.params, end)
    count, fields = len(patterns), quantities(next(iter(patterns.values())))
    values = np.array([[getattr(pattern, name) for name in fields]
                       for pattern in patterns.values()])
    steps, low, high = (np.tile([field[key] for field in fields.values()], count)
                        for key in ("step", "low", "high"))

    def with_numbers(numbers: np.ndarray) -> Any:
        rows = np.reshape(numbers, (count, -1)).tolist()
        return effect.changed(**{end: {
            member: pattern.model_copy(update=dict(zip(fields, row, strict=True)))
            for (member, pattern), row in zip(patterns.items(), rows, strict=True)}})

    return Variation(values.ravel(), steps, low, high, with_numbers,
                     list(np.arange(values.size).reshape(count, -1)))


def report_patterns(patterns: Mapping[int, EffectParams], params_sd: np.ndarray,
                    names: Sequence[str], prefix: str = "",
                    with_scattered: bool = True) -> dict[str, Parameter]:
    """Report every parameter of fitted antenna patterns by name, with a 90 % interval.

    Args:
        patterns: k fitted patterns by index of their device or receiver.
        params_sd: (k r,) standard deviations of their r parameters each.
        names: names of the devices or receivers.
        prefix: prefix of the parameters' names.
        with_scattered: False leaves out the last parameter, the power on paths not followed.
    """
    reported = {}
    for (member, pattern), sd in zip(patterns.items(), np.reshape(params_sd, (len(patterns), -1)),
                                     strict=True):
        for (name, field), field_sd in zip(quantities(pattern).items(), sd, strict=True):
            reported[f"{prefix}{name}[{names[member]}]"] = Parameter.normal(
                getattr(pattern, name), field_sd, field["unit"], Allowed.of(field))
        if not with_scattered:
            reported.popitem()
    return reported


class BodyFrameEffect(GainEffect):
    """An effect with one pattern per receiver, fixed to its body; see `Params.receivers`."""

    settled_by = "fly the same track in both directions"
    figure = "pattern"
    of_receiver = True
    arrivals: ClassVar[Any]  # links, rows -> their arrivals, with a `gain_db(pattern)`
    params: Any

    @abstractmethod
    def usable(self, links: Links) -> np.ndarray:
        """Return the mask (n,) of links that patterns are fitted to."""

    @abstractmethod
    def best_pattern(self, view: ResidualView, rows: np.ndarray) -> EffectParams | None:
        """Find the best pattern for `rows` (r,) of one receiver; None if it improves little."""

    @override
    def propose(self, view: ResidualView) -> list[Any]:
        """Propose together all patterns that clearly fit receivers of `MIN_LINKS` links."""
        usable, receiver = self.usable(view.links), view.links.receiver
        found = {member: self.best_pattern(view, np.flatnonzero((receiver == member) & usable))
                 for member in frequent_labels(receiver[usable], MIN_LINKS)}
        found = {member: pattern for member, pattern in found.items() if pattern is not None}
        return [self.Params.model_validate({"receivers": found})] if found else []

    @override
    def gain_db(self, links: Links) -> np.ndarray:
        """Compute the gain (n,) by the receivers' patterns [dB]; 0 without pattern or heading."""
        gain_db = np.zeros(len(links))
        for receiver, pattern in self.params.receivers.items():
            rows = np.flatnonzero((links.receiver == receiver) & np.isfinite(links.heading_deg))
            arrivals = self.of_links.get(links, receiver, partial(self.arrivals, links, rows))
            gain_db[rows] = arrivals.gain_db(pattern)
        return gain_db

    @override
    def unavailable(self, links: Links) -> str | None:
        """Return why headings cannot tell body-fixed from world directions; None if they can."""
        if np.isnan(links.heading_deg).all():
            return "there is no heading_deg, so directions in the receiver's body frame are unknown"
        heading = np.radians(links.heading_deg)
        if np.nanstd(np.cos(heading)) + np.nanstd(np.sin(heading)) < MIN_HEADING_SD:
            return "the heading never changes, so body and world frame cannot be distinguished"
        return None

    @override
    def variation(self) -> Variation:
        return vary_patterns(self, "receivers")


class SectorPattern(EffectParams):
    """Pattern of one sector antenna; by default flat in elevation."""

    azimuth_deg: float = quantity(
        0.0, unit="deg", low=-720.0, high=1080.0, step=8.0,
        description="Direction of the maximum, clockwise from north.")
    beamwidth_deg: float = quantity(
        65.0, unit="deg", low=20.0, high=150.0, step=10.0,
        description="Horizontal width between the points 3 dB below the maximum.")
    front_to_back_db: float = quantity(
        25.0, unit="dB", low=8.0, high=45.0, step=3.0, description="Greatest attenuation.")
    tilt_deg: float = quantity(
        0.0, unit="deg", low=-60.0, high=80.0, step=4.0,
        description="Elevation of the maximum, up is positive.")
    vertical_beamwidth_deg: float = quantity(
        360.0, unit="deg", low=6.0, high=360.0, step=5.0,
        description="Vertical width between the points 3 dB below the maximum.")
    scattered_db: float = quantity(
        -35.0, unit="dB under free space", low=-80.0, high=-15.0, step=6.0,
        description="Power on paths that are not followed.")


def sector_pattern_db(azimuth_deg: np.ndarray, elevation_deg: np.ndarray,
                      pattern: SectorPattern) -> np.ndarray:
    """Compute the gain of a sector antenna relative to its maximum (3GPP TR 38.901) [dB].

    Args:
        azimuth_deg: (…,) azimuth, clockwise from north [deg].
        elevation_deg: (…,) elevation, up [deg].
        pattern: parameters of the antenna.
    """
    max_db = pattern.front_to_back_db
    turn_deg = azimuth_deg - pattern.azimuth_deg
    off_deg = turn_deg - 360 * np.round(turn_deg / 360)  # ten times as fast as a remainder
    above_deg = elevation_deg - pattern.tilt_deg
    horizontal_db = np.minimum(12 * (off_deg / pattern.beamwidth_deg) ** 2, max_db)
    vertical_db = np.minimum(12 * (above_deg / pattern.vertical_beamwidth_deg) ** 2, max_db)
    return -np.minimum(horizontal_db + vertical_db, max_db)


def linear(gain_db: np.ndarray) -> np.ndarray:
    """Convert gains [dB] to power ratios; in single precision faster than a power of 10."""
    return np.exp(gain_db * (math.log(10) / 10))


class Departures(NamedTuple):
    """Directions of departure of the rays of links at their device.

    Attributes:
        rays: p rays at the device.
        azimuth_deg, elevation_deg: (p,) directions of the rays [deg].
    """

    rays: Rays
    azimuth_deg: np.ndarray
    elevation_deg: np.ndarray

    @classmethod
    def of(cls, links: Links, rows: np.ndarray, straight: bool) -> "Departures":
        """Find at which angles paths over the map (`straight`: direct lines) leave the device."""
        rays = Rays.of(links.select(rows), of_device=True, straight=straight)
        east, north, up = rays.direction.T
        return cls(rays, np.degrees(np.arctan2(east, north)),
                   np.degrees(np.arcsin(np.clip(up, -1, 1))))

    def offset_db(self, pattern: SectorPattern) -> np.ndarray:
        """Compute each link's gain (n,) by a pattern instead of an isotropic antenna [dB]."""
        gain = linear(sector_pattern_db(self.azimuth_deg, self.elevation_deg, pattern))
        at_tilt = np.full(len(AROUND_DEG), pattern.tilt_deg)
        mean_gain = np.mean(linear(sector_pattern_db(AROUND_DEG, at_tilt, pattern)))
        return self.rays.through_antenna_db(gain, pattern.scattered_db, float(mean_gain))


class SectorEffect(GainEffect):
    """Base of effects that give devices sector antennas."""

    name = "antenna_pattern"
    in_words = "directions of the device's antenna"
    figure = "pattern"
    of_device = True
    confused_with = ("device_gain_offset", "device_position_error", "missing_obstacle", "foliage")

    class Params(EffectParams):
        """Antennas of devices."""

        devices: dict[DeviceIndex, SectorPattern] = Field(
            description="Pattern of each device, by index.")
        straight: bool = Field(False, description=(
            "Whether links leave along the straight line even where there is a 3D map."))

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        if not frequent_anchors(links, MIN_LINKS):
            return f"no device of known position has {MIN_LINKS} links"
        return None

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return the pattern's gain on each device's links [dB], and a fitted level per device."""
        offset_db = np.zeros(len(links))
        for device, pattern in self.params.devices.items():
            rows = np.flatnonzero(links.device == device)
            if len(rows):
                departures = self.of_links.get(links, (device, self.params.straight),
                                      partial(Departures.of, links, rows, self.params.straight))
                offset_db[rows] = departures.offset_db(pattern)
        return Term(offset_db, one_hot(links.device, list(self.params.devices)),
                    np.full(len(self.params.devices), LEVEL_SD_DB))

    @override
    def correction(self, links: Links) -> Correction:
        return Correction(antennas={device: FoundAntenna(
            "sector antenna", pattern.azimuth_deg, pattern.beamwidth_deg,
            partial(sector_pattern_db, pattern=pattern.model_copy(update={"azimuth_deg": 0.0})))
            for device, pattern in self.params.devices.items()})
