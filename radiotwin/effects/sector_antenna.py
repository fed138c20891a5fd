"""A device with a sector antenna: gain depends on the direction in which a link leaves the device.

Pattern of 3GPP TR 38.901 V17, Table 7.3-1: horizontally −min(12 (φ / φ_3dB)², A_max), vertically −min(12 ((θ − tilt) /
θ_3dB)², A_max), together no less than −A_max. The maximum gain is the device's level and is fitted with it. With a 3D
map each path has the gain of the direction in which it leaves the device; what is on ways that are not followed, whose
power is fitted too, has the mean of the pattern.
"""

from typing import NamedTuple

import numpy as np

from radiotwin.closeloop.paths import free_space, rays_of, through_antenna_db
from radiotwin.closeloop.records import Records
from radiotwin.effects.base import Effect, Parameter, Remembered, Term, Variation, View, measured, one_hot, some
from radiotwin.effects.position_errors import site_of

LEAST_LINKS = 100
LEAST_NATS = 4.0
LEVEL_SPREAD_DB = 15.0
AZIMUTHS_DEG = np.arange(0.0, 360.0, 15.0)
BEAMWIDTHS_DEG = (65.0, 110.0)
ATTENUATIONS_DB = (12.0, 25.0)
ENOUGH_LINKS = 300  # of a device, for a first look
NO_VERTICAL = (0.0, 360.0)  # tilt and vertical beamwidth of an antenna that is flat in elevation
VERTICALS = (NO_VERTICAL, (0.0, 15.0), (-6.0, 15.0), (-12.0, 15.0), (0.0, 40.0), (-10.0, 40.0), (15.0, 40.0),
             (40.0, 65.0))
FIELDS = ("azimuth_deg", "beamwidth_deg", "front_to_back_db", "tilt_deg", "vertical_beamwidth_deg",
          "scattered_db")
UNITS = ("deg", "deg", "dB", "deg", "deg", "dB under free space")
STEPS = np.array([8.0, 10.0, 3.0, 4.0, 5.0, 6.0])
LOW, HIGH = np.array([-720.0, 20.0, 8.0, -60.0, 6.0, -80.0]), np.array([1080.0, 150.0, 45.0, 80.0, 360.0, -15.0])
SCATTERED_DB = -35.0
AROUND_DEG = np.arange(0.0, 360.0, 5.0)


