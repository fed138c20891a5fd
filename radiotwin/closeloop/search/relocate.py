"""Locate unknown devices again with the effects that were found.

The base located them without the effects, so their positions compensated part of what the effects
explain.
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

RADII_M = (2.0, 5.0, 10.0, 20.0, 40.0, 80.0)  # circles of trial positions around the best one [m]
DIRECTIONS = 12  # trial positions on each circle
ROUNDS = 3  # searches around the best position
MAX_LINKS = 300  # links used of each device
MIN_LINKS = 10  # a device with fewer links is not moved
MIN_MOVE_M = 2.0  # smaller moves are not fitted in folds; paths locate to about 1 m [m]


def relocate_devices(model: CrossFit, links: Links, base: Base) -> CrossFit:
    """Move unknown devices to their likeliest positions given the effects, and refit the levels.

    Each fold uses its own training links. If the base follows paths, devices are located anew over
    the map as corrected by the effects.

    Args:
        model: base and effects.
        links: the n links to which the base was fitted.
        base: the base of the model, without cached positions.

    Returns:
        the model with moved devices, if held-out links become likelier; else the model as it was.
    """
    unknown = [device for device in range(len(links.device_names)) if device not in links.anchors]
    if not unknown or not any(each.is_cause for each in model.whole.effects):
        return model
    twin = model.twin
    if not model.whole.channel.follows_paths:
        moved = [_relocated(each, unknown) for each in model.fits]
        twin = replace(twin, devices=_with_positions(twin.devices, moved[0].links.device_m))
    elif model.whole.model.corrected_map is not links.city:
        located = [_located_anew(model.whole, links, np.ones(len(links), bool), base, unknown)]
        moves = _moved_devices(model.whole, located[0][0])
        if not moves:
            return model  # saves minutes in the folds
        located += [_located_anew(each, links, model.index != number, base, moves)
                    for number, each in enumerate(model.folds)]
        moved = [each for each, _ in located]
        twin = replace(twin, devices=located[0][1])
    else:
        return model
    whole, *folds = (each.fit() for each in moved)
    found = replace(model.with_fits(whole, folds), twin=twin)
    return found if moves_help(model.held_out_nll, found.held_out_nll) else model


def _moved_devices(before: Fit, after: Model) -> list[int]:
    """Return the devices that moved by over `MIN_MOVE_M`, or are located in only one model."""
    apart_m = np.linalg.norm(after.links.device_m - before.links.device_m, axis=1)
    moved = apart_m[before.links.device] > MIN_MOVE_M
    changed = (before.usable != after.usable) | (before.usable & moved)
    return np.unique(before.links.device[changed]).tolist()


def moves_help(before_nll: np.ndarray, after_nll: np.ndarray) -> bool:
    """Return whether moved devices make the held-out links likelier, in sum.

    If more links can be predicted than before, a loss of `MAX_LOSS_NATS` a link is accepted.

    Args:
        before_nll: (n,) held-out negative log-likelihood [nats]; NaN without a prediction.
        after_nll: (n,) the same with devices moved.
    """
    gain = before_nll - after_nll
    found_more = np.isfinite(after_nll).sum() > np.isfinite(before_nll).sum()
    least = -MAX_LOSS_NATS * np.isfinite(gain).sum() if found_more else 0.0
    return bool(np.nansum(gain) > least)


def _with_positions(devices: list[TwinDevice], device_m: np.ndarray) -> list[TwinDevice]:
    """Set the positions of located unknown devices to `device_m` (k, 3) [m]."""
    return [replace(each, x_m=float(x_m), y_m=float(y_m))
            if each.role == "unknown" and each.located else each
            for each, (x_m, y_m, _) in zip(devices, device_m, strict=True)]


def _located_anew(fit: Fit, links: Links, train: np.ndarray, base: Base,
                  devices: list[int]) -> tuple[Model, list[TwinDevice]]:
    """Locate devices by paths over the corrected map, from the training links of one fit.

    Other devices keep the fit's position. The returned model is not fitted yet.
    """
    model = fit.model
    fixed = np.setdiff1d(model.links.device[model.usable], devices).tolist()
    device_m = links.device_m.copy()
    device_m[fixed] = model.links.device_m[fixed]
    corrected = links.with_city(model.corrected_map).with_devices(device_m)
    corrected = corrected.with_ends(anchors=links.anchors | frozenset(fixed)).select(train)
    assert isinstance(base, RaytraceBase) and isinstance(model.channel, ImagePaths)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the base has warned already
        located = base.locate(corrected, model.channel)
    moved = Model.build(model.links, model.channel, model.dof,
                        device_m=reliable_m(located, base.max_radius_m), train=train)
    return moved.with_effects(model.effects), located


def _relocated(fit: Fit, unknown: list[int]) -> Model:
    """Move unknown devices to the positions that a fit's training links make likeliest.

    Devices with fewer than `MIN_LINKS` links stay. The returned model is not fitted yet.
    """
    learnt, model = fit.learnt, fit.model
    device_m = model.links.device_m.copy()
    for device in unknown:
        rows = np.flatnonzero(model.train & (model.links.device == device))
        if len(rows) >= MIN_LINKS:
            device_links = model.links.select(subsample(rows, MAX_LINKS))
            device_m[device, :2] = _likeliest_position(learnt, device_links, device_m[device, :2])
    # Devices that the base could not locate stay without a position.
    device_m[np.setdiff1d(model.links.device, model.links.device[model.usable])] = np.nan
    moved = Model.build(model.links, model.channel, model.dof, device_m=device_m,
                        train=model.train)
    return moved.with_effects(model.effects)


def _likeliest_position(model: FittedModel, device_links: Links,
                        start_m: np.ndarray) -> np.ndarray:
    """Search the likeliest position (2,) of a device on circles around a start (2,) [m]."""
    angles = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    circle = np.column_stack([np.sin(angles), np.cos(angles)])
    circles_m = np.vstack([np.zeros(2), *(radius_m * circle for radius_m in RADII_M)])
    best_m = start_m
    for _ in range(ROUNDS):
        tried_m = best_m + circles_m
        best_m = tried_m[position_log_likelihood(model, device_links, tried_m).argmax()]
    return best_m
