"""A building that no map shows.

Found by back-projecting the loss along the links' rays; then a box is fitted. Loss behind it: what comes over the two
edges of the roof and round both sides (knife edges of ITU-R P.526), and what reaches any shadow by reflections (the
base's own level without line of sight, give or take what is fitted), added as powers; or, exactly, the base's level
over the map with the box in it.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import trimesh
from scipy.constants import speed_of_light

from radiotwin.effects.base import QUANTILE_90, Effect, Parameter, Term, Variation, View
from radiotwin.effects.boxes import (
    CELL_M,
    HEIGHTS_M,
    Box,
    back_project,
    best_cells,
    cross,
    knife_edge_db,
    lacks_nats,
    near_box,
    two_edges_db,
)
from radiotwin.scene.citymap import CityMap

LEAST_NATS = 6.0
NEAR_M = 25.0  # links that pass farther from it are not worked out anew
LOSSES_DB = (8.0, 12.0, 16.0, 20.0, 25.0, 30.0)
STARTS = 4
NAMES = ("x_m", "y_m", "length_m", "width_m", "height_m", "turn_deg", "scattered_db")
UNITS = {"turn_deg": "deg", "scattered_db": "dB"}
MOST_BLANK_DB = 25.0
TYPICAL_HEIGHT_M = 20.0  # dense urban: Table 1 there


class MissingObstacle(Effect):
    """A box; one step finds one."""

    name = "missing_obstacle"
    repeatable = True
    confused_with = ("foliage", "antenna_pattern", "device_position_error")

    def lacks(self, records) -> str | None:
        if not np.isfinite(records.frequency_hz):
            return "the frequency is not known; give frequency_hz in devices.csv"
        return None

    def propose(self, view: View) -> list[dict]:
        records = view.records
        rows = np.flatnonzero(records.los)
        if not len(rows):
            return []
        nats = lacks_nats(view.residual_db[rows], view.scale_db[rows], LOSSES_DB) / view.design_effect
        centres_m, total = back_project(records.device_m[records.device[rows]], records.receiver_m[rows], nats)
        boxes = [[*map(float, centre_m), 1.5 * CELL_M, 1.5 * CELL_M, HEIGHTS_M[height], 0.0]
                 for centre_m, height, nats in best_cells(centres_m, total, STARTS) if nats > LEAST_NATS]
        return [{"box": box, "scattered_db": 0.0} for box in boxes]

    def term(self, records, setting, at) -> Term:
        box = Box(*setting["box"])
        offset_db = np.zeros(len(records))
        if setting.get("exact", False):
            rows = np.flatnonzero(near_box(box, records.device_m[records.device], records.receiver_m, NEAR_M))
            mine = records.select(rows)
            offset_db[rows] = at(replace(mine, city=_with_box(records.city, box)), True) - at(mine, True)
            return Term.of_offset(offset_db)
        rows = np.flatnonzero(records.los)
        crossing = cross(box, records.device_m[records.device[rows]], records.receiver_m[rows])
        hit = np.isfinite(crossing.left_m)
        if not hit.any():
            return Term.of_offset(offset_db)
        rows = rows[hit]
        enter_over_m, leave_over_m, left_m, right_m, before_m, between_m, behind_m = (
            value[hit] for value in crossing[1:])
        over_m, first_m, second_m = np.maximum(enter_over_m, leave_over_m), before_m + between_m / 2, \
            behind_m + between_m / 2
        wavelength_m = speed_of_light / records.frequency_hz
        mine = records.select(rows)
        scattered_db = at(mine.with_los(np.zeros(len(rows), bool))) - at(mine)
        power = 10 ** (np.minimum(scattered_db + setting["scattered_db"], 0) / 10) if records.city is not None else 0.0
        over_db = two_edges_db(enter_over_m, leave_over_m, before_m, between_m, behind_m, wavelength_m)
        for side_m in (left_m, right_m):
            power = power + 10 ** (-knife_edge_db(side_m, first_m, second_m, wavelength_m) / 10)
        # A link that passes above the roof has its own strength, and what comes round the sides does not add to it.
        power = np.where(over_m > 0, power, 0.0) + 10 ** (-over_db / 10)
        offset_db[rows] = np.maximum(10 * np.log10(np.minimum(power, 1.0)), -2 * MOST_BLANK_DB)
        return Term.of_offset(offset_db)

    def exact(self, setting) -> dict:
        return setting | {"exact": True}

    def vary(self, setting) -> Variation:
        x_m, y_m = setting["box"][:2]
        return Variation(np.array([*setting["box"], setting["scattered_db"]]),
                         np.array([6.0, 6.0, 8.0, 8.0, 8.0, 20.0, 4.0]),
                         np.array([x_m - 60, y_m - 60, 4.0, 4.0, 3.0, -90.0, -20.0]),
                         np.array([x_m + 60, y_m + 60, 120.0, 120.0, 250.0, 90.0, 10.0]),
                         lambda numbers: {"box": [float(v) for v in numbers[:-1]], "scattered_db": float(numbers[-1])})

    def improbable(self, setting) -> float:
        # Links that pass below the roof only tell "at least". Buildings' heights are Rayleigh distributed (P.1410-6).
        return 0.5 * (setting["box"][4] / TYPICAL_HEIGHT_M) ** 2

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        variation = self.vary(setting)
        reach = QUANTILE_90 * found.setting_sides
        low = np.maximum(variation.values - reach[0], variation.low)
        high = np.minimum(variation.values + reach[1], variation.high)
        return {name: Parameter(float(value), float(least), float(most), UNITS.get(name, "m"))
                for name, value, least, most in zip(NAMES, variation.values, low, high)}


@lru_cache(maxsize=32)
def _with_box(city: CityMap, box: Box) -> CityMap:
    """A map with a box on its ground."""
    turned = trimesh.transformations.rotation_matrix(np.radians(box.turn_deg), (0, 0, 1))
    turned[:3, 3] = box.x_m, box.y_m, 0.5 * box.height_m
    mesh = trimesh.creation.box((box.length_m, box.width_m, box.height_m), turned)
    return CityMap(np.vstack([city.vertices, mesh.vertices]), np.vstack([city.faces, mesh.faces + len(city.vertices)]))
