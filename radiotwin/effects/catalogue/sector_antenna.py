"""A device with a sector antenna: gain depends on the direction in which a link leaves the device.

Pattern of 3GPP TR 38.901 V17, Table 7.3-1: horizontally −min(12 (φ / φ_3dB)², A_max), vertically
−min(12 ((θ − tilt) / θ_3dB)², A_max), together no less than −A_max. The maximum gain is the
device's level and is fitted with it. With a 3D map each path has the gain of the direction in which
it leaves the device. Power on paths that are not followed, which is fitted too, has the mean of the
pattern. Where the paths over the map explain less than the straight line to the receiver, as over
a map with guessed heights, the gain is that of the straight line.
"""

from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.antenna_params import AntennaParams, report_pattern, vary_patterns
from radiotwin.effects.arrays import LinkCache, frequent_labels, one_hot, subsample
from radiotwin.effects.base import GainEffect, LevelAt, ResidualView, Term
from radiotwin.effects.params import (
    DeviceIndex,
    EffectParams,
    Estimate,
    Parameter,
    Variation,
    quantity,
)
from radiotwin.links import Links, site_of
from radiotwin.propagation.laws.followed_paths import free_space, rays_of, through_antenna_db

MIN_LINKS = 100  # of a device whose antenna is looked for
MIN_NATS = 4.0  # that a pattern must gain to be proposed
MAX_PROPOSE_LINKS = 300  # of a device, from which its pattern is proposed
LEVEL_SD_DB = 15.0  # prior standard deviation of the maximum gain, beside the channel's
# Grid of patterns that are tried first: flat ones, then the best of those with (tilt, beamwidth).
AZIMUTHS_DEG = np.arange(0.0, 360.0, 15.0).tolist()
BEAMWIDTHS_DEG = (65.0, 110.0)
FRONT_TO_BACK_DB = (12.0, 25.0)
VERTICALS_DEG = ((0.0, 360.0), (0.0, 15.0), (-6.0, 15.0), (-12.0, 15.0), (0.0, 40.0),
                 (-10.0, 40.0), (15.0, 40.0), (40.0, 65.0))
AROUND_DEG = np.arange(0.0, 360.0, 5.0)  # azimuths over which a pattern is averaged


class SectorPattern(AntennaParams):
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
    """Return the gain relative to the maximum [dB].

    Args:
        azimuth_deg: (…,) direction, clockwise from north [deg].
        elevation_deg: (…,) direction, up [deg].
        pattern: of the antenna.
    """
    max_db = pattern.front_to_back_db
    # Rays come in single precision.
    off = (np.asarray(azimuth_deg, dtype=float) - pattern.azimuth_deg + 180) % 360 - 180
    above = np.asarray(elevation_deg, dtype=float) - pattern.tilt_deg
    horizontal_db = np.minimum(12 * (off / pattern.beamwidth_deg) ** 2, max_db)
    vertical_db = np.minimum(12 * (above / pattern.vertical_beamwidth_deg) ** 2, max_db)
    return -np.minimum(horizontal_db + vertical_db, max_db)


class SectorAntenna(GainEffect):
    """An undeclared sector antenna; one step finds one device's, or all those of a mast."""

    name = "antenna_pattern"
    variant = "sector antenna of a device"
    figure = "pattern"
    repeatable = True
    of_device = True
    confused_with = ("device_gain_offset", "device_position_error", "missing_obstacle", "foliage")

    class Params(EffectParams):
        """Antennas of devices."""

        devices: dict[DeviceIndex, SectorPattern] = Field(
            description="Pattern of each device, by index.")
        straight: bool = Field(False, description=(
            "Whether links leave along the straight line even where there is a 3D map."))

    def __init__(self) -> None:
        self._rays = LinkCache()

    @override
    def unavailable(self, links: Links) -> str | None:
        if not _eligible_devices(links):
            return f"no device of known position has {MIN_LINKS} links"
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        known = {device for devices in view.found_params(self.name, "devices")
                 for device in devices}
        devices = sorted(set(_eligible_devices(view.links)) - known)
        ways = {straight: _best_patterns(view, devices, straight)
                for straight in ([False, True] if view.links.city is not None else [False])}
        straight = max(ways, key=lambda way: max((nats for _, nats in ways[way].values()),
                                                 default=0.0))  # of equal ones the first
        found = ways[straight]
        if not found:
            return []
        best = max(found, key=lambda device: found[device][1])
        # Sectors of one mast are supported by the evidence of all of them.
        mast = set(site_of(view.links, best)) & set(found)
        return [self.Params(devices={device: found[device][0] for device in sorted(chosen)},
                            straight=straight)
                for chosen in ([mast, {best}] if len(mast) > 1 else [{best}])]

    @override
    def term(self, links: Links, params: Params, level_at: LevelAt) -> Term:
        offset_db = np.zeros(len(links))
        for device, pattern in params.devices.items():
            rows = np.flatnonzero(links.device == device)
            if len(rows):
                rays = self._rays.get(links, (device, params.straight),
                                      partial(Rays.of, links, rows, params.straight))
                offset_db[rows] = rays.offset_db(pattern)
        return Term(offset_db, one_hot(links.device, list(params.devices)),
                    np.full(len(params.devices), LEVEL_SD_DB))

    @override
    def variation(self, params: Params) -> Variation:
        return vary_patterns(params.devices,
                             lambda devices: params.model_copy(update={"devices": devices}))

    @override
    def parameters(self, links: Links, params: Params,
                   estimate: Estimate) -> dict[str, Parameter]:
        reported: dict[str, Parameter] = {}
        patterns_sd = np.reshape(estimate.params_sd, (len(params.devices), -1))
        for number, (device, pattern) in enumerate(params.devices.items()):
            name = links.device_names[device]
            reported |= report_pattern(pattern, patterns_sd[number], name,
                                       links.city is not None and not params.straight)
            reported[f"gain_db[{name}]"] = Parameter.normal(
                estimate.coefficients[number], estimate.coefficients_sd[number], "dB")
        return reported


