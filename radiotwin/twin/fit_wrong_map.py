"""Fitting a twin that follows paths over a 3D map which may be wrong."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
from scipy.stats import f

from radiotwin.channel import fit_once
from radiotwin.channel.base import drop_uninformative
from radiotwin.channel.image_paths import ImagePaths
from radiotwin.channel.map_error import MapError
from radiotwin.channel.map_shift import estimate_shift
from radiotwin.channel.path_kriging import PathKriging
from radiotwin.links import LinkData
from radiotwin.localize import Relocation
from radiotwin.localize.along_paths import CREDIBLE
from radiotwin.localize.estimate import TwinDevice
from radiotwin.progress import progress
from radiotwin.scene import Scene
from radiotwin.scene.perturbation import perturbed_map
from radiotwin.twin.fit_links import reliable_m
from radiotwin.twin.fit_paths import LOST_M, fit_along_paths
from radiotwin.twin.twin import Twin

MAPS = 6  # over which devices are located again


def fit_over_wrong_map(links: LinkData, scene: Scene, seed: int, start: Twin | None) -> Twin:
    """Return a twin that allows for errors of its map.

    Devices are located along paths, on a map moved to where the anchors' links want it. Errors of
    walls and roofs widen their radii.

    Args:
        links: n links over the map.
        scene: the map's.
        seed: of the channel, and of the maps' errors.
        start: an earlier twin, as of `fit_twin`.
    """
    known = links.with_devices(np.nan_to_num(links.device_m))
    anchors = known.select(np.isin(links.device, sorted(links.anchors)))
    geometry, level_db = drop_uninformative(anchors.geometry, anchors.level_db, links.limit_db)
    east_m, north_m, _ = estimate_shift(geometry, level_db, links.limit_db, seed)
    step_m = np.array([east_m, north_m, 0.0])
    on_map = links.with_devices(links.device_m + step_m).with_receivers(links.receiver_m + step_m)
    by_paths = fit_along_paths(on_map, scene, seed, start)
    back = replace(by_paths, devices=[_moved(each, -east_m, -north_m) for each in by_paths.devices])
    device_m = reliable_m(back.devices, LOST_M)
    rows = np.isfinite(device_m).all(axis=1)[links.device]
    located = links.with_devices(np.nan_to_num(device_m)).select(rows)
    channel = fit_once(PathKriging, located.geometry, located.level_db, links.limit_db, seed)
    assert isinstance(channel, PathKriging) and isinstance(by_paths.channel, ImagePaths)
    if channel.map_error.warning:
        warnings.warn(f"the 3D map seems to be off: {channel.map_error.warning}; predictions and "
                      "radii allow for it, and a better map would make them better", stacklevel=3)
    devices = back.devices
    if channel.map_error.is_seen:
        square_m2 = _square_shift_m2(on_map, by_paths.devices, by_paths.channel, channel.map_error,
                                     scene.config.extent.bounds, seed)
        devices = [replace(each, credible_radius_m=float(np.hypot(each.credible_radius_m, more_m)))
                   for each, more_m in zip(devices, np.sqrt(square_m2), strict=True)]
    return replace(back, channel=channel, devices=devices, fitted=None)


def _square_shift_m2(links: LinkData, devices: list[TwinDevice], channel: ImagePaths,
                     error: MapError, bounds: tuple[float, float, float, float],
                     seed: int) -> np.ndarray:
    """Return the square (k,) [m²] of the radius that 90 % of errors by the map stay within.

    What moves an estimate from one map to another that is as wrong moves it from the true map to
    this one. Each axis is taken for normal, with a variance from few maps (F distribution).
    """
    squares: list[list[float]] = [[] for _ in devices]
    assert links.city is not None
    with progress("locating over wrong maps", total=MAPS) as advance:
        for member in range(MAPS):
            wrong = perturbed_map(links.city, error.wall_m[0], error.height_m[0], seed + member)
            there = {each.device: [(each.x_m, each.y_m)] for each in devices}
            found = Relocation(bounds, np.inf, positions=there).relocate(
                links.with_city(wrong), devices, channel)
            for square, before, after in zip(squares, devices, found, strict=True):
                if after is not before:  # paths over this map locate it, too
                    square.append((after.x_m - before.x_m)**2 + (after.y_m - before.y_m)**2)
            advance(1)
    return np.array([np.mean(square) * f.ppf(CREDIBLE, 2, 2 * len(square)) if square else 0.0
                     for square in squares])


def _moved(device: TwinDevice, east_m: float, north_m: float) -> TwinDevice:
    """Return a device whose estimate is moved; an anchor is where it was declared."""
    mode = device.second_mode
    return replace(device, x_m=device.x_m + east_m, y_m=device.y_m + north_m, second_mode=mode and (
        mode[0] + east_m, mode[1] + north_m, mode[2]))
