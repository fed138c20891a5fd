"""Fitting a twin that follows paths over the 3D map."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from radiotwin.channel import ChannelModel
from radiotwin.channel.image_paths import ImagePaths
from radiotwin.channel.segmented_log_distance import SegmentedLogDistance
from radiotwin.effects.effect_model import EffectModel
from radiotwin.effects.fold_model import FoldModel
from radiotwin.execution import Executor
from radiotwin.links import LinkData
from radiotwin.localize import (
    Relocation,
)
from radiotwin.localize.along_paths import MAX_DEVICES
from radiotwin.scene import Scene
from radiotwin.twin.fit_links import fit_links, provenance, reliable_m
from radiotwin.twin.twin import Twin

DOFS = (3.0, 5.0, 10.0, 30.0)  # of the errors, that are tried
MIN_HEARD = 30  # links of a class of line of sight, to learn its level from
MIN_LOSS_NATS = 0.02  # a link, to be worse than the law, which has more numbers to be fitted
LOST_M = 40.0  # radius from which on a device's position says nothing about the channel
SURE_M = 15.0  # radius of a device of an earlier twin that is not searched for everywhere again


def fit_along_paths(links: LinkData, scene: Scene, seed: int, start: Twin | None,
                    executor: Executor | None = None) -> Twin:
    """Return a twin that follows paths, with what they do not tell learnt.

    That is a level for each class of line of sight, the diffuse power, and the errors' sizes. Warns
    where paths explain the levels worse than the law does.
    """
    law = fit_links(links, scene, SegmentedLogDistance, seed)
    twin = fit_paths(links, scene, law, relocation_from(scene, np.inf, start, executor))
    device_m, law_m = reliable_m(twin.devices, LOST_M), reliable_m(law.devices, LOST_M)
    dof = best_dof(links, twin.channel, device_m)
    by_paths = FoldModel.build(links, twin.channel, dof, device_m=device_m)
    by_law = FoldModel.build(links, law.channel, dof, device_m=law_m)
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
    return replace(twin, fitted=EffectModel.of(by_paths, fit))


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
    return Twin(channel, devices, law.level, links.usual_limit_db, provenance(links, scene))


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


def _image_paths(links: LinkData, law: Twin, device_m: np.ndarray) -> ImagePaths:
    """Return the channel, its diffuse power fitted to links of devices that have a position."""
    channel = ImagePaths(law.channel)
    located = links.located(device_m)
    return channel.fit_diffuse(located.geometry, located.level_db, located.limit_db)
