"""`episode`: a loss between two times, such as rain, a wet antenna or a loose plug.

A loss [dB], or an attenuation along the path [dB/km] (ITU-R P.838, 'Specific attenuation model for
rain'), of one receiver or of all. The times are the two change points between which the residual,
compared with other flights at the same places, differs most from the rest (circular binary
segmentation, Olshen et al. 2004, Biostatistics 5). It is proposed only if no other window of that
length differs as much.
"""

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import Field
from scipy.stats import t
from typing_extensions import override

from radiotwin.effects.arrays import MIN_LINKS, frequent_labels
from radiotwin.effects.base import GainEffect, LevelAt, ResidualView, Term
from radiotwin.effects.comparison import (
    by_precision,
    compared_where_possible_db,
    flight_mask,
    mean_by_precision,
    share_alike,
)
from radiotwin.effects.losses import max_gas_db_km, max_rain_db_km
from radiotwin.effects.params import (
    Allowed,
    EffectParams,
    Estimate,
    Parameter,
    ReceiverIndex,
    Seconds,
)
from radiotwin.effects.patterns import Pattern, timed_members
from radiotwin.links import Links, evidence_blocks
from radiotwin.links.sites import site_of

MIN_INSIDE = 20  # least number of links in the window
MAX_INSIDE = 0.5  # largest share of the links in the window: more are the usual state
MIN_NATS = 10.0  # log-likelihood gain above which an episode is proposed
MIN_DB = 1.5  # least mean change; a smaller one changes no decision
INTERVAL_NATS = 2.0  # drop at the ends of a change point's 90 % interval (of a mean: 1.35)
BINS = 160  # trial times in the first pass
FEW_WINDOWS = 6  # other windows of the same length below which a t test is too weak
GAIN_RATIO = 2.5  # then it must gain so many times as much as any other window
MAX_P_VALUE = 0.01  # that any of the windows differs as much by chance
MIN_DEVIATION_SD = 0.3  # least sd between windows; independent links have 1
MIN_MEMBER_LINKS = 5  # of a device or receiver in the window, to test whether it agrees
MIN_KNOWN, MIN_SITES = 0.5, 4  # share of compared links, or else number of sites, that is needed
LOW_M, MIN_PLACES = 10.0, 20  # height of receivers in streets; such need so many places
MIN_MEMBERS = 0.7  # share of devices, and of receivers, that must agree: it acts on all
MIN_OVERLAP = 0.3  # overlap over union of two windows that are the same episode
SAME_SHARE = 0.9  # share of one flight's links from which on it is a faulty flight instead
TYPICAL = 0.1  # share of the time of a typical episode
PRIOR_SD_DB, PRIOR_SD_DB_KM = 15.0, 30.0


class _Window(NamedTuple):
    """A window of time with a loss: gain [nats], start and end with 90 % intervals [s], form."""

    nats: float
    start_s: float
    end_s: float
    start_within_s: tuple[float, float]
    end_within_s: tuple[float, float]
    form: Literal["loss", "attenuation"]


