"""Levels and positions written down by two clocks that differ: each level belongs to where the receiver was a little
earlier or later than its row says.

A receiver that moves at v is d = v t away from where it is said to be if its clocks differ by t, along its way, and so
in another direction whenever it turns. The base model is asked again with the receiver there, lines of sight included.
"""

from typing import Any

import numpy as np

from radiotwin.effects.base import Effect, Parameter, Term, Variation, View, measured, some

LEAST_LINKS = 60
LEAST_NATS = 6.0
ALONG_M = (4.0, 8.0, 15.0, 25.0, 40.0, 60.0, 85.0)  # how far a receiver flies between the two times
FARTHEST_M = 120.0
STEP_M = 3.0
LEAST_SPEED_M_S = 0.3  # below it positions that jitter look like a way
ENOUGH_LINKS = 600  # of a receiver, for a first look
MOST_RECEIVERS = 60


class ReceiverClockOffset(Effect):
    """All positions of a receiver are those of another time; one step finds one receiver, the worst."""

    name = "receiver_clock_offset"
    of_receiver = True
    repeatable = True
    confused_with = ("receiver_position_error", "body_shadowing")

    def lacks(self, records) -> str | None:
        if np.isfinite(records.time_s).sum() < LEAST_LINKS:
            return "there is no time_s"
        moving = _moving(records)
        if len(moving) > MOST_RECEIVERS:
            return f"{len(moving)} receivers are too many to shift each in time; at most {MOST_RECEIVERS}"
        return None if moving else f"no receiver with {LEAST_LINKS} links moves"

    def propose(self, view: View) -> list[dict]:
        records = view.records
        best: tuple[float, Any] = LEAST_NATS, None
        known = view.done(self.name, "receiver")
        for receiver, speed_m_s in sorted(_moving(records).items()):
            if receiver in known:
                continue
            every = np.flatnonzero(records.receiver == receiver)
            rows = some(every, ENOUGH_LINKS)
            mine, share = records.select(rows), len(every) / len(rows)
            before_db = view.at(mine)
            for along_m in (sign * size for size in ALONG_M for sign in (-1, 1)):
                setting = {"receiver": receiver, "offset_s": along_m / speed_m_s, "speed_m_s": speed_m_s}
                moved_db = view.at(_at_other_time(mine, receiver, along_m / speed_m_s)) - before_db
                nats = share * view.nats(rows, moved_db).sum()
                if nats > best[0]:
                    best = nats, setting
        return [best[1]] if best[1] else []

    def term(self, records, setting, at) -> Term:
        offset_db = np.zeros(len(records))
        rows = np.flatnonzero(records.receiver == setting["receiver"])
        mine, exact = records.select(rows), setting.get("exact", False)
        moved = _at_other_time(mine, setting["receiver"], setting["offset_s"])
        offset_db[rows] = at(moved, exact) - at(mine, exact)
        return Term.of_offset(offset_db)

    def exact(self, setting) -> dict:
        return setting | {"exact": True}

    def vary(self, setting) -> Variation:
        farthest_s, step_s = FARTHEST_M / setting["speed_m_s"], STEP_M / setting["speed_m_s"]
        return Variation(np.array([setting["offset_s"]]), np.array([step_s]), np.array([-farthest_s]),
                         np.array([farthest_s]), lambda numbers: setting | {"offset_s": float(numbers[0])})

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        name = records.receiver_names[setting["receiver"]]
        return {f"positions_late_by_s[{name}]": Parameter.normal(setting["offset_s"], found.setting_deviations[0],
                                                                 "s")}


def _moving(records) -> dict[int, float]:
    """Receivers with enough links that move, and how fast they are while they do [m/s]."""
    moving = {}
    for receiver in measured(records.receiver[np.isfinite(records.time_s)], LEAST_LINKS):
        way_m = duration_s = 0.0
        for (mine, _), (time_s, place_m) in records.tracks.items():
            if mine == receiver:
                step_m, step_s = np.linalg.norm(np.diff(place_m, axis=0), axis=1), np.diff(time_s)
                way_m, duration_s = way_m + step_m.sum(), duration_s + step_s[step_m > 0].sum()
        if duration_s > 0 and way_m / duration_s >= LEAST_SPEED_M_S:
            moving[receiver] = float(way_m / duration_s)
    return moving


def _at_other_time(records, receiver: int, offset_s: float):
    """The links, all of one receiver, where its tracks have it `offset_s` later; links without a time stay."""
    receiver_m = records.receiver_m.copy()
    timed = np.flatnonzero(np.isfinite(records.time_s))
    order = timed[np.argsort(records.flight[timed], kind="stable")]
    flights, first = np.unique(records.flight[order], return_index=True)
    for flight, rows in zip(flights.tolist(), np.split(order, first[1:])):
        time_s, place_m = records.tracks[receiver, flight]
        for axis in range(3):
            receiver_m[rows, axis] = np.interp(records.time_s[rows] + offset_s, time_s, place_m[:, axis])
    return records.with_receivers(receiver_m)
