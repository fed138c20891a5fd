"""Fit a twin that traces paths over the 3D map, either exact or with estimated map errors."""

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
from radiotwin.runtime.pieces import cached
from radiotwin.scene import Scene
from radiotwin.scene.citymap import CityMap, perturbed_map
from radiotwin.twin.fit_links import fit_links, make_twin, reliable_m
from radiotwin.twin.localize import Relocation, TwinDevice
from radiotwin.twin.localize.along_paths import MAX_DEVICES
from radiotwin.twin.localize.estimate import CREDIBLE
from radiotwin.twin.model.model import Model
from radiotwin.twin.twin import Twin

DOFS = (3.0, 5.0, 10.0, 30.0)  # tried degrees of freedom of the errors
MIN_HEARD = 30  # detected links of LoS, or NLoS, needed to fit its level
MIN_LOSS_NATS = 0.02  # for each link: paths are worse than the law, which has more parameters
LOST_M = 40.0  # a device with a larger radius is not used to fit the channel
SURE_M = 15.0  # a device of an earlier twin with a smaller radius is searched only around there
MAPS = 4  # maps with random errors over which devices are located again
MAX_COPIES = 4  # anchors that are located as if they were unknown
PRIOR_DEVICES = 2  # weight of the likelihood's radii, in devices, beside the errors of anchors


def fit_along_paths(links: Links, scene: Scene, seed: int, start: Twin | None,
                    executor: Executor | None = None) -> Twin:
    """Fit a twin that traces paths over the map as it is; arguments are as of `fit_twin`.

    Fitted are levels and error scales in LoS and NLoS, and the diffuse power. Warns if paths
    explain the levels worse than a log-distance law does.
    """
    law = fit_links(links, scene, SegmentedLogDistance, seed)
    twin = fit_paths(links, scene, law, relocation_from(scene, np.inf, start, executor))
    device_m, law_m = reliable_m(twin.devices, LOST_M), reliable_m(law.devices, LOST_M)
    dof = best_dof(links, twin.channel, device_m)
    by_paths = Model.build(links, twin.channel, dof, device_m=device_m)
    by_law = Model.build(links, law.channel, dof, device_m=law_m)
    fit, compared = by_paths.fit(), by_paths.usable & by_law.usable
    counts = np.bincount(by_paths.group[by_paths.usable & np.isfinite(links.level_db)], minlength=2)
    # Without slopes, which would turn path levels into a log-distance law
    levels_only = replace(by_paths, level_columns=by_paths.level_columns[:, :2],
                          level_prior_sd_db=by_paths.level_prior_sd_db[:2])
    loss_nats = levels_only.regression(compared).nll(levels_only.fit()).sum() \
        - by_law.regression(compared).nll(by_law.fit()).sum()
    if counts[0] >= MIN_HEARD and loss_nats > MIN_LOSS_NATS * compared.sum():
        warnings.warn("paths over the 3D map explain these levels worse than a law of distance and "
                      "line of sight does: is the map that of the area, and in the same frame? "
                      "Otherwise take the model segmented_nn", stacklevel=4)
    if counts.min() < MIN_HEARD <= counts.max():
        few, many = counts.argmin(), counts.argmax()
        level_db = fit.coefficients[1 - many]  # columns begin with LoS, groups with NLoS
        warnings.warn(f"only {counts[few]} links {('without', 'with')[few]} line of sight were "
                      f"heard: they take the level of the others, {level_db:.1f} dB from the "
                      "power of the paths", stacklevel=4)
        fit = replace(fit, coefficients=np.array([level_db, level_db, 0.0, 0.0]),
                      scale_db=np.full(2, fit.scale_db[many]))
    unknown = sum(device.role == "unknown" for device in twin.devices)
    if unknown > MAX_DEVICES:
        warnings.warn(f"{unknown} devices are unknown, and paths are followed to locate at most "
                      f"{MAX_DEVICES}: their positions are those of a law of distance and line of "
                      "sight", stacklevel=4)
    return replace(twin, fitted=fit.learnt)


def fit_paths(links: Links, scene: Scene, law: Twin, relocation: Relocation) -> Twin:
    """Locate unknown devices along paths, from the positions of a law, and fit the diffuse power.

    The levels of the twin's channel are not fitted yet.
    """
    # For the search, use unreliable devices, too, whose links tell of deep shadow.
    channel = _image_paths(links, law, law.device_m)
    devices = relocation.relocate(links, law.devices, channel)
    channel = _image_paths(links, law, reliable_m(devices, LOST_M))
    return make_twin(links, scene, channel, devices)


