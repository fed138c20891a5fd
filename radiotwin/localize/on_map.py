"""Positions of unknown devices from the levels that receivers at known positions measured."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.localize.estimate import DeviceEstimate, LocalizeSettings
from radiotwin.localize.link_table import Channel
from radiotwin.localize.observations import DeviceObservations, Observations, merge_repeats
from radiotwin.localize.overconfidence import design_effect, residual_correlation
from radiotwin.localize.posterior import Posterior, refine, second_mode
from radiotwin.localize.search import Bounds, Scan, Search
from radiotwin.localize.swarm import distinct_modes, swarm_search
from radiotwin.progress import progress

if TYPE_CHECKING:
    from radiotwin.scene.citymap import CityMap

COARSE_SCAN = 2.0  # factor on the cells of the scan that only serves `_set_repeat_share`
MODE_SPACING_CELLS = 4.0  # least distance of a device's swarms at the start, in cells of the scan
VAGUE_SHARE = 0.5  # of the map: a device with a larger credible region is not located


def localize(
    receiver_m: np.ndarray,
    device: np.ndarray,
    level_db: np.ndarray,
    channel: Channel,
    *,
    devices: np.ndarray,
    bounds: Bounds,
    z_m: np.ndarray | float,
    city: CityMap | None = None,
    limit_db: float | None = None,
    seed: int,
    settings: LocalizeSettings | None = None,
    start_m: np.ndarray | None = None,
) -> list[DeviceEstimate]:
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
        devices: (k,) indices of the devices to locate; rows of others are not used.
        bounds: x_min, x_max, y_min, y_max within which they are [m].
        z_m: their heights, (k,) or one for all [m].
        city: 3D map; None: every link has line of sight.
        limit_db: level below which the receiver does not detect [dB]; None: unknown, links that
            were not detected are left out.
        seed: of the swarms; the same seed gives the same estimates.
        settings: of the search; None: the defaults.
        start_m: (k, 2 or 3) an earlier estimate of each, where one more swarm starts [m]; NaN:
            none.

    Returns:
        one estimate a device, in their order.

    Raises:
        BadInput: shapes, values or bounds that cannot be used, or buildings leave no position.
    """
    settings = settings or LocalizeSettings()
    devices = _checked_devices(devices)
    _check_bounds(bounds)
    z_m = _heights(z_m, len(devices))
    start_m = _starts(start_m, len(devices))
    observations = merge_repeats(receiver_m, device, level_db, devices,
                                 use_missed=limit_db is not None)
    rng = np.random.default_rng(seed)
    usable = np.array([data.usable for data in observations.devices], bool)
    searches = [Search(observations, channel, np.flatnonzero(usable & (z_m == z)), z, bounds, city,
                       limit_db, settings, rng)
                for z in np.unique(z_m[usable])]
    found: dict[int, tuple[Posterior, float, Search]] = {}
    with progress("locating", total=settings.iterations + 3 * len(devices)) as advance:
        _set_repeat_share(searches, observations)
        advance(len(devices))
        scans = [search.scan() for search in searches]
        advance(len(devices))
        peaks: dict[int, np.ndarray] = {}
        if searches:
            peaks = _run_swarms(searches, scans, start_m, settings, rng, advance)
        residuals = {k: search.likelihood.residuals(k, peaks[k][0]).thinned()
                     for search in searches for k in search.devices}
        correlation = residual_correlation(list(residuals.values()))
        for search, scan in zip(searches, scans, strict=True):
            for i, k in enumerate(search.devices):
                effect = design_effect(residuals[k], correlation)
                posterior = refine(partial(search.log_likelihood, k), scan.centre_m, scan.point_m,
                                   scan.value[i], scan.width_m, peaks[k], 1.0 / effect)
                found[k] = (posterior, effect, search)
                advance(1)
    return [_estimate(data, z_m[k], found.get(k)) for k, data in enumerate(observations.devices)]


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
        for k, value in zip(search.devices, scan.value, strict=True):
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
    search_of = {k: search for search in searches for k in search.devices}
    centres, whose = [], []
    for search, scan in zip(searches, scans, strict=True):
        for k, value in zip(search.devices, scan.value, strict=True):
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


def _estimate(data: DeviceObservations, z_m: float,
              found: tuple[Posterior, float, Search] | None) -> DeviceEstimate:
    x_m = y_m = np.nan
    radius_m, other, effect, located = np.inf, None, 1.0, False
    if found is not None:
        posterior, effect, search = found
        modes = posterior.modes(search.allowed)
        x_m, y_m = map(float, modes[0][0])
        radius_m, other = posterior.radius(modes[0][0]), second_mode(modes)
        located = data.n_detected > 0 and posterior.region_share() < VAGUE_SHARE
    return DeviceEstimate(data.device, x_m, y_m, float(z_m), radius_m, other, data.n_detected,
                          data.n_links, effect, located)


def _checked_devices(devices: np.ndarray) -> np.ndarray:
    devices = np.atleast_1d(devices)
    if (devices.ndim != 1 or not np.issubdtype(devices.dtype, np.integer)
            or len(np.unique(devices)) < len(devices)):
        raise BadInput(f"devices to locate {devices.tolist()}: expected different integers, as in "
                       "`device`")
    return devices


def _check_bounds(bounds: Bounds) -> None:
    good = len(bounds) == 4 and np.isfinite(bounds).all()
    if not good or bounds[0] >= bounds[1] or bounds[2] >= bounds[3]:
        raise BadInput(f"bounds {tuple(bounds)}: expected finite (x_min, x_max, y_min, y_max) [m] "
                       "with min < max")


def _heights(z_m: np.ndarray | float, n_devices: int) -> np.ndarray:
    z_m = np.asarray(z_m, float)
    if z_m.shape not in ((), (n_devices,)) or not np.isfinite(z_m).all():
        raise BadInput(f"device heights of shape {z_m.shape}: expected {n_devices} finite heights "
                       "[m], or one for all")
    return np.broadcast_to(z_m, n_devices).copy()


def _starts(start_m: np.ndarray | None, n_devices: int) -> np.ndarray:
    if start_m is None:
        return np.full((n_devices, 2), np.nan)
    start_m = np.asarray(start_m, float)
    if start_m.ndim != 2 or len(start_m) != n_devices or start_m.shape[1] not in (2, 3):
        raise BadInput(f"earlier estimates of shape {start_m.shape}: expected ({n_devices}, 2) or "
                       f"({n_devices}, 3)")
    return start_m[:, :2]
