"""A receiver with a half-wave dipole that nobody declared, upright or not: gain depends on the direction in its body
frame.

Far field of a half-wave dipole, cos(π/2 cos θ) / sin θ along its own polar direction (Balanis, Antenna Theory, Sec.
4.6), directivity 1.64, times the share of it that is polarised as the wave of an upright transmitting antenna is. With
a 3D map each path has the gain of the direction from which it comes; what is on ways that are not followed, whose
power is fitted too, has the mean of the pattern.
"""

from typing import NamedTuple

import numpy as np

from radiotwin.closeloop.paths import free_space, rays_of, through_antenna_db
from radiotwin.closeloop.records import Records
from radiotwin.effects.base import Effect, Parameter, Remembered, Term, Variation, View, measured

LEAST_LINKS = 100
LEAST_NATS = 4.0
DIRECTIVITY = 1.64
LEAST_GAIN = 10**-2.5
MEAN_GAIN = 0.5  # over all directions and both polarisations
STEADY = 0.05  # standard deviation of the heading's sine and cosine
TILTS_DEG = np.arange(0.0, 60.1, 5.0)
AZIMUTHS_DEG = np.arange(0.0, 360.0, 15.0)
FIELDS = ("tilt_deg", "lean_azimuth_deg", "scattered_db")
UNITS = ("deg", "deg", "dB")
SCATTERED_DB = -35.0


def dipole_gain(ray: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """(…,) gain of a half-wave dipole for vertically polarised waves, linear, over an isotropic antenna.

    Args:
        ray: (…, 3) unit vectors towards where the wave comes from; up is z.
        axis: (…, 3) unit vectors along the dipole.
    """
    cosine = (ray * axis).sum(axis=-1)
    # The wave's electric field lies in the vertical plane through the ray.
    flat = np.sqrt(np.maximum(1 - ray[..., 2] ** 2, 1e-9))
    along = (axis[..., 2] - ray[..., 2] * cosine) / flat
    field = np.cos(np.pi / 2 * cosine) / np.maximum(1 - cosine**2, 1e-6) * along
    return DIRECTIVITY * np.maximum(field**2, LEAST_GAIN)


class TiltedDipole(Effect):
    """A receiver's dipole; for each receiver that it helps."""

    name = "antenna_pattern"
    of_receiver = True
    variant = "tilted dipole of a receiver"
    confused_with = ("body_shadowing", "receiver_gain_offset")

    def __init__(self):
        self._arrivals = Remembered()

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
            mine = records.select(rows)
            ray, residual_db, weight = -_unit(mine.offset_m), view.residual_db[rows], view.weight[rows]

            def squares(tilt, azimuth):
                rest = residual_db - 10 * np.log10(dipole_gain(ray, _axis(mine.receiver_axes, tilt, azimuth)))
                return weight @ (rest - weight @ rest / weight.sum()) ** 2

            before = weight @ (residual_db - weight @ residual_db / weight.sum()) ** 2
            after, tilt, azimuth = min((squares(tilt, azimuth), tilt, azimuth) for tilt in TILTS_DEG
                                       for azimuth in AZIMUTHS_DEG)
            if 0.5 * (before - after) > LEAST_NATS:
                found[str(receiver)] = [float(tilt), float(azimuth), SCATTERED_DB]
        return [{"receivers": found}] if found else []

    def term(self, records, setting, at) -> Term:
        offset_db = np.zeros(len(records))
        for receiver, numbers in setting["receivers"].items():
            mine = np.flatnonzero((records.receiver == int(receiver)) & np.isfinite(records.heading_deg))
            arrivals = self._arrivals.of(records, receiver, lambda: _Arrivals.of(records.select(mine)))
            offset_db[mine] = arrivals.offset_db(*numbers)
        return Term.of_offset(offset_db)

    def vary(self, setting) -> Variation:
        receivers = list(setting["receivers"])
        values = np.concatenate([setting["receivers"][receiver] for receiver in receivers])

        def again(numbers: np.ndarray) -> dict:
            return {"receivers": {receiver: [float(v) for v in part] for receiver, part in
                                  zip(receivers, np.reshape(numbers, (-1, len(FIELDS))))}}
        times = len(receivers)
        return Variation(values, np.tile([4.0, 10.0, 6.0], times), np.tile([0.0, -720.0, -80.0], times),
                         np.tile([85.0, 1080.0, 0.0], times), again,
                         list(np.arange(len(FIELDS) * times).reshape(times, -1)))

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        result = {}
        spreads = np.reshape(found.setting_deviations, (-1, len(FIELDS)))
        known = len(FIELDS) - (records.city is None)  # nothing tells the last one then
        for (receiver, numbers), spread in zip(setting["receivers"].items(), spreads):
            for field, unit, value, deviation in list(zip(FIELDS, UNITS, numbers, spread))[:known]:
                value = value % 360 if field == "lean_azimuth_deg" else value
                result[f"{field}[{records.receiver_names[int(receiver)]}]"] = Parameter.normal(value, deviation, unit)
        return result


class _Arrivals(NamedTuple):
    """How links arrive at their receiver.

    Attributes:
        ray: (n, sectors, 3) unit vectors towards where they come from, in the world.
        power: (n, sectors)
        axes: (n, 3, 3) of the receiver, see `Records.receiver_axes`.
        free: (n,) power in free space; 0 where there is no map, and the straight line is all.
    """

    ray: np.ndarray
    power: np.ndarray
    axes: np.ndarray
    free: np.ndarray

    @classmethod
    def of(cls, records: Records) -> "_Arrivals":
        if records.city is None:
            return cls(-_unit(records.offset_m)[:, None], np.ones((len(records), 1)), records.receiver_axes,
                       free_space(records))
        ray = rays_of(records, "arrivals")
        power = np.linalg.norm(ray, axis=2)
        return cls(ray / np.maximum(power, 1e-30)[..., None], power, records.receiver_axes,
                   free_space(records))

    def offset_db(self, tilt_deg: float, azimuth_deg: float, scattered_db: float) -> np.ndarray:
        """(n,) what the dipole adds to each link [dB]."""
        gain = dipole_gain(self.ray, _axis(self.axes, tilt_deg, azimuth_deg)[:, None])
        return through_antenna_db(self.power, gain, self.free * 10 ** (scattered_db / 10), MEAN_GAIN)


def _axis(axes: np.ndarray, tilt_deg: float, azimuth_deg: float) -> np.ndarray:
    """(n, 3) direction of a dipole in the world on receivers with such axes (n, 3, 3); it leans towards an azimuth
    clockwise from the nose."""
    tilt, lean = np.radians(tilt_deg), np.radians(azimuth_deg)
    in_body = np.array([np.sin(tilt) * np.sin(lean), np.sin(tilt) * np.cos(lean), np.cos(tilt)])
    return np.einsum("i,nij->nj", in_body, axes)


def _unit(offset_m: np.ndarray) -> np.ndarray:
    return offset_m / np.maximum(np.linalg.norm(offset_m, axis=1, keepdims=True), 1e-9)
