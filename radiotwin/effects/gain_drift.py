"""A receiver or a device whose gain changes in time: it warms up, it ages, or something in it changed at one moment.

Warm-up as a first-order thermal lag, A exp(−t / τ) from switch-on (amplifier gain falls linearly with temperature, and
temperature follows first-order cooling); ageing as a slope in time; a step at an unknown time (two means, Hinkley 1970,
'Inference about the change-point in a sequence of random variables', Biometrika 57).
"""

from typing import ClassVar

import numpy as np

from radiotwin.effects.base import Effect, Parameter, Setting, Term, Variation, View, measured

LEAST_LINKS = 60
LEAST_FLIGHTS = 3
MOST_DEVICES = 200
LEAST_NATS = 5.0
LEAST_SIDE = 20  # links before and after a step
SPREAD_DB = 10.0
TIME_CONSTANTS_S = (5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0)
WARMING = ("warm_up", "warm_up_each_flight")
MOST_TRIED = 2  # receivers: how much a drift explains shows when all else is fitted again
CLEARLY = 3.0  # standard deviations
STEP_PENALTY = 1.0  # times log of the places where it may be


class _Drift(Effect):
    """The one of several forms that explains an end of links best; one step finds one end.

    Class attributes:
        forms: that it may have.
        ends: what its setting calls them.
    """

    repeatable = True
    forms: ClassVar[tuple[str, ...]]
    ends: ClassVar[str]

    def __init__(self, steps_only: bool = False):
        self._forms = ("step",) if steps_only else self.forms

    def index(self, records) -> np.ndarray:
        """(n,) the end of each link."""
        raise NotImplementedError

    def _names(self, records) -> list[str]:
        raise NotImplementedError

    def _members(self, records) -> list[int]:
        """Ends that may drift."""
        return measured(self.index(records)[np.isfinite(records.time_s)], LEAST_LINKS)

    def lacks(self, records) -> str | None:
        if np.isfinite(records.time_s).sum() < LEAST_LINKS:
            return "there is no time_s"
        return None

    def propose(self, view: View) -> list[dict]:
        known = {int(end) for kept in view.done(self.name, self.ends) for end in kept}
        return self._best(view, sorted(set(self._members(view.records)) - known))

    def propose_like(self, view: View, setting: dict) -> list[dict]:
        # Whether this end drifts is the question, and not whether any does.
        return self._best(view, [int(end) for end in setting[self.ends]])

    def _best(self, view: View, ends: list[int]) -> list[dict]:
        records, found = view.records, []
        for end in ends:
            rows = np.flatnonzero((self.index(records) == end) & np.isfinite(records.time_s))
            if not len(rows):  # a fold may have none of its links
                continue
            candidates = _forms(
                (records.time_s - records.first_s)[rows], records.time_s[rows], records.time_in_flight_s[rows],
                records.flight[rows], view.residual_db[rows], view.weight[rows])
            nats, form, number = max(each for each in candidates if each[1] in self._forms)
            if nats > LEAST_NATS:
                setting: Setting = {self.ends: {str(end): [form, float(number)]}}
                if form == "ageing" or not self.of_receiver:
                    # It is told from first to last, and other links are not to change these.
                    setting["span_s"] = [records.first_s, records.last_s]
                found.append((nats, setting))
        return [setting for _, setting in sorted(found, key=lambda each: -each[0])[:MOST_TRIED]]

    def term(self, records, setting, at) -> Term:
        columns, names = [], []
        index, ends, time_s = self.index(records), self._names(records), records.time_s
        if not self.of_receiver:  # is part of a map, too, which is of what things came to
            time_s = np.where(np.isnan(time_s), setting["span_s"][1], time_s)
        for end, (form, number) in setting[self.ends].items():
            mine = (index == int(end)) & np.isfinite(time_s)
            columns.append(np.where(mine, _shape(form, number, time_s - records.first_s, time_s,
                                                 records.time_in_flight_s, setting.get("span_s")), 0.0))
            # An offset of its own, or the drift would have to stand for a constant error, too.
            columns.append(mine.astype(float))
            names += [form, f"offset[{ends[int(end)]}]"]
        return Term.of_columns(np.column_stack(columns), SPREAD_DB, names)

    def vary(self, setting) -> Variation | None:
        warming = [end for end, (form, _) in setting[self.ends].items() if form in WARMING]
        if not warming:
            return None
        values = np.log([setting[self.ends][end][1] for end in warming])

        def again(numbers: np.ndarray) -> dict:
            changed = {end: [setting[self.ends][end][0], float(np.exp(number))]
                       for end, number in zip(warming, numbers)}
            return setting | {self.ends: setting[self.ends] | changed}
        return Variation(values, np.full(len(values), 0.3), np.full(len(values), 0.0), np.full(len(values), 9.0), again)

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        result, warming = {}, 0
        for number, (end, (form, value)) in enumerate(setting[self.ends].items()):
            name = self._names(records)[int(end)]
            size, deviation = found.coefficients[2 * number], found.deviations[2 * number]
            result[f"{form}_db[{name}]"] = Parameter.normal(size, deviation, "dB")
            if form in WARMING:
                spread = found.setting_deviations[warming]
                warming += 1
                low, high = value * np.exp([-1.645 * spread, 1.645 * spread])
                result[f"time_constant_s[{name}]"] = Parameter(value, float(low), float(high), "s")
            elif form == "step":
                result[f"step_time_s[{name}]"] = Parameter(value, value, value, "s")
        return result


