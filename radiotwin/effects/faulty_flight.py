"""A flight of one receiver whose readings disagree with all others: a loose plug, a wrong set-up.

Its readings have an offset, follow the prediction with another slope (0: not at all), and scatter
more (a random effect beside the error scale). So they no longer corrupt what is learnt of others.

A flight stands out if its level or its scatter, compared with other flights at the same places,
is an outlier among the flights of its receiver: Student's t with the pooled standard deviation of
all others, corrected for the number of flights (Grubbs 1969, 'Procedures for detecting outlying
observations in samples', Technometrics 11).
"""

from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field
from scipy.stats import t
from typing_extensions import override

from radiotwin.effects.base import GainEffect, Term
from radiotwin.effects.comparison import compared_db, flight_mask, share_alike
from radiotwin.effects.params import (
    Decibels,
    EffectParams,
    Estimate,
    Parameter,
    ReceiverIndex,
    quantity,
)
from radiotwin.effects.residual_view import LevelAt, ResidualView
from radiotwin.links import LinkData

MIN_LINKS = 30  # of a receiver on a flight, at places where other flights were
MIN_FLIGHTS = 3  # of a receiver: of two that differ, either may be the faulty one
MIN_DEVICE_LINKS = 5  # of a device, to be asked whether it agrees
MIN_DEVICES = 0.7  # share of the devices that must agree: a fault of the receiver acts on all
MIN_OFFSET_DB = 2.0  # a smaller one changes no decision
MIN_SCATTER = 1.5  # times the others'
MAX_P_VALUE = 0.01  # corrected for the number of flights
PRIOR_SD_DB = 15.0
RELATION_SD = 0.5  # of the slope that is lost or gained
MAD_SD = 1.4826  # standard deviation over median absolute deviation, of normal errors


@dataclass(frozen=True)
class _Flight:
    """A receiver's flight: level and log of the scatter of what is left after the comparison."""

    receiver: int
    flight: int
    rows: np.ndarray
    level_db: float
    log_scatter: float


class FaultyFlight(GainEffect):
    """One flight of one receiver that disagrees with all others; a step finds the worst."""

    name = "faulty_flight"
    figure = "links"
    of_receiver = True
    repeatable = True
    within_flights = True
    confused_with = ("receiver_drift", "episode", "lock_loss")

    class Params(EffectParams):
        """A receiver, one of its flights, and how much more that scatters."""

        receiver: ReceiverIndex = Field(description="Index of the receiver.")
        flight: str = Field(max_length=10_000, description="Name of the flight.")
        centre_db: Decibels = Field(description="Predicted level at which the offset holds [dB].")
        noise_sd_db: float = quantity(
            1.0, unit="dB", low=0.0, high=60.0, step=1.0,
            description="Standard deviation beside that of other flights [dB].")

    @override
    def unavailable(self, links: LinkData) -> str | None:
        pairs = np.unique(np.column_stack([links.receiver, links.flight]), axis=0)
        if np.unique(pairs[:, 0], return_counts=True)[1].max() < MIN_FLIGHTS:
            return f"no receiver is on {MIN_FLIGHTS} flights, so that one could disagree"
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        known = list(zip(view.found_params(self.name, "receiver"),
                         view.found_params(self.name, "flight"), strict=True))
        flights = _compared_flights(view)
        found = []
        for each in flights:
            name = str(view.links.flight_names[each.flight])
            if (each.receiver, name) in known:
                continue
            p_value, scatter_db = _disagreement(each, flights, view.links)
            if p_value * len(flights) <= MAX_P_VALUE:
                centre_db = float(np.median(view.mean_db[each.rows]))
                found.append((p_value, self.Params(receiver=each.receiver, flight=name,
                                                   centre_db=centre_db, noise_sd_db=scatter_db)))
        return [params for _, params in sorted(found, key=lambda each: each[0])[:1]]

    @override
    def propose_like(self, view: ResidualView, params: Params) -> list[Params]:
        there = flight_mask(view.links, params.receiver, params.flight)
        return [params] if there.sum() >= MIN_LINKS else []

    @override
    def term(self, links: LinkData, params: Params, level_at: LevelAt) -> Term:
        rows = np.flatnonzero(flight_mask(links, params.receiver, params.flight))
        columns, noise_db = np.zeros((len(links), 2)), np.zeros(len(links))
        columns[rows, 0] = 1.0
        if len(rows):
            columns[rows, 1] = level_at(links.select(rows)) - params.centre_db
        noise_db[rows] = params.noise_sd_db
        return replace(Term.of_columns(columns, PRIOR_SD_DB),
                       prior_sd_db=np.array([PRIOR_SD_DB, RELATION_SD]),
                       random_effect_sd_db=noise_db)

    @override
    def parameters(self, links: LinkData, params: Params,
                   estimate: Estimate) -> dict[str, Parameter]:
        member = f"[{links.receiver_names[params.receiver]}, flight {params.flight}]"
        offset_db, slope = estimate.coefficients
        offset_sd_db, slope_sd = estimate.coefficients_sd
        noise = Parameter.normal(params.noise_sd_db, estimate.params_sd[0], "dB")
        return {"offset_db" + member: Parameter.normal(offset_db, offset_sd_db, "dB"),
                "added_noise_db" + member: replace(noise, low=max(noise.low, 0.0)),
                "relation" + member: Parameter.normal(1 + slope, slope_sd, "of the prediction")}


