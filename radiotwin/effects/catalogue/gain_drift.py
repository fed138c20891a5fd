"""`receiver_drift`, `device_drift`: a gain that changes with time, by warm-up, ageing or a step.

Warm-up as a first-order thermal lag, A exp(−t / τ) since switch-on (amplifier gain falls linearly
with temperature, and temperature follows first-order cooling); ageing as a slope in time; a step at
an unknown time (two means, Hinkley 1970, 'Inference about the change-point in a sequence of random
variables', Biometrika 57).
"""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator, Field
from typing_extensions import override

from radiotwin.effects.arrays import MIN_LINKS, MIN_NATS, frequent_labels
from radiotwin.effects.base import Effect, GainEffect, LevelAt, ResidualView, Term
from radiotwin.effects.params import (
    Allowed,
    DeviceIndex,
    EffectParams,
    Estimate,
    Parameter,
    ReceiverIndex,
    Seconds,
    Variation,
)
from radiotwin.effects.patterns import Pattern, timed_members
from radiotwin.links import Links
from radiotwin.links.sites import inseparable_end

MIN_FLIGHTS = 3  # of a device: within a flight, time and position change together
MAX_DEVICES = 200  # bounds the time of the search
MIN_SIDE = 20  # least number of links before and after a step
MIN_GAP_SD = 3.0  # least size of a step [standard deviations between flights]
MAX_PROPOSALS = 2  # receivers or devices proposed in one step of the search
PRIOR_SD_DB = 10.0  # of the amplitude, and of a constant beside it
MAX_LOG_S = 9.0  # natural logarithm of the longest time constant [s]
TIME_CONSTANTS_S = (5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0)  # trial values
MIN_CONSTANT_S = 1e-3  # least time constant that is accepted in a twin's file
WARM_UPS = ("warm_up", "warm_up_each_flight")


class Drift(NamedTuple):
    """Form of a drift in time.

    Attributes:
        form: warm-up since the first measurement or since each take-off, ageing, or a step.
        number: time constant of a warm-up, mid-time of ageing, or time of the step [s].
    """

    form: Literal["warm_up", "warm_up_each_flight", "ageing", "step"]
    number: Seconds


def _check_constants(drifts: dict[int, Drift]) -> dict[int, Drift]:
    """Raise if a warm-up has a time constant below `MIN_CONSTANT_S`."""
    if any(drift.form in WARM_UPS and drift.number < MIN_CONSTANT_S for drift in drifts.values()):
        raise ValueError(f"a warm-up takes {MIN_CONSTANT_S:g} s or more")
    return drifts


class _DriftParams(EffectParams):
    span_s: tuple[Seconds, Seconds] | None = Field(
        None, description="First and last time that was learnt from [s]; ageing is relative to it.")