def _eligible_devices(links: Links) -> list[int]:
    """Return devices with enough links and a declared position.

    One that was located wrongly from these very measurements may look as if it had an antenna.
    """
    return [device for device in frequent_labels(links.device, MIN_LINKS)
            if device in links.anchors]


class Rays(NamedTuple):
    """Directions in which links leave their device.

    Attributes:
        power: (n, sectors) power gain of what leaves into each sector.
        azimuth_deg, elevation_deg: (n, sectors) its direction.
        free: (n,) power gain in free space; 0 where the straight line is all.
    """

    power: np.ndarray
    azimuth_deg: np.ndarray
    elevation_deg: np.ndarray
    free: np.ndarray

    @classmethod
    def of(cls, links: Links, rows: np.ndarray, straight: bool) -> "Rays":
        """Return those of some links, which are followed over the map unless they are straight."""
        links = links.select(rows)
        if straight or links.city is None:
            return cls(np.ones((len(links), 1)), links.azimuth_deg[:, None],
                       links.elevation_deg[:, None], np.zeros(len(links)))
        ray = rays_of(links, "departures")
        power = np.linalg.norm(ray, axis=2)
        sine = ray[..., 2] / np.maximum(power, 1e-30)
        return cls(power, np.degrees(np.arctan2(ray[..., 0], ray[..., 1])),
                   np.degrees(np.arcsin(np.clip(sine, -1, 1))), free_space(links.geometry))

    def offset_db(self, pattern: SectorPattern) -> np.ndarray:
        """Return (n,) what a pattern adds to each link [dB]."""
        gain = 10 ** (sector_pattern_db(self.azimuth_deg, self.elevation_deg, pattern) / 10)
        at_tilt = np.full(len(AROUND_DEG), pattern.tilt_deg)
        mean_gain = np.mean(10 ** (sector_pattern_db(AROUND_DEG, at_tilt, pattern) / 10))
        return through_antenna_db(self.power, gain, self.free * 10 ** (pattern.scattered_db / 10),
                                  float(mean_gain))


def _best_patterns(view: ResidualView, devices: list[int],
                   straight: bool) -> dict[int, tuple[SectorPattern, float]]:
    """Return device -> best pattern and its gain [nats], of those that gain enough."""
    found = {}
    for device in devices:
        every = np.flatnonzero(view.links.device == device)
        rows = subsample(every, MAX_PROPOSE_LINKS)
        if not len(rows):
            continue
        pattern, nats = _best_pattern(view, rows, straight)
        if nats * len(every) / len(rows) > MIN_NATS:
            found[device] = pattern, nats * len(every) / len(rows)
    return found


def _best_pattern(view: ResidualView, rows: np.ndarray,
                  straight: bool) -> tuple[SectorPattern, float]:
    """Return the pattern of a grid that fits links best, and its gain over a level alone [nats]."""
    rays, residual_db = Rays.of(view.links, rows, straight), view.residual_db[rows]
    weight = view.weight[rows] * np.isfinite(view.links.level_db[rows])

    def nats(offset_db: np.ndarray) -> float:
        level_db = weight @ (residual_db - offset_db) / max(weight.sum(), 1e-12)
        return float(view.gain_nats(rows, offset_db + level_db).sum())

    def tried(azimuth: float, width: float, back_db: float, tilt: float = 0.0,
              height: float = 360.0) -> tuple[float, SectorPattern]:
        pattern = SectorPattern(azimuth_deg=azimuth, beamwidth_deg=width, front_to_back_db=back_db,
                                tilt_deg=tilt, vertical_beamwidth_deg=height)
        return nats(rays.offset_db(pattern)), pattern

    # Of equal ones the last in the order of the numbers.
    flat = max((tried(*numbers)[0], numbers)
               for numbers in product(AZIMUTHS_DEG, BEAMWIDTHS_DEG, FRONT_TO_BACK_DB))[1]
    vertical = max((tried(*flat, *numbers)[0], numbers) for numbers in VERTICALS_DEG)[1]
    best, pattern = tried(*flat, *vertical)
    return pattern, best - nats(np.zeros(len(rows)))
