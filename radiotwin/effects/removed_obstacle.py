"""A mapped building that is not there any more.

No law of its own: links that only this building blocks have the base's level with line of sight; or, exactly, links
near it have the base's level over the map without it.
"""

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from radiotwin.effects.base import Effect, Parameter, Term, View
from radiotwin.effects.boxes import Box, near_box
from radiotwin.scene.citymap import CityMap

LEAST_NATS = 6.0
LEAST_LINKS = 8
WELD_M = 0.05
NEAR_M = 25.0  # links that pass farther from it are not worked out anew


class RemovedObstacle(Effect):
    """One building of the map; one step finds one."""

    name = "removed_obstacle"
    nlos_only = True
    repeatable = True
    confused_with = ("device_position_error",)

    def __init__(self):
        self._cache = None
        self._others: dict[int, tuple[CityMap, CityMap]] = {}  # of each building the map, and the map without it

    def lacks(self, records) -> str | None:
        return "there is no 3D map" if records.city is None else None

    def propose(self, view: View) -> list[dict]:
        records = view.records
        blocker = self._only_blocker(records)
        rows = np.flatnonzero(blocker >= 0)
        if not len(rows):
            return []
        mine = records.select(rows)
        rise_db = view.at(mine.with_los(np.ones(len(rows), bool))) - view.at(mine)
        total = np.bincount(blocker[rows], weights=view.nats(rows, rise_db))
        counts = np.bincount(blocker[rows])
        best = int(np.where(counts >= LEAST_LINKS, total, -np.inf).argmax())
        if total[best] < LEAST_NATS or counts[best] < LEAST_LINKS:
            return []
        return [{"building": best, "centre_m": [float(v) for v in self._centres[best]]}]

    def term(self, records, setting, at) -> Term:
        offset_db = np.zeros(len(records))
        if setting.get("exact", False):
            city, box = self._without(records.city, setting["building"])
            rows = np.flatnonzero(near_box(box, records.device_m[records.device], records.receiver_m, NEAR_M))
            mine = records.select(rows)
            offset_db[rows] = at(replace(mine, city=city), True) - at(mine, True)
            return Term.of_offset(offset_db)
        rows = np.flatnonzero(self._only_blocker(records) == setting["building"])
        if len(rows):
            mine = records.select(rows)
            offset_db[rows] = at(mine.with_los(np.ones(len(rows), bool))) - at(mine)
        return Term.of_offset(offset_db)

    def exact(self, setting) -> dict:
        return setting | {"exact": True}

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        return {name: Parameter(value, value, value, "m") for name, value in zip(("x_m", "y_m", "height_m"),
                                                                                setting["centre_m"])}

    def _without(self, city: CityMap, building: int) -> tuple[CityMap, Box]:
        """The map without a building, and a box around that."""
        label = buildings(city)[0]
        corners_m = city.vertices[city.faces[label == building]].reshape(-1, 3)
        low_m, high_m = corners_m.min(axis=0), corners_m.max(axis=0)
        if self._others.get(building, (None,))[0] is not city:
            self._others[building] = city, CityMap(city.vertices, city.faces[label != building])
        (x_m, y_m, _), (length_m, width_m, _) = (low_m + high_m) / 2, high_m - low_m
        return self._others[building][1], Box(x_m, y_m, length_m, width_m, high_m[2], 0.0)

    def _only_blocker(self, records) -> np.ndarray:
        """(n,) building that alone stands between the ends of each link; -1 where there is none or more than one."""
        if self._cache is None or self._cache[0] is not records.city:
            label, self._centres = buildings(records.city)
            self._cache = records.city, label
        label = self._cache[1]
        alone = np.full(len(records), -1)
        rows = np.flatnonzero(~records.los)
        a_m, b_m = records.device_m[records.device[rows]], records.receiver_m[rows]
        near, far = records.city.first_face(a_m, b_m), records.city.first_face(b_m, a_m)
        same = (near >= 0) & (far >= 0) & (label[near] == label[far])
        alone[rows[same]] = label[near[same]]
        return alone


def buildings(city) -> tuple[np.ndarray, np.ndarray]:
    """Faces that hang together.

    Returns:
        (f,) index of each face's building, and (buildings, 3) centre x, y and height of each [m]
    """
    place = np.unique(np.round(city.vertices / WELD_M).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
    faces = place[city.faces]
    ends = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(place.max() + 1,) * 2)
    label = np.unique(connected_components(graph, directed=False)[1][faces[:, 0]], return_inverse=True)[1]
    corners = city.vertices[city.faces]
    low, high = np.full((label.max() + 1, 3), np.inf), np.full((label.max() + 1, 3), -np.inf)
    np.minimum.at(low, label, corners.min(axis=1))
    np.maximum.at(high, label, corners.max(axis=1))
    return label, np.column_stack([0.5 * (low + high)[:, :2], high[:, 2]])
