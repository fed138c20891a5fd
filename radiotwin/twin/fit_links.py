"""Fitting a twin to links: the channel from the anchors' links, then the unknown devices."""

from __future__ import annotations

import warnings
from functools import partial
from typing import Any

import numpy as np

import radiotwin
from radiotwin.errors import BadInput
from radiotwin.links import LinkGeometry, Links, link_geometry
from radiotwin.links.prepare import ASSUMED_HEIGHT_M
from radiotwin.propagation.laws import ChannelModel, check_fit_data, fit_once
from radiotwin.propagation.laws.base import MIN_DETECTED
from radiotwin.propagation.laws.published import PublishedLaw
from radiotwin.runtime.pieces import cached
from radiotwin.scene import Scene
from radiotwin.twin.localize import LawError, LocalizeSettings, TwinDevice, localize
from radiotwin.twin.model.model import FittedModel
from radiotwin.twin.twin import Twin, measured_heights

NO_ANCHOR = ("no anchor: the channel is learned from devices of known position, and there is "
             "none. Give positions of one or more to `radiotwin import --devices TABLE`, or in "
             "devices.csv (x_m, y_m, role anchor; in Python, Measurements(frame, devices)); or "
             "take a published law, such as tr36777_uma, which is not learned")
MAX_POWER_APART_DB = 3.0  # between declared and fitted powers; more hints at a loss


def fit_links(links: Links, scene: Scene, channel: type[ChannelModel], seed: int,
              start: Twin | None = None, settings: LocalizeSettings | None = None,
              locator: type[ChannelModel] | None = None) -> Twin:
    """Learn a channel from the anchors' links, then locate the unknown devices with it.

    Seed, `start` and errors are as of `fit_twin`. `locator` is the class of the channel model that
    locates, learnt from the anchors' links, too; None: `channel`.
    """
    anchors_m = _anchors_m(links)
    is_anchor = np.isfinite(anchors_m).all(axis=1)
    unknown = np.flatnonzero(~is_anchor)
    if locator is None or not len(unknown):
        locator = channel
    if issubclass(locator, PublishedLaw):
        fitted: ChannelModel = _published(links, anchors_m, scene, locator)
    else:
        fitted = _fit_channel(links, anchors_m, locator, seed)
    devices: list[Any] = [TwinDevice.anchor(name, *position_m) if anchor else None
                          for name, position_m, anchor in
                          zip(links.device_names, links.device_m, is_anchor, strict=True)]
    if len(unknown):
        law_error = None if isinstance(fitted, PublishedLaw) else LawError.learnt(
            fitted.trend, locator.uses_map, *_known_links(links, anchors_m)[:2])
        found = _locate(links, scene, fitted.trend, law_error, unknown, seed, start, settings)
        for index, each in zip(unknown, found, strict=True):
            devices[index] = each
    interpolates = channel.trend is not ChannelModel.trend
    if len(unknown) and (interpolates or locator is not channel):
        known_m = reliable_m(devices) if interpolates else anchors_m
        fitted = _fit_channel(links, known_m, channel, seed)
    if isinstance(fitted, PublishedLaw):
        for note in fitted.outside(_known_links(links, reliable_m(devices))[0]):
            warnings.warn(note, stacklevel=3)
    return make_twin(links, scene, fitted, devices)


def anchors_links(links: Links) -> tuple[LinkGeometry, np.ndarray, np.ndarray]:
    """Return geometry, levels (m,), detection limits (m,) of the anchors' links, for a channel.

    Declared powers, cables and antenna gains are subtracted from levels and limits [dB].
    """
    return _known_links(links, _anchors_m(links))


def _anchors_m(links: Links) -> np.ndarray:
    """Return the positions (k, 3) of the devices [m]; NaN for those that are no anchors."""
    is_anchor = np.isin(np.arange(len(links.device_m)), sorted(links.anchors))
    return np.where(is_anchor[:, None], links.device_m, np.nan)


def fit_known(links: Links, channel: type[ChannelModel], seed: int) -> Twin:
    """Learn a channel from links whose devices all have declared positions; no scene is needed.

    Raises:
        BadInput: links that no channel can be learnt from.
    """
    geometry, gain_db, limit_db = links.gains()
    check_fit_data(geometry, gain_db, needs_los=channel.uses_map and links.city is not None)
    fitted = fit_once(channel, geometry, gain_db, limit_db, seed)
    devices = [TwinDevice.anchor(name, *position_m)
               for name, position_m in zip(links.device_names, links.device_m, strict=True)]
    return make_twin(links, None, fitted, devices)


def reliable_m(devices: list[TwinDevice], max_radius_m: float = np.inf) -> np.ndarray:
    """Return positions (k, 3) [m] of devices located within a 90 % radius [m], or NaN."""
    located = np.array([each.located and each.credible_radius_m <= max_radius_m
                        for each in devices])
    return np.where(located[:, None], [each.position_m for each in devices], np.nan)


