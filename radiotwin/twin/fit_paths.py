"""Fitting a twin that follows paths over the 3D map, as it is or with allowance for its errors."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
from scipy.stats import f

from radiotwin.links import Links
from radiotwin.propagation.laws import ChannelModel
from radiotwin.propagation.laws.base import drop_uninformative
from radiotwin.propagation.laws.followed_paths import declared_antenna_db
from radiotwin.propagation.laws.image_paths import ImagePaths
from radiotwin.propagation.laws.log_distance import SegmentedLogDistance
from radiotwin.propagation.laws.map_error import (
    NO_SHIFT,
    Found,
    Shift,
    estimate_other_errors,
    estimate_shift,
)
from radiotwin.propagation.laws.path_kriging import PathKriging
from radiotwin.runtime.console import progress
from radiotwin.runtime.execution import Executor
from radiotwin.runtime.pieces import kept
from radiotwin.scene import Scene
from radiotwin.scene.citymap import CityMap, perturbed_map
from radiotwin.twin.fit_links import fit_links, make_twin, reliable_m
from radiotwin.twin.localize import Relocation, TwinDevice
from radiotwin.twin.localize.along_paths import CREDIBLE, MAX_DEVICES
from radiotwin.twin.model.model import Model
from radiotwin.twin.twin import Twin

DOFS = (3.0, 5.0, 10.0, 30.0)  # of the errors, that are tried
MIN_HEARD = 30  # links of a class of line of sight, to learn its level from
MIN_LOSS_NATS = 0.02  # a link, to be worse than the law, which has more numbers to be fitted
LOST_M = 40.0  # radius from which on a device's position says nothing about the channel
SURE_M = 15.0  # radius of a device of an earlier twin that is not searched for everywhere again
MAPS = 4  # over which devices are located again
MAX_COPIES = 4  # anchors that are located as if they were unknown
PRIOR_DEVICES = 2  # that the radii of the likelihood are worth, beside what those show


def fit_along_paths(links: Links, scene: Scene, seed: int, start: Twin | None,
                    executor: Executor | None = None) -> Twin:
    """Return a twin that follows paths, with what they do not tell learnt.

    That is a level for each class of line of sight, the diffuse power, and the errors' sizes. Warns
    where paths explain the levels worse than the law does.
    """
    law = fit_links(links, scene, SegmentedLogDistance, seed)
    twin = fit_paths(links, scene, law, relocation_from(scene, np.inf, start, executor))
    device_m, law_m = reliable_m(twin.devices, LOST_M), reliable_m(law.devices, LOST_M)
    dof = best_dof(links, twin.channel, device_m)
    by_paths = Model.build(links, twin.channel, dof, device_m=device_m)
    by_law = Model.build(links, law.channel, dof, device_m=law_m)
    fit, both = by_paths.fit(), by_paths.usable & by_law.usable
    heard = np.bincount(by_paths.group[by_paths.usable & np.isfinite(links.level_db)], minlength=2)
    # Slopes of their own would make any law of what paths bring.
    as_they_are = replace(by_paths, level_columns=by_paths.level_columns[:, :2],
                          level_prior_sd_db=by_paths.level_prior_sd_db[:2])
    loss = as_they_are.regression(both).nll(as_they_are.fit()).sum() \
        - by_law.regression(both).nll(by_law.fit()).sum()
    if heard[0] >= MIN_HEARD and loss > MIN_LOSS_NATS * both.sum():
        warnings.warn("paths over the 3D map explain these levels worse than a law of distance and "
                      "line of sight does: is the map that of the area, and in the same frame? "
                      "Otherwise take the model segmented_nn", stacklevel=4)
    if heard.min() < MIN_HEARD <= heard.max():
        few, many = heard.argmin(), heard.argmax()
        level_db = fit.coefficients[1 - many]  # of the columns LoS comes first, of the groups NLoS
        warnings.warn(f"only {heard[few]} links {('without', 'with')[few]} line of sight were "
                      f"heard: their level is that of the others, {level_db:.1f} dB from what "
                      "paths bring", stacklevel=4)
        fit = replace(fit, coefficients=np.array([level_db, level_db, 0.0, 0.0]),
                      scale_db=np.full(2, fit.scale_db[many]))
    unknown = sum(device.role == "unknown" for device in twin.devices)
    if unknown > MAX_DEVICES:
        warnings.warn(f"{unknown} devices are unknown, and paths are followed to locate "
                      f"{MAX_DEVICES} at most: they are where a law of distance and line of sight "
                      "has them", stacklevel=4)
    return replace(twin, fitted=fit.learnt)


def fit_paths(links: Links, scene: Scene, law: Twin, relocation: Relocation) -> Twin:
    """Follow paths over the map, with unknown devices where they explain the levels best.

    Args:
        links: n links.
        scene: its map; all surfaces are taken to be concrete.
        law: a twin of a law of distance and line of sight; says where it is worth searching.
        relocation: the search, which remembers what it followed.

    Returns:
        a twin with the channel `paths`, whose levels are still to be fitted.
    """
    # To be found from there, with all that is known of deep shadow, unreliable devices count, too.
    channel = _image_paths(links, law, law.device_m)
    devices = relocation.relocate(links, law.devices, channel)
    channel = _image_paths(links, law, reliable_m(devices, LOST_M))
    return make_twin(links, scene, channel, devices)


def relocation_from(scene: Scene, max_radius_m: float, start: Twin | None = None,
                    executor: Executor | None = None) -> Relocation:
    """Return a search along paths.

    Args:
        scene: its extent bounds the search.
        max_radius_m: of a device's circle by the law [m], beyond which it is not searched for.
        start: an earlier twin; devices that it is sure of are searched for around its position, and
            the law's, only.
        executor: where it searches for several devices at once; None: one after the other here.
    """
    sure = [device for device in start.devices if device.role == "unknown" and device.located
            and device.credible_radius_m <= SURE_M] if start else []
    positions = {device.device: [(device.x_m, device.y_m)] for device in sure}
    return Relocation(scene.config.extent.bounds, max_radius_m, positions=positions,
                      executor=executor or Executor())


def best_dof(links: Links, channel: ChannelModel, device_m: np.ndarray) -> float:
    """Return the degrees of freedom of the errors that explain the links best.

    Args:
        links: n links.
        channel: fitted.
        device_m: (k, 3) where it has the devices [m]; NaN for none.
    """
    model = Model.build(links, channel, DOFS[0], device_m=device_m)
    objectives = [replace(model, dof=dof).fit().objective for dof in DOFS]
    return DOFS[int(np.argmin(objectives))]


def _image_paths(links: Links, law: Twin, device_m: np.ndarray) -> ImagePaths:
    """Return the channel, its diffuse power fitted to links of devices that have a position."""
    channel = ImagePaths(law.channel)
    located = links.with_located_devices(device_m)
    declared, antenna_db = located.declared, declared_antenna_db(located)
    fed_db = 0.0 if declared.adds_nothing else declared.fed_db[located.device]
    return channel.fit_diffuse(*located.gains(fed_db), antenna_db)


def fit_over_wrong_map(links: Links, scene: Scene, seed: int, start: Twin | None,
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
    return make_twin(links, scene, _channel(links, devices, found, seed), devices)


def _shift(links: Links, seed: int) -> Shift:
    """Return the shift of the map, from the anchors' links."""
    known = links.with_located_devices(links.device_m)
    if not len(known):
        return NO_SHIFT
    informative = drop_uninformative(*known.gains())
    return estimate_shift(*informative, seed)


