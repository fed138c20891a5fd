"""Vegetation that no map shows.

Loss of d metres through it: A_m (1 − exp(−γ d / A_m)), which saturates (ITU-R P.833-10, Eq. 1). Its place is found by
back-projection. A grove that links of one device only pass cannot be placed along their rays: the box then says in
which direction it lies.
"""

import numpy as np

from radiotwin.effects.base import Effect, Parameter, Term, Variation, View
from radiotwin.effects.boxes import CELL_M, HEIGHTS_M, Box, back_project, best_cells, cross, lacks_nats
from radiotwin.effects.missing_obstacle import NAMES

LEAST_NATS = 6.0
LOWEST, HIGHEST = 3.0, 26.0  # tops of trees [m]
LOSSES_DB = (3.0, 6.0, 9.0, 12.0, 16.0, 20.0)
STARTS = 3
SIDES_M = (25.0, 55.0)
MOST_DB = 25.0  # what loses more is no vegetation
FIRST_LAW = (0.6, 15.0)  # specific attenuation [dB/m], greatest loss [dB]


class Foliage(Effect):
    """A box of vegetation; one step finds one."""

    name = "foliage"
    repeatable = True
    confused_with = ("missing_obstacle", "excess_attenuation", "device_gain_offset", "antenna_pattern")

    def propose(self, view: View) -> list[dict]:
        records = view.records
        nats = lacks_nats(view.residual_db, view.scale_db, LOSSES_DB) / view.design_effect
        centres_m, total = back_project(records.device_m[records.device], records.receiver_m, nats)
        allowed = [i for i, height in enumerate(HEIGHTS_M) if LOWEST <= height <= HIGHEST]
        return [{"box": [*map(float, centre_m), side, side, HEIGHTS_M[allowed[height]], 0.0], "law": list(FIRST_LAW)}
                for centre_m, height, nats in best_cells(centres_m, total[:, allowed], STARTS) if nats > LEAST_NATS
                for side in SIDES_M]

    def term(self, records, setting, at) -> Term:
        crossing = cross(Box(*setting["box"]), records.device_m[records.device], records.receiver_m)
        specific_db_m, most_db = setting["law"]
        return Term.of_offset(-most_db * (1 - np.exp(-crossing.inside_m * specific_db_m / most_db)))

    def vary(self, setting) -> Variation:
        x_m, y_m = setting["box"][:2]
        return Variation(
            np.array([*setting["box"], *np.log(setting["law"])]),
            np.array([CELL_M, CELL_M, 12.0, 12.0, 3.0, 20.0, 0.4, 0.3]),
            np.array([x_m - 80, y_m - 80, 5.0, 5.0, LOWEST, -90.0, np.log(0.05), np.log(3.0)]),
            np.array([x_m + 80, y_m + 80, 200.0, 200.0, 30.0, 90.0, np.log(5.0), np.log(MOST_DB)]),
            lambda numbers: {"box": [float(v) for v in numbers[:6]], "law": [float(v) for v in np.exp(numbers[6:])]})

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        result = {name: Parameter.normal(value, spread, "deg" if name == "turn_deg" else "m")
                  for name, value, spread in zip(NAMES, setting["box"], found.setting_deviations)}
        for name, unit, value, spread in zip(("specific_attenuation_db_m", "greatest_loss_db"), ("dB/m", "dB"),
                                             setting["law"], found.setting_deviations[6:]):
            low, high = value * np.exp([-1.645 * spread, 1.645 * spread])
            result[name] = Parameter(value, float(low), float(high), unit)
        return result