def _fit_channel(links: Links, device_m: np.ndarray, channel: type[ChannelModel],
                 seed: int) -> ChannelModel:
    """Fit a channel model to the links of all devices with a position in `device_m` (k, 3) [m]."""
    if not links.anchors:
        raise BadInput(NO_ANCHOR)
    geometry, level_db, limit_db = _known_links(links, device_m)
    if not len(geometry):
        raise BadInput("no link to an anchor: none of the devices with role anchor was measured; "
                       "fly nearer to them")
    check_fit_data(geometry, level_db, needs_los=channel.uses_map)
    return fit_once(channel, geometry, level_db, limit_db, seed)


def _known_links(links: Links, device_m: np.ndarray
                 ) -> tuple[LinkGeometry, np.ndarray, np.ndarray]:
    """Return the links of devices with a position (k, 3) [m], isotropic levels and limits."""
    known = np.isfinite(device_m[:, :2]).all(axis=1)[links.device]
    receiver_m, device = links.receiver_m[known], links.device[known]
    geometry = link_geometry(device_m, receiver_m, device, links.city, links.frequency_hz)
    declared_db = links.declared.added_db(device, receiver_m - device_m[device])
    return geometry, links.level_db[known] - declared_db, links.limit_db[known] - declared_db


def _published(links: Links, device_m: np.ndarray, scene: Scene,
               law: type[PublishedLaw]) -> PublishedLaw:
    """Return a published law for the links' frequency and map, without fitting it to levels.

    If levels are received powers and no transmit power is declared, `power_dbm` is the median over
    detected links of anchors, or else the scene's; a warning says which.
    """
    geometry, level_db, limit_db = _known_links(links, device_m)
    fitted = law().fit(geometry, level_db, limit_db)
    if links.is_gain:
        return fitted
    surplus_db = level_db - fitted.predict(geometry)[0]
    if links.has_gains:
        apart_db = float(np.nanmedian(surplus_db)) if np.isfinite(surplus_db).any() else 0.0
        if abs(apart_db) > MAX_POWER_APART_DB:
            warnings.warn(f"with the declared powers, levels of the anchors' links are "
                          f"{apart_db:+.1f} dB from what {law.name} predicts (median): is there a "
                          "loss, or a gain of an antenna, that is not declared?", stacklevel=4)
        return fitted
    if np.isfinite(surplus_db).sum() >= MIN_DETECTED:
        fitted.power_dbm, how = float(np.nanmedian(surplus_db)), "fitted to the anchors' links"
    else:
        fitted.power_dbm, how = scene.config.radio.tx_power_dbm, "the scene's tx_power_dbm"
    warnings.warn(f"levels are received powers, and {law.name} predicts gains: the transmit power "
                  f"is taken for {fitted.power_dbm:.1f} dBm ({how})", stacklevel=4)
    return fitted


def _locate(links: Links, scene: Scene, channel: ChannelModel, law_error: LawError | None,
            unknown: np.ndarray, seed: int, start: Twin | None,
            settings: LocalizeSettings | None) -> list[TwinDevice]:
    """Locate the devices `unknown` (k,) by a fitted channel, or load an earlier result."""
    start_m = None
    if start is not None:
        earlier = {device.device: (device.x_m, device.y_m) for device in start.devices}
        start_m = np.array([earlier.get(links.device_names[i], (np.nan, np.nan)) for i in unknown])
    # A position may be heard by several receivers: below the highest of their limits is all that
    # blanks of each surely are.
    known = np.isfinite(links.limit_db)
    limit_db = float(links.limit_db[known].max()) if known.any() else None
    rows = np.isin(links.device, unknown) & (known | np.isfinite(links.level_db))
    measured = links.receiver_m[rows], links.device[rows], links.level_db[rows], channel
    declared = {} if links.declared.adds_nothing else {"declared": links.declared}
    options: dict[str, Any] = {
        "devices": {int(index): links.device_names[index] for index in unknown},
        "bounds": scene.config.extent.bounds, "city": links.city,
        "z_m": np.nan_to_num(links.device_m[unknown, 2], nan=ASSUMED_HEIGHT_M),
        "limit_db": limit_db, "seed": seed, "law_error": law_error,
        "start_m": start_m, "settings": settings, **declared}
    return cached("positions", (*measured, options), partial(localize, *measured, **options),
                  lambda found: ({}, [each.record for each in found]),
                  lambda _, content: [TwinDevice.from_record(each) for each in content])


def make_twin(links: Links, scene: Scene | None, channel: ChannelModel,
              devices: list[TwinDevice]) -> Twin:
    """Make a twin of a fitted channel; its provenance says of which links, scene and version."""
    provenance: dict[str, Any] = {}
    if scene is not None:
        provenance = {"scene": scene.config.name, "scene_hash": scene.content_hash()}
        if scene.config.origin is not None:
            provenance["origin"] = scene.config.origin.model_dump()
    provenance |= {"links": len(links), "radiotwin_version": radiotwin.__version__}
    provenance |= measured_heights(links)
    level = "gain_db" if links.is_gain else "rssi_dbm"
    return Twin(FittedModel.of_channel(channel), devices, level, links.usual_limit_db, provenance,
                links.declared)
