"""Where links cross the roofs of a map, and what is lost over them if they are higher or lower."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from radiotwin.effects.boxes import Box, cross, two_edges_db
from radiotwin.effects.mapped_buildings import building_extents_m, buildings
from radiotwin.scene.citymap import DOWN, CityMap

SAMPLES = 24  # points of a link over the box around a building
END_M = 2.0  # a building closer to an end of a link than this belongs to that end
BOTTOMLESS_M = 1e4  # height of the box in which links are looked for above a building


class RoofCrossings(NamedTuple):
    """How links cross roofs; m pairs of a link and a building, sorted by the link.

    Attributes:
        link: (m,) row of the link.
        building: (m,) as `buildings` numbers them.
        enter_over_m, leave_over_m: (m,) height of the roof above the link, where it enters and
            where it leaves; negative where it passes above.
        before_m, between_m, behind_m: (m,) distance along the ground from the first end to where
            the link enters, from there to where it leaves, and on to the second end.
    """

    link: np.ndarray
    building: np.ndarray
    enter_over_m: np.ndarray
    leave_over_m: np.ndarray
    before_m: np.ndarray
    between_m: np.ndarray
    behind_m: np.ndarray

    def loss_db(self, raised_m: np.ndarray | float, wavelength_m: float,
                rows: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return the loss over each roof alone, by two edges (ITU-R P.526) [dB].

        Args:
            raised_m: (r,) how much higher the roofs are than on the map [m].
            wavelength_m: of the radio [m].
            rows: r pairs.
        """
        return two_edges_db(self.enter_over_m[rows] + raised_m, self.leave_over_m[rows] + raised_m,
                            self.before_m[rows], self.between_m[rows], self.behind_m[rows],
                            wavelength_m)


def roof_crossings(city: CityMap, a_m: np.ndarray, b_m: np.ndarray,
                   which: np.ndarray | None = None) -> RoofCrossings:
    """Return where links cross buildings that neither of their ends stands on.

    Args:
        city: 3D map.
        a_m: (n, 3) first ends [m].
        b_m: (n, 3) second ends [m].
        which: buildings; None: all of the map.
    """
    label, boxes = buildings(city)[0], _boxes(city)
    found = [np.zeros((7, 0))]
    share = (np.arange(SAMPLES) + 0.5) / SAMPLES
    for building in sorted(boxes) if which is None else which.tolist():
        if building not in boxes:
            continue
        way = cross(boxes[building], a_m, b_m)
        near = np.flatnonzero((way.before_m > END_M) & (way.behind_m > END_M))
        if not len(near):
            continue
        track_m = way.before_m[near] + way.between_m[near] + way.behind_m[near]
        along_m = way.before_m[near, None] + share * way.between_m[near, None]
        points_m = a_m[near, None] + (along_m / track_m[:, None])[..., None] * (
            b_m - a_m)[near, None]
        over_m = _roof_over_m(city, points_m.reshape(-1, 3), label == building)
        over_m = over_m.reshape(along_m.shape)
        is_over = np.isfinite(over_m)
        hit = np.flatnonzero(is_over.any(axis=1))
        first, last = is_over[hit].argmax(axis=1), SAMPLES - 1 - is_over[hit, ::-1].argmax(axis=1)
        enter_m, leave_m = along_m[hit, first], along_m[hit, last]
        found.append(np.array([near[hit], np.full(len(hit), building), over_m[hit, first],
                               over_m[hit, last], enter_m, leave_m - enter_m,
                               track_m[hit] - leave_m]))
    pairs = np.concatenate(found, axis=1)
    pairs = pairs[:, np.argsort(pairs[0], kind="stable")]
    return RoofCrossings(pairs[0].astype(int), pairs[1].astype(int), *pairs[2:])


def _roof_over_m(city: CityMap, points_m: np.ndarray, is_mine: np.ndarray) -> np.ndarray:
    """Return how far some faces (f,) lie above points (n, 3), seen from above; NaN beside them."""
    top_m = float(city.vertices[:, 2].max()) + 1.0
    above_m = np.column_stack([points_m[:, :2], np.full(len(points_m), top_m)])
    distance_m, face, _ = city.first_hits_towards(above_m, DOWN)
    return np.where((face >= 0) & is_mine[face], top_m - distance_m - points_m[:, 2], np.nan)


@lru_cache(maxsize=4)
def _boxes(city: CityMap) -> dict[int, Box]:
    """Return a bottomless box around each building; the ground is none."""
    label = buildings(city)[0]
    low_m, high_m = building_extents_m(city, label)
    middle_m, size_m = 0.5 * (low_m + high_m), high_m - low_m
    found = {}
    for building in np.unique(label[~city.on_ground]).tolist():
        (x_m, y_m, _), (length_m, width_m, _) = (each[building].tolist()
                                                 for each in (middle_m, size_m))
        found[building] = Box(x_m, y_m, length_m, width_m, BOTTOMLESS_M, 0.0)
    return found
