"""An unknown emitter somewhere adds its power to whatever receivers read: the more, the closer they are to it.

Powers of signal and interference add (ITU-R SM.1753), and that of the emitter falls by the free-space law, 20 log10 d
(ITU-R P.525). It depends on the place of the receiver only. The emitter is taken to stand on the ground.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from radiotwin.effects.base import NEPERS, Effect, Parameter, Term, Variation, View, some
from radiotwin.effects.noise_floor import with_power

LEAST_PLACES = 20
PLACE_M = 10.0  # places closer together count as one
HEIGHT_M = 1.5
REFERENCE_M = 100.0
AROUND_M = 100.0  # farther from all receivers it would be the same for each of them: a noise floor
EDGE_M = 10.0
CELLS = 300
FINEST_M = 20.0
QUANTILES = (0.05, 0.2, 0.4, 0.6, 0.8)  # of the levels, for the emitter's
ENOUGH_LINKS = 2000
STARTS = 2
APART_M = 60.0
LEAST_NATS = 4.0


class Interference(Effect):
    """One emitter that all receivers hear."""

    name = "interference"
    of_receiver = True
    stage = "receiver"
    confused_with = ("noise_floor_censoring", "receiver_drift")

    def lacks(self, records) -> str | None:
        places = np.unique((records.receiver_m[:, :2] / PLACE_M).round(), axis=0)
        if len(places) < LEAST_PLACES:
            return f"receivers were in {len(places)} places; {LEAST_PLACES} are needed to see where an emitter stands"
        return None

    def propose(self, view: View) -> list[dict]:
        records = view.records
        low, high = records.receiver_m[:, :2].min(axis=0) - AROUND_M, records.receiver_m[:, :2].max(axis=0) + AROUND_M
        step_m = max(FINEST_M, float(np.sqrt(np.prod(high - low) / CELLS)))
        places = np.stack(np.meshgrid(*(np.arange(a, b, step_m) for a, b in zip(low, high))), axis=-1).reshape(-1, 2)
        levels_db = np.nanquantile(records.level_db, QUANTILES)
        rows = some(np.arange(len(records)), ENOUGH_LINKS)
        nats = _gain_of_places(view, rows, places, levels_db) * len(records) / len(rows)
        found: list[dict] = []
        for number in np.argsort(-nats.max(axis=1)):
            if nats[number].max() < LEAST_NATS or len(found) == STARTS:
                break
            if all(np.hypot(*(places[number] - other["place_m"])) > APART_M for other in found):
                found.append({"place_m": [float(v) for v in places[number]],
                              "level_db": float(levels_db[nats[number].argmax()]),
                              "within_m": [float(v) for v in (*low, *high)]})
        return found

    def term(self, records, setting, at) -> Term:
        nothing = Term.of_offset(np.zeros(len(records)))
        power_db = interference_db(records.receiver_m, setting["place_m"], setting["level_db"])
        return replace(nothing, extra=np.exp(power_db * NEPERS))

    def bend(self, level_db, setting, extra):
        return with_power(level_db, extra)

    def vary(self, setting) -> Variation:
        level_db, within_m = setting["level_db"], np.array(setting["within_m"])
        return Variation(
            np.array([*setting["place_m"], level_db]), np.array([20.0, 20.0, 3.0]),
            np.array([*within_m[:2], level_db - 40]), np.array([*within_m[2:], level_db + 40]),
            lambda numbers: setting | {"place_m": [float(v) for v in numbers[:2]], "level_db": float(numbers[2])})

    def unphysical(self, setting, coefficients) -> str | None:
        low, high = np.reshape(setting["within_m"], (2, 2))
        if (np.minimum(setting["place_m"] - low, high - setting["place_m"]) < EDGE_M).any():
            return "the emitter would stand at the edge of what is searched, or beyond: its place is not told"
        return None

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        values = zip(("x_m", "y_m", f"level_at_{REFERENCE_M:.0f}_m"), (*setting["place_m"], setting["level_db"]),
                     found.setting_deviations, ("m", "m", "dB" if records.is_gain else "dBm"))
        return {name: Parameter.normal(value, spread, unit) for name, value, spread, unit in values}


def interference_db(receiver_m: np.ndarray, place_m: Sequence[float], level_db: float) -> np.ndarray:
    """(n,) level of an emitter at receivers.

    Args:
        receiver_m: (n, 3) [m].
        place_m: x and y of the emitter [m].
        level_db: at `REFERENCE_M`.
    """
    distance_m = np.linalg.norm(receiver_m - [*place_m, HEIGHT_M], axis=1)
    return level_db - 20 * np.log10(np.maximum(distance_m, 1.0) / REFERENCE_M)


def _gain_of_places(view: View, rows: np.ndarray, places: np.ndarray, levels_db: np.ndarray) -> np.ndarray:
    """(places, levels) half of the drop of the weighted squares of some links [nats], after a level and a slope for
    each class of line of sight are fitted: the base's have taken up part of the interference."""
    part = view.records.select(rows)
    root = np.sqrt(view.weight[rows])
    decades = np.log10(part.distance_m)
    columns = np.column_stack([part.los, part.los * decades, ~part.los, ~part.los * decades]) * root[:, None]
    basis, size, _ = np.linalg.svd(columns, full_matrices=False)
    basis = basis[:, size > 1e-9 * size[0]]
    target = root * view.residual_db[rows]
    target = target - basis @ (basis.T @ target)
    nats = np.empty((len(places), len(levels_db)))
    for number, place_m in enumerate(places):
        power_db = interference_db(part.receiver_m, place_m, 0.0) + levels_db[:, None]
        rise = root * 10 * np.log10(1 + 10 ** ((power_db - view.mean_db[rows]) / 10))
        rise = rise - (rise @ basis) @ basis.T
        nats[number] = rise @ target - 0.5 * (rise**2).sum(axis=1)
    return nats