def _compared_flights(view: ResidualView) -> list[_Flight]:
    """Return every flight of every receiver that was where others were."""
    links, rest_db = view.links, compared_db(view)
    known = np.isfinite(rest_db) & np.isfinite(links.level_db)
    found = []
    for receiver, flight in np.unique(np.column_stack([links.receiver, links.flight])[known],
                                      axis=0).tolist():
        rows = np.flatnonzero(known & (links.receiver == receiver) & (links.flight == flight))
        if len(rows) >= MIN_LINKS:
            level_db = float(np.median(rest_db[rows]))
            scatter_db = MAD_SD * float(np.median(np.abs(rest_db[rows] - level_db)))
            found.append(_Flight(receiver, flight, rows, level_db,
                                 float(np.log(max(scatter_db, 1e-3)))))
    # What a receiver always has is no fault of one of its flights.
    own = {each.receiver: float(np.median([other.level_db for other in found
                                           if other.receiver == each.receiver])) for each in found}
    for number, each in enumerate(found):
        rest_db[each.rows] -= own[each.receiver]
        found[number] = replace(each, level_db=each.level_db - own[each.receiver])
    return [each for each in found if _devices_agree(each, found, rest_db, links)
            or abs(each.level_db) < MIN_OFFSET_DB]


def _devices_agree(flight: _Flight, others: list[_Flight], rest_db: np.ndarray,
                   links: LinkData) -> bool:
    """Return whether most devices show what the flight as a whole shows."""
    device, own_db = links.device[flight.rows], rest_db[flight.rows]
    if len(np.unique(device)) > len(device) / MIN_DEVICE_LINKS:  # positions of one that moves
        return True
    if abs(flight.level_db) >= MIN_OFFSET_DB and share_alike(
            device, own_db, MIN_DEVICE_LINKS, 0.4 * flight.level_db) >= MIN_DEVICES:
        return True
    usual_db = float(np.exp(np.median([other.log_scatter for other in others])))
    return share_alike(device, np.abs(own_db - np.median(own_db)), MIN_DEVICE_LINKS,
                       MIN_SCATTER * usual_db / MAD_SD) >= MIN_DEVICES


def _disagreement(flight: _Flight, flights: list[_Flight], links: LinkData) -> tuple[float, float]:
    """Return the p-value of a flight's disagreement, and the scatter that it adds [dB]."""
    others = [each for each in flights if each is not flight]
    same = [each for each in others if each.receiver == flight.receiver]
    if len(same) < MIN_FLIGHTS - 1:
        return 1.0, 0.0
    usual = float(np.median([each.log_scatter for each in others]))
    excess = flight.log_scatter - usual
    noisy_p = 1.0
    if excess > np.log(MIN_SCATTER):
        sd = float(np.std([each.log_scatter for each in others], ddof=1))
        noisy_p = float(t.sf(excess / max(sd, 0.05), len(others) - 1))
    levels_db = np.array([each.level_db for each in others])
    receivers = len({each.receiver for each in others})
    freedom = max(len(others) - receivers, 1)
    sd_db = max(float(np.sqrt((levels_db**2).sum() / freedom)), 0.1)
    own_db = flight.level_db - float(np.median([each.level_db for each in same]))
    offset_p = 1.0
    if abs(own_db) >= MIN_OFFSET_DB and not _is_first_or_last(flight, links):
        offset_p = float(2 * t.sf(abs(own_db) / sd_db, freedom))
    added_db = np.sqrt(max(np.exp(2 * flight.log_scatter) - np.exp(2 * usual), 0.0))
    return min(2 * min(noisy_p, offset_p), 1.0), float(min(added_db, 50.0))


def _is_first_or_last(flight: _Flight, links: LinkData) -> bool:
    """Return whether a level that is off may as well be a step in time, before or after it."""
    times = {number: time_s[0] for (receiver, number), (time_s, _) in links.tracks.items()
             if receiver == flight.receiver}
    if links.time_restarts or flight.flight not in times:
        return False
    return times[flight.flight] in (min(times.values()), max(times.values()))
