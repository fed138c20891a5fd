"""A receiver with a half-wave dipole that is not upright: gain depends on the direction in its body frame.

Far field of a half-wave dipole, cos(π/2 cos θ) / sin θ along its own polar direction (Balanis, Antenna Theory, Sec.
4.6), times the share of it that is polarised as the wave of an upright transmitting antenna is.
"""

import numpy as np

from radiotwin.effects.base import Effect, Parameter, Term, Variation, View, measured

LEAST_LINKS = 100
LEAST_NATS = 4.0
DEEPEST_DB = -25.0
STEADY = 0.05  # standard deviation of the heading's sine and cosine
TILTS_DEG = np.arange(5.0, 60.1, 5.0)
AZIMUTHS_DEG = np.arange(0.0, 360.0, 15.0)


def dipole_gain_db(body_azimuth_deg: np.ndarray, elevation_deg: np.ndarray, tilt_deg: float,
                   azimuth_deg: float) -> np.ndarray:
    """Gain of a tilted dipole over that of an upright one [dB], for vertically polarised waves.

    Args:
        body_azimuth_deg, elevation_deg: (n,) direction to the device, clockwise from the heading, and up.
        tilt_deg: of the dipole from the vertical.
        azimuth_deg: direction in the body frame towards which its upper end leans.
    """
    return _field_db(body_azimuth_deg, elevation_deg, tilt_deg, azimuth_deg) \
        - _field_db(body_azimuth_deg, elevation_deg, 0.0, 0.0)


def _field_db(body_azimuth_deg, elevation_deg, tilt_deg, azimuth_deg):
    psi, up = np.radians(body_azimuth_deg), np.radians(elevation_deg)
    tilt, lean = np.radians(tilt_deg), np.radians(azimuth_deg)
    # Right, forward, up.
    cosine = np.sin(tilt) * np.cos(up) * np.cos(psi - lean) + np.cos(tilt) * np.sin(up)
    # Along the wave's electric field, which lies in the vertical plane through the link.
    along = -np.sin(tilt) * np.sin(up) * np.cos(psi - lean) + np.cos(tilt) * np.cos(up)
    sine2 = np.maximum(1 - cosine**2, 1e-6)
    field = np.cos(np.pi / 2 * cosine) / sine2 * along
    return np.maximum(20 * np.log10(np.maximum(np.abs(field), 1e-6)), DEEPEST_DB)


class TiltedDipole(Effect):
    """A receiver's dipole leans; the same for each receiver that it helps."""

    name = "antenna_pattern"
    of_receiver = True
    variant = "tilted dipole of a receiver"
    confused_with = ("body_shadowing", "receiver_gain_offset")

    def lacks(self, records) -> str | None:
        if np.isnan(records.heading_deg).all():
            return "there is no heading_deg, so directions in the receiver's body frame are not known"
        heading = np.radians(records.heading_deg)
        if np.nanstd(np.cos(heading)) + np.nanstd(np.sin(heading)) < STEADY:
            return "the heading never changes, so body and world frame cannot be told apart"
        return None

    def propose(self, view: View) -> list[dict]:
        records, found = view.records, {}
        for receiver in measured(records.receiver, LEAST_LINKS):
            rows = np.flatnonzero((records.receiver == receiver) & records.los & np.isfinite(records.heading_deg))
            if len(rows) < LEAST_LINKS:
                continue
            psi, up = records.body_azimuth_deg[rows], -records.elevation_deg[rows]
            residual_db, weight = view.residual_db[rows], view.weight[rows]

            def squares(tilt, azimuth):
                rest = residual_db - dipole_gain_db(psi, up, tilt, azimuth)
                return weight @ (rest - weight @ rest / weight.sum()) ** 2

            before = squares(0.0, 0.0)
            after, tilt, azimuth = min((squares(tilt, azimuth), tilt, azimuth) for tilt in TILTS_DEG
                                       for azimuth in AZIMUTHS_DEG)
            if 0.5 * (before - after) > LEAST_NATS:
                found[str(receiver)] = [float(tilt), float(azimuth)]
        return [{"receivers": found}] if found else []

    def term(self, records, setting, at) -> Term:
        offset_db = np.zeros(len(records))
        for receiver, (tilt, azimuth) in setting["receivers"].items():
            mine = (records.receiver == int(receiver)) & np.isfinite(records.heading_deg)
            offset_db[mine] = dipole_gain_db(records.body_azimuth_deg[mine], -records.elevation_deg[mine], tilt,
                                             azimuth)
        return Term.of_offset(offset_db)

    def vary(self, setting) -> Variation:
        receivers = list(setting["receivers"])
        values = np.concatenate([setting["receivers"][receiver] for receiver in receivers])

        def again(numbers: np.ndarray) -> dict:
            return {"receivers": {receiver: [float(v) for v in pair]
                                  for receiver, pair in zip(receivers, np.reshape(numbers, (-1, 2)))}}
        times = len(receivers)
        return Variation(values, np.tile([4.0, 10.0], times), np.tile([0.0, -720.0], times),
                         np.tile([85.0, 1080.0], times), again, list(np.arange(2 * times).reshape(times, 2)))

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        result = {}
        spreads = np.reshape(found.setting_deviations, (-1, 2))
        for (receiver, (tilt, azimuth)), spread in zip(setting["receivers"].items(), spreads):
            name = records.receiver_names[int(receiver)]
            result[f"tilt_deg[{name}]"] = Parameter.normal(tilt, spread[0], "deg")
            result[f"lean_azimuth_deg[{name}]"] = Parameter.normal(azimuth % 360, spread[1], "deg")
        return result
