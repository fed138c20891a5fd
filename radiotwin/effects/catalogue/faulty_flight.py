"""`faulty_flight`: one flight whose readings disagree with all others (loose plug, wrong set-up).

Its readings get an offset, another slope in the predicted level (0: no relation), and additional
scatter (a random effect), so that they do not bias other estimates.

A flight stands out if its level, compared with other flights at the same places, is an outlier
among the flights of its receiver, or if its scatter or its roughness (the scatter between
successive readings of a device) is one among all flights: Student's t with the pooled standard
deviation of all others, corrected for the number of flights and statistics (Grubbs 1969,
'Procedures for detecting outlying observations in samples', Technometrics 11). Other receivers on
the same flight are not peers: if all of them are outliers, the fault is that of the flight. Wrong
maps change the scatter of flights but hardly their roughness.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from pydantic import Field
from scipy.stats import t
from typing_extensions import override

from radiotwin.effects.base import GainEffect, LevelAt, ResidualView, Term
from radiotwin.effects.comparison import (
    by_precision,
    compared_db,
    flight_mask,
    mean_by_precision,
    share_alike,
)
from radiotwin.effects.params import (
    Decibels,
    EffectParams,
    Estimate,
    Parameter,
    ReceiverIndex,
    quantity,
)
from radiotwin.effects.patterns import Pattern, members
from radiotwin.inference.gaussian import robust_sd
from radiotwin.links import Links

MIN_LINKS = 30  # of a receiver on a flight, at places where other flights were
MIN_FLIGHTS = 3  # of a receiver: if only two levels differ, either flight may be faulty
MIN_ALL_FLIGHTS = 4  # of all receivers, for an outlier of the scatter
MIN_DEVICE_LINKS = 5  # of a device, to test whether it agrees
MIN_DEVICES = 0.7  # share of devices that must agree: a fault of the receiver acts on all
MIN_OFFSET_DB = 2.0  # a smaller one changes no decision
FAR_SD, MIN_USUAL_SD_DB = 4.0, 0.5  # levels beyond so many robust sd (at least so large) are far
MIN_SCATTER = 1.5  # least scatter relative to other flights
MIN_SCATTER_DB = 1e-3
# Prior sd of flights' levels [dB], of log scatters and log roughnesses, and their degrees of
# freedom (Smyth 2004, 'Linear models and empirical Bayes methods', Stat. Appl. Genet. Mol. Biol.
# 3): two or three flights do not determine it. In 30 campaigns over cities with wrong maps, the
# levels of one receiver's flights had an sd of 0.37 dB in the median and 0.78 dB at the 90 %
# quantile; this prior has 0.68 and 1.4, to cover other worlds.
PRIOR_LEVEL_SD_DB, PRIOR_LOG_SD, PRIOR_FREEDOM = 0.6, (0.35, 0.25), 3
STATISTICS = 4  # number of tests per flight: two levels, scatter, roughness
MAX_P_VALUE = 0.02  # corrected for the number of flights
PRIOR_SD_DB = 15.0  # of the offset
RELATION_SD = 0.5  # prior sd of the change of slope


@dataclass(frozen=True)
class _Flight:
    """Statistics of one receiver's flight; NaN: unknown."""

    receiver: int
    flight: int
    rows: np.ndarray  # its detected links
    # Of compared residuals (see `compared_db`) and of residuals, minus the median over the
    # receiver's flights; NaN if its devices disagree.
    levels_db: tuple[float, float]
    log_scatters: tuple[float, float]  # of the compared residuals, and roughness [log dB]


