"""`receiver_clock_offset`: a constant delay between the clocks of levels and positions.

Each level belongs to the receiver's position some time before or after that of its row: at speed v
and offset t, d = v t along the track. The channel predicts the level again from that position,
including the line of sight.
"""

import numpy as np
from pydantic import Field
from typing_extensions import override

from radiotwin.effects.arrays import MIN_LINKS, frequent_labels
from radiotwin.effects.base import ResidualView
from radiotwin.effects.moves import MAX_ENDS, MovedEnd
from radiotwin.effects.params import (
    EffectParams,
    Estimate,
    Parameter,
    ReceiverIndex,
    Seconds,
    Variation,
)
from radiotwin.links import Links

MIN_SPEED_M_S = 0.3  # below it, jitter of positions looks like movement
# Displacements along the track [m]: trial values; first step and bound of the search.
TRIED_M = (4.0, 8.0, 15.0, 25.0, 40.0, 60.0, 85.0)
STEP_M, MAX_M = 3.0, 120.0


class ReceiverClockOffset(MovedEnd):
    """Clock offset of one receiver's positions; each search step finds the worst receiver."""

    name = "receiver_clock_offset"
    in_words = "a wrong clock of the receiver"
    acts_on = ("receiver",)
    settled_by = "fly one track forth and back"
    of_receiver = True
    confused_with = ("receiver_position_error", "body_shadowing")

    class Params(EffectParams):
        """A receiver and the offset of its clocks."""

        receiver: ReceiverIndex = Field(description="Index of the receiver.")
        offset_s: Seconds = Field(
            description="A level belongs to the position at its row's time plus this [s].")
        speed_m_s: float = Field(
            ge=1e-6, le=1e9,
            description="Mean while it moves; scales steps and bounds of the search [m/s].")

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        """Return why no clock can be tested (no times, none moves, or too many); else None."""
        if np.isfinite(links.time_s).sum() < MIN_LINKS:
            return "there is no time_s"
        moving = _speeds_m_s(links)
        if len(moving) > MAX_ENDS:
            return (f"{len(moving)} receivers are too many to shift each in time; "
                    f"at most {MAX_ENDS}")
        return None if moving else f"no receiver with {MIN_LINKS} links moves"

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose the receiver (not yet found) and clock offset, along its track, that fit best."""
        known = view.found_params(self.name, "receiver")
        return self.best_move(view, (
            [self.Params(receiver=receiver, offset_s=sign * size_m / speed_m_s, speed_m_s=speed_m_s)
             for size_m in TRIED_M for sign in (-1, 1)]
            for receiver, speed_m_s in sorted(_speeds_m_s(view.links).items())
            if receiver not in known))

    @override
    def moved(self, links: Links) -> Links:
        return _at_other_time(links, self.params.receiver, self.params.offset_s)

    @override
    def variation(self) -> Variation:
        """Return the clock offset [s] for the search; it moves a receiver by `MAX_M` at most."""
        params = self.params
        max_s, step_s = MAX_M / params.speed_m_s, STEP_M / params.speed_m_s
        return Variation(
            np.array([params.offset_s]), np.array([step_s]), np.array([-max_s]), np.array([max_s]),
            lambda numbers: self.changed(offset_s=float(numbers[0])), follows_paths=self.is_exact)

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        name = f"positions_late_by_s[{links.receiver_names[self.params.receiver]}]"
        return self.variation().parameters({name: "s"}, estimate.params_sd)


def _speeds_m_s(links: Links) -> dict[int, float]:
    """Compute receiver -> mean speed while moving [m/s], for moving receivers with enough links."""
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
    """Shift all `links`, of one receiver, along its track by `offset_s`; untimed ones stay."""
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
