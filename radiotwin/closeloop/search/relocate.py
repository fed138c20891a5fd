"""Unknown devices where a corrected model puts them.

The base has located them without the effects, so each position has taken up part of what an effect
explains, and the effect was found with that part missing.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from radiotwin.closeloop.crossfit import Base, CrossFit, RaytraceBase
from radiotwin.closeloop.verdict.criteria import MAX_LOSS_NATS
from radiotwin.effects.arrays import subsample
from radiotwin.links import Links
from radiotwin.propagation.laws.image_paths import ImagePaths
from radiotwin.twin.fit_links import reliable_m
from radiotwin.twin.localize import position_log_likelihood
from radiotwin.twin.localize.estimate import TwinDevice
from radiotwin.twin.model.model import Fit, FittedModel, Model

RADII_M = (2.0, 5.0, 10.0, 20.0, 40.0, 80.0)  # of circles around a position, that are tried
DIRECTIONS = 12
ROUNDS = 3  # of moves
MAX_LINKS = 300  # of a device
MIN_LINKS = 10
MIN_MOVE_M = 2.0  # along paths, which put a device to about a metre


def relocate_devices(model: CrossFit, links: Links, base: Base
                     ) -> CrossFit:
    """Return the model with unknown devices moved to where its effects make their links likeliest.

    Each fold moves them by its own training links, then its levels are fitted again. Where paths
    are followed, devices are located anew over the map that the effects have changed.

    Args:
        model: base and effects.
        links: n links as the base was given them.
        base: that the model began with; it must not remember earlier positions.

    Returns:
        the moved one where that makes held-out links likelier, else the same. The same, too, where
        all devices are known, or where paths are followed and the map is as it was or moves no
        device.
    """
    unknown = [device for device in range(len(links.device_names)) if device not in links.anchors]
    if not unknown or not any(each.is_cause for each in model.whole.effects):
        return model
    twin = model.twin
    if not model.whole.channel.follows_paths:
        moved = [_relocated(each, unknown) for each in model.each]
        twin = replace(twin, devices=_with_positions(twin.devices, moved[0].links.device_m))
    elif model.whole.model.corrected_map is not links.city:
        located = [_located_anew(model.whole, links, np.ones(len(links), bool), base, unknown)]
        moves = _moved(model.whole, located[0][0])
        if not len(moves):
            return model  # which takes folds minutes, too
        located += [_located_anew(each, links, model.index != number, base, moves)
                    for number, each in enumerate(model.folds)]
        moved = [each for each, _ in located]
        twin = replace(twin, devices=located[0][1])
    else:
        return model
    whole, *folds = (each.fit() for each in moved)
    found = replace(model.extended(whole, folds), twin=twin)
    return found if is_better(model.held_out_nll, found.held_out_nll) else model


def _moved(before: Fit, after: Model) -> list[int]:
    """Return the devices with links that move noticeably, are found or are lost."""
    apart_m = np.linalg.norm(after.links.device_m - before.links.device_m, axis=1)
    moved = apart_m[before.links.device] > MIN_MOVE_M
    changed = (before.usable != after.usable) | (before.usable & moved)
    return np.unique(before.links.device[changed]).tolist()


def is_better(before_nll: np.ndarray, after_nll: np.ndarray) -> bool:
    """Return whether devices are to be left where they were moved to.

    A device that was lost and is found makes links predictable, which counts for more than the
    chances by which those of the others change.

    Args:
        before_nll: (n,) of held-out links; NaN where they could not be predicted [nats].
        after_nll: (n,) the same with devices moved.
    """
    gain = before_nll - after_nll
    found_more = np.isfinite(after_nll).sum() > np.isfinite(before_nll).sum()
    least = -MAX_LOSS_NATS * np.isfinite(gain).sum() if found_more else 0.0
    return bool(np.nansum(gain) > least)


def _with_positions(devices: list[TwinDevice], device_m: np.ndarray) -> list[TwinDevice]:
    """Return located devices of unknown position where they are now (k, 3) [m]."""
    return [replace(each, x_m=float(x_m), y_m=float(y_m))
            if each.role == "unknown" and each.located else each
            for each, (x_m, y_m, _) in zip(devices, device_m, strict=True)]


def _located_anew(fit: Fit, links: Links, mine: np.ndarray, base: Base,
                  wanted: list[int]) -> tuple[Model, list[TwinDevice]]:
    """Return one model with devices where its base, over the corrected map, has them.

    Args:
        fit: one model.
        links: n links as the base was given them.
        mine: (n,) bool, those that the model learns from.
        base: follows paths.
        wanted: devices to be located; others stay where the model has them, if it does.
    """
    model = fit.model
    stay = np.setdiff1d(model.links.device[model.usable], wanted).tolist()
    device_m = links.device_m.copy()
    device_m[stay] = model.links.device_m[stay]
    asked = links.with_city(model.corrected_map).with_devices(device_m)
    asked = asked.with_ends(anchors=links.anchors | frozenset(stay)).select(mine)
    assert isinstance(base, RaytraceBase) and isinstance(model.channel, ImagePaths)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the base has warned already
        devices = base.locate(asked, model.channel)
    moved = Model.build(model.links, model.channel, model.dof,
                        device_m=reliable_m(devices, base.max_radius_m), train=mine)
    return moved.with_effects(model.effects), devices


def _relocated(fit: Fit, unknown: list[int]) -> Model:
    """Return one model with its devices moved, by its training links."""
    learnt, model = fit.learnt, fit.model
    device_m = model.links.device_m.copy()
    for device in unknown:
        rows = np.flatnonzero(model.train & (model.links.device == device))
        if len(rows) >= MIN_LINKS:
            own = model.links.select(subsample(rows, MAX_LINKS))
            device_m[device, :2] = _likeliest(learnt, own, device_m[device, :2])
    # Where the base could not locate a device, its links are not looked at here, either.
    nowhere = np.setdiff1d(model.links.device, model.links.device[model.usable])
    placed_m = device_m.copy()
    placed_m[nowhere] = np.nan
    moved = Model.build(model.links, model.channel, model.dof, device_m=placed_m,
                            train=model.train)
    return moved.with_effects(model.effects)


def _likeliest(model: FittedModel, own: Links, start_m: np.ndarray) -> np.ndarray:
    """Return the likeliest position (2,) of a device on circles around the best so far [m]."""
    angles = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    circle = np.column_stack([np.sin(angles), np.cos(angles)])
    circles_m = np.vstack([np.zeros(2), *(radius_m * circle for radius_m in RADII_M)])
    best_m = start_m
    for _ in range(ROUNDS):
        tried_m = best_m + circles_m
        best_m = tried_m[position_log_likelihood(model, own, tried_m).argmax()]
    return best_m
