"""A receiver whose gain changes in time: it warms up, it ages, or something in it changed at one moment.

Warm-up as a first-order thermal lag, A exp(−t / τ) from switch-on (amplifier gain falls linearly with temperature, and
temperature follows first-order cooling); ageing as a slope in time; a step at an unknown time (two means, Hinkley 1970,
'Inference about the change-point in a sequence of random variables', Biometrika 57).
"""


import numpy as np

from radiotwin.effects.base import Effect, Parameter, Setting, Term, Variation, View, measured

LEAST_LINKS = 60
LEAST_NATS = 5.0
LEAST_SIDE = 20  # links before and after a step
SPREAD_DB = 10.0
TIME_CONSTANTS_S = (5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0)
WARMING = ("warm_up", "warm_up_each_flight")
MOST_TRIED = 2  # receivers: how much a drift explains shows when all else is fitted again
CLEARLY = 3.0  # standard deviations
STEP_PENALTY = 1.0  # times log of the places where it may be


class ReceiverDrift(Effect):
    """The one of three forms that explains a receiver best; one step finds one receiver."""

    name = "receiver_drift"
    of_receiver = True
    repeatable = True
    confused_with = ("receiver_gain_offset", "interference")

    def __init__(self, steps_only: bool = False):
        self._steps_only = steps_only

    def lacks(self, records) -> str | None:
        if np.isfinite(records.time_s).sum() < LEAST_LINKS:
            return "there is no time_s"
        return None

    def propose(self, view: View) -> list[dict]:
        receivers = measured(view.records.receiver[np.isfinite(view.records.time_s)], LEAST_LINKS)
        known = {int(receiver) for kept in view.done(self.name, "receivers") for receiver in kept}
        return self._best(view, sorted(set(receivers) - known))

    def propose_like(self, view: View, setting: dict) -> list[dict]:
        # Whether this receiver drifts is the question, and not whether any does.
        return self._best(view, [int(receiver) for receiver in setting["receivers"]])

    def _best(self, view: View, receivers: list[int]) -> list[dict]:
        records, found = view.records, []
        for receiver in receivers:
            rows = np.flatnonzero((records.receiver == receiver) & np.isfinite(records.time_s))
            candidates = _forms(
                (records.time_s - records.first_s)[rows], records.time_s[rows], records.time_in_flight_s[rows],
                records.flight[rows], view.residual_db[rows], view.weight[rows])
            nats, form, number = max(each for each in candidates if each[1] == "step" or not self._steps_only)
            if nats > LEAST_NATS:
                setting: Setting = {"receivers": {str(receiver): [form, float(number)]}}
                if form == "ageing":  # is told from first to last, which other links are not to change
                    setting["span_s"] = [records.first_s, records.last_s]
                found.append((nats, setting))
        return [setting for _, setting in sorted(found, key=lambda each: -each[0])[:MOST_TRIED]]

    def term(self, records, setting, at) -> Term:
        columns, names = [], []
        for receiver, (form, number) in setting["receivers"].items():
            mine = (records.receiver == int(receiver)) & np.isfinite(records.time_s)
            columns.append(np.where(mine, _shape(form, number, records.time_s - records.first_s, records.time_s,
                                                 records.time_in_flight_s, setting.get("span_s")), 0.0))
            # An offset of its own, or the drift would have to stand for a constant error, too.
            columns.append(mine.astype(float))
            names += [form, f"offset[{records.receiver_names[int(receiver)]}]"]
        return Term.of_columns(np.column_stack(columns), SPREAD_DB, names)

    def vary(self, setting) -> Variation | None:
        warming = [receiver for receiver, (form, _) in setting["receivers"].items() if form in WARMING]
        if not warming:
            return None
        values = np.log([setting["receivers"][receiver][1] for receiver in warming])

        def again(numbers: np.ndarray) -> dict:
            changed = {receiver: [setting["receivers"][receiver][0], float(np.exp(number))]
                       for receiver, number in zip(warming, numbers)}
            return setting | {"receivers": setting["receivers"] | changed}
        return Variation(values, np.full(len(values), 0.3), np.full(len(values), 0.0), np.full(len(values), 9.0), again)

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        result, warming = {}, 0
        for number, (receiver, (form, value)) in enumerate(setting["receivers"].items()):
            name = records.receiver_names[int(receiver)]
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
