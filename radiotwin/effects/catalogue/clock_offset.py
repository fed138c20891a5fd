"""Levels and positions recorded by two clocks that differ.

Each level belongs to the position of the receiver a little earlier or later than its row says. A
receiver that moves at v is then d = v t away from its given position along its track, and so in
another direction whenever it turns. The channel predicts again with the receiver there, lines of
sight included.
"""

from typing import Any

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.arrays import frequent_labels, subsample
from radiotwin.effects.base import GainEffect, LevelAt, ResidualView, Term
from radiotwin.effects.params import (
    Allowed,
    EffectParams,
    Estimate,
    Parameter,
    ReceiverIndex,
    Seconds,
    Variation,
)
from radiotwin.links import Links

MIN_LINKS = 60  # with a time, of a receiver that is looked at
MAX_RECEIVERS = 60  # that are shifted in time, or it takes too long
MIN_NATS = 6.0  # that an offset must gain to be proposed
MAX_PROPOSE_LINKS = 600  # of a receiver, on which offsets are tried
MIN_SPEED_M_S = 0.3  # below it, positions that jitter look like a movement
# How far a receiver moves between the two times [m]: tried, first step and bound of the search.
TRIED_M = (4.0, 8.0, 15.0, 25.0, 40.0, 60.0, 85.0)
STEP_M, MAX_M = 3.0, 120.0


class ReceiverClockOffset(GainEffect):
    """A clock offset of all positions of a receiver; one step finds one receiver, the worst."""

    name = "receiver_clock_offset"
    settled_by = "fly one track forth and back"
    of_receiver = True
    repeatable = True
    always_exact = True  # a map's streets are what shows where it was
    confused_with = ("receiver_position_error", "body_shadowing")

    class Params(EffectParams):
        """A receiver and the offset of its clocks."""

        receiver: ReceiverIndex = Field(description="Index of the receiver.")
        offset_s: Seconds = Field(
            description="A level belongs to the position at its row's time plus this [s].")
        speed_m_s: float = Field(
            ge=1e-6, le=1e9,
            description="Mean while it moves; scales steps and bounds of the search [m/s].")
        exact: bool = Field(False, description="Whether paths are followed to those positions.")

    @override
    def unavailable(self, links: Links) -> str | None:
        if np.isfinite(links.time_s).sum() < MIN_LINKS:
            return "there is no time_s"
        moving = _speeds_m_s(links)
        if len(moving) > MAX_RECEIVERS:
            return (f"{len(moving)} receivers are too many to shift each in time; "
                    f"at most {MAX_RECEIVERS}")
        return None if moving else f"no receiver with {MIN_LINKS} links moves"

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        links = view.links
        best: tuple[float, Any] = MIN_NATS, None
        known = view.found_params(self.name, "receiver")
        for receiver, speed_m_s in sorted(_speeds_m_s(links).items()):
            if receiver in known:
                continue
            every = np.flatnonzero(links.receiver == receiver)
            rows = subsample(every, MAX_PROPOSE_LINKS)
            mine, share = links.select(rows), len(every) / len(rows)
            before_db = view.level_at(mine)
            for offset_s in (sign * size_m / speed_m_s for size_m in TRIED_M for sign in (-1, 1)):
                moved = _at_other_time(mine, receiver, offset_s)
                nats = share * view.gain_nats(rows, view.level_at(moved) - before_db).sum()
                if nats > best[0]:
                    best = nats, self.Params(receiver=receiver, offset_s=offset_s,
                                             speed_m_s=speed_m_s)
        return [best[1]] if best[1] else []

    @override
    def term(self, links: Links, params: Params, level_at: LevelAt) -> Term:
        offset_db = np.zeros(len(links))
        rows = np.flatnonzero(links.receiver == params.receiver)
        mine = links.select(rows)
        moved = _at_other_time(mine, params.receiver, params.offset_s)
        offset_db[rows] = level_at(moved, params.exact) - level_at(mine, params.exact)
        return Term.of_offset(offset_db)

    @override
    def exact(self, params: Params) -> Params:
        return params.model_copy(update={"exact": True})

    @override
    def variation(self, params: Params) -> Variation:
        max_s, step_s = MAX_M / params.speed_m_s, STEP_M / params.speed_m_s
        return Variation(
            np.array([params.offset_s]), np.array([step_s]), np.array([-max_s]), np.array([max_s]),
            lambda numbers: params.model_copy(update={"offset_s": float(numbers[0])}),
            follows_paths=params.exact)

    @override
    def parameters(self, links: Links, params: Params,
                   estimate: Estimate) -> dict[str, Parameter]:
        name = f"positions_late_by_s[{links.receiver_names[params.receiver]}]"
        max_s = MAX_M / params.speed_m_s
        return {name: Parameter.normal(params.offset_s, estimate.params_sd[0], "s",
                                       Allowed(-max_s, max_s))}


def _speeds_m_s(links: Links) -> dict[int, float]:
    """Return the mean speed while moving of each receiver that moves and has enough links [m/s]."""
    moving = {}
    for receiver in frequent_labels(links.receiver[np.isfinite(links.time_s)], MIN_LINKS):
        length_m = duration_s = 0.0
        for (other, _), (time_s, position_m) in links.tracks.items():
            if other == receiver:
                step_m = np.linalg.norm(np.diff(position_m, axis=0), axis=1)
                length_m += step_m.sum()
                duration_s += np.diff(time_s)[step_m > 0].sum()
        if duration_s > 0 and length_m / duration_s >= MIN_SPEED_M_S:
            moving[receiver] = float(length_m / duration_s)
    return moving


def _at_other_time(links: Links, receiver: int, offset_s: float) -> Links:
    """Return links of one receiver, moved to where its tracks have it `offset_s` later.

    Links without a time stay.
    """
    receiver_m = links.receiver_m.copy()
    timed = np.flatnonzero(np.isfinite(links.time_s))
    order = timed[np.argsort(links.flight[timed], kind="stable")]
    flights, first = np.unique(links.flight[order], return_index=True)
    for flight, rows in zip(flights.tolist(), np.split(order, first[1:]), strict=False):
        time_s, position_m = links.tracks[receiver, flight]
        for axis in range(3):
            receiver_m[rows, axis] = np.interp(links.time_s[rows] + offset_s, time_s,
                                               position_m[:, axis])
    return links.with_receivers(receiver_m)
