"""A device with a sector antenna: gain depends on the direction in which a link leaves the device.

Pattern of 3GPP TR 38.901 V17, Table 7.3-1: horizontally −min(12 (φ / φ_3dB)², A_max), vertically −min(12 ((θ − tilt) /
θ_3dB)², A_max), together no less than −A_max. The maximum gain is the device's level and is fitted with it. What
reaches a place without line of sight leaves the device in many directions: a share of it, fitted too, has the mean of
the pattern.
"""

import numpy as np

from radiotwin.effects.base import Effect, Parameter, Term, Variation, View, measured, one_hot

LEAST_LINKS = 100
LEAST_NATS = 4.0
LEAST_TOO_NATS = 1.5  # where another device surely has one
LEVEL_SPREAD_DB = 15.0
AZIMUTHS_DEG = np.arange(0.0, 360.0, 15.0)
BEAMWIDTHS_DEG = (50.0, 65.0, 90.0, 120.0)
ATTENUATIONS_DB = (10.0, 15.0, 20.0, 30.0)
NO_VERTICAL = (0.0, 360.0)  # tilt and vertical beamwidth of an antenna that is flat in elevation
VERTICALS = (NO_VERTICAL, (0.0, 15.0), (-6.0, 15.0), (-12.0, 15.0), (0.0, 40.0), (-10.0, 40.0), (15.0, 40.0),
             (40.0, 65.0))
FIELDS = ("azimuth_deg", "beamwidth_deg", "front_to_back_db", "tilt_deg", "vertical_beamwidth_deg",
          "scattered_share")
UNITS = ("deg", "deg", "dB", "deg", "deg", "of the power without line of sight")
STEPS = np.array([8.0, 10.0, 3.0, 4.0, 5.0, 0.2])
LOW, HIGH = np.array([-720.0, 20.0, 3.0, -60.0, 6.0, 0.0]), np.array([1080.0, 180.0, 45.0, 80.0, 360.0, 0.95])
SCATTERED = 0.2
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
    """A device's sector antenna that nobody declared."""

    name = "antenna_pattern"
    variant = "sector antenna of a device"
    confused_with = ("device_gain_offset", "device_position_error", "missing_obstacle", "foliage")

    def lacks(self, records) -> str | None:
        if not measured(records.device, LEAST_LINKS):
            return f"no device has {LEAST_LINKS} links"
        return None

    def propose(self, view: View) -> list[dict]:
        records, found = view.records, {}
        sure = False
        for device in measured(records.device, LEAST_LINKS):
            rows = np.flatnonzero((records.device == device) & (records.los if records.los.any() else True))
            if len(rows) < LEAST_LINKS:
                rows = np.flatnonzero(records.device == device)
            pattern, nats = _best_pattern(records.azimuth_deg[rows], records.elevation_deg[rows],
                                          view.residual_db[rows], view.weight[rows])
            sure |= nats > LEAST_NATS
            if nats > LEAST_TOO_NATS:
                found[str(device)] = [*pattern, SCATTERED]
        return [{"devices": found}] if sure else []

    def term(self, records, setting, at) -> Term:
        offset_db = np.zeros(len(records))
        for device, pattern in setting["devices"].items():
            mine = records.device == int(device)
            offset_db[mine] = _offset_db(records.azimuth_deg[mine], records.elevation_deg[mine], records.los[mine],
                                         np.array(pattern))
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
            known = len(FIELDS) - bool(records.los.all())  # nothing tells the last one then
            for field, unit, value, spread in list(zip(FIELDS, UNITS, pattern, spreads[number]))[:known]:
                value = value % 360 if field == "azimuth_deg" else value
                result[f"{field}[{name}]"] = Parameter.normal(value, spread, unit)
            result[f"gain_db[{name}]"] = Parameter.normal(found.coefficients[number], found.deviations[number], "dB")
        return result


def _offset_db(azimuth_deg: np.ndarray, elevation_deg: np.ndarray, los: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """(n,) what the pattern (6,), as in `FIELDS`, takes from each link [dB]."""
    direct_db = sector_pattern_db(azimuth_deg, elevation_deg, pattern[:5])
    mean = np.mean(10 ** (sector_pattern_db(AROUND_DEG, np.full(len(AROUND_DEG), pattern[3]), pattern[:5]) / 10))
    share = pattern[5]
    return np.where(los, direct_db, 10 * np.log10((1 - share) * 10 ** (direct_db / 10) + share * mean))


def _best_pattern(azimuth_deg, elevation_deg, residual_db, weight) -> tuple[list[float], float]:
    """The pattern of the grid that explains residuals best, with a free level, and by how many nats."""
    def squares(offset_db):
        rest = residual_db - offset_db
        return weight @ (rest - weight @ rest / weight.sum()) ** 2

    before = squares(0.0)
    best = before, [0.0, 65.0, 3.0, *NO_VERTICAL]
    for azimuth in AZIMUTHS_DEG:
        for beamwidth in BEAMWIDTHS_DEG:
            for most_db in ATTENUATIONS_DB:
                pattern = np.array([azimuth, beamwidth, most_db, *NO_VERTICAL])
                after = squares(sector_pattern_db(azimuth_deg, elevation_deg, pattern))
                if after < best[0]:
                    best = after, list(pattern)
    for vertical in VERTICALS:
        pattern = np.array([*best[1][:3], *vertical])
        after = squares(sector_pattern_db(azimuth_deg, elevation_deg, pattern))
        if after < best[0]:
            best = after, list(pattern)
    return [float(v) for v in best[1]], 0.5 * (before - best[0])