class _GainDrift(GainEffect):
    """Base of drifts: one receiver or device, in the form that fits its links best."""

    repeatable = True
    parameter_labels = {"warm_up_db": "excess at switch-on",
                        "warm_up_each_flight_db": "excess at take-off",
                        "ageing_db": "change from first to last", "step_time_s": "time of the step",
                        "time_constant_s": "time constant"}
    forms: ClassVar[tuple[str, ...]]  # that are allowed
    end: ClassVar[str]  # "receiver" or "device"
    params: _DriftParams

    def __init__(self, between_flights: bool = False) -> None:
        """Make the effect; `between_flights` restricts it to changes between flights."""
        super().__init__()
        self._between_flights = between_flights

    def index(self, links: Links) -> np.ndarray:
        """Return the index (n,) of each link's receiver, or device."""
        return getattr(links, self.end)

    def drifts(self) -> dict[int, Drift]:
        """Return index of the receiver, or device -> its drift."""
        return getattr(self.params, f"{self.end}s")

    @override
    def between_flights(self) -> Effect:
        return type(self)(between_flights=True)

    @override
    def untold(self, links: Links, train: np.ndarray) -> np.ndarray:
        """Return (n,) bool, links with no training link between them and the step or warm-up.

        A warm-up counts as a change at its time constant, when two thirds of it are over.
        """
        found = np.zeros(len(links), dtype=bool)
        for member, (form, number) in self.drifts().items():
            if form not in ("step", "warm_up"):  # others show in every flight
                continue
            when_s = number + (links.first_s if form == "warm_up" else 0.0)
            of_member = (self.index(links) == member) & np.isfinite(links.time_s)
            learnt_s = np.sort(links.time_s[of_member & train & np.isfinite(links.level_db)])
            first = np.searchsorted(learnt_s, np.minimum(links.time_s, when_s), side="left")
            last = np.searchsorted(learnt_s, np.maximum(links.time_s, when_s), side="right")
            found |= of_member & (first == last)
        return found

    def _members(self, links: Links) -> list[int]:
        """List the receivers, or devices, with enough links."""
        return frequent_labels(self.index(links)[np.isfinite(links.time_s)], MIN_LINKS)

    @override
    def unavailable(self, links: Links) -> str | None:
        """Return why no drift can be searched (no times, or flights have no order); else None."""
        if np.isfinite(links.time_s).sum() < MIN_LINKS:
            return "there is no time_s"
        if links.time_restarts and (self._between_flights
                                    or "warm_up_each_flight" not in self.forms):
            return "time_s begins anew in each flight, so that flights have no order"
        return None

    @override
    def propose(self, view: ResidualView) -> list[Any]:
        known = {member for drifts in view.found_params(self.name, f"{self.end}s")
                 for member in drifts}
        return self._proposals(view, sorted(set(self._members(view.links)) - known))

    @override
    def propose_for_fold(self, view: ResidualView) -> list[Any]:
        # The fold must confirm the drift of this member, not of any other.
        return self._proposals(view, list(self.drifts()))

    def _proposals(self, view: ResidualView, members: list[int]) -> list[Any]:
        """Propose the likeliest drift of each receiver (or device), `MAX_PROPOSALS` at most."""
        links, found = view.links, []
        for member in members:
            rows = np.flatnonzero((self.index(links) == member) & np.isfinite(links.time_s))
            if not len(rows):  # a fold may have none of its links
                continue
            nats, form, number = max(
                candidate for candidate in _candidates(
                    links.select(rows), view.residual_db[rows], view.weight[rows],
                    self._between_flights) if candidate[1] in self.forms)
            # What fits best as a warm-up on each flight is no change between flights. A receiver
            # that has both is given the warm-up alone.
            if nats > MIN_NATS and not (self._between_flights and form == "warm_up_each_flight"):
                # The drift must not depend on the times of the links that it is applied to.
                keep = form == "ageing" or not self.of_receiver
                span_s = (links.first_s, links.last_s) if keep else None
                found.append((nats, self.Params.model_validate(
                    {f"{self.end}s": {member: (form, float(number))}, "span_s": span_s})))
        return [params for _, params in sorted(found, key=lambda pair: -pair[0])[:MAX_PROPOSALS]]

    @override
    def term(self, links: Links, level_at: LevelAt) -> Term:
        """Return each drift's course in time and a constant, both of fitted size [dB]."""
        params = self.params
        columns, time_s = [], links.time_s
        if not self.of_receiver and params.span_s:  # a map, without times, shows the latest state
            time_s = np.where(np.isnan(time_s), params.span_s[1], time_s)
        for member, drift in self.drifts().items():
            rows = (self.index(links) == member) & np.isfinite(time_s)
            columns.append(np.where(rows, _shape(drift, links, time_s, params.span_s), 0.0))
            # Plus a constant, or the drift would have to model a constant error, too.
            columns.append(rows.astype(float))
        return Term.of_columns(np.column_stack(columns), PRIOR_SD_DB)

    @override
    def variation(self) -> Variation | None:
        """Return the log time constants of warm-ups for the search; None if there is no warm-up."""
        drifts = self.drifts()
        warming = [member for member, drift in drifts.items() if drift.form in WARM_UPS]
        if not warming:
            return None
        values, n = np.log([drifts[member].number for member in warming]), len(warming)

        def varied(numbers: np.ndarray) -> _GainDrift:
            new = {member: drifts[member]._replace(number=float(np.exp(number)))
                   for member, number in zip(warming, numbers)}
            return self.changed(**{f"{self.end}s": drifts | new})

        return Variation(values, np.full(n, 0.3), np.full(n, 0.0), np.full(n, MAX_LOG_S), varied)

    @override
    def rivals(self, links: Links, parameters: Mapping[str, Parameter]) -> list[str]:
        other = inseparable_end(links, self.end, set(self.drifts()))
        return [] if other is None else [self.name.replace(self.end, other)]

    @override
    def typical_patterns(self, view: ResidualView) -> Iterator[Pattern]:
        """Yield a rise of 1 dB from first to last time of one receiver or device, for several."""
        time_s = view.links.time_s
        for mask in timed_members(view.links, self.index(view.links)):
            first_s, last_s = np.nanmin(time_s[mask]), np.nanmax(time_s[mask])
            ramp = np.nan_to_num((time_s - first_s) / (last_s - first_s))
            yield Pattern(self.end, "dB", f"from first to last of one {self.end}", mask * ramp)

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        """Report each drift's amplitude [dB], and its time constant or time of step [s]."""
        result, names = {}, getattr(links, f"{self.end}_names")
        log_sd = iter(estimate.params_sd)
        for number, (member, (form, value)) in enumerate(self.drifts().items()):
            name = names[member]
            result[f"{form}_db[{name}]"] = Parameter.normal(
                estimate.coefficients[2 * number], estimate.coefficients_sd[2 * number], "dB")
            if form in WARM_UPS:
                result[f"time_constant_s[{name}]"] = Parameter.log_normal(
                    value, next(log_sd), "s", Allowed(1.0, float(np.exp(MAX_LOG_S)), is_log=True))
            elif form == "step":
                result[f"step_time_s[{name}]"] = Parameter(
                    value, *_gap_s(links, self.index(links) == member, value), "s")
        return result