class FaultyFlight(GainEffect):
    """One flight that disagrees with all others; each search step finds the worst."""

    name = "faulty_flight"
    in_words = "a fault on that flight"
    settled_by = "repeat that flight with a receiver that was compared with another"
    figure = "links"
    of_receiver = True
    repeatable = True
    within_flights = True
    acts_on = ("flight", "receiver x flight")
    confused_with = ("receiver_drift", "episode", "lock_loss")

    class Params(EffectParams):
        """A flight, of which receiver, and how much more that scatters."""

        receiver: ReceiverIndex | None = Field(description="Index of the receiver; None: all.")
        flight: str = Field(max_length=10_000, description="Name of the flight.")
        centre_db: Decibels = Field(description="Predicted level at which the offset holds [dB].")
        noise_sd_db: float = quantity(
            1.0, unit="dB", low=0.0, high=60.0, step=1.0,
            description="Standard deviation beside that of other flights [dB].")

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        """Return why there are too few flights to call one faulty; None if there are enough."""
        pairs = np.unique(np.column_stack([links.receiver, links.flight]), axis=0)
        most = np.unique(pairs[:, 0], return_counts=True)[1].max()
        if most < 2 or (most < MIN_FLIGHTS and len(pairs) < MIN_ALL_FLIGHTS):
            return (f"no receiver is on {MIN_FLIGHTS} flights, and all are on fewer than "
                    f"{MIN_ALL_FLIGHTS}, so that one could disagree")
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose the flight, of one receiver or of all, that disagrees most with the others."""
        known = list(zip(view.found_params(self.name, "receiver"),
                         view.found_params(self.name, "flight"), strict=True))
        flights = _flights(view)
        found: dict[int, list[tuple[float, float, _Flight]]] = {}
        for flight in flights:
            name = str(view.links.flight_names[flight.flight])
            if (flight.receiver, name) in known or (None, name) in known:
                continue
            p_value, scatter_db = _disagreement(flight, flights, view.links)
            stands_out = view.group is not None and view.group[flight.rows].any()
            if stands_out or (view.group is None and p_value * len(flights) <= MAX_P_VALUE):
                found.setdefault(flight.flight, []).append((p_value, scatter_db, flight))
        if not found:
            return []
        worst = min(found.values(), key=lambda faults: min(p_value for p_value, _, _ in faults))
        receivers = {flight.receiver for flight in flights if flight.flight == worst[0][2].flight}
        if not 1 < len(receivers) == len(worst):  # not all receivers: take the worst
            worst = [min(worst, key=lambda fault: fault[0])]
        rows = np.concatenate([flight.rows for _, _, flight in worst])
        return [self.Params(
            receiver=worst[0][2].receiver if len(worst) == 1 else None,
            flight=str(view.links.flight_names[worst[0][2].flight]),
            centre_db=float(np.median(view.mean_db[rows])),
            noise_sd_db=float(np.median([scatter_db for _, scatter_db, _ in worst])))]

    @override
    def propose_for_fold(self, view: ResidualView) -> list[Params]:
        on_flight = flight_mask(view.links, self.params.receiver, self.params.flight)
        return [self.params] if on_flight.sum() >= MIN_LINKS else []

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return a flight's fitted offset and slope against the prediction, and its added noise."""
        rows = np.flatnonzero(flight_mask(links, self.params.receiver, self.params.flight))
        columns, noise_db = np.zeros((len(links), 2)), np.zeros(len(links))
        columns[rows, 0] = 1.0
        if len(rows):
            columns[rows, 1] = level_at(links.select(rows)) - self.params.centre_db
        noise_db[rows] = self.params.noise_sd_db
        return replace(Term.of_columns(columns, PRIOR_SD_DB),
                       prior_sd_db=np.array([PRIOR_SD_DB, RELATION_SD]),
                       random_effect_sd_db=noise_db)

    @override
    def typical_patterns(self, view: ResidualView) -> Iterator[Pattern]:
        """Yield a loss of 1 dB on one flight of one receiver, for several flights."""
        links = view.links
        flights = members(links.track)
        between = [mask for mask in flights if not is_first_or_last(
            int(links.receiver[mask][0]), int(links.flight[mask][0]), links)]
        for mask in between or flights:  # a first or last one may be a step in time
            yield Pattern("flight", "dB", "a constant of one flight of one receiver, "
                                          "neither its first nor its last", -1.0 * mask)

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report the flight's offset [dB], added noise [dB], and slope against the prediction."""
        receiver = self.params.receiver
        who = "all" if receiver is None else links.receiver_names[receiver]
        member = f"[{who}, flight {self.params.flight}]"
        offset_db, slope = estimate.coefficients
        offset_sd_db, slope_sd = estimate.coefficients_sd
        noise = Parameter.normal(self.params.noise_sd_db, estimate.params_sd[0], "dB")
        return {"offset_db" + member: Parameter.normal(offset_db, offset_sd_db, "dB"),
                "added_noise_db" + member: replace(noise, low=max(noise.low, 0.0)),
                "relation" + member: Parameter.normal(1 + slope, slope_sd, "of the prediction")}


