"""Positions of unknown devices from the levels that receivers at known positions measured.

The likelihood of a device's data is scanned over all of the map where it may be. Particle swarms,
of all devices in one batch, then search for the most likely positions.
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
DIRECT_SAVING = 8  # times fewer links where predicting one takes ten times longer than a look-up
# Points of a cell that are tried for one where a device may be, from its centre, in cell widths.
POINTS_OF_CELL = np.array([[0, 0], [0.35, 0], [-0.35, 0], [0, 0.35], [0, -0.35],
                           [0.35, 0.35], [-0.35, 0.35], [0.35, -0.35], [-0.35, -0.35]])
# Clerc & Kennedy 2002, "The particle swarm: explosion, stability, and convergence in a
# multidimensional complex space", IEEE Trans. Evol. Comput. 6(1), eq. (4.1)-(4.2): phi is
# 2.05 + 2.05, which gives chi = 2 / (phi - 2 + sqrt(phi^2 - 4 phi)); a velocity is
# chi (v + 2.05 u1 (own best - x) + 2.05 u2 (swarm's best - x)).
PHI_EACH = 2.05
CONSTRICTION = 2.0 / (2 * PHI_EACH - 2.0 + np.sqrt((2 * PHI_EACH) ** 2 - 8 * PHI_EACH))
COARSE_SCAN = 2.0  # factor on the cells of the scan that only serves `_set_repeat_share`
MODE_SPACING_CELLS = 4.0  # least distance of a device's swarms at the start, in cells of the scan
VAGUE_SHARE = 0.5  # of the map: a device with a larger credible region is not located


@dataclass(frozen=True)
class LocalizeSettings:
    """Extent of the search.

    Attributes:
        scan_step_m: width of a cell of the first scan over the map [m].
        scan_links: links that the scan may evaluate, beyond which its cells grow.
        swarms: number for each device.
        particles: of each swarm.
        iterations: of every swarm.
        allow_indoor: whether a device may be inside a building.
    """

    scan_step_m: float = 5.0
    scan_links: int = 15_000_000
    swarms: int = 6
    particles: int = 12
    iterations: int = 25
    allow_indoor: bool = False


@dataclass(frozen=True)
class Scan:
    """Log-likelihoods over a grid of square cells, which covers the bounds.

    Cells without a point where a device may be are left out.

    Attributes:
        centre_m: (c, 2) centres of the cells [m].
        width_m: of every cell [m].
        point_m: (c, 2) point of each cell where a device may be, at which it was evaluated [m].
        value: (k, c) log-likelihood of each of the search's devices [nats].
    """

    centre_m: np.ndarray
    width_m: float
    point_m: np.ndarray
    value: np.ndarray


@dataclass(frozen=True, eq=False)
class Search:
    """Devices of one height, with their data, on a map.

    Attributes:
        likelihood: of their data.
        bounds: within which they are.
        settings: of the search.
    """

    likelihood: Likelihood
    bounds: Bounds
    settings: LocalizeSettings

    def allowed(self, xy_m: np.ndarray) -> np.ndarray:
        """Return whether (p,) a device may be at positions (p, 2) [m]."""
        x_min, x_max, y_min, y_max = self.bounds
        city, z_m = self.likelihood.city, self.likelihood.z_m
        x, y = xy_m.T
        allowed = (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)
        if city is not None and not self.settings.allow_indoor and allowed.any():
            at = np.column_stack([xy_m[allowed], np.full(allowed.sum(), z_m)])
            allowed[allowed] = ~city.inside(at)
        return allowed

    def log_likelihood(self, k: int, xy_m: np.ndarray) -> np.ndarray:
        """Return the log-likelihood of one device's data at positions.

        Args:
            k: index in `Observations.devices`.
            xy_m: (p, 2) [m].

        Returns:
            (p,) [nats]; -inf where the device may not be.
        """
        value = np.full(len(xy_m), -np.inf)
        allowed = self.allowed(xy_m)
        value[allowed] = self.likelihood.of_devices([k], xy_m[allowed])[0]
        return value

    def scan(self, coarser: float = 1.0) -> Scan:
        """Evaluate every device's log-likelihood over the whole map.

        The cells are as small as the settings' number of links allows.

        Args:
            coarser: factor on the width of the cells.

        Returns:
            log-likelihoods

        Raises:
            BadInput: there is no point outside buildings.
        """
        x_min, x_max, y_min, y_max = self.bounds
        is_direct = isinstance(self.likelihood.channel, DirectChannel)
        links = self.settings.scan_links // (DIRECT_SAVING if is_direct else 1)
        area = (x_max - x_min) * (y_max - y_min)
        receivers = len(self.likelihood.observations.receiver_m)
        width = max(self.settings.scan_step_m, np.sqrt(area * receivers / links)) * coarser
        axes = _centres(x_min, x_max, width), _centres(y_min, y_max, width)
        centre = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        point, placed = centre.copy(), np.zeros(len(centre), bool)
        for offset in POINTS_OF_CELL * width:
            todo = np.flatnonzero(~placed)
            tried = centre[todo] + offset
            good = self.allowed(tried)
            point[todo[good]], placed[todo[good]] = tried[good], True
        if not placed.any():
            raise BadInput(
                f"no position for a device at height {self.likelihood.z_m} m within x {x_min} … "
                f"{x_max} and y {y_min} … {y_max} m: all of it is inside buildings; widen the "
                "bounds, check the heights, or set allow_indoor")
        centre, point = centre[placed], point[placed]
        return Scan(centre, width, point,
                    self.likelihood.of_devices(self.likelihood.devices, point))


def _centres(low: float, high: float, width: float) -> np.ndarray:
    """Return centres, all inside, of cells that cover an interval and overhang both ends alike."""
    n = max(1, int(np.ceil((high - low) / width - 1e-9)))
    return (low + high) / 2 + (np.arange(n) - (n - 1) / 2) * width


def distinct_modes(xy_m: np.ndarray, log_likelihood: np.ndarray, n_modes: int,
                   separation_m: float) -> np.ndarray:
    """Return the best of scanned positions that keep a distance from each other.

    Args:
        xy_m: (p, 2) positions [m].
        log_likelihood: (p,) [nats]; -inf where no device may be.
        n_modes: number of positions, at most.
        separation_m: least distance between two of them [m].

    Returns:
        (at most n_modes, 2) [m], best first.
    """
    modes = np.empty((0, 2))
    left = np.isfinite(log_likelihood)
    while left.any() and len(modes) < n_modes:
        best = xy_m[np.argmax(np.where(left, log_likelihood, -np.inf))]
        modes = np.vstack([modes, best])
        left &= np.linalg.norm(xy_m - best, axis=1) >= separation_m
    return modes


def swarm_search(
    log_likelihood: Callable[[np.ndarray, np.ndarray], np.ndarray],
    centre_m: np.ndarray,
    device: np.ndarray,
    anywhere_m: np.ndarray,
    start_sd_m: float,
    particles: int,
    iterations: int,
    rng: np.random.Generator,
    advance: Callable[[int], None] = lambda n: None,
) -> tuple[np.ndarray, np.ndarray]:
    """Run s swarms and return the best position that each found.

    Two thirds of a swarm start around its centre, the first particle at the centre itself, and the
    others anywhere, so that a swarm can leave a poor mode.

    Args:
        log_likelihood: maps positions (p, 2) and devices (p,) to (p,) [nats], -inf where no device
            may be.
        centre_m: (s, 2) start of each swarm [m].
        device: (s,) device that each swarm looks for.
        anywhere_m: (a, 2) positions where the other third may start [m].
        start_sd_m: standard deviation of starts around a centre [m].
        particles: of each swarm.
        iterations: of every swarm.
        rng: random state.
        advance: called with 1 after each iteration.

    Returns:
        (s, 2) best positions [m], and their log-likelihoods (s,) [nats].
    """
    s = len(centre_m)
    x = centre_m[:, None] + start_sd_m * rng.standard_normal((s, particles, 2))
    x[:, 0] = centre_m
    n_far = particles // 3
    x[:, particles - n_far :] = anywhere_m[rng.integers(len(anywhere_m), size=(s, n_far))]
    v = start_sd_m * rng.uniform(-1.0, 1.0, x.shape)
    whose = np.repeat(device, particles)
    own_best, own_value = x.copy(), log_likelihood(x.reshape(-1, 2), whose).reshape(s, particles)
    for _ in range(iterations):
        best = own_best[np.arange(s), own_value.argmax(axis=1)][:, None]
        u1, u2 = rng.random((2, s, particles, 2))
        v = CONSTRICTION * (v + PHI_EACH * (u1 * (own_best - x) + u2 * (best - x)))
        x = x + v
        value = log_likelihood(x.reshape(-1, 2), whose).reshape(s, particles)
        better = value > own_value
        own_best[better], own_value[better] = x[better], value[better]
        advance(1)
    best = own_value.argmax(axis=1)
    return own_best[np.arange(s), best], own_value[np.arange(s), best]


def localize(
    receiver_m: np.ndarray,
    device: np.ndarray,
    level_db: np.ndarray,
    channel: Channel,
    *,
    devices: Mapping[int, str],
    bounds: Bounds,
    z_m: np.ndarray | float,
    city: CityMap | None = None,
    limit_db: float | None = None,
    seed: int,
    settings: LocalizeSettings | None = None,
    start_m: np.ndarray | None = None,
    law_error: LawError | None = None,
    declared: Declared = NOTHING,
) -> list[TwinDevice]:
    """Estimate every device's position with the channel as it is.

    Repeated measurements are merged (`Observations`, `Likelihood`); the map is scanned with every
    device's data; several swarms a device start at the best distinct modes (`swarm_search`); the
    cells that the scan or a swarm found good are split down to 0.3 m or less, and the posterior
    over them, with a power of the likelihood that corrects for correlated model error
    (`overconfidence`), gives position, radius and second mode.

    Args:
        receiver_m: (n, 3) positions of the receivers [m].
        device: (n,) int, device of each measurement.
        level_db: (n,) gain [dB] or received power [dBm]; NaN: not detected.
        channel: fitted, with the same device indices in its links.
        devices: index and name of the k devices to locate; rows of others are not used.
        bounds: x_min, x_max, y_min, y_max within which they are [m].
        z_m: their heights, (k,) or one for all [m].
        city: 3D map; None: every link has line of sight.
        limit_db: level below which the receiver does not detect [dB]; None: unknown, links that
            were not detected are left out.
        seed: of the swarms; the same seed gives the same estimates.
        settings: of the search; None: the defaults.
        start_m: (k, 2) an earlier estimate of each, where one more swarm starts [m]; NaN: none.
        law_error: of the channel, which widens the radii; None: it is exact.
        declared: of the devices by their index: what is in the levels beside the channel.

    Returns:
        the devices in their order.

    Raises:
        BadInput: buildings leave no position.
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
    """Set the share of the channel's variance that is drawn anew at each repeat.

    A one-way analysis of variance: the variance within positions over the channel's variance at the
    devices' roughly best positions.
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


def _run_swarms(
    searches: list[Search],
    scans: list[Scan],
    start_m: np.ndarray,
    settings: LocalizeSettings,
    rng: np.random.Generator,
    advance: Callable[[int], None],
) -> dict[int, np.ndarray]:
    """Return the best positions (s, 2) [m] of each device's swarms, best first."""
    search_of = {k: search for search in searches for k in search.likelihood.devices}
    centres, whose = [], []
    for search, scan in zip(searches, scans, strict=True):
        for k, value in zip(search.likelihood.devices, scan.value, strict=True):
            modes = distinct_modes(scan.point_m, value, settings.swarms,
                                   MODE_SPACING_CELLS * scan.width_m)
            if np.isfinite(start_m[k]).all():
                modes = np.vstack([modes, start_m[k]])
            centres.append(modes)
            whose.append(np.full(len(modes), k))

    def log_likelihood(xy_m: np.ndarray, device: np.ndarray) -> np.ndarray:
        value = np.empty(len(xy_m))
        for k in np.unique(device):
            value[device == k] = search_of[k].log_likelihood(k, xy_m[device == k])
        return value

    devices = np.concatenate(whose)
    best_m, value = swarm_search(
        log_likelihood, np.concatenate(centres), devices, scans[0].point_m, scans[0].width_m,
        settings.particles, settings.iterations, rng, advance)
    order = np.argsort(-value, kind="stable")
    return {k: best_m[order][devices[order] == k] for k in search_of}


def _estimate(data: DeviceObservations, name: str, z_m: float,
              found: tuple[Posterior, Search] | None) -> TwinDevice:
    x_m = y_m = np.nan
    radius_m, other, located = np.inf, None, False
    if found is not None:
        posterior, search = found
        modes = posterior.modes(search.allowed)
        x_m, y_m = map(float, modes[0][0])
        radius_m, other = posterior.radius(modes[0][0]), second_mode(modes)
        located = len(data.seen) > 0 and posterior.region_share() < VAGUE_SHARE
    return TwinDevice(name, x_m, y_m, float(z_m), "unknown", located, radius_m, other)