class ReceiverDrift(_GainDrift):
    """A receiver whose gain changes by warm-up (once or on each flight), ageing or a step."""

    name = "receiver_drift"
    in_words = "gain of the receiver that changes with time"
    acts_on = ("receiver", "receiver x flight", "time")
    settled_by = "return to the same places at other times"
    of_receiver = True
    confused_with = ("receiver_gain_offset", "interference")
    forms = ("warm_up", "warm_up_each_flight", "ageing", "step")
    end = "receiver"

    class Params(_DriftParams):
        """Drifts of receivers."""

        receivers: Annotated[dict[ReceiverIndex, Drift], AfterValidator(_check_constants)] = Field(
            min_length=1, description="Drift of each receiver, by index.")

    params: Params


class DeviceDrift(_GainDrift):
    """A device whose power changes by ageing (a battery that discharges) or a step."""

    name = "device_drift"
    in_words = "power of the device that changes with time"
    acts_on = ("device", "device x flight", "time")
    settled_by = "return to the same places at other times"
    confused_with = ("device_gain_offset", "device_position_error")
    forms = ("ageing", "step")
    end = "device"

    class Params(_DriftParams):
        """Drifts of devices."""

        devices: Annotated[dict[DeviceIndex, Drift], AfterValidator(_check_constants)] = Field(
            min_length=1, description="Drift of each device, by index.")

    params: Params

    @override
    def _members(self, links: Links) -> list[int]:
        flights = np.unique(np.column_stack([links.device, links.flight]), axis=0)[:, 0]
        return sorted(set(super()._members(links)) & set(frequent_labels(flights, MIN_FLIGHTS)))

    @override
    def unavailable(self, links: Links) -> str | None:
        """Return why no device can be tested (too many, too few links or flights); else None."""
        members = self._members(links)
        if len(members) > MAX_DEVICES:
            return f"{len(members)} devices are too many to examine each; at most {MAX_DEVICES}"
        return super().unavailable(links) or (
            None if members else f"no device has {MIN_LINKS} links on {MIN_FLIGHTS} flights")


def _shape(drift: Drift, links: Links, time_s: np.ndarray,
           span_s: tuple[float, float] | None) -> np.ndarray:
    """Compute drifts (n,) of amplitude 1 at times (n,) [s]; ageing rises by 1 over `span_s`."""
    form, number = drift
    if form == "warm_up":
        return np.exp(-(time_s - links.first_s) / number)
    if form == "warm_up_each_flight":
        return np.exp(-links.time_in_flight_s / number)
    if form == "step":
        return (time_s >= number).astype(float)
    low, high = span_s or (np.nanmin(time_s), np.nanmax(time_s))  # a twin's file may lack the span
    return (time_s - number) / max(high - low, 1.0)


