"""Fitting a twin: the channel from the anchors' links, then the unknown devices' positions."""

from __future__ import annotations

import warnings
from dataclasses import asdict, replace
from typing import Any

import numpy as np

import radiotwin
from radiotwin.channel import ChannelModel, channel_named, check_fit_data, fit_once
from radiotwin.channel.base import MIN_DETECTED
from radiotwin.channel.image_paths import ImagePaths
from radiotwin.channel.path_kriging import PathKriging
from radiotwin.channel.published import PublishedLaw
from radiotwin.channel.segmented_log_distance import SegmentedLogDistance
from radiotwin.effects.effect_model import EffectModel
from radiotwin.effects.fold_model import FoldModel
from radiotwin.errors import BadInput
from radiotwin.links import LinkData, LinkGeometry, join_links, link_geometry, prepare_links
from radiotwin.localize import (
    DeviceEstimate,
    LocalizeSettings,
    Relocation,
    TwinDevice,
    localize,
    read_device,
)
from radiotwin.localize.along_paths import MAX_DEVICES
from radiotwin.measurements import MAX_APART_M, Measurements
from radiotwin.pieces import kept
from radiotwin.scene import Scene
from radiotwin.twin.twin import Twin

MAX_BLANK, LIMIT_GAP_DB = 0.02, 10.0  # beyond both, blanks and the limit of detection disagree
DOFS = (3.0, 5.0, 10.0, 30.0)  # of the errors, that are tried
# Of more links, so many are fitted. Measured on simulated links: with all of a million, the levels
# of a law differ by 0.02 dB (root mean square; 0.08 dB at most), two to four of its standard errors
# then, and about one of those with fewer. The time to train a network is in proportion to them.
MAX_LINKS, THINNED_LINKS = 1_000_000, 300_000
MIN_HEARD = 30  # links of a class of line of sight, to learn its level from
MIN_LOSS_NATS = 0.02  # a link, to be worse than the law, which has more numbers to be fitted
LOST_M = 40.0  # radius from which on a device's position says nothing about the channel
SURE_M = 15.0  # radius of a device of an earlier twin that is not searched for everywhere again


def fit_twin(measurements: Measurements, scene: Scene, *, model: str = "segmented_nn", seed: int,
             start: Twin | None = None, allow_indoor: bool = False) -> Twin:
    """Learn the channel from the anchors' links, then locate the unknown devices with it.

    A published law (`radiotwin.channel.published`) is taken as it stands and needs no anchor.

    Args:
        measurements: links to anchors and unknown devices.
        scene: its map and extent, and the receivers' sensitivity.
        model: name of a channel model (`radiotwin.channel.channel_models`); `raytrace` stands for
            `image_paths`, which follows paths over the 3D map, and `path_kriging` allows for errors
            of that.
        seed: of the channel's and the search's random numbers.
        start: an earlier twin; the search also starts from its positions.
        allow_indoor: whether unknown devices may be inside buildings.

    Returns:
        the twin; positions of devices that could not be located are NaN.

    Warns:
        Of more than `MAX_LINKS` links, `THINNED_LINKS` are drawn, evenly among the devices.

    Raises:
        BadInput: no anchor, nothing detected, links that no channel can be learnt from, an unknown
            model, or devices that may be indoors with one that follows paths.
    """
    flights, measurements = measurements.flights, _thinned(measurements, seed)
    if start is not None:
        start.warn_of_another_scene(scene, scene.content_hash())
    channel = channel_named(model)
    if channel in (ImagePaths, PathKriging):
        if allow_indoor:
            raise BadInput(f"model {model} follows paths outside buildings only; take another "
                           "model where unknown devices may be indoors")
        links = prepare_links(measurements, scene)
        for note in links.notes:
            warnings.warn(note, stacklevel=2)
        twin = _fit_along_paths(links, scene, seed, start)
        if channel is PathKriging:
            twin = _with_path_kriging(twin, links, seed)
        twin.provenance.update(flights=flights, seed=seed)
        return twin
    _check_heights(measurements)
    settings = LocalizeSettings(allow_indoor=allow_indoor)
    twin = fit_links(join_links(measurements, scene), scene, channel, seed, start, settings)
    twin.provenance.update(flights=flights, seed=seed)
    return twin


