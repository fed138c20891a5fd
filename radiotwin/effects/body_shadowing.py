"""The receiver's body stands in the way: loss depends on the direction in the body frame only.

First harmonic of the loss over the direction of arrival. Airframe shadowing is described by Khawaja et al., 'A survey
of air-to-ground propagation channel modeling for unmanned aerial vehicles', IEEE COMST 21(3), 2019.
"""

import numpy as np

from radiotwin.effects.base import Effect, Parameter, Term, View, measured
from radiotwin.effects.tilted_dipole import TiltedDipole

LEAST_LINKS = 100
SPREAD_DB = 8.0


class BodyShadowing(Effect):
    """Each receiver loses more on one side."""

    name = "body_shadowing"
    of_receiver = True
    confused_with = ("antenna_pattern",)

    def lacks(self, records) -> str | None:
        return TiltedDipole().lacks(records)

    def propose(self, view: View) -> list[dict]:
        members = measured(view.records.receiver[np.isfinite(view.records.heading_deg)], LEAST_LINKS)
        return [{"members": members}] if members else []

    def term(self, records, setting, at) -> Term:
        psi = np.radians(records.body_azimuth_deg)
        columns, names = [], []
        for member in setting["members"]:
            mine = (records.receiver == member) & np.isfinite(psi)
            for name, wave in (("front", np.cos(psi)), ("right", np.sin(psi))):
                columns.append(np.where(mine, wave, 0.0))
                names.append(f"{name}[{records.receiver_names[member]}]")
        return Term.of_columns(np.column_stack(columns), SPREAD_DB, names)

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        result = {}
        for number, member in enumerate(setting["members"]):
            place = slice(2 * number, 2 * number + 2)
            (front, right), spread = found.coefficients[place], found.deviations[place]
            name, size = records.receiver_names[member], np.hypot(front, right)
            result[f"front_to_back_db[{name}]"] = Parameter.normal(2 * size, 2 * spread.mean(), "dB")
            result[f"clearest_side_deg[{name}]"] = Parameter.normal(
                np.degrees(np.arctan2(right, front)) % 360, np.degrees(spread.mean() / max(size, 0.1)), "deg")
        return result