def _gap_s(links: Links, rows: np.ndarray, when_s: float) -> tuple[float, float]:
    """Return the times [s] of the last reading before a step and the first after; else `when_s`."""
    time_s = links.time_s[rows & np.isfinite(links.time_s) & np.isfinite(links.level_db)]
    before, after = time_s[time_s < when_s], time_s[time_s >= when_s]
    return (float(before.max()) if len(before) else when_s,
            float(after.min()) if len(after) else when_s)


def _candidates(links: Links, residual_db: np.ndarray, weight: np.ndarray,
                between_flights: bool) -> Iterator[tuple[float, str, float]]:
    """Yield (gain [nats], form, number) of drifts that a receiver's or device's times allow.

    The number is a time constant or a time [s]. The first one is a step without any gain. Of steps
    only the likeliest is yielded, if it exceeds the scatter of flights. `between_flights` restricts
    steps to times between flights: within a flight, position changes with time. Clocks that restart
    in each flight allow only warm-ups on each flight.
    """
    time_s, comparable = links.time_s, not links.time_restarts
    yield 0.0, "step", float(time_s.mean())

    def nats(shape: np.ndarray) -> float:
        centred = shape - weight @ shape / weight.sum()
        power = weight @ centred**2
        if power < 1e-9:
            return 0.0
        return 0.5 * (weight @ (centred * residual_db)) ** 2 / (power + 1 / PRIOR_SD_DB**2)

    if np.ptp(time_s) > 0 and comparable:
        yield nats((time_s - time_s.mean()) / np.ptp(time_s)), "ageing", float(time_s.mean())
    for constant_s in TIME_CONSTANTS_S:
        for form, since_s in zip(WARM_UPS, (time_s - links.first_s, links.time_in_flight_s)):
            if constant_s < np.ptp(since_s) and (comparable or form == "warm_up_each_flight"):
                yield nats(np.exp(-since_s / constant_s)), form, constant_s
    order = np.argsort(time_s, kind="stable")
    sums = np.cumsum(weight[order]), np.cumsum((weight * residual_db)[order])
    gaps = np.flatnonzero(np.diff(time_s[order]) > 0)
    gaps = gaps[(gaps >= MIN_SIDE) & (gaps < len(order) - MIN_SIDE)]
    if between_flights:
        flight = links.flight[order]
        gaps = gaps[flight[gaps] != flight[gaps + 1]]
    if len(gaps) and comparable:
        total, moment = sums[0][-1], sums[1][-1]
        before, moment_before = sums[0][gaps], sums[1][gaps]
        step_db = moment_before / before - (moment - moment_before) / (total - before)
        # The logarithm is the penalty for the choice among the gaps.
        value = 0.5 * step_db**2 * before * (total - before) / total - np.log(len(gaps))
        best = int(value.argmax())
        when_s = 0.5 * (time_s[order][gaps[best]] + time_s[order][gaps[best] + 1])
        sd_db = _step_sd_db(time_s >= when_s, links.flight, residual_db, weight)
        if abs(step_db[best]) > MIN_GAP_SD * sd_db:
            yield float(value[best]), "step", float(when_s)


def _step_sd_db(after: np.ndarray, flight: np.ndarray, residual_db: np.ndarray,
                weight: np.ndarray) -> float:
    """Estimate the standard deviation of a step from the scatter of flights on each side [dB]."""
    cell = np.unique(np.column_stack([flight, after]), axis=0, return_inverse=True)[1].ravel()
    mass = np.bincount(cell, weights=weight)
    mean = np.bincount(cell, weights=weight * residual_db) / mass
    later = np.bincount(cell, weights=weight * after) > 0.5 * mass
    counts = [max((later == which).sum(), 1) for which in (False, True)]
    deviation_db = mean - np.where(later, mean[later].mean(), mean[~later].mean())
    freedom = max(len(mean) - 2, 1)
    return float(np.sqrt((deviation_db**2).sum() / freedom * (1 / counts[0] + 1 / counts[1])))
