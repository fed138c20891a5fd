"""Locate unknown devices from levels at known receiver positions: scan, particle swarms, posterior.

The likelihood of a device's data is scanned over the allowed area. Particle swarms, of all devices
in one batch, then search for the most likely positions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.links.declared import NOTHING, Declared
from radiotwin.runtime.console import progress
from radiotwin.twin.localize.estimate import TwinDevice
from radiotwin.twin.localize.likelihood import (
    LawError,
    Likelihood,
    design_effect,
    residual_correlation,
)
from radiotwin.twin.localize.observations import (
    Channel,
    DeviceObservations,
    DirectChannel,
    Observations,
    merge_repeats,
    tabulate,
)
from radiotwin.twin.localize.posterior import Posterior, refine, second_mode

if TYPE_CHECKING:
    from radiotwin.scene.citymap import CityMap

Bounds = tuple[float, float, float, float]  # x_min, x_max, y_min, y_max [m]
DIRECT_SAVING = 8  # factor fewer links without a table: a prediction takes ten times a look-up
# Points of a cell that are tried until one is allowed, relative to the centre, in cell widths.
POINTS_OF_CELL = np.array([[0, 0], [0.35, 0], [-0.35, 0], [0, 0.35], [0, -0.35],
                           [0.35, 0.35], [-0.35, 0.35], [0.35, -0.35], [-0.35, -0.35]])
# Clerc & Kennedy 2002, "The particle swarm: explosion, stability, and convergence in a
# multidimensional complex space", IEEE Trans. Evol. Comput. 6(1), eq. (4.1)-(4.2): phi is
# 2.05 + 2.05, which gives chi = 2 / (phi - 2 + sqrt(phi^2 - 4 phi)); a velocity is
# chi (v + 2.05 u1 (own best - x) + 2.05 u2 (swarm's best - x)).
PHI_EACH = 2.05
CONSTRICTION = 2.0 / (2 * PHI_EACH - 2.0 + np.sqrt((2 * PHI_EACH) ** 2 - 8 * PHI_EACH))
COARSE_SCAN = 2.0  # factor on the cell width of the scan for `_set_repeat_share`
MODE_SPACING_CELLS = 4.0  # least distance between starts of a device's swarms, in cells of the scan
VAGUE_SHARE = 0.5  # share of the map: a device with a larger credible region is not located


@dataclass(frozen=True)
class LocalizeSettings:
    """Extent of the search.

    Attributes:
        scan_step_m: width of a cell of the first scan over the map [m].
        scan_links: most links that the scan evaluates; beyond it, its cells grow.
        swarms: swarms of each device.
        particles: particles of each swarm.
        iterations: iterations of each swarm.
        allow_indoor: True if a device may be inside a building.
    """

    scan_step_m: float = 5.0
    scan_links: int = 15_000_000
    swarms: int = 6
    particles: int = 12
    iterations: int = 25
    allow_indoor: bool = False


@dataclass(frozen=True)
class Scan:
    """Log-likelihoods over a grid of square cells that covers the bounds.

    Cells without an allowed point are left out.

    Attributes:
        centre_m: (c, 2) centres of the cells [m].
        width_m: width of the cells [m].
        point_m: (c, 2) allowed point of each cell, at which it was evaluated [m].
        value: (k, c) log-likelihood of each device of the search [nats].
    """

    centre_m: np.ndarray
    width_m: float
    point_m: np.ndarray
    value: np.ndarray


@dataclass(frozen=True, eq=False)
class Search:
    """Search for devices of one height.

    Attributes:
        likelihood: likelihood of their positions.
        bounds: bounds of their positions [m].
        settings: extent of the search.
    """

    likelihood: Likelihood
    bounds: Bounds
    settings: LocalizeSettings

    def allowed(self, xy_m: np.ndarray) -> np.ndarray:
        """Return (p,) bool: a device may be at the position (p, 2) [m]."""
        x_min, x_max, y_min, y_max = self.bounds
        city, z_m = self.likelihood.city, self.likelihood.z_m
        x, y = xy_m.T
        allowed = (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)
        if city is not None and not self.settings.allow_indoor and allowed.any():
            position_m = np.column_stack([xy_m[allowed], np.full(allowed.sum(), z_m)])
            allowed[allowed] = ~city.inside(position_m)
        return allowed

    def log_likelihood(self, k: int, xy_m: np.ndarray) -> np.ndarray:
        """Return the log-likelihood (p,) of a device at positions (p, 2); -inf: not allowed."""
        value = np.full(len(xy_m), -np.inf)
        allowed = self.allowed(xy_m)
        value[allowed] = self.likelihood.of_devices([k], xy_m[allowed])[0]
        return value

    def scan(self, coarser: float = 1.0) -> Scan:
        """Evaluate every device's log-likelihood over the map; BadInput if no point is allowed.

        The cells are as small as the settings' number of links allows, times `coarser`.
        """
        x_min, x_max, y_min, y_max = self.bounds
        is_direct = isinstance(self.likelihood.channel, DirectChannel)
        links = self.settings.scan_links // (DIRECT_SAVING if is_direct else 1)
        area = (x_max - x_min) * (y_max - y_min)
        receivers = len(self.likelihood.observations.receiver_m)
        width_m = max(self.settings.scan_step_m, np.sqrt(area * receivers / links)) * coarser
        axes = _centres(x_min, x_max, width_m), _centres(y_min, y_max, width_m)
        centre_m = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        point_m, placed = centre_m.copy(), np.zeros(len(centre_m), bool)
        for offset in POINTS_OF_CELL * width_m:
            todo = np.flatnonzero(~placed)
            tried = centre_m[todo] + offset
            free = self.allowed(tried)
            point_m[todo[free]], placed[todo[free]] = tried[free], True
        if not placed.any():
            raise BadInput(
                f"no position for a device at height {self.likelihood.z_m} m within x {x_min} … "
                f"{x_max} and y {y_min} … {y_max} m: all of it is inside buildings; widen the "
                "bounds, check the heights, or set allow_indoor")
        centre_m, point_m = centre_m[placed], point_m[placed]
        return Scan(centre_m, width_m, point_m,
                    self.likelihood.of_devices(self.likelihood.devices, point_m))


def _centres(low: float, high: float, width: float) -> np.ndarray:
    """Return the centres of cells that cover an interval, with equal overhang at both ends."""
    n = max(1, int(np.ceil((high - low) / width - 1e-9)))
    return (low + high) / 2 + (np.arange(n) - (n - 1) / 2) * width


def distinct_modes(xy_m: np.ndarray, log_likelihood: np.ndarray, n_modes: int,
                   separation_m: float) -> np.ndarray:
    """Return the likeliest of positions (p, 2) [m], `separation_m` or more apart, likeliest first.

    At most `n_modes`; those without a finite log-likelihood (p,) are left out.
    """
    modes = np.empty((0, 2))
    left = np.isfinite(log_likelihood)
    while left.any() and len(modes) < n_modes:
        best = xy_m[np.argmax(np.where(left, log_likelihood, -np.inf))]
        modes = np.vstack([modes, best])
        left &= np.linalg.norm(xy_m - best, axis=1) >= separation_m
    return modes


def swarm_search(log_likelihood: Callable[[np.ndarray, np.ndarray], np.ndarray],
                 centre_m: np.ndarray, device: np.ndarray, anywhere_m: np.ndarray,
                 start_sd_m: float, particles: int, iterations: int, rng: np.random.Generator,
                 advance: Callable[[int], None] = lambda n: None) -> tuple[np.ndarray, np.ndarray]:
    """Run s particle swarms; return their best positions (s, 2) [m] and log-likelihoods (s,).

    Two thirds of a swarm start around its centre (s, 2), the first particle at the centre itself;
    the others start anywhere (a, 2), so that a swarm can leave a poor mode. The log-likelihood of
    positions (p, 2) and devices (p,) is -inf where none is allowed. `advance` is called with 1
    after each iteration.
    """
    s = len(centre_m)
    x = centre_m[:, None] + start_sd_m * rng.standard_normal((s, particles, 2))
    x[:, 0] = centre_m
    n_far = particles // 3
    x[:, particles - n_far :] = anywhere_m[rng.integers(len(anywhere_m), size=(s, n_far))]
    v = start_sd_m * rng.uniform(-1.0, 1.0, x.shape)
    devices = np.repeat(device, particles)
    own_best, own_value = x.copy(), log_likelihood(x.reshape(-1, 2), devices).reshape(s, particles)
    for _ in range(iterations):
        best = own_best[np.arange(s), own_value.argmax(axis=1)][:, None]
        u1, u2 = rng.random((2, s, particles, 2))
        v = CONSTRICTION * (v + PHI_EACH * (u1 * (own_best - x) + u2 * (best - x)))
        x = x + v
        value = log_likelihood(x.reshape(-1, 2), devices).reshape(s, particles)
        better = value > own_value
        own_best[better], own_value[better] = x[better], value[better]
        advance(1)
    best = own_value.argmax(axis=1)
    return own_best[np.arange(s), best], own_value[np.arange(s), best]


def localize(receiver_m: np.ndarray, device: np.ndarray, level_db: np.ndarray, channel: Channel, *,
             devices: Mapping[int, str], bounds: Bounds, z_m: np.ndarray | float,
             city: CityMap | None = None, limit_db: float | None = None, seed: int,
             settings: LocalizeSettings | None = None, start_m: np.ndarray | None = None,
             law_error: LawError | None = None, declared: Declared = NOTHING) -> list[TwinDevice]:
    """Locate unknown devices from measured levels by a fitted channel.

    Repeated measurements are merged (`Observations`, `Likelihood`). The likelihood is scanned over
    the map; for each device, several swarms start at the best distinct modes (`swarm_search`). The
    best cells of scan and swarms are split down to 0.3 m or less. The posterior over them, with the
    likelihood divided by the design effect of correlated model errors, gives position, radius and
    second mode.

    Args:
        receiver_m: (n, 3) positions of the receivers [m].
        device: (n,) device index of each measurement.
        level_db: (n,) gain [dB] or received power [dBm]; NaN: not detected.
        channel: fitted channel with the same device indices in its links.
        devices: index and name of the k devices to locate; other devices are not used.
        bounds: x_min, x_max, y_min, y_max of their positions [m].
        z_m: heights of the devices, (k,) or one for all [m].
        city: 3D map; None: every link has line of sight.
        limit_db: limit of detection [dB]; None: unknown, undetected links are left out.
        seed: of the swarms; the same seed gives the same estimates.
        settings: extent of the search; None: the defaults.
        start_m: (k, 2) earlier estimates, where an additional swarm starts [m]; NaN: none.
        law_error: standard errors of the channel, which widen the radii; None: it is exact.
        declared: declared powers, cables and antennas of the devices, by their index.

    Returns:
        the devices in their order.

    Raises:
        BadInput: all positions are inside buildings.
    """
    settings = settings or LocalizeSettings()
    z_m = np.broadcast_to(z_m, len(devices))
    if start_m is None:
        start_m = np.full((len(devices), 2), np.nan)
    observations = merge_repeats(receiver_m, device, level_db, np.array(list(devices)),
                                 use_missed=limit_db is not None)
    rng = np.random.default_rng(seed)
    usable = np.array([data.usable for data in observations.devices], bool)
    searches: list[Search] = []
    for z in np.unique(z_m[usable]):
        rows = np.flatnonzero(usable & (z_m == z))
        index = np.array([observations.devices[k].device for k in rows])
        links = tabulate(channel, observations.receiver_m, z, bounds, index, rng)
        likelihood = Likelihood(observations, links, rows, z, city, limit_db, law_error, declared)
        searches.append(Search(likelihood, bounds, settings))
    found: dict[int, tuple[Posterior, Search]] = {}
    with progress("locating", total=settings.iterations + 3 * len(devices)) as advance:
        _set_repeat_share(searches, observations)
        advance(len(devices))
        scans = [search.scan() for search in searches]
        advance(len(devices))
        peaks: dict[int, np.ndarray] = {}
        if searches:
            peaks = _run_swarms(searches, scans, start_m, settings, rng, advance)
        residuals = {k: search.likelihood.residuals(k, peaks[k][0]).thinned()
                     for search in searches for k in search.likelihood.devices}
        correlation = residual_correlation(list(residuals.values()))
        for search, scan in zip(searches, scans, strict=True):
            for i, k in enumerate(search.likelihood.devices):
                effect = design_effect(residuals[k], correlation)
                posterior = refine(partial(search.log_likelihood, k), scan.centre_m, scan.point_m,
                                   scan.value[i], scan.width_m, peaks[k], 1.0 / effect)
                found[k] = (posterior, search)
                advance(1)
    return [_estimate(data, devices[data.device], z_m[k], found.get(k))
            for k, data in enumerate(observations.devices)]


def _set_repeat_share(searches: list[Search], observations: Observations) -> None:
    """Set `Likelihood.repeat_share` of all searches: how much repeats at one position vary.

    It is their variance over the channel's, at the likeliest cells of a coarse scan, at most 1.
    """
    repeats = sum(int((data.count - 1).sum()) for data in observations.devices)
    if repeats == 0:
        return
    within = 0.0
    for search in searches:
        scan = search.scan(COARSE_SCAN)
        for k, value in zip(search.likelihood.devices, scan.value, strict=True):
            sd_db = search.likelihood.link_at(k, scan.point_m[value.argmax()])[1]
            within += float((observations.devices[k].squares / sd_db**2).sum())
    for search in searches:
        search.likelihood.repeat_share = min(1.0, within / repeats)


def _run_swarms(searches: list[Search], scans: list[Scan], start_m: np.ndarray,
                settings: LocalizeSettings, rng: np.random.Generator, advance: Callable[[int], None]
                ) -> dict[int, np.ndarray]:
    """Run a swarm from each likely position of each device; return their best ones (s, 2) [m].

    Likely are distinct modes of the scan, and an earlier estimate in `start_m`.
    """
    search_of = {k: search for search in searches for k in search.likelihood.devices}
    centres, device_of = [], []
    for search, scan in zip(searches, scans, strict=True):
        for k, value in zip(search.likelihood.devices, scan.value, strict=True):
            modes = distinct_modes(scan.point_m, value, settings.swarms,
                                   MODE_SPACING_CELLS * scan.width_m)
            if np.isfinite(start_m[k]).all():
                modes = np.vstack([modes, start_m[k]])
            centres.append(modes)
            device_of.append(np.full(len(modes), k))

    def log_likelihood(xy_m: np.ndarray, device: np.ndarray) -> np.ndarray:
        value = np.empty(len(xy_m))
        for k in np.unique(device):
            value[device == k] = search_of[k].log_likelihood(k, xy_m[device == k])
        return value

    devices = np.concatenate(device_of)
    best_m, value = swarm_search(
        log_likelihood, np.concatenate(centres), devices, scans[0].point_m, scans[0].width_m,
        settings.particles, settings.iterations, rng, advance)
    order = np.argsort(-value, kind="stable")
    return {k: best_m[order][devices[order] == k] for k in search_of}


def _estimate(data: DeviceObservations, name: str, z_m: float,
              found: tuple[Posterior, Search] | None) -> TwinDevice:
    """Return a device with position, 90 % radius and second mode; `found` None: without data."""
    x_m = y_m = np.nan
    radius_m, second, located = np.inf, None, False
    if found is not None:
        posterior, search = found
        modes = posterior.modes(search.allowed)
        x_m, y_m = map(float, modes[0][0])
        radius_m, second = posterior.radius(modes[0][0]), second_mode(modes)
        located = len(data.seen) > 0 and posterior.region_share() < VAGUE_SHARE
    return TwinDevice(name, x_m, y_m, float(z_m), "unknown", located, radius_m, second)