def _moved(links: Links, shift_m: Shift) -> Links:
    """Return links whose ends are all moved by a shift."""
    if shift_m == NO_SHIFT:
        return links
    step_m = np.array([*shift_m[:2], 0.0])
    return links.with_devices(links.device_m + step_m).with_receivers(links.receiver_m + step_m)


def _with_copies(links: Links) -> Links:
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
    return known.of_devices(device, np.vstack([links.device_m, height_m]),
                            [*links.device_names, *names], known.anchors)


def _calibrated(devices: list[TwinDevice], links: Links) -> list[TwinDevice]:
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


def _found(links: Links, devices: list[TwinDevice], shift_m: Shift, seed: int) -> Found:
    """Return the errors of a map that is not shifted any more, from devices that are not lost."""
    known = links.with_located_devices(reliable_m(devices, LOST_M))
    informative = drop_uninformative(*known.gains())
    error, diffuse = estimate_other_errors(*informative, seed)
    return replace(error, shift_m=shift_m), diffuse


def _channel(links: Links, devices: list[TwinDevice], found: Found, seed: int) -> PathKriging:
    """Fit the channel to all devices that are located; kriging alone to those that are lost."""
    lost = tuple(np.flatnonzero(~np.isfinite(reliable_m(devices, LOST_M)).all(axis=1)).tolist())
    known = links.with_located_devices(reliable_m(devices))
    data = *known.gains(PathKriging(found).declared_db(known)), seed
    inputs = PathKriging, *data, str(found[0].state()), found[1], lost
    return kept("channel", inputs, lambda: PathKriging(found, lost).fit(*data), PathKriging.state,
                PathKriging.from_state)


def _radius_by_map_m(links: Links, devices: list[TwinDevice], channel: ImagePaths,
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