def _flights(view: ResidualView) -> list[_Flight]:
    """Compute level, scatter and roughness of each receiver's flights with enough readings."""
    links = view.links
    detected = np.isfinite(links.level_db)
    pairs = np.unique(np.column_stack([links.receiver, links.flight])[detected], axis=0)
    rows = [np.flatnonzero(detected & (links.receiver == receiver) & (links.flight == flight))
            for receiver, flight in pairs]
    residuals_db = [np.where(detected, values_db, np.nan)
                    for values_db in (compared_db(view), view.residual_db)]
    levels_db = np.column_stack([_levels_db(*by_precision(view, values_db), rows, pairs[:, 0],
                                            links) for values_db in residuals_db])
    found = []
    for (receiver, flight), of_flight, level_db in zip(pairs.tolist(), rows, levels_db,
                                                       strict=True):
        if len(of_flight) >= MIN_LINKS:
            steps_db = _steps_db(view.residual_db[of_flight], links.select(of_flight))
            logs = [float(np.log(max(_robust_sd(values_db), MIN_SCATTER_DB)))
                    for values_db in (residuals_db[0][of_flight], steps_db)]
            found.append(_Flight(receiver, flight, of_flight, (level_db[0], level_db[1]),
                                 (logs[0], logs[1])))
    return found


def _levels_db(value_db: np.ndarray, weight: np.ndarray, rows: list[np.ndarray],
               receiver: np.ndarray, links: Links) -> np.ndarray:
    """Compute the mean residual (f,) of each flight, minus its receiver's median flight [dB].

    NaN if too few links have a weight, or if most devices do not show the difference.
    """
    known = [of_flight[weight[of_flight] > 0] for of_flight in rows]
    level_db = np.array([mean_by_precision(value_db[of_flight], weight[of_flight])
                         if len(of_flight) >= MIN_LINKS else np.nan for of_flight in known])
    for index in np.unique(receiver):  # a constant of the receiver is no fault of one flight
        same = (receiver == index) & np.isfinite(level_db)
        level_db[same] -= np.median(level_db[same]) if same.any() else 0.0
    for number, (of_flight, flight_db) in enumerate(zip(known, level_db.tolist(), strict=True)):
        if abs(flight_db) >= MIN_OFFSET_DB and not _devices_agree(
                value_db[of_flight], weight[of_flight], flight_db, links.device[of_flight]):
            level_db[number] = np.nan
    return level_db


def _devices_agree(value_db: np.ndarray, weight: np.ndarray, level_db: float,
                   device: np.ndarray) -> bool:
    """Check whether most devices differ by 0.4 of the flight's level; True with few links each."""
    if len(np.unique(device)) > len(device) / MIN_DEVICE_LINKS:  # places of a moving device
        return True
    return share_alike(device, value_db, weight, MIN_DEVICE_LINKS, 0.4 * level_db) >= MIN_DEVICES


def _robust_sd(values: np.ndarray) -> float:
    """Estimate the standard deviation of values (n,) robustly; NaN if too few are known."""
    known = values[np.isfinite(values)]
    return robust_sd(known) if len(known) >= MIN_LINKS else np.nan


def _steps_db(residual_db: np.ndarray, links: Links) -> np.ndarray:
    """Compute differences of successive residuals of the same device, over sqrt(2) [dB]."""
    order = np.lexsort((links.time_s, links.device))
    same = np.diff(links.device[order]) == 0
    return np.diff(residual_db[order])[same] / np.sqrt(2)


