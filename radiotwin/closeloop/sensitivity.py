"""How large an effect would have had to be, to be seen in these measurements.

For each family a typical pattern over the links is laid beside what the base may be wrong in
(`radiotwin.closeloop.hypotheses`): the size at which the expected evidence makes it probable
enough to be named. What was not named and is smaller may be there.
"""

from __future__ import annotations

from collections.abc import Iterator, Set
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from radiotwin.closeloop.criteria import SelectionCriteria
from radiotwin.closeloop.hypotheses import Hypotheses
from radiotwin.closeloop.posterior import features, probability_of
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
        size: in `unit`; inf where no size would do.
        unit: dB, dB/km or m.
        pattern: what its size is of.
    """

    name: str
    size: float
    unit: str
    pattern: str


def detectable(hypotheses: Hypotheses, criteria: SelectionCriteria,
               there: Set[str] = frozenset()) -> list[Detectable]:
    """Return the least size that would have been named of each family that can be there.

    Args:
        hypotheses: about what the last model lacks.
        criteria: with the probability that is needed.
        there: names of the effects of that model.
    """
    found: dict[tuple[str, str, str], list[float]] = {}
    rest_db, noise_db = hypotheses.sizes_db
    ratio, probability = rest_db / noise_db, criteria.min_probability
    for name, unit, what, pattern in _patterns(hypotheses.links):
        information = hypotheses.information(pattern)
        nats = needed_nats(name, probability, ratio, bool(there - {name}))
        nats += 0.5 * np.log(len(pattern))
        size = np.sqrt(2 * nats / information) if information > 0 else np.inf
        found.setdefault((name, unit, what), []).append(float(size))
    return [Detectable(name, float(np.median(sizes)), unit, what)
            for (name, unit, what), sizes in found.items()]


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


def _patterns(links: LinkData) -> Iterator[tuple[str, str, str, np.ndarray]]:
    """Yield family, unit, description and change (n,) of unit size."""
    one, timed = np.ones(len(links)), np.isfinite(links.time_s)
    for end, label in (("receiver", links.receiver), ("device", links.device)):
        for mine in _members(label):
            yield f"{end}_gain_offset", "dB", f"a constant of one {end}", mine * one
            if timed[mine].mean() > 0.5 and np.ptp(links.time_s[mine & timed]) > 0:
                first, last = np.nanmin(links.time_s[mine]), np.nanmax(links.time_s[mine])
                ramp = np.nan_to_num((links.time_s - first) / (last - first))
                yield f"{end}_drift", "dB", f"from first to last of one {end}", mine * ramp
                middle = first + np.array([0.5 - EPISODE / 2, 0.5 + EPISODE / 2]) * (last - first)
                if end == "receiver":
                    during = (links.time_s >= middle[0]) & (links.time_s <= middle[1])
                    yield ("episode", "dB", f"over {EPISODE:.0%} of the time of one receiver",
                           mine & during)
    for mine in _members(links.track):
        yield "faulty_flight", "dB", "a constant of one flight of one receiver", mine * one
    yield "excess_attenuation", "dB/km", "on all links", -links.distance_m / 1000
    if np.isfinite(links.body_azimuth_deg).any():
        back = 0.5 - 0.5 * np.cos(np.radians(np.nan_to_num(links.body_azimuth_deg)))
        yield "body_shadowing", "dB", "behind the receiver's body", -back
    for mine in _members(links.device):
        off = _signed_deg(links.azimuth_deg - median_azimuth_deg(links.azimuth_deg[mine]))
        yield ("antenna_pattern", "dB", f"front to back of one device, {BEAMWIDTH_DEG:.0f}° wide",
               mine * -np.minimum(0.5 * (off / BEAMWIDTH_DEG) ** 2, 1.0))
        hidden = mine & (np.abs(off) < SECTOR_DEG / 2)
        if hidden.sum() >= MIN_LINKS:
            for name in ("missing_obstacle", "removed_obstacle", "foliage"):
                yield name, "dB", f"in {SECTOR_DEG:.0f}° around one device", hidden * one
        moved_m = np.linalg.norm(links.offset_m - [0.0, MOVE_M, 0.0], axis=1)
        change_db = -20 * np.log10(np.maximum(moved_m, 1.0) / links.distance_m)
        yield "device_position_error", "m", "of one device", mine * change_db / MOVE_M


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