def fit_links(links: LinkData, scene: Scene, channel: type[ChannelModel], seed: int,
              start: Twin | None = None, settings: LocalizeSettings | None = None) -> Twin:
    """Learn a channel from the anchors' links, then locate the unknown devices with it.

    Args:
        links: n links.
        scene: its map and extent.
        channel: class of the channel model.
        seed: as of `fit_twin`.
        start: as of `fit_twin`.
        settings: of the search.

    Raises:
        BadInput: as of `fit_twin`.
    """
    _check_positions(links, scene)
    _check_limit(links)
    is_anchor = np.isin(np.arange(len(links.device_m)), sorted(links.anchors))
    anchors_m = np.where(is_anchor[:, None], links.device_m, np.nan)
    if issubclass(channel, PublishedLaw):
        fitted: ChannelModel = _published(links, anchors_m, scene, channel)
    else:
        fitted = _fit_channel(links, anchors_m, channel, seed)
    devices: list[Any] = [TwinDevice.anchor(name, *position_m) if anchor else None
                          for name, position_m, anchor in
                          zip(links.device_names, links.device_m, is_anchor, strict=True)]
    unknown = np.flatnonzero(~is_anchor)
    if len(unknown):
        found = _locate(links, scene, fitted.trend, unknown, seed, start, settings)
        for index, each in zip(unknown, found, strict=True):
            devices[index] = each
    if fitted.trend is not fitted:
        fitted = _fit_channel(links, reliable_m(devices), channel, seed)
    if isinstance(fitted, PublishedLaw):
        for note in fitted.outside(_known_links(links, reliable_m(devices))[0]):
            warnings.warn(note, stacklevel=3)
    return Twin(fitted, devices, _level(links), links.limit_db, _provenance(links, scene))


def fit_known(links: LinkData, channel: type[ChannelModel], seed: int) -> Twin:
    """Learn a channel from links whose devices all have declared positions; no scene is needed.

    Raises:
        BadInput: links that no channel can be learnt from.
    """
    geometry = links.geometry
    check_fit_data(geometry, links.level_db,
                   needs_los=channel.uses_map and links.city is not None)
    fitted = fit_once(channel, geometry, links.level_db, links.limit_db, seed)
    devices = [TwinDevice.anchor(name, *position_m)
               for name, position_m in zip(links.device_names, links.device_m, strict=True)]
    return Twin(fitted, devices, _level(links), links.limit_db, _provenance(links, None))


def fit_paths(links: LinkData, scene: Scene, law: Twin, relocation: Relocation) -> Twin:
    """Follow paths over the map, with unknown devices where they explain the levels best.

    Args:
        links: n links.
        scene: its map; all surfaces are taken to be concrete.
        law: a twin of a law of distance and line of sight; says where it is worth searching.
        relocation: the search, which remembers what it followed.

    Returns:
        a twin with the channel `image_paths`, whose levels are still to be fitted.
    """
    # To be found from there, with all that is known of deep shadow, unreliable devices count, too.
    channel = _image_paths(links, law, law.device_m)
    devices = relocation.relocate(links, law.devices, channel)
    channel = _image_paths(links, law, reliable_m(devices, LOST_M))
    return Twin(channel, devices, law.level, links.limit_db, _provenance(links, scene))


def relocation_from(scene: Scene, max_radius_m: float, start: Twin | None = None) -> Relocation:
    """Return a search along paths.

    Args:
        scene: its extent bounds the search.
        max_radius_m: of a device's circle by the law [m], beyond which it is not searched for.
        start: an earlier twin; devices that it is sure of are searched for around its position, and
            the law's, only.
    """
    sure = [device for device in start.devices if device.role == "unknown" and device.located
            and device.credible_radius_m <= SURE_M] if start else []
    positions = {device.device: [(device.x_m, device.y_m)] for device in sure}
    return Relocation(scene.config.extent.bounds, max_radius_m, positions=positions)