class ReceiverDrift(_Drift):
    """A receiver that warms up, once or on each flight, ages, or has changed."""

    name = "receiver_drift"
    of_receiver = True
    confused_with = ("receiver_gain_offset", "interference")
    forms = ("warm_up", "warm_up_each_flight", "ageing", "step")
    ends = "receivers"

    def index(self, records) -> np.ndarray:
        return records.receiver

    def _names(self, records) -> list[str]:
        return records.receiver_names


class DeviceDrift(_Drift):
    """A device whose battery sinks or that has changed. Within a flight a change of time is one of place, so it must
    have been heard on some."""

    name = "device_drift"
    confused_with = ("device_gain_offset", "device_position_error")
    forms = ("ageing", "step")
    ends = "devices"

    def index(self, records) -> np.ndarray:
        return records.device

    def _names(self, records) -> list[str]:
        return records.device_names

    def _members(self, records) -> list[int]:
        flights = np.unique(np.column_stack([records.device, records.flight]), axis=0)[:, 0]
        return sorted(set(super()._members(records)) & set(measured(flights, LEAST_FLIGHTS)))

    def lacks(self, records) -> str | None:
        members = self._members(records)
        if len(members) > MOST_DEVICES:
            return f"{len(members)} devices are too many to ask each; at most {MOST_DEVICES}"
        no_device = None if members else f"no device has {LEAST_LINKS} links on {LEAST_FLIGHTS} flights"
        return super().lacks(records) or no_device


def _shape(form: str, number: float, since_first_s: np.ndarray, time_s: np.ndarray,
           time_in_flight_s: np.ndarray, span_s: list[float] | None = None) -> np.ndarray:
    if form == "warm_up":
        return np.exp(-since_first_s / number)
    if form == "warm_up_each_flight":
        return np.exp(-time_in_flight_s / number)
    if form == "step":
        return (time_s >= number).astype(float)
    low, high = span_s or (np.nanmin(time_s), np.nanmax(time_s))  # twins of version 0.1 do not tell
    return (time_s - number) / max(high - low, 1.0)


def _forms(since_first_s, time_s, time_in_flight_s, flight, residual_db, weight):
    """(nats, form, number) of each form that the times allow."""
    yield 0.0, "step", float(time_s.mean())

    def nats(shape):
        centred = shape - weight @ shape / weight.sum()
        power = weight @ centred**2
        return 0.0 if power < 1e-9 else 0.5 * (weight @ (centred * residual_db)) ** 2 / (power + 1 / SPREAD_DB**2)

    if np.ptp(time_s) > 0:
        yield nats((time_s - time_s.mean()) / np.ptp(time_s)), "ageing", float(time_s.mean())
    for constant in TIME_CONSTANTS_S:
        for form, since_s in (("warm_up", since_first_s), ("warm_up_each_flight", time_in_flight_s)):
            if constant < np.ptp(since_s):
                yield nats(np.exp(-since_s / constant)), form, constant
    order = np.argsort(time_s, kind="stable")
    sums = np.cumsum(weight[order]), np.cumsum((weight * residual_db)[order])
    places = np.flatnonzero(np.diff(time_s[order]) > 0)
    places = places[(places >= LEAST_SIDE) & (places < len(order) - LEAST_SIDE)]
    if len(places):
        total, moment = sums[0][-1], sums[1][-1]
        before, moment_before = sums[0][places], sums[1][places]
        gap = moment_before / before - (moment - moment_before) / (total - before)
        value = 0.5 * gap**2 * before * (total - before) / total - STEP_PENALTY * np.log(len(places))
        best = int(value.argmax())
        when = 0.5 * (time_s[order][places[best]] + time_s[order][places[best] + 1])
        if abs(gap[best]) > CLEARLY * _spread_of_flights_db(time_s >= when, flight, residual_db, weight):
            yield float(value[best]), "step", float(when)


def _spread_of_flights_db(after, flight, residual_db, weight) -> float:
    """Standard deviation of the gap between two means [dB], from how much flights on one side of the step differ."""
    side = np.unique(np.column_stack([flight, after]), axis=0, return_inverse=True)[1].ravel()
    mass = np.bincount(side, weights=weight)
    mean = np.bincount(side, weights=weight * residual_db) / mass
    later = np.bincount(side, weights=weight * after) > 0.5 * mass
    counts = [max((later == which).sum(), 1) for which in (False, True)]
    rest = mean - np.where(later, mean[later].mean(), mean[~later].mean())
    freedom = max(len(mean) - 2, 1)
    return float(np.sqrt((rest**2).sum() / freedom * (1 / counts[0] + 1 / counts[1])))
