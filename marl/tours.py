"""Random changes of tours: the neighbourhood of the planner's simulated annealing."""

import numpy as np

from radiotwin.runtime.compiled import njit


@njit(cache=True, nogil=True, error_model="numpy")
def change(tour: np.ndarray, count: np.ndarray, only: int, level: np.ndarray, peaks: np.ndarray,
           left: np.ndarray, rows: int, columns: int, rng: np.random.Generator,
           changed: np.ndarray, first: np.ndarray) -> int:
    """Change one tour, or two, at random in place; return how many may have changed.

    A change that does not fit is abandoned: then 1 is returned, and no tour has changed.

    `tour` (U, W, 3) and `count` (U,) are as in `marl.planner.Plan`; `only` is the UAV whose tour
    changes, -1 any. `peaks` (L, K, 2) are the cells where devices are heard best; those with much
    data `left` (K,) attract new waypoints. Written to `changed` (2,) are the UAVs whose tours have
    changed, to `first` (2,) the index of the first changed waypoint of each.
    """
    u = int(only if only >= 0 else rng.integers(0, len(count)))
    n, max_count = count[u], tour.shape[1]
    kind = rng.random()
    changed[0] = u
    if n < max_count and (n == 0 or kind < 0.12):  # insert a waypoint
        first[0] = rng.integers(0, n + 1)
        _insert(tour[u], count, u, first[0])
        _draw_waypoint(tour[u, first[0]], peaks[level[u]], left, rows, columns, rng)
        return 1
    at = rng.integers(0, n)
    first[0] = at
    if kind < 0.24:
        _delete(tour[u], count, u, at)
    elif kind < 0.54:  # shift a waypoint by up to two cells
        for axis, limit in ((0, rows), (1, columns)):
            tour[u, at, axis] = min(max(tour[u, at, axis] + rng.integers(-2, 3), 0), limit - 1)
    elif kind < 0.74:  # change its hovers
        tour[u, at, 2] = max(tour[u, at, 2] + rng.integers(-4, 5), 0)
    elif kind < 0.82:  # replace it
        _draw_waypoint(tour[u, at], peaks[level[u]], left, rows, columns, rng)
    elif kind < 0.88 or len(count) == 1 or only >= 0:  # swap two waypoints of the tour
        other = rng.integers(0, n)
        first[0] = min(at, other)
        _exchange(tour[u, at], tour[u, other])
    else:
        v = int((u + rng.integers(1, len(count))) % len(count))
        other = rng.integers(0, count[v] + 1)
        changed[1], first[1] = v, other
        if kind < 0.92:  # swap a waypoint with another UAV
            if other == count[v]:
                return 1
            _exchange(tour[u, at], tour[v, other])
        elif kind < 0.96:  # give a waypoint to another UAV
            if count[v] == max_count:
                return 1
            _insert(tour[v], count, v, other)
            tour[v, other] = tour[u, at]
            _delete(tour[u], count, u, at)
        else:  # swap the tails of the tours
            rest, others = n - at, count[v] - other
            if at + others > max_count or other + rest > max_count:
                return 1
            for i in range(max(rest, others)):
                if i < min(rest, others):
                    _exchange(tour[u, at + i], tour[v, other + i])
                elif i < rest:
                    tour[v, other + i] = tour[u, at + i]
                else:
                    tour[u, at + i] = tour[v, other + i]
            count[u], count[v] = at + others, other + rest
        return 2
    return 1


@njit(cache=True, nogil=True, error_model="numpy")
def _insert(tour: np.ndarray, count: np.ndarray, uav: int, at: int) -> None:
    """Make room for a waypoint at an index of one UAV's tour (W, 3)."""
    for i in range(count[uav], at, -1):
        tour[i] = tour[i - 1]
    count[uav] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _delete(tour: np.ndarray, count: np.ndarray, uav: int, at: int) -> None:
    """Delete the waypoint at an index of one UAV's tour (W, 3)."""
    for i in range(at, count[uav] - 1):
        tour[i] = tour[i + 1]
    count[uav] -= 1


@njit(cache=True, nogil=True, error_model="numpy")
def _exchange(one: np.ndarray, other: np.ndarray) -> None:
    """Swap two waypoints (3,) in place."""
    for i in range(len(one)):
        one[i], other[i] = other[i], one[i]


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_waypoint(waypoint: np.ndarray, peaks: np.ndarray, left: np.ndarray, rows: int,
                   columns: int, rng: np.random.Generator) -> None:
    """Draw a waypoint (3,) in place: with probability 0.7 near a device's peak cell, else anywhere.

    Of two random devices, the one with more data left is taken.
    """
    if rng.random() < 0.7:
        k, other = rng.integers(0, len(peaks)), rng.integers(0, len(peaks))
        k = other if left[other] > left[k] else k
        for axis, limit in ((0, rows), (1, columns)):
            waypoint[axis] = min(max(peaks[k, axis] + rng.integers(-2, 3), 0), limit - 1)
    else:
        waypoint[0], waypoint[1] = rng.integers(0, rows), rng.integers(0, columns)
    waypoint[2] = rng.integers(0, 10)
