"""Test of paths for obstacles."""

from collections.abc import Iterator

import numpy as np

from radiotwin.propagation.paths.images import Candidates, PathBuffer, find_paths, sequence_length
from radiotwin.propagation.paths.surfaces import NORMAL, NORMAL_0, NORMAL_N, Surfaces
from radiotwin.runtime.compiled import njit
from radiotwin.scene.citymap import SKIN_M, CityMap


def found_clear(
    city: CityMap, surfaces: Surfaces, candidates: Candidates, device_m: np.ndarray,
    receiver_m: np.ndarray, buffer: PathBuffer,
) -> Iterator[np.ndarray]:
    """Find the paths from a device that nothing blocks, as many at a time as a buffer holds.

    Args:
        city: 3D map.
        surfaces: of the map.
        candidates: that are tried.
        device_m: (3,) position [m].
        receiver_m: (n, 3) positions [m].
        buffer: takes the paths.

    Yields:
        (m,) rows of the buffer, ascending; the next paths take their places.
    """
    cursor = 0
    while cursor < len(candidates.edge) * len(receiver_m):
        found, cursor = find_paths(surfaces, candidates, device_m, receiver_m, cursor, buffer)
        yield clear_paths(city, surfaces, candidates, buffer, found)


def clear_paths(
    city: CityMap, surfaces: Surfaces, candidates: Candidates, buffer: PathBuffer, found: int
) -> np.ndarray:
    """Return the rows of the paths in a buffer that nothing blocks.

    Points of interaction are moved off their surface by `SKIN_M`, so that no surface blocks the
    path that it reflects or diffracts.

    Args:
        city: 3D map.
        surfaces: of the map.
        candidates: that the paths were found with.
        buffer: the paths.
        found: number of paths in the buffer.

    Returns:
        (m,) rows of the buffer, ascending.
    """
    legs = buffer.count[:found] - 1
    points_m = np.empty((int(legs.max(initial=0)) + 1, found, 3))
    _move_off_surfaces(surfaces, candidates, buffer, SKIN_M, points_m)
    rows = np.arange(found)
    for leg in range(len(points_m) - 1):
        used = np.flatnonzero(legs[rows] > leg)
        tested = rows[used]
        clear = np.ones(len(rows), dtype=bool)
        clear[used] = city.line_of_sight(points_m[leg].take(tested, 0),
                                         points_m[leg + 1].take(tested, 0))
        rows = rows[clear]
    return rows


@njit(cache=True, nogil=True, error_model="numpy")
def _move_off_surfaces(
    surfaces: Surfaces, candidates: Candidates, buffer: PathBuffer, skin_m: float,
    points_m: np.ndarray,
) -> None:
    planes, edges = surfaces.planes, surfaces.edges
    for path in range(points_m.shape[1]):
        row, last = buffer.candidate[path], buffer.count[path] - 1
        before = sequence_length(candidates.before, row)
        for k in range(last + 1):
            x = y = z = 0.0
            if k == 0 or k == last:
                pass
            elif k == before + 1:
                edge = candidates.edge[row]
                x = edges[edge, NORMAL_0] + edges[edge, NORMAL_N]
                y = edges[edge, NORMAL_0 + 1] + edges[edge, NORMAL_N + 1]
                z = edges[edge, NORMAL_0 + 2] + edges[edge, NORMAL_N + 2]
                size = np.sqrt(x * x + y * y + z * z)
                x, y, z = x / size, y / size, z / size
            else:
                facet = candidates.before[row, k - 1] if k <= before \
                    else candidates.after[row, k - before - 2]
                x, y, z = planes[facet, NORMAL], planes[facet, NORMAL + 1], \
                    planes[facet, NORMAL + 2]
            points_m[k, path, 0] = buffer.points_m[path, k, 0] + skin_m * x
            points_m[k, path, 1] = buffer.points_m[path, k, 1] + skin_m * y
            points_m[k, path, 2] = buffer.points_m[path, k, 2] + skin_m * z
