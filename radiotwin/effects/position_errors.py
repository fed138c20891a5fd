"""Ends of links that are not where they are declared to be: an anchor, or a receiver.

No law of its own: the base model is asked again with the end elsewhere, lines of sight included.
"""

from typing import Any

import numpy as np

from radiotwin.effects.base import Effect, Parameter, Term, Variation, View, measured, some

LEAST_LINKS = 60
LEAST_NATS = 6.0
RADII_M = (8.0, 15.0, 25.0, 40.0, 60.0, 85.0)
DIRECTIONS = 12
FARTHEST_M = 120.0
MOST_DEVICES = 60
RECEIVER_OFFSETS_M = (5.0, 10.0, 20.0)
ENOUGH_LINKS = 600  # of a device, for a first look
SAME_SITE_M = 1.0  # devices this close together are on one mast, and move together


class DevicePositionError(Effect):
    """An anchor stands elsewhere, and all that share its mast; one step finds one, the worst."""

    name = "device_position_error"
    repeatable = True
    quickly_exact = True
    confused_with = ("removed_obstacle", "missing_obstacle", "antenna_pattern", "device_gain_offset")

    def lacks(self, records) -> str | None:
        devices = _anchors(records)
        if not devices:
            return f"no anchor has {LEAST_LINKS} links"
        if len(devices) > MOST_DEVICES:
            return f"{len(devices)} devices are too many to move each about; at most {MOST_DEVICES}"
        return None

    def propose(self, view: View) -> list[dict]:
        records = view.records
        best: tuple[float, Any] = LEAST_NATS, None
        moves = [(radius * np.sin(angle), radius * np.cos(angle)) for radius in RADII_M
                 for angle in np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS]
        known = {other for device in view.done(self.name, "device") for other in site_of(records, device)}
        for device in sorted({min(site_of(records, device)) for device in _anchors(records)} - known):
            every = np.flatnonzero(np.isin(records.device, site_of(records, device)))
            rows = some(every, ENOUGH_LINKS)
            mine, share = records.select(rows), len(every) / len(rows)
            before_db = view.at(mine)
            for east, north in moves:
                moved_db = view.at(_with_moved(mine, device, (east, north))) - before_db
                nats = share * view.nats(rows, moved_db).sum()
                if nats > best[0]:
                    best = nats, {"device": device, "move_m": [float(east), float(north)]}
        return [best[1]] if best[1] else []

    def term(self, records, setting, at) -> Term:
        offset_db = np.zeros(len(records))
        rows = np.flatnonzero(np.isin(records.device, site_of(records, setting["device"])))
        mine = records.select(rows)
        exact = setting.get("exact", False)
        offset_db[rows] = at(_with_moved(mine, setting["device"], setting["move_m"]), exact) - at(mine, exact)
        return Term.of_offset(offset_db)

    def exact(self, setting) -> dict:
        return setting | {"exact": True}

    def vary(self, setting) -> Variation:
        return Variation(np.array(setting["move_m"]), np.full(2, 6.0), np.full(2, -FARTHEST_M), np.full(2, FARTHEST_M),
                         lambda numbers: {"device": setting["device"], "move_m": [float(v) for v in numbers]})

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        declared_m = records.device_m[setting["device"], :2]
        return {f"{axis}_m[{records.device_names[device]}]": Parameter.normal(declared + move, spread, "m")
                for device in site_of(records, setting["device"]) for axis, declared, move, spread in
                zip("xy", declared_m, setting["move_m"], found.setting_deviations)}


class ReceiverPositionError(Effect):
    """All positions of a receiver are off by a constant; one step finds one receiver, the worst."""

    name = "receiver_position_error"
    of_receiver = True
    repeatable = True
    confused_with = ("receiver_gain_offset",)

    def lacks(self, records) -> str | None:
        receivers = measured(records.receiver, LEAST_LINKS)
        if len(receivers) > MOST_DEVICES:
            return f"{len(receivers)} receivers are too many to move each about; at most {MOST_DEVICES}"
        return None if receivers else f"no receiver has {LEAST_LINKS} links"

    def propose(self, view: View) -> list[dict]:
        records = view.records
        best: tuple[float, Any] = LEAST_NATS, None
        axes = [(1, 0, 0), (0, 1, 0), (0.7, 0.7, 0), (0.7, -0.7, 0), (0, 0, 1)]
        moves = [sign * size * np.array(axis) for axis in axes for size in RECEIVER_OFFSETS_M for sign in (-1, 1)]
        for receiver in sorted(set(measured(records.receiver, LEAST_LINKS)) - set(view.done(self.name, "receiver"))):
            rows = some(np.flatnonzero(records.receiver == receiver), ENOUGH_LINKS)
            mine, share = records.select(rows), (records.receiver == receiver).sum() / len(rows)
            before_db = view.at(mine)
            for move in moves:
                moved_db = view.at(mine.with_receivers(mine.receiver_m + move)) - before_db
                nats = share * view.nats(rows, moved_db).sum()
                if nats > best[0]:
                    best = nats, {"receiver": receiver, "move_m": [float(v) for v in move]}
        return [best[1]] if best[1] else []

    def term(self, records, setting, at) -> Term:
        offset_db = np.zeros(len(records))
        rows = np.flatnonzero(records.receiver == setting["receiver"])
        mine = records.select(rows)
        offset_db[rows] = at(mine.with_receivers(mine.receiver_m + np.array(setting["move_m"]))) - at(mine)
        return Term.of_offset(offset_db)

    def vary(self, setting) -> Variation:
        return Variation(np.array(setting["move_m"]), np.full(3, 3.0), np.full(3, -60.0), np.full(3, 60.0),
                         lambda numbers: setting | {"move_m": [float(v) for v in numbers]})

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        name = records.receiver_names[setting["receiver"]]
        return {f"true_minus_given_{axis}_m[{name}]": Parameter.normal(move, spread, "m")
                for axis, move, spread in zip("xyz", setting["move_m"], found.setting_deviations)}


def _anchors(records) -> list[int]:
    """Devices with enough links; those that were located from these very measurements stand where they fit best."""
    return [device for device in measured(records.device, LEAST_LINKS) if device in records.anchors]


def site_of(records, device: int) -> list[int]:
    """The device, and the anchors that share its mast."""
    apart_m = np.linalg.norm(records.device_m - records.device_m[device], axis=1)
    return [int(other) for other in np.flatnonzero(apart_m <= SAME_SITE_M)
            if other == device or other in records.anchors]


def _with_moved(records, device: int, move_m):
    device_m = records.device_m.copy()
    device_m[site_of(records, device), :2] += move_m
    return records.with_devices(device_m)