def _disagreement(flight: _Flight, flights: list[_Flight], links: Links) -> tuple[float, float]:
    """Compute the p-value, over all tests, that a flight is like others, and added scatter [dB].

    The level of a receiver's first or last flight is not tested: it may be a step in time.
    """
    others = [other for other in flights if other.flight != flight.flight]
    noisy = [_excess_scatter(log_scatter, np.array([other.log_scatters[kind] for other in others]),
                             prior_sd)
             for kind, (log_scatter, prior_sd) in enumerate(zip(flight.log_scatters, PRIOR_LOG_SD,
                                                                strict=True))]
    p_value, added_db = min(noisy)
    if not is_first_or_last(flight.receiver, flight.flight, links):
        p_value = min(p_value, *(_offset_p_value(flight, others, kind, links)
                                  for kind in range(2)))
    return min(STATISTICS * p_value, 1.0), min(added_db, 50.0)


def _excess_scatter(log_scatter: float, usual: np.ndarray, prior_sd: float) -> tuple[float, float]:
    """Test whether a flight's log scatter exceeds that of others (m,): p-value, added scatter [dB].

    p = 1 if others are too few, or if the scatter is not `MIN_SCATTER` times their median.
    """
    usual = usual[np.isfinite(usual)]
    if np.isnan(log_scatter) or len(usual) < MIN_FLIGHTS - 1:
        return 1.0, 0.0
    excess = log_scatter - float(np.median(usual))
    added_db = np.sqrt(max(np.exp(2 * log_scatter) - np.exp(2 * np.median(usual)), 0.0))
    if excess <= np.log(MIN_SCATTER):
        return 1.0, float(added_db)
    freedom = len(usual) - 1
    sum_of_squares = freedom * np.var(usual, ddof=1) + PRIOR_FREEDOM * prior_sd**2
    sd = np.sqrt(sum_of_squares / (freedom + PRIOR_FREEDOM))
    return float(t.sf(excess / sd, freedom + PRIOR_FREEDOM)), float(added_db)


def _offset_p_value(flight: _Flight, others: list[_Flight], kind: int, links: Links) -> float:
    """Compute the p-value of a flight's mean residual against its receiver's other flights.

    1 if there are too few, or if the difference is below `MIN_OFFSET_DB`. `kind` 0 takes residuals
    relative to other flights at the same place, 1 plain ones.
    """
    known = [other for other in others if np.isfinite(other.levels_db[kind])]
    level_db = np.array([other.levels_db[kind] for other in known])
    receiver = np.array([other.receiver for other in known])
    same = receiver == flight.receiver
    if same.sum() < MIN_FLIGHTS - 1:
        return 1.0
    offset_db = flight.levels_db[kind] - float(np.median(level_db[same]))
    if not abs(offset_db) >= MIN_OFFSET_DB:
        return 1.0
    # A first or last flight far from the others is a step in time and must not widen their usual
    # spread: a step of 20 dB would hide a fault of 15 dB.
    far = np.abs(level_db) > FAR_SD * max(robust_sd(level_db), MIN_USUAL_SD_DB)
    usual = ~far | [not is_first_or_last(other.receiver, other.flight, links) for other in known]
    freedom = max(int(usual.sum()) - len(np.unique(receiver[usual])), 0) + PRIOR_FREEDOM
    sum_of_squares = (level_db[usual]**2).sum() + PRIOR_FREEDOM * PRIOR_LEVEL_SD_DB**2
    return float(2 * t.sf(abs(offset_db) / np.sqrt(sum_of_squares / freedom), freedom))


def is_first_or_last(receiver: int, flight: int, links: Links) -> bool:
    """Check whether a flight is the receiver's first or last; False if flights have no order."""
    start_s = {number: time_s[0] for (index, number), (time_s, _) in links.tracks.items()
               if index == receiver}
    if links.time_restarts or flight not in start_s:
        return False
    return start_s[flight] in (min(start_s.values()), max(start_s.values()))