class Episode(GainEffect):
    """A loss or an attenuation between two times; each search step finds the strongest."""

    name = "episode"
    in_words = "something that lasted for a while, such as rain"
    acts_on = ("time", "receiver", "flight", "receiver x flight")
    settled_by = "repeat the flight in dry weather"
    figure = "dependence"
    of_receiver = True
    repeatable = True
    within_flights = True
    confused_with = ("faulty_flight", "receiver_drift", "excess_attenuation")

    class Params(EffectParams):
        """Who is affected, when, and in which form."""

        receiver: ReceiverIndex | None = Field(description="Index of the receiver; None: all.")
        flight: str | None = Field(
            None, max_length=10_000,
            description="Name of the flight, where clocks restart in each; None: times tell.")
        start_s: Seconds = Field(description="First time [s].")
        end_s: Seconds = Field(description="Last time [s].")
        start_within_s: tuple[Seconds, Seconds] = Field(
            description="90 % interval of the time at which it began [s].")
        end_within_s: tuple[Seconds, Seconds] = Field(
            description="90 % interval of the time at which it ended [s].")
        form: Literal["loss", "attenuation"] = Field(
            description="A loss [dB], or one in proportion to the distance [dB/km].")
        frequency_hz: float | None = Field(
            None, gt=0, le=1e12, description="Of the radio [Hz]; None: unknown, no bound.")

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        """Return why no temporary loss can be searched (no times, or one flight); else None."""
        if np.isfinite(links.time_s).sum() < MIN_LINKS:
            return "there is no time_s"
        if len(np.unique(links.flight)) < 2:
            return "there is one flight, and no other to compare with at the same places"
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose the two strongest temporary losses, each of one receiver or of all at once."""
        links, found = view.links, []
        rest_db, known = compared_where_possible_db(view)
        value_db, weight = by_precision(view, rest_db)
        receivers: list[int | None] = list(frequent_labels(links.receiver, MIN_LINKS))
        flights = [str(links.flight_names[number]) for number in np.unique(links.flight)] \
            if links.time_restarts else [None]
        for receiver in receivers if len(receivers) < 2 else [None, *receivers]:
            for flight in flights:
                params = self._proposed(links, value_db, weight, known, receiver, flight)
                if params is not None:
                    found.append(params)
        return [params for _, params in sorted(found, key=lambda pair: -pair[0])[:2]]

    @override
    def propose_for_fold(self, view: ResidualView) -> list[Params]:
        """Propose the same episode for a fold, its times estimated anew, without held-out links."""
        value_db, weight = by_precision(view, compared_where_possible_db(view)[0])
        rows = _timed_rows(view.links, self.params.receiver, self.params.flight)
        window = _strongest(view.links, value_db, weight, rows) \
            if len(rows) >= MIN_LINKS else None
        if window is None or not _is_same(window, self.params):
            return []
        return [self.params.model_copy(update={
            key: value for key, value in window._asdict().items() if key not in ("nats", "form")})]

    def _proposed(self, links: Links, value_db: np.ndarray, weight: np.ndarray,
                  known: np.ndarray, receiver: int | None, flight: str | None,
                  ) -> tuple[float, Params] | None:
        """Return gain [nats] and parameters of the strongest episode; None if it is doubtful.

        Doubtful: a small gain, most devices or receivers do not show it, it may be a step in time
        or a bad flight, or other times differ as much.
        """
        rows = _timed_rows(links, receiver, flight)
        window = _strongest(links, value_db, weight, rows) if len(rows) >= MIN_LINKS else None
        if window is None or window.nats < MIN_NATS:
            return None
        known_hz = float(links.frequency_hz) if np.isfinite(links.frequency_hz) else None
        params = self.Params(receiver=receiver, flight=flight, frequency_hz=known_hz,
                             **{key: value for key, value in window._asdict().items()
                                if key != "nats"})
        inside = _inside(links, params)
        stands_out = _most_members_agree(links, value_db, weight, known, rows, inside) \
            and not _is_step_or_flight(links, params, inside) \
            and _is_unique(links, value_db, weight, rows, inside, window.nats)
        return (window.nats, params) if stands_out else None

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        loss = np.where(_inside(links, self.params), -1.0, 0.0)
        if self.params.form == "attenuation":
            return Term.of_columns((loss * links.distance_m / 1000)[:, None], PRIOR_SD_DB_KM)
        return Term.of_columns(loss[:, None], PRIOR_SD_DB)

    @override
    def implausible(self, coefficients: np.ndarray) -> str | None:
        """Return why the loss is negative, or more than air and rain take; None if plausible."""
        params = self.params
        if coefficients[0] < 0:
            unit = "dB" if params.form == "loss" else "dB/km"
            return f"it would have to amplify, by {-coefficients[0]:.1f} {unit}"
        if params.form == "attenuation" and params.frequency_hz is not None:
            most_db_km = max_gas_db_km(params.frequency_hz) + max_rain_db_km(params.frequency_hz)
            if coefficients[0] > most_db_km:
                return (f"{coefficients[0]:.3g} dB/km are more than air and rain take at "
                        f"{params.frequency_hz / 1e9:g} GHz: {most_db_km:.3g} dB/km (ITU-R P.676, "
                        "P.838)")
        return None

    @override
    def typical_patterns(self, view: ResidualView) -> Iterator[Pattern]:
        """Yield a loss of 1 dB during part of the time of one receiver, for several receivers."""
        links = view.links
        for of_receiver in timed_members(links, links.receiver):
            # Quantiles of the readings' times: half of the duration may be between two flights.
            start_s, end_s = np.nanquantile(links.time_s[of_receiver],
                                            [0.5 - TYPICAL / 2, 0.5 + TYPICAL / 2])
            during = (links.time_s >= start_s) & (links.time_s <= end_s)
            yield Pattern("receiver", "dB", f"over {100 * TYPICAL:.0f} % of the time of one "
                          "receiver", -1.0 * (of_receiver & during), low=MIN_DB)

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report the loss [dB or dB/km], its start and its end [s], with 90 % intervals."""
        params = self.params
        who = "all" if params.receiver is None else links.receiver_names[params.receiver]
        member = f"[{who}]" if params.flight is None else f"[{who}, flight {params.flight}]"
        time_s = links.time_s[_timed_rows(links, params.receiver, params.flight)]
        flown = Allowed(float(time_s.min()), float(time_s.max())) if len(time_s) else Allowed()
        name, unit = ("loss_db", "dB") if params.form == "loss" else \
            ("specific_attenuation_db_km", "dB/km")
        return {name + member: Parameter.normal(estimate.coefficients[0],
                                                estimate.coefficients_sd[0], unit),
                "start_s" + member: Parameter(params.start_s, *params.start_within_s, "s",
                                              allowed=flown),
                "end_s" + member: Parameter(params.end_s, *params.end_within_s, "s",
                                            allowed=flown)}


