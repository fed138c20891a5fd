"""Where one can stand, drive and fly in a city: clearance from all buildings of the plan, on a grid."""

from functools import lru_cache

import numpy as np
from scipy.ndimage import distance_transform_edt

from tests.undeclared.foreign.layouts import City
from tests.undeclared.shapes import inside

BORDER_M = 6.0
ABOVE_ROOF_M = 7.0  # that flights keep: heights of the map are off by a few metres


class Grounds:
    """Clearances in a city."""

    def __init__(self, city: City):
        self.city = city
        self.clearance_m = lru_cache(None)(self._clearance_m)

    def _clearance_m(self, over: frozenset[int]) -> np.ndarray:
        """(n, n) distance of each metre of the plane (y, then x) from the buildings `over` [m]."""
        n = int(self.city.side_m) + 1
        free = np.ones((n, n), dtype=bool)
        for number in over:
            corners = self.city.buildings[number].footprint_m
            low = np.maximum(np.floor(corners.min(axis=0)).astype(int), 0)
            high = np.minimum(np.ceil(corners.max(axis=0)).astype(int) + 1, n)
            x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
            within = inside(np.column_stack([x.ravel(), y.ravel()]).astype(float), corners).reshape(x.shape)
            free[low[1]:high[1], low[0]:high[0]] &= ~within
        return np.asarray(distance_transform_edt(free)) if over else np.full((n, n), 1e3)

    def room_m(self, points_m: np.ndarray, height_m: float = 0.0) -> np.ndarray:
        """(m,) distance of points (m, 2) from buildings that reach up to `height_m`, 0 at the border [m]."""
        over = frozenset(number for number, one in enumerate(self.city.buildings)
                         if one.height_m + ABOVE_ROOF_M > height_m)
        grid = self.clearance_m(over)
        row = np.clip(np.round(points_m).astype(int), 0, len(grid) - 1)
        outside = ((points_m < BORDER_M) | (points_m > self.city.side_m - BORDER_M)).any(axis=1)
        return np.where(outside, 0.0, grid[row[:, 1], row[:, 0]])

    def free_point(self, rng: np.random.Generator, room_m: float, height_m: float = 0.0) -> np.ndarray:
        """(2,) a random point with room around it."""
        while True:
            point = rng.uniform(BORDER_M, self.city.side_m - BORDER_M, 2)
            if self.room_m(point[None], height_m)[0] >= room_m:
                return point

    def roof_edge(self, rng: np.random.Generator, tallest: bool) -> np.ndarray:
        """(3,) a point over a roof's edge, on a mast: above the roof whether the map's height or the true one holds."""
        heights = np.array([one.height_m for one in self.city.buildings])
        among = np.argsort(-heights)[:max(4, len(heights) // 4)] if tallest else np.flatnonzero(heights < 40)
        one = self.city.buildings[int(rng.choice(among))]
        corner = one.footprint_m[int(rng.integers(len(one.footprint_m)))]
        middle = one.footprint_m.mean(axis=0)
        point = corner + (middle - corner) * min(0.4, 3.5 / np.hypot(*(middle - corner)))
        return np.array([*point, one.height_m + rng.uniform(5, 9)])
