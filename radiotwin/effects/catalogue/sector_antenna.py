"""`antenna_pattern` of a device: an undeclared sector antenna, see `radiotwin.effects.antennas`."""

from collections.abc import Iterator
from itertools import product

import numpy as np
from typing_extensions import override

from radiotwin.effects.antennas import (
    BEAMWIDTHS_DEG,
    FRONT_TO_BACK_DB,
    MAX_PROPOSE_LINKS,
    MIN_LINKS,
    VERTICALS_DEG,
    Departures,
    SectorEffect,
    SectorPattern,
    report_patterns,
    vary_patterns,
)
from radiotwin.effects.arrays import MIN_NATS, frequent_anchors, subsample
from radiotwin.effects.base import ResidualView
from radiotwin.effects.params import Estimate, Parameter, Variation, quantities
from radiotwin.effects.patterns import Pattern, members
from radiotwin.links import Links, site_of

AZIMUTHS_DEG = np.arange(0.0, 360.0, 15.0).tolist()  # of trial patterns
TYPICAL_WIDTH_DEG = 65.0  # 3GPP TR 38.901, Table 7.3-1


class SectorAntenna(SectorEffect):
    """An undeclared sector antenna; each search step finds that of one device, or all of a mast."""

    settled_by = "fly around the device at one distance and one height"
    variant = "sector antenna of a device"
    acts_on = ("device", "device x receiver", "direction")
    repeatable = True

    @override
    def propose(self, view: ResidualView) -> list[SectorEffect.Params]:
        """Propose sector antennas for the best-fitting device's mast, and for that device alone."""
        known = {device for devices in view.found_params(self.name, "devices")
                 for device in devices}
        devices = sorted((set(frequent_anchors(view.links, MIN_LINKS)) - known)
                         & set(view.in_group(view.links.device)))
        patterns = {straight: _best_patterns(view, devices, straight)
                    for straight in ([False, True] if view.links.city is not None else [False])}
        straight = max(patterns, key=lambda key: max((nats for _, nats in patterns[key].values()),
                                                     default=0.0))  # if equal, the first
        found = patterns[straight]
        if not found:
            return []
        best = max(found, key=lambda device: found[device][1])
        # All sectors of the mast at once, as their evidence adds up, and the best one.
        mast = set(site_of(view.links, best)) & set(found)
        return [self.Params(devices={device: found[device][0] for device in sorted(chosen)},
                            straight=straight)
                for chosen in ([mast, {best}] if len(mast) > 1 else [{best}])]

    @override
    def variation(self) -> Variation:
        return vary_patterns(self, "devices")

    @override
    def typical_patterns(self, view: ResidualView) -> Iterator[Pattern]:
        """Yield a loss of 1 dB behind the sector antenna of one device, for several devices."""
        links, front_to_back = view.links, quantities(SectorPattern)["front_to_back_db"]
        for mask in members(links.device):
            off_deg = _signed_deg(links.azimuth_deg - median_azimuth_deg(links.azimuth_deg[mask]))
            yield Pattern("direction", "dB",
                          f"front to back of one device, {TYPICAL_WIDTH_DEG:.0f}° wide",
                          mask * -np.minimum(0.5 * (off_deg / TYPICAL_WIDTH_DEG) ** 2, 1.0),
                          low=front_to_back["low"], high=front_to_back["high"])

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report each device's antenna pattern, and its gain over the channel's level [dB]."""
        reported: dict[str, Parameter] = {}
        patterns_sd = np.reshape(estimate.params_sd, (len(self.params.devices), -1))
        for number, (device, pattern) in enumerate(self.params.devices.items()):
            reported |= report_patterns(
                {device: pattern}, patterns_sd[number], links.device_names,
                with_scattered=links.city is not None and not self.params.straight)
            reported[f"gain_db[{links.device_names[device]}]"] = Parameter.normal(
                estimate.coefficients[number], estimate.coefficients_sd[number], "dB")
        return reported


def median_azimuth_deg(azimuth_deg: np.ndarray) -> float:
    """Compute the median of directions (n,) about their circular mean [deg]."""
    mean_deg = np.degrees(np.angle(np.exp(1j * np.radians(azimuth_deg)).sum()))
    return float((mean_deg + np.median(_signed_deg(azimuth_deg - mean_deg))) % 360)


def _signed_deg(angle_deg: np.ndarray) -> np.ndarray:
    """Wrap angles to -180 to 180 [deg]."""
    return (angle_deg + 180) % 360 - 180


def _best_patterns(view: ResidualView, devices: list[int],
                   straight: bool) -> dict[int, tuple[SectorPattern, float]]:
    """Find device -> best pattern and its log-likelihood gain, where above `MIN_NATS` [nats]."""
    found = {}
    for device in devices:
        device_rows = np.flatnonzero(view.links.device == device)
        rows = subsample(device_rows, MAX_PROPOSE_LINKS)
        if not len(rows):
            continue
        pattern, nats = _best_pattern(view, rows, straight)
        nats = nats * len(device_rows) / len(rows)
        if nats > MIN_NATS:
            found[device] = pattern, nats
    return found


def _best_pattern(view: ResidualView, rows: np.ndarray,
                  straight: bool) -> tuple[SectorPattern, float]:
    """Find the likeliest trial pattern, and its gain in likelihood over a constant level [nats]."""
    rays, residual_db = Departures.of(view.links, rows, straight), view.residual_db[rows]
    weight = view.weight[rows] * np.isfinite(view.links.level_db[rows])

    def nats(offset_db: np.ndarray) -> float:
        level_db = weight @ (residual_db - offset_db) / max(weight.sum(), 1e-12)
        return float(view.gain_nats(rows, offset_db + level_db).sum())

    def rate_pattern(azimuth_deg: float, width_deg: float, back_db: float, tilt_deg: float = 0.0,
                     vertical_deg: float = 360.0) -> tuple[float, SectorPattern]:
        pattern = SectorPattern(
            azimuth_deg=azimuth_deg, beamwidth_deg=width_deg, front_to_back_db=back_db,
            tilt_deg=tilt_deg, vertical_beamwidth_deg=vertical_deg)
        return nats(rays.offset_db(pattern)), pattern

    # Of equal gains the pattern with the largest numbers is taken.
    flat = max((rate_pattern(*numbers)[0], numbers)
               for numbers in product(AZIMUTHS_DEG, BEAMWIDTHS_DEG, FRONT_TO_BACK_DB))[1]
    vertical = max((rate_pattern(*flat, *numbers)[0], numbers) for numbers in VERTICALS_DEG)[1]
    best, pattern = rate_pattern(*flat, *vertical)
    return pattern, best - nats(np.zeros(len(rows)))
