"""How large an effect would have had to be, to be seen in these measurements.

For each family a typical pattern over the links is laid beside what the base may be wrong in
(`radiotwin.closeloop.hypotheses`): the size at which the expected evidence makes it probable
enough to be named. What was not named and is smaller may be there. Only what was looked for in
these links is asked, and a size counts only within what its effect allows.
"""

from __future__ import annotations

from collections.abc import Iterator, Set
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from radiotwin.closeloop.criteria import SelectionCriteria
from radiotwin.closeloop.hypotheses import Hypotheses
from radiotwin.closeloop.posterior import features, probability_of
from radiotwin.effects import (
    episode,
    excess_attenuation,
    foliage,
    gain_offsets,
    missing_obstacle,
    position_errors,
)
from radiotwin.effects.base import Effect
from radiotwin.effects.body_shadowing import Body, BodyShadowing
from radiotwin.effects.faulty_flight import FaultyFlight
from radiotwin.effects.gain_drift import DeviceDrift, ReceiverDrift
from radiotwin.effects.params import quantities
from radiotwin.effects.removed_obstacle import RemovedObstacle
from radiotwin.effects.sector_antenna import SectorAntenna, SectorPattern
from radiotwin.effects.vegetation import max_loss_db
from radiotwin.links import LinkData

MAX_ENDS = 12  # devices or receivers of which the median is taken
MIN_LINKS = 30  # of an end or a part of a flight
MAX_NATS = 1e4  # more are not looked for
SECTOR_DEG = 20.0  # width of what a building or a grove hides from a device
BEAMWIDTH_DEG = 65.0  # of a sector antenna (3GPP TR 38.901, Table 7.3-1)
MOVE_M = 10.0  # of a device, for the slope of levels in its position
EPISODE = 0.1  # share of the time


@dataclass(frozen=True)
class Detectable:
    """Least size of an effect that would have been named.

    Attributes:
        name: of the effect.
        size: in `unit`; inf where no size would do that the effect may have.
        unit: dB, dB/km or m.
        pattern: what its size is of.
    """

    name: str
    size: float
    unit: str
    pattern: str


def detectable(hypotheses: Hypotheses, criteria: SelectionCriteria,
               there: Set[str] = frozenset()) -> list[Detectable]:
    """Return the least size that would have been named of each family that was looked for.

    Args:
        hypotheses: about what the last model lacks.
        criteria: with the probability that is needed.
        there: names of the effects of that model.
    """
    found: dict[tuple[type[Effect], str, str], list[float]] = {}
    rest_db, noise_db = hypotheses.sizes_db
    ratio, probability = rest_db / noise_db, criteria.min_probability
    links = hypotheses.links
    for effect, unit, what, pattern in _patterns(links):
        information = hypotheses.information(pattern)
        nats = needed_nats(effect.name, probability, ratio, bool(there - {effect.name}))
        nats += 0.5 * np.log(len(pattern))
        size = np.sqrt(2 * nats / information) if information > 0 else np.inf
        found.setdefault((effect, unit, what), []).append(float(size))
    return [Detectable(effect.name, _allowed(effect, float(np.median(sizes)), links), unit, what)
            for (effect, unit, what), sizes in found.items() if effect().unavailable(links) is None]


def needed_nats(name: str, probability: float, rest_over_noise: float,
                is_another_kind: bool = False) -> float:
    """Return the evidence that makes an effect so probable, if nothing competes with it [nats].

    inf where none does.
    """
    def lack(nats: float) -> float:
        return probability_of(name, features((nats, nats, nats), 0.0, rest_over_noise,
                                             is_another_kind)) - probability

    if lack(0.0) >= 0:
        return 0.0
    return float(brentq(lack, 0.0, MAX_NATS)) if lack(MAX_NATS) > 0 else np.inf


def _allowed(effect: type[Effect], size: float, links: LinkData) -> float:
    """Return the least size from another one on that an effect may have; inf where none is."""
    low, high = _bounds(effect, links)
    return max(size, low) if size <= high else np.inf


