"""Fitting a twin that follows paths over a 3D map which may be wrong."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
from scipy.stats import f

from radiotwin.channel.base import drop_uninformative
from radiotwin.channel.image_paths import ImagePaths
from radiotwin.channel.map_error import Found, estimate_other_errors
from radiotwin.channel.map_shift import NO_SHIFT, Shift, estimate_shift
from radiotwin.channel.path_kriging import PathKriging
from radiotwin.execution import Executor
from radiotwin.links import LinkData
from radiotwin.localize import Relocation
from radiotwin.localize.along_paths import CREDIBLE, MAX_DEVICES
from radiotwin.localize.estimate import TwinDevice
from radiotwin.pieces import kept
from radiotwin.progress import progress
from radiotwin.scene import Scene
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.perturbation import perturbed_map
from radiotwin.twin.fit_links import provenance, reliable_m
from radiotwin.twin.fit_paths import LOST_M, fit_along_paths
from radiotwin.twin.twin import Twin

MAPS = 4  # over which devices are located again
MAX_COPIES = 4  # anchors that are located as if they were unknown
PRIOR_DEVICES = 2  # that the radii of the likelihood are worth, beside what those show


def fit_over_wrong_map(links: LinkData, scene: Scene, seed: int, start: Twin | None,
                       executor: Executor | None = None) -> Twin:
    """Return a twin that allows for errors of its map.

    Devices are located along paths, on a map moved to where the anchors' links want it. Errors of
    walls and roofs widen their radii, and so does what some anchors are off by when they are
    located as if they were unknown.

    Args:
        links: n links over the map.
        scene: the map's.
        seed: of the channel, and of the maps' errors.
        start: an earlier twin, as of `fit_twin`.
        executor: as of `fit_twin`.
    """
    shift_m = _shift(links, seed)
    on_map = _moved(links, shift_m)
    with_copies = _with_copies(on_map)
    if start is not None:
        back_m = -shift_m[0], -shift_m[1], -shift_m[2]
        start = replace(start, devices=[_moved_device(each, back_m) for each in start.devices])
    by_paths = fit_along_paths(with_copies, scene, seed, start, executor)
    assert isinstance(by_paths.channel, ImagePaths)
    unsure = _calibrated(by_paths.devices, on_map)
    found = _found(on_map, unsure, shift_m, seed)
    if found[0].warning:
        warnings.warn(f"the 3D map seems to be off: {found[0].warning}; predictions and radii "
                      "allow for it, and a better map would make them better", stacklevel=3)
    devices = by_paths.devices
    if found[0].is_seen:
        cities = [perturbed_map(on_map.city, found[0].wall_m[0], found[0].height_m[0],
                                seed + member) for member in range(MAPS)]
        bounds = scene.config.extent.bounds
        more_m = _radius_by_map_m(with_copies, devices, by_paths.channel, cities, bounds)
        devices = [replace(each, credible_radius_m=float(np.hypot(each.credible_radius_m, more)))
                   for each, more in zip(devices, more_m, strict=True)]
    devices = [_moved_device(each, shift_m) for each in _calibrated(devices, on_map)]
    channel = _channel(links, devices, found, seed)
    return Twin(channel, devices, by_paths.level, links.usual_limit_db, provenance(links, scene))


def _shift(links: LinkData, seed: int) -> Shift:
    """Return the shift of the map, from the anchors' links."""
    known = links.located(links.device_m)
    if not len(known):
        return NO_SHIFT
    informative = drop_uninformative(known.geometry, known.level_db, known.limit_db)
    return estimate_shift(*informative, seed)


def _moved(links: LinkData, shift_m: Shift) -> LinkData:
    """Return links whose ends are all moved by a shift."""
    if shift_m == NO_SHIFT:
        return links
    step_m = np.array([*shift_m[:2], 0.0])
    return links.with_devices(links.device_m + step_m).with_receivers(links.receiver_m + step_m)


