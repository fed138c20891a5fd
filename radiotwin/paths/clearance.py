"""Whether anything stands in the way of a path."""

import numpy as np
from numba import njit

from radiotwin.scene.citymap import SKIN_M, CityMap


def clear_paths(city: CityMap, surfaces, candidates, buffer, found: int) -> np.ndarray:
    """Rows of the first `found` paths of a buffer whose legs are all clear.

    Turns are pulled off the surface by `SKIN_M`, so that no leg is blocked by what it turns on.
    """
    points_m = np.empty((found, *buffer.points_m.shape[1:]))
    _pulled_off(surfaces, candidates, buffer, SKIN_M, points_m)
    legs = buffer.count[:found] - 1
    rows = np.arange(found)
    for leg in range(int(legs.max()) if found else 0):
        used = np.flatnonzero(legs[rows] > leg)
        tested = rows[used]
        clear = np.ones(len(rows), dtype=bool)
        clear[used] = city.line_of_sight(points_m[tested, leg], points_m[tested, leg + 1])
        rows = rows[clear]
    return rows


@njit(cache=True, nogil=True, error_model="numpy")
def _pulled_off(surfaces, candidates, buffer, skin_m, points_m):
    for path in range(len(points_m)):
        row, last = buffer.candidate[path], buffer.count[path] - 1
        before = 0
        while before < candidates.before.shape[1] and candidates.before[row, before] >= 0:
            before += 1
        points_m[path] = buffer.points_m[path]
        for k in range(1, last):
            if k == before + 1:
                edge = candidates.edge[row]
                outward = surfaces.edges[edge, 10:13] + surfaces.edges[edge, 13:16]
                outward /= np.sqrt((outward ** 2).sum())
            elif k <= before:
                outward = surfaces.planes[candidates.before[row, k - 1], :3]
            else:
                outward = surfaces.planes[candidates.behind[row, k - before - 2], :3]
            points_m[path, k] += skin_m * outward
