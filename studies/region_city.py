"""Random cities of any number of buildings, 500 to a square kilometre: blocks between streets."""

import json
import math
from pathlib import Path

import numpy as np

PLOTS = 3  # of a block, along each side
PLOT_M, STREET_M = 38.0, 20.0
PERIOD_M = PLOTS * PLOT_M + STREET_M  # 134 m: 9 buildings in 1.8 hectares
HEIGHT_M, HIGHEST_M = 15.0, 60.0


def city_footprints(buildings: int, seed: int) -> np.ndarray:
    """Draw the buildings of a square city, one a plot, none touching another.

    Args:
        buildings: number of them.
        seed: of all sides, places and heights.

    Returns:
        (n, 5) x_min, y_min, x_max, y_max, height [m]; the city's middle is at 0, 0. Sides are
        uniform from 15 to 30 m, heights above 4 m gamma distributed with the mean 15 m.
    """
    rng = np.random.default_rng(seed)
    blocks = math.ceil(math.sqrt(buildings / PLOTS**2))
    side = PLOTS * blocks
    plots = np.sort(rng.permutation(side**2)[:buildings])
    row, column = np.divmod(plots, side)
    low_m = np.column_stack([place // PLOTS * PERIOD_M + place % PLOTS * PLOT_M
                             for place in (column, row)]) - blocks * PERIOD_M / 2
    size_m = rng.uniform(15.0, 30.0, (buildings, 2))
    low_m = low_m + rng.uniform(1.0, PLOT_M - size_m - 1.0)
    height_m = np.clip(4.0 + rng.gamma(2.0, (HEIGHT_M - 4.0) / 2, buildings), 4.0, HIGHEST_M)
    return np.column_stack([low_m, low_m + size_m, height_m]).round(2)


def write_map(footprints: np.ndarray, path: Path) -> None:
    """Write buildings as GeoJSON, which `radiotwin build-scene` reads.

    Args:
        footprints: as `city_footprints` returns them.
        path: file to write.
    """
    features = [{"type": "Feature",
                 "properties": {"building": "yes", "height": height_m},
                 "geometry": {"type": "Polygon", "coordinates": [[
                     _degrees(x, y) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1),
                                                 (x0, y0))]]}}
                for x0, y0, x1, y1, height_m in footprints.tolist()]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}),
                    encoding="utf-8")


def _degrees(x_m: float, y_m: float) -> list[float]:
    """Return longitude and latitude, near 8.5° east and 47.4° north."""
    return [round(8.5 + x_m / 75_300, 8), round(47.4 + y_m / 111_190, 8)]