def _with_copies(links: LinkData) -> LinkData:
    """Return the links, and those of some anchors once more, as of unknown devices at the end."""
    count = len(links.device_names)
    unknown = count - len(links.anchors)
    anchors = sorted(links.anchors)[:max(min(MAX_COPIES, MAX_DEVICES - unknown), 0)]
    if not unknown or not anchors:
        return links
    again = [np.flatnonzero(links.device == anchor) for anchor in anchors]
    device = np.concatenate([links.device, *(np.full(len(rows), count + number)
                                             for number, rows in enumerate(again))])
    height_m = np.full((len(anchors), 3), np.nan)
    height_m[:, 2] = links.device_m[anchors, 2]
    rows = np.concatenate([np.arange(len(links)), *again])
    known = links.with_devices(np.nan_to_num(links.device_m)).select(rows)
    names = [f"{links.device_names[anchor]} (as if unknown)" for anchor in anchors]
    return replace(known, device=device, device_m=np.vstack([links.device_m, height_m]),
                   device_names=[*links.device_names, *names], known_los=None)


def _calibrated(devices: list[TwinDevice], links: LinkData) -> list[TwinDevice]:
    """Return the devices of links with radii as wide as the copies' errors show that they must be.

    Errors within a 90 % radius r of a normal distribution have the mean square r² / ln 10.
    """
    count = len(links.device_names)
    ratios = [PRIOR_DEVICES]
    for copy, anchor in zip(devices[count:], sorted(links.anchors)):
        if copy.located and copy.credible_radius_m > 0:
            square_m2 = ((links.device_m[anchor, :2] - (copy.x_m, copy.y_m))**2).sum()
            ratios.append(np.log(10) * square_m2 / copy.credible_radius_m**2)
    factor = max(np.sqrt(sum(ratios) / (PRIOR_DEVICES + len(ratios) - 1)), 1.0)
    return [replace(each, credible_radius_m=float(factor * each.credible_radius_m))
            for each in devices[:count]]


def _found(links: LinkData, devices: list[TwinDevice], shift_m: Shift, seed: int) -> Found:
    """Return the errors of a map that is not shifted any more, from devices that are not lost."""
    known = links.located(reliable_m(devices, LOST_M))
    informative = drop_uninformative(known.geometry, known.level_db, known.limit_db)
    error, diffuse = estimate_other_errors(*informative, seed)
    return replace(error, shift_m=shift_m), diffuse


def _channel(links: LinkData, devices: list[TwinDevice], found: Found, seed: int) -> PathKriging:
    """Fit the channel to all devices that are located; kriging alone to those that are lost."""
    lost = tuple(np.flatnonzero(~np.isfinite(reliable_m(devices, LOST_M)).all(axis=1)).tolist())
    known = links.located(reliable_m(devices))
    data = known.geometry, known.level_db, known.limit_db, seed
    inputs = PathKriging, *data, str(found[0].state()), found[1], lost
    return kept("channel", inputs, lambda: PathKriging(found, lost).fit(*data), PathKriging.state,
                PathKriging.from_state)


def _radius_by_map_m(links: LinkData, devices: list[TwinDevice], channel: ImagePaths,
                     cities: list[CityMap], bounds: tuple[float, float, float, float]
                     ) -> np.ndarray:
    """Return the radius (k,) [m] that 90 % of the errors by the map stay within.

    What moves an estimate from one map to another that is as wrong moves it from the true map to
    this one. Each axis is taken for normal, with a variance from few maps (F distribution).
    """
    squares: list[list[float]] = [[] for _ in devices]
    there = {each.device: [(each.x_m, each.y_m)] for each in devices}
    with progress("locating over wrong maps", total=len(cities)) as advance:
        for city in cities:
            search = Relocation(bounds, np.inf, positions={key: [*at] for key, at in there.items()})
            found = search.relocate(links.with_city(city), devices, channel)
            for square, before, after in zip(squares, devices, found, strict=True):
                if after is not before:  # paths over this map locate it, too
                    square.append((after.x_m - before.x_m)**2 + (after.y_m - before.y_m)**2)
            advance(1)
    return np.sqrt([np.mean(square) * f.ppf(CREDIBLE, 2, 2 * len(square)) if square else 0.0
                    for square in squares])


def _moved_device(device: TwinDevice, shift_m: Shift) -> TwinDevice:
    """Return a device of a shifted map where it is."""
    east_m, north_m, _ = shift_m
    mode = device.second_mode
    if mode is not None:
        mode = mode[0] - east_m, mode[1] - north_m, mode[2]
    return replace(device, x_m=device.x_m - east_m, y_m=device.y_m - north_m, second_mode=mode)