def relocation_from(scene: Scene, max_radius_m: float, start: Twin | None = None,
                    executor: Executor | None = None) -> Relocation:
    """Set up a search for unknown devices by tracing paths.

    Devices with a 90 % radius by the law above `max_radius_m` [m] are not searched. A device that
    `start` located within `SURE_M` is searched only around that position and the law's.
    """
    sure = [device for device in start.devices if device.role == "unknown" and device.located
            and device.credible_radius_m <= SURE_M] if start else []
    positions = {device.device: [(device.x_m, device.y_m)] for device in sure}
    return Relocation(scene.config.extent.bounds, max_radius_m, positions=positions,
                      executor=executor or Executor())


def best_dof(links: Links, channel: ChannelModel, device_m: np.ndarray) -> float:
    """Return the likeliest degrees of freedom in DOFS of Student-t errors, on the training links.

    Devices are at (k, 3) [m]; NaN: unknown.
    """
    model = Model.build(links, channel, DOFS[0], device_m=device_m)
    objectives = [replace(model, dof=dof).fit().objective for dof in DOFS]
    return DOFS[int(np.argmin(objectives))]


def _image_paths(links: Links, law: Twin, device_m: np.ndarray) -> ImagePaths:
    """Return the path channel with diffuse power fitted to the devices in `device_m` (k, 3) [m]."""
    channel = ImagePaths(law.channel)
    located = links.with_located_devices(device_m)
    declared, antenna_db = located.declared, declared_antenna_db(located)
    feed_db = 0.0 if declared.adds_nothing else declared.fed_db[located.device]
    return channel.fit_diffuse(*located.gains(feed_db), antenna_db)


def fit_over_wrong_map(links: Links, scene: Scene, seed: int, start: Twin | None,
                       executor: Executor | None = None) -> Twin:
    """Fit a twin that traces paths over a map with errors; arguments are as of `fit_twin`.

    The map's shift is estimated from the anchors' links; devices are located along paths on the
    shifted map. Errors of walls and roofs widen the radii, and so do the position errors of some
    anchors that are located as if they were unknown.
    """
    shift_m = _shift(links, seed)
    on_map = _moved(links, shift_m)
    with_copies = _with_copies(on_map)
    if start is not None:
        back_m = -shift_m[0], -shift_m[1], -shift_m[2]
        start = replace(start, devices=[_moved_device(device, back_m) for device in start.devices])
    by_paths = fit_along_paths(with_copies, scene, seed, start, executor)
    assert isinstance(by_paths.channel, ImagePaths)
    found = _estimate_errors(on_map, _calibrated(by_paths.devices, on_map), shift_m, seed)
    if found[0].warning:
        warnings.warn(f"the 3D map seems to be off: {found[0].warning}; predictions and radii "
                      "include it, and a better map would improve them", stacklevel=3)
    devices = by_paths.devices
    if found[0].is_seen:
        cities = [perturbed_map(on_map.city, found[0].wall_m[0], found[0].height_m[0],
                                seed + member) for member in range(MAPS)]
        bounds = scene.config.extent.bounds
        more_m = _radius_by_map_m(with_copies, devices, by_paths.channel, cities, bounds)
        devices = [
            replace(device, credible_radius_m=float(np.hypot(device.credible_radius_m, more)))
            for device, more in zip(devices, more_m, strict=True)]
    devices = [_moved_device(device, shift_m) for device in _calibrated(devices, on_map)]
    return make_twin(links, scene, _channel(links, devices, found, seed), devices)


def _shift(links: Links, seed: int) -> Shift:
    """Estimate the shift of the map from the anchors' links; none if no anchor has a position."""
    known = links.with_located_devices(links.device_m)
    if not len(known):
        return NO_SHIFT
    informative = drop_uninformative(*known.gains())
    return estimate_shift(*informative, seed)


def _moved(links: Links, shift_m: Shift) -> Links:
    """Move devices and receivers of links by a shift of the map."""
    if shift_m == NO_SHIFT:
        return links
    step_m = np.array([*shift_m[:2], 0.0])
    return links.with_devices(links.device_m + step_m).with_receivers(links.receiver_m + step_m)


