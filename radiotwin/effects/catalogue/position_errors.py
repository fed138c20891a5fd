"""`device_position_error`, `device_moved`, `receiver_position_error`: wrong positions of ends.

The channel predicts the links again from the other position, including the line of sight.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, ClassVar

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.arrays import (
    MIN_LINKS,
    MIN_NATS,
    frequent_anchors,
    frequent_labels,
    subsample,
)
from radiotwin.effects.base import ResidualView
from radiotwin.effects.moves import MAX_ENDS, MAX_PROPOSE_LINKS, MovedEnd
from radiotwin.effects.params import (
    Allowed,
    DeviceIndex,
    EffectParams,
    Estimate,
    Metres,
    Parameter,
    ReceiverIndex,
    Unique,
    Variation,
)
from radiotwin.effects.patterns import Pattern, members
from radiotwin.effects.places import Correction, Mark
from radiotwin.links import Links, site_of

MIN_MOVE_M = 5.0  # smaller moves are within the accuracy of surveys and of the walls of maps
# Trial moves: of devices on circles, of receivers along axes.
RADII_M = (8.0, 15.0, 25.0, 40.0, 60.0, 85.0)
DIRECTIONS = 12
RECEIVER_MOVES_M = (5.0, 10.0, 20.0)
RECEIVER_AXES = ((1, 0, 0), (0, 1, 0), (0.7, 0.7, 0), (0.7, -0.7, 0), (0, 0, 1))
MAX_MOVE_M = 120.0  # largest move of a device, east and north
TYPICAL_M = 10.0  # typical move of a device, for the change of levels per metre
MAX_RECEIVER_MOVE_M = 60.0  # along each axis


class _PositionError(MovedEnd):
    """Base of constant position errors."""

    figure = "links"
    step_m: ClassVar[float]  # first step of the search along each axis
    max_move_m: ClassVar[float]  # its bound
    params: Any  # with `move_m`

    @override
    def implausible(self, coefficients: np.ndarray) -> str | None:
        """Return a sentence if the move is within the accuracy of surveys and maps; else None."""
        size_m = float(np.linalg.norm(self.params.move_m))
        if size_m < MIN_MOVE_M:
            return (f"it would be {size_m:.1f} m from its given position only; surveys and the "
                    f"walls of maps are off by as much, and less than {MIN_MOVE_M:g} m is no "
                    "effect")
        return None

    @override
    def variation(self) -> Variation:
        """Return the move along each axis [m] for the search."""
        axes, most_m = len(self.params.move_m), self.max_move_m
        return Variation(
            np.array(self.params.move_m), np.full(axes, self.step_m), np.full(axes, -most_m),
            np.full(axes, most_m), lambda move_m: self.changed(move_m=tuple(move_m.tolist())),
            follows_paths=self.is_exact)


class _MovedDevices(_PositionError):
    """Base of anchors at another position, east and north."""

    step_m, max_move_m = 6.0, MAX_MOVE_M

    def devices(self, links: Links) -> list[int]:
        """Return the devices that are moved."""
        return [self.params.device]

    @override
    def moved(self, links: Links) -> Links:
        device_m = links.device_m.copy()
        device_m[self.devices(links), :2] += self.params.move_m
        return links.with_devices(device_m)

    def positions(self, links: Links, estimate: Estimate, when: str = "") -> dict[str, Parameter]:
        """Report the corrected x and y of each moved device [m]; `when` follows its name."""
        return {f"{axis}_m[{links.device_names[device]}{when}]": Parameter.normal(
                    old_m + move_m, sd, "m", Allowed(old_m - MAX_MOVE_M, old_m + MAX_MOVE_M))
                for device in self.devices(links)
                for axis, old_m, move_m, sd in zip("xy", links.device_m[device], self.params.move_m,
                                                   estimate.params_sd)}


class DevicePositionError(_MovedDevices):
    """Wrong position of an anchor and all devices on its mast; each search step finds the worst."""

    name = "device_position_error"
    in_words = "a wrong position of the device"
    settled_by = "fly past the device on two sides, close by, or survey it again"
    acts_on = ("device", "device x receiver", "direction")
    confused_with = ("removed_obstacle", "missing_obstacle", "antenna_pattern",
                     "device_gain_offset", "device_moved")

    class Params(EffectParams):
        """An anchor and its move."""

        device: DeviceIndex = Field(
            description="Index of the anchor, or of one of those on its mast.")
        move_m: tuple[Metres, Metres] = Field(
            description="True minus declared position, east and north [m].")

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        """Return why no device can be moved (none of known position, or too many); else None."""
        devices = frequent_anchors(links, MIN_LINKS)
        if not devices:
            return f"no anchor has {MIN_LINKS} links"
        if len(devices) > MAX_ENDS:
            return f"{len(devices)} devices are too many to move each about; at most {MAX_ENDS}"
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose the position correction of a mast not yet found that raises the likelihood most.

        Devices of fewer than `MIN_LINKS` links are left out; empty if it gains under `MIN_NATS`.
        """
        links = view.links
        known = {other for device in view.found_params(self.name, "device")
                 for other in site_of(links, device)}
        masts = {min(site_of(links, device)) for device in frequent_anchors(links, MIN_LINKS)
                 if device in view.in_group(links.device)}
        return self.best_move(view, (
            [self.Params(device=device, move_m=move_m) for move_m in _moves_around_m()]
            for device in sorted(masts - known)))

    @override
    def devices(self, links: Links) -> list[int]:
        return site_of(links, self.params.device)

    @override
    def rows(self, links: Links) -> np.ndarray:
        return np.flatnonzero(np.isin(links.device, self.devices(links)))

    @override
    def correction(self, links: Links) -> Correction:
        return Correction(moves_m=dict.fromkeys(self.devices(links), self.params.move_m))

    @override
    def mark(self, links: Links) -> Mark:
        given_m = links.device_m[self.params.device, :2]
        name, away_m = links.device_names[self.params.device], np.hypot(*self.params.move_m)
        return Mark(f"{name} is\n{away_m:.0f} m away", given_m + self.params.move_m, from_m=given_m)

    @override
    def typical_patterns(self, view: ResidualView) -> Iterator[Pattern]:
        """Yield the level change per metre that a device is moved north, for several devices."""
        for mask in members(view.links.device):
            device = int(view.links.device[mask][0])
            if device in view.links.anchors:
                move_db = partial(self._moved_north_db, view, device)
                yield Pattern("position", "m", "of one device", move_db(TYPICAL_M) / TYPICAL_M,
                              move_db, MIN_MOVE_M, MAX_MOVE_M)

    def _moved_north_db(self, view: ResidualView, device: int, by_m: float) -> np.ndarray:
        """Compute the change of all levels (n,) if a device moves north [dB]."""
        north = self.with_params(self.Params(device=device, move_m=(0.0, by_m)))
        return north.term(view.links, view.level_at).offset_db

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report the corrected x and y of each device on the mast [m]."""
        return self.positions(links, estimate)


class DeviceMoved(_MovedDevices):
    """An anchor at another position from one flight on, or up to one flight."""

    name = "device_moved"
    in_words = "a device that was moved between flights"
    settled_by = "survey the device's position before and after each flight"
    of_groups = True
    acts_on = ("device", "device x flight", "device x receiver", "time")
    confused_with = ("device_position_error", "device_drift", "faulty_flight")

    class Params(EffectParams):
        """An anchor, its move, and when."""

        device: DeviceIndex = Field(description="Index of the anchor.")
        flights: Unique[str] = Field(description="Names of the flights on which it was elsewhere.")
        move_m: tuple[Metres, Metres] = Field(
            description="True minus declared position on these flights, east and north [m].")

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        if not frequent_anchors(links, MIN_LINKS):
            return f"no anchor has {MIN_LINKS} links"
        return None if len(np.unique(links.flight)) > 1 else "there is one flight"

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose which device moved, where to and on which flights, among links that stand out."""
        links = view.links
        if view.group is None:
            return []
        found = [self._best_move_in_time(view, device) for device in view.in_group(links.device)
                 if device in frequent_anchors(links, MIN_LINKS)]
        return [params for nats, params in sorted(found, key=lambda pair: -pair[0])
                if nats > MIN_NATS][:1]

    @override
    def propose_for_fold(self, view: ResidualView) -> list[Params]:
        return [self.params] if len(self.rows(view.links)) else []

    def _best_move_in_time(self, view: ResidualView, device: int) -> tuple[float, Params]:
        """Find the likeliest move on a device's first or last flights; its gain [nats] first."""
        links = view.links
        device_rows = np.flatnonzero(links.device == device)
        rows = subsample(device_rows, MAX_PROPOSE_LINKS)
        device_links = links.select(rows)
        flights = flights_by_time(device_links)
        flight_number = np.array([flights.index(flight) for flight in device_links.flight.tolist()])
        before_db = view.level_at(device_links)
        best: tuple[float, int, bool, tuple[float, float]] = (-np.inf, 0, False, (0.0, 0.0))
        for move_m in _moves_around_m():
            moved = self.with_params(self.Params(device=device, flights=[""], move_m=move_m))
            change_db = view.level_at(moved.moved(device_links)) - before_db
            nats = np.bincount(flight_number, weights=view.gain_nats(rows, change_db),
                               minlength=len(flights))
            up_to = np.cumsum(nats)
            for first in range(1, len(flights)):
                for total, is_before in ((up_to[-1] - up_to[first - 1], False),
                                         (up_to[first - 1], True)):
                    best = max(best, (float(total), first, is_before, move_m))
        total, first, is_before, move_m = best
        names = [str(links.flight_names[flight])
                 for flight in (flights[:first] if is_before else flights[first:])]
        return total * len(device_rows) / len(rows), self.Params(
            device=device, flights=names or [str(links.flight_names[flights[0]])], move_m=move_m)

    @override
    def rows(self, links: Links) -> np.ndarray:
        named = [number for number, name in enumerate(links.flight_names)
                 if str(name) in self.params.flights]
        return np.flatnonzero((links.device == self.params.device)
                              & np.isin(links.flight, named))

    @override
    def is_on_maps(self) -> bool:
        return False

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report x and y of the device on the flights when it was elsewhere [m]."""
        flights = self.params.flights
        when = flights[0] if len(flights) == 1 else f"{flights[0]} to {flights[-1]}"
        return self.positions(links, estimate, f", {when}")


class ReceiverPositionError(_PositionError):
    """Constant error of all positions of one receiver; each search step finds the worst one."""

    name = "receiver_position_error"
    in_words = "a wrong position of the receiver"
    parameter_labels = {"true_minus_given_x_m": "true − given position, east",
                        "true_minus_given_y_m": "true − given position, north",
                        "true_minus_given_z_m": "true − given height"}
    settled_by = "fly one track forth and back"
    of_receiver = True
    step_m, max_move_m = 3.0, MAX_RECEIVER_MOVE_M
    acts_on = ("receiver",)
    confused_with = ("receiver_gain_offset",)

    class Params(EffectParams):
        """A receiver and its move."""

        receiver: ReceiverIndex = Field(description="Index of the receiver.")
        move_m: tuple[Metres, Metres, Metres] = Field(
            description="True minus given position, east, north and up [m].")

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        receivers = frequent_labels(links.receiver, MIN_LINKS)
        if len(receivers) > MAX_ENDS:
            return f"{len(receivers)} receivers are too many to move each about; at most {MAX_ENDS}"
        return None if receivers else f"no receiver has {MIN_LINKS} links"

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose the receiver (not yet found) and shift that raise the likelihood most."""
        moves = [sign * size_m * np.array(axis) for axis in RECEIVER_AXES
                 for size_m in RECEIVER_MOVES_M for sign in (-1, 1)]
        known = set(view.found_params(self.name, "receiver"))
        receivers = sorted((set(frequent_labels(view.links.receiver, MIN_LINKS)) - known)
                           & set(view.in_group(view.links.receiver)))
        return self.best_move(view, (
            [self.Params(receiver=receiver, move_m=tuple(move_m.tolist())) for move_m in moves]
            for receiver in receivers))

    @override
    def moved(self, links: Links) -> Links:
        return links.with_receivers(links.receiver_m + np.array(self.params.move_m))

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report the receiver's true minus given x, y and z [m]."""
        name = links.receiver_names[self.params.receiver]
        units = {f"true_minus_given_{axis}_m[{name}]": "m" for axis in "xyz"}
        return self.variation().parameters(units, estimate.params_sd)


def _moves_around_m() -> list[tuple[float, float]]:
    """List the trial moves of a device, east and north [m]."""
    return [(float(radius_m * np.sin(angle)), float(radius_m * np.cos(angle)))
            for radius_m in RADII_M
            for angle in np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS]


def flights_by_time(links: Links) -> list[int]:
    """List the flights of links by their first time, or by their index if times are unknown."""
    flights = np.unique(links.flight)
    known = np.isfinite(links.time_s).all() and not links.time_restarts
    return sorted(flights.tolist(), key=lambda flight: float(
        links.time_s[links.flight == flight].min()) if known else flight)