def reliable_m(devices: list[TwinDevice], max_radius_m: float = np.inf) -> np.ndarray:
    """Return positions (k, 3) [m] that may be relied on, and NaN for the others.

    Args:
        devices: k devices.
        max_radius_m: of the circle that holds nine in ten of the guesses [m].
    """
    located = np.array([each.located and each.credible_radius_m <= max_radius_m
                        for each in devices])
    positions_m = [(each.x_m, each.y_m, each.z_m) for each in devices]
    return np.where(located[:, None], positions_m, np.nan)


def best_dof(links: LinkData, channel: ChannelModel, device_m: np.ndarray) -> float:
    """Return the degrees of freedom of the errors that explain the links best.

    Args:
        links: n links.
        channel: fitted.
        device_m: (k, 3) where it has the devices [m]; NaN for none.
    """
    model = FoldModel.build(links, channel, DOFS[0], device_m=device_m)
    objectives = [replace(model, dof=dof).fit().objective for dof in DOFS]
    return DOFS[int(np.argmin(objectives))]


def _fit_along_paths(links: LinkData, scene: Scene, seed: int, start: Twin | None) -> Twin:
    """Return a twin that follows paths, with what they do not tell learnt.

    That is a level for each class of line of sight, the diffuse power, and the errors' sizes. Warns
    where paths explain the levels worse than the law does.
    """
    law = fit_links(links, scene, SegmentedLogDistance, seed)
    twin = fit_paths(links, scene, law, relocation_from(scene, np.inf, start))
    device_m, law_m = reliable_m(twin.devices, LOST_M), reliable_m(law.devices, LOST_M)
    dof = best_dof(links, twin.channel, device_m)
    by_paths = FoldModel.build(links, twin.channel, dof, device_m=device_m)
    by_law = FoldModel.build(links, law.channel, dof, device_m=law_m)
    fit, both = by_paths.fit(), by_paths.usable & by_law.usable
    heard = np.bincount(by_paths.group[by_paths.usable & np.isfinite(links.level_db)], minlength=2)
    loss = by_paths.regression(both).nll(fit).sum() \
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
        fit = replace(fit, coefficients=np.full(2, level_db),
                      scale_db=np.full(2, fit.scale_db[many]))
    unknown = sum(device.role == "unknown" for device in twin.devices)
    if unknown > MAX_DEVICES:
        warnings.warn(f"{unknown} devices are unknown, and paths are followed to locate "
                      f"{MAX_DEVICES} at most: they are where a law of distance and line of sight "
                      "has them", stacklevel=4)
    return replace(twin, fitted=EffectModel.of(by_paths, fit))


def _with_path_kriging(twin: Twin, links: LinkData, seed: int) -> Twin:
    """Return a twin with the same positions, and all that the links tell of map and errors."""
    device_m = reliable_m(twin.devices, LOST_M)
    rows = np.isfinite(device_m).all(axis=1)[links.device]
    located = links.with_devices(np.where(np.isfinite(device_m), device_m, 0.0)).select(rows)
    channel = fit_once(PathKriging, located.geometry, located.level_db, links.limit_db, seed)
    return replace(twin, channel=channel, fitted=None)


def _image_paths(links: LinkData, law: Twin, device_m: np.ndarray) -> ImagePaths:
    """Return the channel, its diffuse power fitted to links of devices that have a position."""
    channel = ImagePaths(law.channel)
    rows = np.isfinite(device_m).all(axis=1)[links.device]
    located = links.with_devices(np.where(np.isfinite(device_m), device_m, 0.0)).select(rows)
    return channel.fit_diffuse(located.geometry, located.level_db, links.limit_db)


