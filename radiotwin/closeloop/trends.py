"""`unexplained_trend`, a last resort: the residual as a smooth curve over whatever it still depends on.

It explains nothing: it says on which variable the rest depends, and how. It is no candidate among the effects, because
it would fit part of whatever they stand for; and a map, which has no heading and no time, is drawn without it.
"""

import numpy as np

from radiotwin.closeloop.structure import variables
from radiotwin.effects.base import Effect, Parameter, Remembered, Term, View

KNOTS = 8
SPREAD_DB = 5.0
MOST_CURVES = 10
LEAST_KNOWN = 0.5  # share of the links whose value is known
CIRCULAR = ("azimuth_deg", "body_azimuth_deg", "heading_deg")


class UnexplainedTrend(Effect):
    """A curve over one variable, one for all receivers or one for each."""

    name = "unexplained_trend"
    nlos_only = True  # may be: what it stands for is not known
    of_receiver = True
    explains = False

    def __init__(self, variable: str):
        self.variable = variable
        self.variant = f"over {variable}"  # type: ignore[misc]  # one class stands for every variable
        self._values = Remembered()

    def propose(self, view: View) -> list[dict]:
        value = self._value(view.records, view.at)
        known = np.isfinite(value)
        if known.mean() < LEAST_KNOWN or np.ptp(value[known]) < 1e-9:
            return []
        receivers = [int(receiver) for receiver in np.unique(view.records.receiver)]
        every = [None], *([receivers] if 1 < len(receivers) <= MOST_CURVES else [])
        knots = _knots(self.variable, value[known])

        def rating(setting: dict) -> float:
            term = self.term(view.records, setting, view.at)
            return view.score(term) - term.columns.shape[1]  # (Akaike 1974)
        return [max(({"knots": knots, "receivers": members} for members in every), key=rating)]

    def term(self, records, setting, at) -> Term:
        hats = _hats(self._value(records, at), np.array(setting["knots"]), self.variable in CIRCULAR)
        columns = [hats if member is None else hats * (records.receiver == member)[:, None]
                   for member in setting["receivers"]]
        return Term.of_columns(np.hstack(columns), SPREAD_DB, [""] * len(columns) * hats.shape[1])

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        curves = np.reshape(found.coefficients, (len(setting["receivers"]), -1))
        result = {}
        for member, curve in zip(setting["receivers"], curves):
            whose = [self.variable, *([] if member is None else [records.receiver_names[member]])]
            result[f"rise_and_fall_db[{', '.join(whose)}]"] = Parameter(float(np.ptp(curve)), np.nan, np.nan, "dB")
        return result

    def _value(self, records, at) -> np.ndarray:
        return self._values.of(records, at, lambda: variables(records, at(records))[self.variable])


def _knots(name: str, value: np.ndarray) -> list[float]:
    if name in CIRCULAR:
        return [float(knot) for knot in np.arange(KNOTS) * 360.0 / KNOTS]
    return [float(knot) for knot in np.unique(np.quantile(value, (np.arange(KNOTS) + 0.5) / KNOTS))]


def _hats(value: np.ndarray, knots: np.ndarray, circular: bool) -> np.ndarray:
    """(n, knots) how much each link belongs to each knot: linear in between, constant beyond; zero where unknown."""
    known = np.isfinite(value)
    at = np.where(known, value, knots[0])
    if circular:
        place = at % 360 / 360 * len(knots)
        left = np.floor(place).astype(int) % len(knots)
        right, share = (left + 1) % len(knots), place % 1
    else:
        place = np.interp(at, knots, np.arange(len(knots)))
        left = np.minimum(np.floor(place).astype(int), len(knots) - 1)
        right, share = np.minimum(left + 1, len(knots) - 1), place - left
    hats = np.zeros((len(value), len(knots)))
    rows = np.arange(len(value))
    np.add.at(hats, (rows, left), 1 - share)
    np.add.at(hats, (rows, right), share)
    return hats * known[:, None]
