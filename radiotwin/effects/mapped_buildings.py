"""The buildings of a 3D map: their faces, positions, and standard deviations of their heights."""

from functools import lru_cache

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from radiotwin.scene.citymap import CityMap

WELD_M = 0.05  # vertices closer together belong to one building
# Standard deviation of a height: the default, and a lower bound. With less, other shadows beside a
# roof are fitted by small errors of its height.
HEIGHT_SD_M = 3.0  # one storey


@lru_cache(maxsize=4)
def buildings(city: CityMap) -> tuple[np.ndarray, np.ndarray]:
    """Group faces that are connected.

    Args:
        city: a map with f faces.

    Returns:
        (f,) index of each face's building, and (buildings, 3) centre x, y and height of each [m];
        read-only, as they are kept for the next call.
    """
    welded = np.round(city.vertices / WELD_M).astype(np.int64)
    vertex = np.unique(welded, axis=0, return_inverse=True)[1].ravel()
    faces = vertex[city.faces]
    ends = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])),
                       shape=(vertex.max() + 1,) * 2)
    component = connected_components(graph, directed=False)[1]
    label = np.unique(component[faces[:, 0]], return_inverse=True)[1]
    low_m, high_m = building_extents_m(city, label)
    centre_m = np.column_stack([0.5 * (low_m + high_m)[:, :2], high_m[:, 2]])
    label.flags.writeable = centre_m.flags.writeable = False
    return label, centre_m


def building_extents_m(city: CityMap, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest x, y and z (buildings, 3) of faces by their label (f,)."""
    corners_m = city.vertices[city.faces]
    low_m = np.full((label.max() + 1, 3), np.inf)
    high_m = -low_m
    np.minimum.at(low_m, label, corners_m.min(axis=1))
    np.maximum.at(high_m, label, corners_m.max(axis=1))
    return low_m, high_m


def building_height_sds_m(city: CityMap) -> np.ndarray:
    """Return the standard deviation of the mapped height of each building, a storey at least.

    Args:
        city: a map.

    Returns:
        (buildings,), as `buildings` numbers them [m]
    """
    label, centres_m = buildings(city)
    if city.height_sd_m is None:
        return np.full(len(centres_m), HEIGHT_SD_M)
    known = np.isfinite(city.height_sd_m)
    faces = np.bincount(label[known], minlength=len(centres_m))
    sums = np.bincount(label[known], weights=city.height_sd_m[known], minlength=len(centres_m))
    return np.maximum(sums / np.maximum(faces, 1), HEIGHT_SD_M)