def _fit_channel(links: LinkData, device_m: np.ndarray, channel: type[ChannelModel],
                 seed: int) -> ChannelModel:
    """Fit to the links of all devices whose position in `device_m` (k, 3) is known."""
    if not links.anchors:
        raise BadInput("no anchor: every device has the role unknown, and a channel is learned "
                       "from devices whose positions are known; give at least one device x_m, y_m "
                       "and the role anchor in devices.csv, or take a published law, such as "
                       "tr36777_uma, which is not learned")
    geometry, level_db = _known_links(links, device_m)
    if not len(geometry):
        raise BadInput("no link to an anchor: none of the devices with role anchor was measured; "
                       "fly nearer to them")
    check_fit_data(geometry, level_db, needs_los=channel.uses_map)
    return fit_once(channel, geometry, level_db, links.limit_db, seed)


def _known_links(links: LinkData, device_m: np.ndarray) -> tuple[LinkGeometry, np.ndarray]:
    """Return the m links of devices with a position in `device_m` (k, 3), and their levels."""
    known = np.isfinite(device_m[:, :2]).all(axis=1)[links.device]
    geometry = link_geometry(device_m, links.receiver_m[known], links.device[known], links.city)
    return replace(geometry, frequency_hz=links.frequency_hz), links.level_db[known]


def _published(links: LinkData, device_m: np.ndarray, scene: Scene,
               law: type[PublishedLaw]) -> PublishedLaw:
    """Return a law as it was published; warn of the transmit power, where levels are powers.

    That is the median over detected links of anchors of what it must be, or the declared one.
    """
    geometry, level_db = _known_links(links, device_m)
    fitted = law().fit(geometry, level_db, links.limit_db)
    if links.is_gain:
        return fitted
    surplus_db = level_db - fitted.predict(geometry)[0]
    if np.isfinite(surplus_db).sum() >= MIN_DETECTED:
        fitted.power_dbm, how = float(np.nanmedian(surplus_db)), "fitted to the anchors' links"
    else:
        fitted.power_dbm, how = scene.config.radio.tx_power_dbm, "the scene's tx_power_dbm"
    warnings.warn(f"levels are received powers, and {law.name} predicts gains: the transmit power "
                  f"is taken for {fitted.power_dbm:.1f} dBm ({how})", stacklevel=4)
    return fitted


def _locate(links: LinkData, scene: Scene, channel: ChannelModel, unknown: np.ndarray, seed: int,
            start: Twin | None, settings: LocalizeSettings | None) -> list[TwinDevice]:
    start_m = None
    if start is not None:
        before = {device.device: (device.x_m, device.y_m) for device in start.devices}
        start_m = np.array([before.get(links.device_names[i], (np.nan, np.nan)) for i in unknown])
    rows = np.isin(links.device, unknown)
    measured = links.receiver_m[rows], links.device[rows], links.level_db[rows], channel
    options: dict[str, Any] = {
        "devices": unknown, "bounds": scene.config.extent.bounds, "city": scene.city,
        "z_m": links.device_m[unknown, 2], "limit_db": links.limit_db, "seed": seed,
        "start_m": start_m, "settings": settings}
    names = [links.device_names[index] for index in unknown]
    return kept("positions", (*measured, options, names),
                lambda: [_device(name, each) for name, each in
                         zip(names, localize(*measured, **options), strict=True)],
                lambda found: ({}, [asdict(each) for each in found]),
                lambda _, content: [read_device(each) for each in content])


def _device(name: str, found: DeviceEstimate) -> TwinDevice:
    return TwinDevice(name, found.x_m, found.y_m, found.z_m, "unknown", bool(found.located),
                      float(found.credible_radius_m), found.second_mode)