def _is_same(window: _Window, params: Any) -> bool:
    """Check whether a window overlaps an episode's enough to be the same."""
    overlap_s = min(window.end_s, params.end_s) - max(window.start_s, params.start_s)
    union_s = max(window.end_s, params.end_s) - min(window.start_s, params.start_s)
    return overlap_s >= 0 and overlap_s >= MIN_OVERLAP * union_s


def _inside(links: Links, params: Any) -> np.ndarray:
    """Return the mask (n,) of links that an episode acts on."""
    with np.errstate(invalid="ignore"):
        between = (links.time_s >= params.start_s) & (links.time_s <= params.end_s)
    return between & flight_mask(links, params.receiver, params.flight)


def _timed_rows(links: Links, receiver: int | None, flight: str | None) -> np.ndarray:
    """List the rows with a time of a receiver on a flight (None: any)."""
    return np.flatnonzero(flight_mask(links, receiver, flight) & np.isfinite(links.time_s))


def _strongest(links: Links, values_db: np.ndarray, weights: np.ndarray,
               rows: np.ndarray) -> _Window | None:
    """Find the window of time in which a loss explains the residuals best, among rows (r,).

    From residuals relative to other flights (n,) and weights (n,). The loss is constant or grows
    with distance. Two passes: coarse times over all data, then all times near the ends found.
    """
    time_s, rest_db, weight = links.time_s[rows], values_db[rows], weights[rows]
    distance_km = links.distance_m[rows] / 1000
    times_s = np.unique(time_s)
    ends_s = times_s[np.unique(np.linspace(0, len(times_s) - 1, BINS).round().astype(int))]
    best = _best_window(ends_s, time_s, rest_db, weight, distance_km)
    if best is None or len(ends_s) == len(times_s):
        return best
    coarse = np.max(np.diff(np.searchsorted(times_s, ends_s)))
    near = [np.abs(np.arange(len(times_s)) - np.searchsorted(times_s, end_s)) <= coarse
            for end_s in (best.start_s, best.end_s)]
    ends_s = times_s[near[0] | near[1]]
    return _best_window(np.unique(np.r_[times_s[0], ends_s, times_s[-1]]), time_s, rest_db, weight,
                        distance_km) or best


def _best_window(ends_s: np.ndarray, time_s: np.ndarray, rest_db: np.ndarray, weight: np.ndarray,
                 distance_km: np.ndarray) -> _Window | None:
    """Find the window between two of the times `ends_s` with the likeliest loss, or None."""
    cell = np.searchsorted(ends_s, time_s, side="right") - 1
    count = _sums(cell, np.ones(len(cell)), len(ends_s))
    inside = count[None, :] - count[:, None]
    allowed = (inside >= MIN_INSIDE) & (inside <= MAX_INSIDE * len(time_s))
    if not allowed.any():
        return None
    total = weight.sum()
    if not total > 0:
        return None
    centred, best = rest_db - weight @ rest_db / total, None
    shapes: dict[Literal["loss", "attenuation"], np.ndarray] = {
        "loss": np.ones(len(cell)), "attenuation": distance_km}
    for form, shape in shapes.items():
        wx, wxx, wxd = (_sums(cell, weight * value, len(ends_s)) for value in
                        (shape, shape**2, shape * centred))
        x, xx, xd = (sums[None, :] - sums[:, None] for sums in (wx, wxx, wxd))
        prior = PRIOR_SD_DB if form == "loss" else PRIOR_SD_DB_KM
        power = np.maximum(xx - x**2 / total, 0) + prior**-2
        # The logarithm is the penalty for the choice among the windows.
        nats = np.where(allowed & (xx > 0), 0.5 * xd**2 / power, -np.inf) - np.log(allowed.sum())
        nats = np.where(xd < 0, nats, -np.inf)  # an episode is a loss
        start, end = np.unravel_index(int(nats.argmax()), nats.shape)
        if nats[start, end] > (-np.inf if best is None else best.nats):
            likely = nats > nats[start, end] - INTERVAL_NATS
            starts, stops = np.flatnonzero(likely[:, end]), np.flatnonzero(likely[start])
            last_s = np.full(len(ends_s), -np.inf)  # time of the last reading in each cell
            np.maximum.at(last_s, cell, time_s)
            last_s = np.r_[-np.inf, np.maximum.accumulate(last_s)]
            # Begin: after the reading before the window; end: before the reading behind it.
            best = _Window(
                float(nats[start, end]), float(ends_s[start]), float(last_s[end]),
                (float(last_s[starts[0]] if starts[0] else ends_s[0]), float(ends_s[starts[-1]])),
                (float(last_s[stops[0]]), float(ends_s[min(stops[-1], len(ends_s) - 1)])), form)
    return best