def _with_copies(links: Links) -> Links:
    """Append copies of some anchors' links, as of unknown devices, to test the localisation."""
    count = len(links.device_names)
    unknown = count - len(links.anchors)
    anchors = sorted(links.anchors)[:max(min(MAX_COPIES, MAX_DEVICES - unknown), 0)]
    if not unknown or not anchors:
        return links
    copied = [np.flatnonzero(links.device == anchor) for anchor in anchors]
    device = np.concatenate([links.device, *(np.full(len(rows), count + number)
                                             for number, rows in enumerate(copied))])
    height_m = np.full((len(anchors), 3), np.nan)
    height_m[:, 2] = links.device_m[anchors, 2]
    rows = np.concatenate([np.arange(len(links)), *copied])
    known = links.with_devices(np.nan_to_num(links.device_m)).select(rows)
    names = [f"{links.device_names[anchor]} (as if unknown)" for anchor in anchors]
    return known.of_devices(device, np.vstack([links.device_m, height_m]),
                            [*links.device_names, *names], known.anchors)


def _calibrated(devices: list[TwinDevice], links: Links) -> list[TwinDevice]:
    """Drop the copies of anchors, and scale all radii by the position errors of the copies.

    A normal distribution with 90 % radius r has the mean square error r² / ln 10. The factor is at
    least 1.
    """
    count = len(links.device_names)
    ratios = [PRIOR_DEVICES]
    for copy, anchor in zip(devices[count:], sorted(links.anchors)):
        if copy.located and copy.credible_radius_m > 0:
            square_m2 = ((links.device_m[anchor, :2] - (copy.x_m, copy.y_m))**2).sum()
            ratios.append(np.log(10) * square_m2 / copy.credible_radius_m**2)
    factor = max(np.sqrt(sum(ratios) / (PRIOR_DEVICES + len(ratios) - 1)), 1.0)
    return [replace(device, credible_radius_m=float(factor * device.credible_radius_m))
            for device in devices[:count]]


def _estimate_errors(links: Links, devices: list[TwinDevice], shift_m: Shift, seed: int) -> Found:
    """Estimate the map's wall, height and material errors by devices located within LOST_M."""
    known = links.with_located_devices(reliable_m(devices, LOST_M))
    informative = drop_uninformative(*known.gains())
    error, diffuse = estimate_other_errors(*informative, seed)
    return replace(error, shift_m=shift_m), diffuse


def _channel(links: Links, devices: list[TwinDevice], found: Found, seed: int) -> PathKriging:
    """Fit `PathKriging` to located devices, or load it; lost ones are predicted by kriging only."""
    lost = tuple(np.flatnonzero(~np.isfinite(reliable_m(devices, LOST_M)).all(axis=1)).tolist())
    known = links.with_located_devices(reliable_m(devices))
    data = *known.gains(PathKriging(found).declared_db(known)), seed
    inputs = PathKriging, *data, str(found[0].state()), found[1], lost
    return cached("channel", inputs, lambda: PathKriging(found, lost).fit(*data), PathKriging.state,
                  PathKriging.from_state)


def _radius_by_map_m(links: Links, devices: list[TwinDevice], channel: ImagePaths,
                     cities: list[CityMap], bounds: tuple[float, float, float, float]
                     ) -> np.ndarray:
    """Return the 90 % radius (k,) [m] of the position errors that errors of the map cause.

    It is from how far devices move over `cities`, wrong copies of the map (F distribution for few
    of them); 0 if paths never locate the device.
    """
    squares: list[list[float]] = [[] for _ in devices]
    known = {device.device: [(device.x_m, device.y_m)] for device in devices}
    with progress("locating over wrong maps", total=len(cities)) as advance:
        for city in cities:
            search = Relocation(bounds, np.inf, positions={key: [*xy] for key, xy in known.items()})
            found = search.relocate(links.with_city(city), devices, channel)
            for square, before, after in zip(squares, devices, found, strict=True):
                if after is not before:  # paths over this map locate it, too
                    square.append((after.x_m - before.x_m)**2 + (after.y_m - before.y_m)**2)
            advance(1)
    return np.sqrt([np.mean(square) * f.ppf(CREDIBLE, 2, 2 * len(square)) if square else 0.0
                    for square in squares])


def _moved_device(device: TwinDevice, shift_m: Shift) -> TwinDevice:
    """Move a device back from the shifted map to the frame of the links."""
    east_m, north_m, _ = shift_m
    mode = device.second_mode
    if mode is not None:
        mode = mode[0] - east_m, mode[1] - north_m, mode[2]
    return replace(device, x_m=device.x_m - east_m, y_m=device.y_m - north_m, second_mode=mode)
