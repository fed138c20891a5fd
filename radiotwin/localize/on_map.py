"""Positions of unknown devices from what receivers at known positions measured of them."""

from __future__ import annotations

from collections.abc import Callable
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

FIRST_LOOK = 2.0  # the scan that only tells how repeats scatter has cells this much wider
MODE_SPACING_CELLS = 4.0
VAGUE_SHARE = 0.5


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
    """Estimates every device's position with the channel as it is; one estimate a device, in their order.

    receiver_m: (n, 3) [m]; device: (n,) int; level_db: (n,) gain [dB] or received power [dBm], NaN = not detected.
    channel: anything with `predict(links) -> (mean_db, sigma_db)`, its links named by the same device indices.
    devices: (k,) indices of those to locate; rows of others are not used. bounds: (x_min, x_max, y_min, y_max) [m]
    within which they are; z_m: their heights, (k,) or one for all. city: the 3D map; without one every link has
    line of sight. limit_db: the level below which the receiver does not detect; without it links that were not
    detected are left out. start_m: (k, 2 or 3) an earlier estimate of each, NaN for none: one more swarm starts
    there.

    Repeated measurements are merged (`Observations`, `Likelihood`); the map is scanned with every device's data;
    from the best distinct modes several swarms a device fly (`swarm_search`); the cells that the scan or a swarm
    found good are split down to 0.3 m or less, and the posterior over them, tempered for correlated model error
    (`overconfidence`), gives position, radius and second mode. The same seed gives the same estimates.

    Raises BadInput for shapes, values or bounds that cannot be used, and where buildings leave no place.
    """
    settings = settings or LocalizeSettings()
    devices = _checked_devices(devices)
    _check_bounds(bounds)
    z_m = _heights(z_m, len(devices))
    start_m = _starts(start_m, len(devices))
    observations = merge_repeats(receiver_m, device, level_db, devices, use_missed=limit_db is not None)
    rng = np.random.default_rng(seed)
    usable = np.array([data.usable for data in observations.devices], bool)
    searches = [
        Search(
            observations, channel, np.flatnonzero(usable & (z_m == z)), z, bounds, city, limit_db, settings, rng
        )
        for z in np.unique(z_m[usable])
    ]  # fmt: skip
    found: dict[int, tuple[Posterior, float, Search]] = {}
    with progress("locating", total=settings.iterations + 3 * len(devices)) as advance:
        _learn_repeat_share(searches, observations)
        advance(len(devices))
        scans = [search.scan() for search in searches]
        advance(len(devices))
        peaks = {} if not searches else _fly(searches, scans, start_m, settings, rng, advance)
        residuals = {
            k: search.likelihood.residuals(k, peaks[k][0]).thinned()
            for search in searches
            for k in search.devices
        }
        correlation = residual_correlation(list(residuals.values()))
        for search, scan in zip(searches, scans, strict=True):
            for i, k in enumerate(search.devices):
                effect = design_effect(residuals[k], correlation)
                posterior = refine(
                    lambda xy_m, k=k, search=search: search.log_likelihood(k, xy_m),  # type: ignore[misc]
                    scan.centre_m, scan.point_m, scan.value[i], scan.width_m, peaks[k], 1.0 / effect,
                )  # fmt: skip
                found[k] = (posterior, effect, search)
                advance(1)
    return [_estimate(data, z_m[k], found.get(k)) for k, data in enumerate(observations.devices)]


def _learn_repeat_share(searches: list[Search], observations: Observations) -> None:
    """Sets how much of the channel's variance is drawn anew at each repeat: one-way analysis of variance, the
    scatter within positions over the variance of the channel at the devices' roughly best positions."""
    repeats = sum(int((data.count - 1).sum()) for data in observations.devices)
    if repeats == 0:
        return
    within = 0.0
    for search in searches:
        scan = search.scan(FIRST_LOOK)
        for k, value in zip(search.devices, scan.value, strict=True):
            sigma_db = search.likelihood.link_at(k, scan.point_m[value.argmax()])[1]
            within += float((observations.devices[k].squares / sigma_db**2).sum())
    for search in searches:
        search.likelihood.repeat_share = min(1.0, within / repeats)


def _fly(
    searches: list[Search],
    scans: list[Scan],
    start_m: np.ndarray,
    settings: LocalizeSettings,
    rng: np.random.Generator,
    advance: Callable[[int], None],
) -> dict[int, np.ndarray]:
    """Best positions (s, 2) of each device's swarms, best first."""
    search_of = {k: search for search in searches for k in search.devices}
    centres, whose = [], []
    for search, scan in zip(searches, scans, strict=True):
        for k, value in zip(search.devices, scan.value, strict=True):
            modes = distinct_modes(scan.point_m, value, settings.swarms, MODE_SPACING_CELLS * scan.width_m)
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
        settings.particles, settings.iterations, rng, advance,
    )  # fmt: skip
    order = np.argsort(-value, kind="stable")
    return {k: best_m[order][devices[order] == k] for k in search_of}


def _estimate(
    data: DeviceObservations, z_m: float, found: tuple[Posterior, float, Search] | None
) -> DeviceEstimate:
    x_m = y_m = np.nan
    radius_m, other, effect, located = np.inf, None, 1.0, False
    if found is not None:
        posterior, effect, search = found
        modes = posterior.modes(search.allowed)
        x_m, y_m = map(float, modes[0][0])
        radius_m, other = posterior.radius(modes[0][0]), second_mode(modes)
        located = data.n_detected > 0 and posterior.region_share() < VAGUE_SHARE
    return DeviceEstimate(
        device=data.device,
        x_m=x_m,
        y_m=y_m,
        z_m=float(z_m),
        credible_radius_m=radius_m,
        second_mode=other,
        n_detected=data.n_detected,
        n_links=data.n_links,
        design_effect=effect,
        located=located,
    )


def _checked_devices(devices: np.ndarray) -> np.ndarray:
    devices = np.atleast_1d(devices)
    if (
        devices.ndim != 1
        or not np.issubdtype(devices.dtype, np.integer)
        or len(np.unique(devices)) < len(devices)
    ):
        raise BadInput(f"devices to locate {devices.tolist()}: expected different integers, as in `device`")
    return devices


def _check_bounds(bounds: Bounds) -> None:
    good = len(bounds) == 4 and np.isfinite(bounds).all()
    if not good or bounds[0] >= bounds[1] or bounds[2] >= bounds[3]:
        raise BadInput(
            f"bounds {tuple(bounds)}: expected finite (x_min, x_max, y_min, y_max) [m] with min < max"
        )


def _heights(z_m: np.ndarray | float, n_devices: int) -> np.ndarray:
    z_m = np.asarray(z_m, float)
    if z_m.shape not in ((), (n_devices,)) or not np.isfinite(z_m).all():
        raise BadInput(
            f"device heights of shape {z_m.shape}: expected {n_devices} finite heights [m], or one for all"
        )
    return np.broadcast_to(z_m, n_devices).copy()


def _starts(start_m: np.ndarray | None, n_devices: int) -> np.ndarray:
    if start_m is None:
        return np.full((n_devices, 2), np.nan)
    start_m = np.asarray(start_m, float)
    if start_m.ndim != 2 or len(start_m) != n_devices or start_m.shape[1] not in (2, 3):
        raise BadInput(
            f"earlier estimates of shape {start_m.shape}: expected ({n_devices}, 2) or ({n_devices}, 3)"
        )
    return start_m[:, :2]