def _bounds(effect: type[Effect], links: LinkData) -> tuple[float, float]:
    """Return the least and the largest size that an effect may have, as of `implausible`."""
    known = bool(np.isfinite(links.frequency_hz))
    if effect in (gain_offsets.DeviceGainOffset, gain_offsets.ReceiverGainOffset):
        return gain_offsets.MIN_OFFSET_DB, np.inf
    if effect is episode.Episode:
        return episode.MIN_DB, np.inf
    if effect is position_errors.DevicePositionError:
        return position_errors.MIN_MOVE_M, position_errors.MAX_MOVE_M
    if effect is missing_obstacle.MissingObstacle:
        return 0.0, missing_obstacle.MAX_LOSS_DB
    if effect is foliage.Foliage:
        return 0.0, max_loss_db(links.frequency_hz) if known else foliage.UNKNOWN_MAX_LOSS_DB
    if effect is excess_attenuation.ExcessAttenuation and known:
        # Its pattern is the same at all heights.
        return 0.0, excess_attenuation.max_at_ground_db_km(
            links.frequency_hz, excess_attenuation.MAX_HEIGHT_M)
    if effect in (BodyShadowing, SectorAntenna):
        field = (quantities(Body)["depth_db"] if effect is BodyShadowing else
                 quantities(SectorPattern)["front_to_back_db"])
        return field["low"], field["high"]
    return 0.0, np.inf


def _patterns(links: LinkData) -> Iterator[tuple[type[Effect], str, str, np.ndarray]]:
    """Yield effect, unit, description and change (n,) of unit size."""
    one, timed = np.ones(len(links)), np.isfinite(links.time_s)
    for end, label, offset, drift in (
            ("receiver", links.receiver, gain_offsets.ReceiverGainOffset, ReceiverDrift),
            ("device", links.device, gain_offsets.DeviceGainOffset, DeviceDrift)):
        for mine in _members(label):
            yield offset, "dB", f"a constant of one {end}", mine * one
            if timed[mine].mean() > 0.5 and np.ptp(links.time_s[mine & timed]) > 0:
                first, last = np.nanmin(links.time_s[mine]), np.nanmax(links.time_s[mine])
                ramp = np.nan_to_num((links.time_s - first) / (last - first))
                yield drift, "dB", f"from first to last of one {end}", mine * ramp
                if end == "receiver":
                    # Of the time that it measured: half-way may be between two flights.
                    middle = np.nanquantile(links.time_s[mine], [0.5 - EPISODE / 2,
                                                                 0.5 + EPISODE / 2])
                    during = (links.time_s >= middle[0]) & (links.time_s <= middle[1])
                    yield (episode.Episode, "dB",
                           f"over {100 * EPISODE:.0f} % of the time of one receiver", mine & during)
    for mine in _members(links.track):
        yield FaultyFlight, "dB", "a constant of one flight of one receiver", mine * one
    yield (excess_attenuation.ExcessAttenuation, "dB/km", "on all links, at all heights alike",
           -links.distance_m / 1000)
    if np.isfinite(links.body_azimuth_deg).any():
        back = 0.5 - 0.5 * np.cos(np.radians(np.nan_to_num(links.body_azimuth_deg)))
        yield BodyShadowing, "dB", "behind the receiver's body", -back
    for mine in _members(links.device):
        off = _signed_deg(links.azimuth_deg - median_azimuth_deg(links.azimuth_deg[mine]))
        yield (SectorAntenna, "dB", f"front to back of one device, {BEAMWIDTH_DEG:.0f}° wide",
               mine * -np.minimum(0.5 * (off / BEAMWIDTH_DEG) ** 2, 1.0))
        hidden = mine & (np.abs(off) < SECTOR_DEG / 2)
        if hidden.sum() >= MIN_LINKS:
            for effect in (missing_obstacle.MissingObstacle, RemovedObstacle, foliage.Foliage):
                yield effect, "dB", f"in {SECTOR_DEG:.0f}° around one device", hidden * one
        moved_m = np.linalg.norm(links.offset_m - [0.0, MOVE_M, 0.0], axis=1)
        change_db = -20 * np.log10(np.maximum(moved_m, 1.0) / links.distance_m)
        yield position_errors.DevicePositionError, "m", "of one device", mine * change_db / MOVE_M


def median_azimuth_deg(azimuth_deg: np.ndarray) -> float:
    """Return the median of directions (n,), taken around their mean: there is no step at north."""
    mean_deg = np.degrees(np.angle(np.exp(1j * np.radians(azimuth_deg)).sum()))
    return float((mean_deg + np.median(_signed_deg(azimuth_deg - mean_deg))) % 360)


def _signed_deg(angle_deg: np.ndarray) -> np.ndarray:
    """Return the same angles from -180 up to 180 [deg]."""
    return (angle_deg + 180) % 360 - 180


def _members(label: np.ndarray) -> list[np.ndarray]:
    """Return masks (n,) of up to `MAX_ENDS` labels with links enough, if there are two at least."""
    values, counts = np.unique(label, return_counts=True)
    values = values[counts >= MIN_LINKS]
    if len(values) < 2:
        return []
    return [label == value for value in values[:: -(-len(values) // MAX_ENDS)]]
