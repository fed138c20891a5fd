"""How wrong a map may be: declared accuracy of heights, and maps with random errors.

Maps as they might be: each wall and each roof of a 3D map moved by a random error.

Surveyed maps have walls off by decimetres to metres, and heights by metres where they were counted
from storeys. What such errors do to a prediction is seen by predicting over several such maps.

How well a scene made from a map knows the heights of its buildings: from `buildings.csv`.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from radiotwin.io.cells import as_numbers, read_cells, refuse
from radiotwin.io.inputs import require_within
from radiotwin.scene.citymap import CityMap

SAME_CORNER_M = 0.01  # corners closer than this are one [m]
MIN_HEIGHT_SHARE = 0.2  # of a building's height that is left, whatever the error
_GROUND_M = 0.05  # faces below are ground, and stay
_MAX_SD_M, _MAX_AREA_M2 = 1000.0, 1e9


def building_of_vertex(city: CityMap) -> np.ndarray:
    """Return the building that each corner belongs to; -1: only ground.

    A building is what is joined by its triangles, above the ground.

    Args:
        city: 3D map.

    Returns:
        (v,) int
    """
    corners, index = np.unique(np.round(city.vertices / SAME_CORNER_M).astype(np.int64), axis=0,
                               return_inverse=True)
    faces = index.reshape(-1)[city.faces]
    above = ~city.terrain if city.terrain is not None else (
        city.vertices[city.faces][:, :, 2] > _GROUND_M).any(axis=1)
    sides = faces[above][:, [[0, 1], [1, 2]]].reshape(-1, 2)
    graph = coo_matrix((np.ones(len(sides)), sides.T), shape=(len(corners),) * 2)
    label = connected_components(graph, directed=False)[1]
    built = np.zeros(len(corners), dtype=bool)
    built[sides.ravel()] = True
    _, building = np.unique(np.where(built, label, -1), return_inverse=True)
    return (building.reshape(-1) - (~built).any())[index.reshape(-1)]


@lru_cache(maxsize=8)  # a map holds what was found for its paths: tens of MB
def perturbed_map(city: CityMap, wall_sd_m: float, height_sd_m: float, seed: int) -> CityMap:
    """Return a map with the walls and roofs of every building moved by normal errors.

    The walls on opposite sides of a building move independently, so that it is shifted and grows or
    shrinks; its roof keeps its shape. The same seed moves them in the same direction whatever the
    size of the errors.

    Args:
        city: 3D map.
        wall_sd_m: standard deviation of the position of a wall, across it [m].
        height_sd_m: standard deviation of a building's height [m].
        seed: of the errors.
    """
    rng = np.random.default_rng(seed)
    building = building_of_vertex(city)
    count = int(building.max()) + 1 if len(building) else 0
    walls_m = wall_sd_m * rng.standard_normal((count, 2, 2))
    heights_m = height_sd_m * rng.standard_normal(count)
    vertices_m = city.vertices.copy()
    order = np.argsort(building, kind="stable")
    ends = np.searchsorted(building[order], np.arange(count + 1))
    for number in range(count):
        rows = order[ends[number]:ends[number + 1]]
        corners_m = vertices_m[rows]
        low_m, size_m = corners_m[:, :2].min(axis=0), np.ptp(corners_m[:, :2], axis=0)
        share = (corners_m[:, :2] - low_m) / np.maximum(size_m, SAME_CORNER_M)
        corners_m[:, :2] += (1 - share) * walls_m[number, 0] + share * walls_m[number, 1]
        base_m = 0.0 if city.terrain is None else corners_m[:, 2].min()
        corners_m[:, 2] -= base_m
        top_m = corners_m[:, 2].max()
        corners_m[:, 2] *= max(1 + heights_m[number] / top_m, MIN_HEIGHT_SHARE)
        corners_m[:, 2] += base_m
        vertices_m[rows] = corners_m
    return city.with_vertices(vertices_m)


def shape_height_sds_m(folder: Path) -> dict[str, float] | None:
    """Return the standard deviation of the height of each shape [m], as `buildings.csv` has it.

    A shape is a block of buildings that touch: it has their mean, by area.

    Args:
        folder: of a scene.

    Returns:
        shape -> standard deviation; None: the folder has no such table, or one of an earlier
        version, without the column `height_sd_m`.

    Raises:
        BadInput: the table cannot be read, lies outside the folder, or has an impossible value.
    """
    path = folder / "buildings.csv"
    if not path.is_file():
        return None
    require_within(folder, path, str(folder))
    table = read_cells(path, optional=("shape", "area_m2", "height_sd_m"))
    if not {"shape", "area_m2", "height_sd_m"} <= set(table.columns):
        return None
    numbers = {name: as_numbers(table[name]) for name in ("area_m2", "height_sd_m")}
    for name, most in (("area_m2", _MAX_AREA_M2), ("height_sd_m", _MAX_SD_M)):
        refuse(path, name, table[name], ~((numbers[name] > 0) & (numbers[name] <= most)),
               f"is impossible; allowed are numbers above 0, up to {most:g}")
    areas_m2 = pd.Series(numbers["area_m2"]).groupby(table["shape"]).sum()
    sums = pd.Series(numbers["area_m2"] * numbers["height_sd_m"]).groupby(table["shape"]).sum()
    return dict((sums / areas_m2).items())