def sector_pattern_db(azimuth_deg: np.ndarray, elevation_deg: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Gain below the maximum [dB].

    Args:
        azimuth_deg, elevation_deg: (n,) direction, clockwise from north, and up.
        pattern: (5,) as in `FIELDS`; a tilt above zero looks up.
    """
    azimuth, beamwidth, most_db, tilt, vertical = pattern
    off = (azimuth_deg - azimuth + 180) % 360 - 180
    horizontal_db = np.minimum(12 * (off / beamwidth) ** 2, most_db)
    vertical_db = np.minimum(12 * ((elevation_deg - tilt) / vertical) ** 2, most_db)
    return -np.minimum(horizontal_db + vertical_db, most_db)


class SectorAntenna(Effect):
    """A device's sector antenna that nobody declared; one step finds one device's, or all of a mast's."""

    name = "antenna_pattern"
    variant = "sector antenna of a device"
    repeatable = True
    confused_with = ("device_gain_offset", "device_position_error", "missing_obstacle", "foliage")

    def __init__(self):
        self._rays = Remembered()

    def lacks(self, records) -> str | None:
        return None if _placed(records) else f"no device of known position has {LEAST_LINKS} links"

    def propose(self, view: View) -> list[dict]:
        known = {int(device) for devices in view.done(self.name, "devices") for device in devices}
        found = self._patterns(view, sorted(set(_placed(view.records)) - known))
        if not found:
            return []
        best = max(found, key=lambda device: found[device][1])
        # Sectors of one mast have the evidence of all of them.
        others = set(site_of(view.records, best)) & set(found)
        return [{"devices": {str(device): found[device][0] for device in sorted(mast)}}
                for mast in ([others, {best}] if len(others) > 1 else [{best}])]

    def _patterns(self, view: View, devices: list[int]) -> dict[int, tuple[list[float], float]]:
        """Device -> its best pattern, and what it gains [nats], where that is enough."""
        found = {}
        for device in devices:
            every = np.flatnonzero(view.records.device == device)
            rows = some(every, ENOUGH_LINKS)
            if not len(rows):
                continue
            pattern, nats = _best_pattern(_Rays.of(view.records.select(rows)), view, rows)
            if nats * len(every) / len(rows) > LEAST_NATS:
                found[device] = pattern, nats * len(every) / len(rows)
        return found

    def term(self, records, setting, at) -> Term:
        offset_db = np.zeros(len(records))
        for device, pattern in setting["devices"].items():
            mine = np.flatnonzero(records.device == int(device))
            if len(mine):
                rays = self._rays.of(records, device, lambda: _Rays.of(records.select(mine)))
                offset_db[mine] = rays.offset_db(np.array(pattern))
        members = [int(device) for device in setting["devices"]]
        names = [f"gain_db[{records.device_names[member]}]" for member in members]
        return Term(offset_db, one_hot(records.device, members), np.full(len(members), LEVEL_SPREAD_DB), names)

    def vary(self, setting) -> Variation:
        devices = list(setting["devices"])
        values = np.concatenate([setting["devices"][device] for device in devices])

        def again(numbers: np.ndarray) -> dict:
            return {"devices": {device: [float(v) for v in part]
                                for device, part in zip(devices, np.reshape(numbers, (-1, len(FIELDS))))}}
        times = len(devices)
        return Variation(values, np.tile(STEPS, times), np.tile(LOW, times), np.tile(HIGH, times), again,
                         list(np.arange(len(values)).reshape(times, -1)))

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        result = {}
        spreads = np.reshape(found.setting_deviations, (-1, len(FIELDS)))
        for number, (device, pattern) in enumerate(setting["devices"].items()):
            name = records.device_names[int(device)]
            known = len(FIELDS) - (records.city is None)
            for field, unit, value, spread in list(zip(FIELDS, UNITS, pattern, spreads[number]))[:known]:
                value = value % 360 if field == "azimuth_deg" else value
                result[f"{field}[{name}]"] = Parameter.normal(value, spread, unit)
            result[f"gain_db[{name}]"] = Parameter.normal(found.coefficients[number], found.deviations[number], "dB")
        return result


def _placed(records: Records) -> list[int]:
    """Devices with enough links whose positions are declared: one that was located from these very measurements, at a
    wrong place, may look as if it had an antenna."""
    return [device for device in measured(records.device, LEAST_LINKS) if device in records.anchors]


class _Rays(NamedTuple):
    """How links leave their device.

    Attributes:
        power, azimuth_deg, elevation_deg: (n, sectors) what leaves in each sector, and where to.
        free: (n,) power in free space; 0 where there is no map, and the straight line is all.
    """

    power: np.ndarray
    azimuth_deg: np.ndarray
    elevation_deg: np.ndarray
    free: np.ndarray

    @classmethod
    def of(cls, records: Records) -> "_Rays":
        if records.city is None:
            return cls(np.ones((len(records), 1)), records.azimuth_deg[:, None], records.elevation_deg[:, None],
                       free_space(records))
        ray = rays_of(records, "departures")
        power = np.linalg.norm(ray, axis=2)
        sine = ray[..., 2] / np.maximum(power, 1e-30)
        return cls(power, np.degrees(np.arctan2(ray[..., 0], ray[..., 1])),
                   np.degrees(np.arcsin(np.clip(sine, -1, 1))), free_space(records))

    def offset_db(self, pattern: np.ndarray) -> np.ndarray:
        """(n,) what a pattern (6,), as in `FIELDS`, takes from each link [dB]."""
        gain = 10 ** (sector_pattern_db(self.azimuth_deg, self.elevation_deg, pattern[:5]) / 10)
        mean = np.mean(10 ** (sector_pattern_db(AROUND_DEG, np.full(len(AROUND_DEG), pattern[3]), pattern[:5]) / 10))
        return through_antenna_db(self.power, gain, self.free * 10 ** (pattern[5] / 10), float(mean))


def _best_pattern(rays: _Rays, view: View, rows: np.ndarray) -> tuple[list[float], float]:
    """The pattern of a grid that explains the links best, and how many nats it gains over a level alone."""
    residual_db, weight = view.residual_db[rows], view.weight[rows] * np.isfinite(view.records.level_db[rows])

    def nats(offset_db: np.ndarray) -> float:
        level_db = weight @ (residual_db - offset_db) / max(weight.sum(), 1e-12)
        return float(view.nats(rows, offset_db + level_db).sum())

    before = nats(np.zeros(len(rows)))
    best: tuple[float, list[float]] = -np.inf, []
    for azimuth in AZIMUTHS_DEG:
        for beamwidth in BEAMWIDTHS_DEG:
            for most_db in ATTENUATIONS_DB:
                pattern = [azimuth, beamwidth, most_db, *NO_VERTICAL, SCATTERED_DB]
                best = max(best, (nats(rays.offset_db(np.array(pattern))), pattern))
    for vertical in VERTICALS:
        pattern = [*best[1][:3], *vertical, SCATTERED_DB]
        best = max(best, (nats(rays.offset_db(np.array(pattern))), pattern))
    return [float(v) for v in best[1]], best[0] - before