def _thinned(measurements: Measurements, seed: int) -> Measurements:
    """Return all links, or random ones of each device where there are too many."""
    device = measurements.device_index
    if len(device) <= MAX_LINKS:
        return measurements
    links = np.bincount(device)
    few, many = 1, len(device)  # a device; the first is possible, the second is not
    while many - few > 1:
        middle = (few + many) // 2
        fits = np.minimum(links, middle).sum() <= max(THINNED_LINKS, len(links))
        few, many = (middle, many) if fits else (few, middle)
    shuffled = np.random.default_rng(seed).permutation(len(device))
    by_device = shuffled[np.argsort(device[shuffled], kind="stable")]
    number = np.arange(len(device)) - np.repeat(np.cumsum(links) - links, links)
    keep = np.zeros(len(device), dtype=bool)
    keep[by_device[number < few]] = True
    warnings.warn(f"{len(device):,} links were measured, {keep.sum():,} of them are fitted: at "
                  f"most {few:,} of each device, drawn at random; the result is as certain as so "
                  "many links make it", stacklevel=3)
    return measurements.select(keep)


def _check_heights(measurements: Measurements) -> None:
    """Raise BadInput, with the row, where a height is empty: a 3D map needs it."""
    empty = np.flatnonzero(measurements.table["receiver_z_m"].isna())
    if len(empty):
        raise BadInput(f"measurements, row {empty[0] + 2}, column receiver_z_m: the receiver's "
                       "height is empty; with a 3D map every position needs one")
    measured = np.unique(measurements.device_index)
    for index in measured[np.isnan(measurements.device_m[measured, 2])]:
        raise BadInput(f"devices, row {index + 2}, column z_m: the height of device "
                       f"{measurements.devices['device'][index]!r} is empty; with a 3D map every "
                       "position needs one")


def _check_positions(links: LinkData, scene: Scene) -> None:
    """Raise BadInput for anchors inside buildings or far away, warn about receivers likewise."""
    anchors = np.array(sorted(links.anchors), dtype=int)
    anchors = anchors[np.isfinite(links.device_m[anchors]).all(axis=1)]
    apart_m = np.abs(links.device_m[anchors, :2] - np.median(links.receiver_m[:, :2], axis=0))
    for index in anchors[(apart_m > MAX_APART_M).any(axis=1)]:
        raise BadInput(f"devices, row {index + 2}: anchor {links.device_names[index]!r} is more "
                       f"than {MAX_APART_M / 1000:g} km from the middle of the receivers; both "
                       "need one frame, in metres")
    for index in anchors[scene.city.inside(links.device_m[anchors])]:
        x_m, y_m, z_m = links.device_m[index]
        raise BadInput(f"devices, row {index + 2}: anchor {links.device_names[index]!r} at "
                       f"({x_m:g}, {y_m:g}, {z_m:g}) m is inside a building of the scene; correct "
                       "its position, or the scene's frame")
    receiver_m, corners_m = links.receiver_m[:, :2], scene.city.vertices[:, :2]
    outside = (receiver_m < corners_m.min(axis=0)) | (receiver_m > corners_m.max(axis=0))
    for odd, where in ((scene.city.inside(links.receiver_m), "inside buildings"),
                       (outside.any(axis=1), "outside the 3D map")):
        if odd.any():
            warnings.warn(f"{odd.sum()} of {len(odd)} receiver positions lie {where}: do "
                          "measurements and scene share one frame and unit?", stacklevel=4)


def _check_limit(links: LinkData) -> None:
    """Warn where blanks should lie below a limit that no measured level comes near."""
    level_db, limit_db = links.level_db, links.limit_db
    blank = np.isnan(level_db)
    if limit_db is not None and blank.mean() > MAX_BLANK and not blank.all() \
            and np.nanmin(level_db) > limit_db + LIMIT_GAP_DB:
        warnings.warn(f"{blank.sum()} levels are blank and taken for levels below the scene's "
                      f"limit of detection, {limit_db:.0f} dB, but the weakest measured one is "
                      f"{np.nanmin(level_db):.0f} dB: check sensitivity_dbm and tx_power_dbm in "
                      "scene.toml", stacklevel=4)


def _level(links: LinkData) -> str:
    return "gain_db" if links.is_gain else "rssi_dbm"


def _provenance(links: LinkData, scene: Scene | None) -> dict[str, Any]:
    own = {} if scene is None else {"scene": scene.config.name, "scene_hash": scene.content_hash()}
    return own | {"links": len(links), "radiotwin_version": radiotwin.__version__}