def _sums(cell: np.ndarray, value: np.ndarray, cells: int) -> np.ndarray:
    """Compute cumulative sums (cells + 1,) of values (n,) over their cells."""
    return np.r_[0.0, np.cumsum(np.bincount(cell, weights=value, minlength=cells))]


def _most_members_agree(links: Links, value_db: np.ndarray, weight: np.ndarray, known: np.ndarray,
                        rows: np.ndarray, inside: np.ndarray) -> bool:
    """Check whether most devices, and most receivers, show the loss in the window of time.

    If few links have other flights at the same place to compare with (`known`), an obstacle could
    be the cause: it hides few masts at once, so several must show the loss; it hides all of them
    from a street, so receivers at street level must have been at many places.
    """
    during, others = rows[inside[rows]], rows[~inside[rows]]
    if known[during].mean() < MIN_KNOWN:
        devices = frequent_labels(links.device[during], MIN_MEMBER_LINKS)
        sites = {min(site_of(links, device)) for device in devices}
        pieces = np.unique(np.column_stack([links.device, evidence_blocks(links)])[during], axis=0)
        places = np.median(np.unique(pieces[:, 0], return_counts=True)[1])
        place_m = links.receiver_m[during]
        ground_m = 0.0 if links.city is None else links.city.ground_height_m(*place_m[:, :2].T)
        is_low = np.median(place_m[:, 2] - ground_m) < LOW_M
        if len(sites) < MIN_SITES or (places < MIN_PLACES and is_low):
            return False
    outside_db = mean_by_precision(value_db[others], weight[others])
    change_db = mean_by_precision(value_db[during], weight[during]) - outside_db
    if abs(change_db) < MIN_DB:
        return False
    return all(share_alike(label[during], value_db[during] - outside_db, weight[during],
                           MIN_MEMBER_LINKS, 0.3 * change_db) >= MIN_MEMBERS
               for label in (links.device, links.receiver)
               if np.bincount(label[during]).max() >= MIN_MEMBER_LINKS)


def _is_step_or_flight(links: Links, params: Any, inside: np.ndarray) -> bool:
    """Check whether an episode of one receiver is rather a step in time or one whole flight."""
    if params.receiver is None:
        return False
    of_receiver = links.receiver == params.receiver
    if params.flight is None:
        timed_s = links.time_s[of_receiver & np.isfinite(links.time_s)]
        if params.start_s <= timed_s.min() or params.end_s >= timed_s.max():
            return True
    flights = np.unique(links.flight[inside])
    return len(flights) == 1 and bool(
        inside[of_receiver & (links.flight == flights[0])].mean() > SAME_SHARE)


def _is_unique(links: Links, value_db: np.ndarray, weight: np.ndarray, rows: np.ndarray,
               inside: np.ndarray, nats: float) -> bool:
    """Check whether no other window of time differs as much from the usual level.

    By Student's t against windows of the same length; if there are fewer than `FEW_WINDOWS`, by the
    gain against the best other window of any length.
    """
    order = rows[np.lexsort((links.time_s[rows], links.flight[rows] * links.time_restarts))]
    during = inside[order]
    others = order[~during]
    windows = int(len(others) // during.sum())
    if windows < FEW_WINDOWS:
        other = _strongest(links, value_db, weight, others)
        return other is None or nats > GAIN_RATIO * max(other.nats, MIN_NATS)
    usual_db = mean_by_precision(value_db[others], weight[others])

    def deviation(rows: np.ndarray) -> float:
        """Compute the mean deviation over its sd for independent links (windows differ in size)."""
        return float(weight[rows] @ (value_db[rows] - usual_db)
                     / np.sqrt(max(weight[rows].sum(), 1e-9)))

    usual = np.array([deviation(window) for window in np.array_split(others, windows)])
    change = abs(deviation(order[during]) - float(usual.mean()))
    sd = max(float(usual.std(ddof=1)), MIN_DEVIATION_SD) * np.sqrt(1 + 1 / windows)
    return bool(2 * t.sf(change / sd, windows - 1) * (windows + 1) <= MAX_P_VALUE)
