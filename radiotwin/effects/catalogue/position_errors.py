"""Ends of links that are not at their declared positions: an anchor, or a receiver.

No law of its own: the channel predicts again with the end elsewhere, lines of sight included.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.arrays import frequent_labels, subsample
from radiotwin.effects.base import GainEffect, LevelAt, ResidualView, Term
from radiotwin.effects.params import (
    Allowed,
    DeviceIndex,
    EffectParams,
    Estimate,
    Metres,
    Parameter,
    ReceiverIndex,
    Variation,
)
from radiotwin.effects.patterns import Pattern, members
from radiotwin.effects.places import Correction, Mark
from radiotwin.links import Links, site_of

MIN_LINKS = 60  # of an end that is moved about
MAX_ENDS = 60  # that are moved about, or it takes too long
MIN_NATS = 6.0  # that a move must gain to be proposed
MIN_MOVE_M = 5.0  # less is within what surveys, receivers and the walls of maps are off by
MAX_PROPOSE_LINKS = 600  # of an end, on which moves are tried
# Moves that are tried: of devices on circles, of receivers along axes.
RADII_M = (8.0, 15.0, 25.0, 40.0, 60.0, 85.0)
DIRECTIONS = 12
RECEIVER_MOVES_M = (5.0, 10.0, 20.0)
RECEIVER_AXES = ((1, 0, 0), (0, 1, 0), (0.7, 0.7, 0), (0.7, -0.7, 0), (0, 0, 1))
MAX_MOVE_M = 120.0  # east and north, of a device
TYPICAL_M = 10.0  # move of a device, for the slope of levels in its position
MAX_RECEIVER_MOVE_M = 60.0  # along each axis


class DevicePositionError(GainEffect):
    """A wrong position of an anchor and of all on its mast; one step finds one, the worst."""

    name = "device_position_error"
    settled_by = "fly past the device on two sides, close by, or survey it again"
    figure = "links"
    repeatable = True
    always_exact = True
    confused_with = ("removed_obstacle", "missing_obstacle", "antenna_pattern",
                     "device_gain_offset")

    class Params(EffectParams):
        """An anchor and its move."""

        device: DeviceIndex = Field(
            description="Index of the anchor, or of one of those on its mast.")
        move_m: tuple[Metres, Metres] = Field(
            description="True minus declared position, east and north [m].")
        exact: bool = Field(False, description="Whether paths are followed to the new position.")

    @override
    def unavailable(self, links: Links) -> str | None:
        devices = _movable_anchors(links)
        if not devices:
            return f"no anchor has {MIN_LINKS} links"
        if len(devices) > MAX_ENDS:
            return f"{len(devices)} devices are too many to move each about; at most {MAX_ENDS}"
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        links = view.links
        best: tuple[float, Any] = MIN_NATS, None
        moves = [(float(radius * np.sin(angle)), float(radius * np.cos(angle)))
                 for radius in RADII_M
                 for angle in np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS]
        known = {other for device in view.found_params(self.name, "device")
                 for other in site_of(links, device)}
        masts = {min(site_of(links, device)) for device in _movable_anchors(links)}
        for device in sorted(masts - known):
            every = np.flatnonzero(np.isin(links.device, site_of(links, device)))
            rows = subsample(every, MAX_PROPOSE_LINKS)
            mine, share = links.select(rows), len(every) / len(rows)
            before_db = view.level_at(mine)
            for move_m in moves:
                change_db = view.level_at(_with_moved(mine, device, move_m)) - before_db
                nats = share * view.gain_nats(rows, change_db).sum()
                if nats > best[0]:
                    best = nats, self.Params(device=device, move_m=move_m)
        return [best[1]] if best[1] else []

    @override
    def term(self, links: Links, params: Params, level_at: LevelAt) -> Term:
        offset_db = np.zeros(len(links))
        rows = np.flatnonzero(np.isin(links.device, site_of(links, params.device)))
        mine = links.select(rows)
        moved = _with_moved(mine, params.device, params.move_m)
        offset_db[rows] = level_at(moved, params.exact) - level_at(mine, params.exact)
        return Term.of_offset(offset_db)

    @override
    def exact(self, params: Params) -> Params:
        return params.model_copy(update={"exact": True})

    @override
    def implausible(self, params: Params, coefficients: np.ndarray) -> str | None:
        return _too_near(params.move_m)

    @override
    def variation(self, params: Params) -> Variation:
        return Variation(
            np.array(params.move_m), np.full(2, 6.0), np.full(2, -MAX_MOVE_M),
            np.full(2, MAX_MOVE_M),
            lambda move_m: params.model_copy(update={"move_m": tuple(move_m.tolist())}),
            follows_paths=params.exact)

    @override
    def correction(self, links: Links, params: Params) -> Correction:
        return Correction(moves_m=dict.fromkeys(site_of(links, params.device), params.move_m))

    @override
    def mark(self, links: Links, params: Params) -> Mark:
        given_m = links.device_m[params.device, :2]
        name, away_m = links.device_names[params.device], np.hypot(*params.move_m)
        return Mark(f"{name} is\n{away_m:.0f} m away", given_m + params.move_m, from_m=given_m)

    @override
    def typical_patterns(self, view: ResidualView) -> Iterator[Pattern]:
        for mine in members(view.links.device):
            device = int(view.links.device[mine][0])
            if device in view.links.anchors:
                move_db = partial(self._moved_north_db, view, device)
                yield Pattern("position", "m", "of one device", move_db(TYPICAL_M) / TYPICAL_M,
                              move_db, MIN_MOVE_M, MAX_MOVE_M)

    def _moved_north_db(self, view: ResidualView, device: int, by_m: float) -> np.ndarray:
        params = self.Params(device=device, move_m=(0.0, by_m))
        return self.term(view.links, params, view.level_at).offset_db

    @override
    def parameters(self, links: Links, params: Params,
                   estimate: Estimate) -> dict[str, Parameter]:
        declared_m = links.device_m[params.device, :2]
        return {f"{axis}_m[{links.device_names[device]}]": Parameter.normal(
                    old_m + move_m, sd, "m", Allowed(old_m - MAX_MOVE_M, old_m + MAX_MOVE_M))
                for device in site_of(links, params.device)
                for axis, old_m, move_m, sd in zip("xy", declared_m, params.move_m,
                                                   estimate.params_sd, strict=True)}


class ReceiverPositionError(GainEffect):
    """A constant error of all positions of a receiver; one step finds one receiver, the worst."""

    name = "receiver_position_error"
    parameter_labels = {"true_minus_given_x_m": "true − given position, east",
                        "true_minus_given_y_m": "true − given position, north",
                        "true_minus_given_z_m": "true − given height"}
    settled_by = "fly one track forth and back"
    figure = "links"
    of_receiver = True
    repeatable = True
    always_exact = True
    confused_with = ("receiver_gain_offset",)

    class Params(EffectParams):
        """A receiver and its move."""

        receiver: ReceiverIndex = Field(description="Index of the receiver.")
        move_m: tuple[Metres, Metres, Metres] = Field(
            description="True minus given position, east, north and up [m].")
        exact: bool = Field(False, description="Whether paths are followed to the new positions.")

    @override
    def unavailable(self, links: Links) -> str | None:
        receivers = frequent_labels(links.receiver, MIN_LINKS)
        if len(receivers) > MAX_ENDS:
            return f"{len(receivers)} receivers are too many to move each about; at most {MAX_ENDS}"
        return None if receivers else f"no receiver has {MIN_LINKS} links"

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        links = view.links
        best: tuple[float, Any] = MIN_NATS, None
        moves = [sign * size_m * np.array(axis) for axis in RECEIVER_AXES
                 for size_m in RECEIVER_MOVES_M for sign in (-1, 1)]
        known = set(view.found_params(self.name, "receiver"))
        for receiver in sorted(set(frequent_labels(links.receiver, MIN_LINKS)) - known):
            every = np.flatnonzero(links.receiver == receiver)
            rows = subsample(every, MAX_PROPOSE_LINKS)
            mine, share = links.select(rows), len(every) / len(rows)
            before_db = view.level_at(mine)
            for move_m in moves:
                moved = mine.with_receivers(mine.receiver_m + move_m)
                nats = share * view.gain_nats(rows, view.level_at(moved) - before_db).sum()
                if nats > best[0]:
                    best = nats, self.Params(receiver=receiver, move_m=tuple(move_m.tolist()))
        return [best[1]] if best[1] else []

    @override
    def term(self, links: Links, params: Params, level_at: LevelAt) -> Term:
        offset_db = np.zeros(len(links))
        rows = np.flatnonzero(links.receiver == params.receiver)
        mine = links.select(rows)
        moved = mine.with_receivers(mine.receiver_m + np.array(params.move_m))
        offset_db[rows] = level_at(moved, params.exact) - level_at(mine, params.exact)
        return Term.of_offset(offset_db)

    @override
    def exact(self, params: Params) -> Params:
        return params.model_copy(update={"exact": True})

    @override
    def implausible(self, params: Params, coefficients: np.ndarray) -> str | None:
        return _too_near(params.move_m)

    @override
    def variation(self, params: Params) -> Variation:
        return Variation(
            np.array(params.move_m), np.full(3, 3.0), np.full(3, -MAX_RECEIVER_MOVE_M),
            np.full(3, MAX_RECEIVER_MOVE_M),
            lambda move_m: params.model_copy(update={"move_m": tuple(move_m.tolist())}),
            follows_paths=params.exact)

    @override
    def parameters(self, links: Links, params: Params,
                   estimate: Estimate) -> dict[str, Parameter]:
        name = links.receiver_names[params.receiver]
        return {f"true_minus_given_{axis}_m[{name}]": Parameter.normal(
                    move_m, sd, "m", Allowed(-MAX_RECEIVER_MOVE_M, MAX_RECEIVER_MOVE_M))
                for axis, move_m, sd in zip("xyz", params.move_m, estimate.params_sd, strict=True)}


def _too_near(move_m: tuple[float, ...]) -> str | None:
    size_m = float(np.linalg.norm(move_m))
    if size_m < MIN_MOVE_M:
        return (f"it would be {size_m:.1f} m from its given position only; surveys and the walls "
                f"of maps are off by as much, and less than {MIN_MOVE_M:g} m is no effect")
    return None


def _movable_anchors(links: Links) -> list[int]:
    """Return anchors with enough links; other devices were located where these links fit best."""
    return [device for device in frequent_labels(links.device, MIN_LINKS)
            if device in links.anchors]


def _with_moved(links: Links, device: int, move_m: tuple[float, float]) -> Links:
    """Return the links with a device and all on its mast moved east and north."""
    device_m = links.device_m.copy()
    device_m[site_of(links, device), :2] += move_m
    return links.with_devices(device_m)
