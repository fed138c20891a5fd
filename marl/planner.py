"""The strong planner without learning: simulated annealing over waypoints, judged by the mission's own rules.

It knows the radio map and nothing else: where a device is does not matter, only where it is heard. Shadowing enters by
its expectation: each slot counts with what it gives on average.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.stats import norm

from marl.environment import ACTION_COUNT, Frame, assign, feasible
from marl.mission import COSTS, EAST, HOVER, MOVES, NO_OP, NORTH, SOUTH, WEST, Mission
from marl.randomness import stream
from radiotwin.progress import progress

MOST_WAYPOINTS = 8  # of a UAV
HOT, COLD = 0.02, 0.0003  # temperature at the start and at the end, in collection ratio
CHUNK = 5000  # iterations between updates of the progress bar


class Plan(NamedTuple):
    """What to fly, whatever happens.

    Attributes:
        actions: (T, U) int8; feasible from take-off until all batteries are empty.
        ratio: expected share of the data that it collects in the map that it was planned in.
        tour: (U, MOST_WAYPOINTS, 3) int64 waypoints (row, column, hovers) that the actions come of.
        visits: (U,) int64 number of waypoints of each UAV.
    """

    actions: np.ndarray
    ratio: float
    tour: np.ndarray
    visits: np.ndarray


class TourFlight(NamedTuple):
    """Where UAVs that follow tours are, and what they work with.

    Attributes:
        cell: (U, 2) int64 row and column.
        battery: (U,) int64 slots that are left.
        left: (K,) data units that are expected to be left.
        reached, hovered: (U,) int64 waypoints behind each UAV, and hovers flown at the next one.
        strength, assigned, mask: room for the choice of devices and actions, which a slot overwrites.
    """

    cell: np.ndarray
    battery: np.ndarray
    left: np.ndarray
    reached: np.ndarray
    hovered: np.ndarray
    strength: np.ndarray
    assigned: np.ndarray
    mask: np.ndarray


class PlanPolicy:
    """Flies the (T, U) actions of a plan, in all flights the same."""

    def __init__(self, actions: np.ndarray):
        self._actions = actions

    def start(self, mission: Mission, flights: int) -> None:
        self._slot, self._flights = 0, flights

    def act(self, frame: Frame) -> np.ndarray:
        action = np.tile(self._actions[self._slot].astype(np.int64), (self._flights, 1))
        self._slot += 1
        return action


def plan(mission: Mission, iterations: int, seed: int) -> Plan:
    """Search a good plan.

    Args:
        mission: in the map that one has.
        iterations: plans that are tried; the annealing is spread over them.
        seed: of the search.
    """
    rng = stream(seed, "planning")
    value = expected_data(mission)
    tour = np.zeros((mission.uavs, MOST_WAYPOINTS, 3), dtype=np.int64)
    count = np.zeros(mission.uavs, dtype=np.int64)
    with progress("planning", total=iterations) as advance:
        return improve(mission, value, tour, count, iterations, rng, advance=advance)


def improve(mission: Mission, value: np.ndarray, tour: np.ndarray, count: np.ndarray, iterations: int,
            rng: np.random.Generator, *, only: int = -1, hot: float = HOT,
            advance: Callable[[int], None] = lambda _: None) -> Plan:
    """Search on from a tour.

    Args:
        mission: where the UAVs are, what they have left, and what is thought to be left at the devices.
        value: `expected_data` of its map.
        tour, count: see `Plan`; not changed.
        iterations: plans that are tried.
        rng: of the search.
        only: the UAV whose tour is changed, while the others keep theirs; -1 for all.
        hot: temperature at the start, in collection ratio.
        advance: called with the number of plans tried.
    """
    peaks = np.stack(np.unravel_index(value.reshape(*value.shape[:2], -1).argmax(axis=2), value.shape[2:]), axis=-1)
    tour, count = tour.copy(), count.copy()
    best_tour, best_count = tour.copy(), count.copy()
    actions = np.full((mission.longest, mission.uavs), NO_OP, dtype=np.int8)
    score = best = _fly_tour(mission, value, tour, count, actions)
    for start in range(0, iterations, CHUNK):
        stop = min(start + CHUNK, iterations)
        score, best = _anneal(mission, value, peaks, tour, count, only, hot, score, best_tour, best_count, best,
                              np.arange(start, stop) / iterations, actions, rng)
        advance(stop - start)
    best = _fly_tour(mission, value, best_tour, best_count, actions)
    return Plan(actions, float(best), best_tour, best_count)


def expected_data(mission: Mission) -> np.ndarray:
    """Expected data units of one slot on each link: the chance that its SNR reaches the threshold times the rate at the
    mean SNR of the cases in which it does.

    Returns:
        (U, K, ny, nx) float64
    """
    mean_db, sigma_db = mission.snr_db.astype(float), np.maximum(mission.sigma_db.astype(float), 1e-6)
    least_db = max(mission.threshold_db, mission.detection_db)
    short = np.clip((least_db - mean_db) / sigma_db, -40.0, 40.0)
    chance = np.where(mission.sigma_db > 0, norm.sf(short), mean_db >= least_db)
    # Mean of a normal distribution above a threshold; the ratio of density and tail in logarithms, both may vanish.
    usable_db = np.where(np.isfinite(mean_db), mean_db, 0) + sigma_db * np.exp(norm.logpdf(short) - norm.logsf(short))
    data = mission.rate_scale * np.log2(1 + 10 ** (np.minimum(usable_db, 300.0) / 10))
    return np.where(np.isfinite(mean_db) & (chance > 1e-3), chance * data, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _towards(mission, uav, row, column, to_row, to_column, mask):
    """A feasible move towards a cell, along the larger axis where that is possible; NO_OP where there is none."""
    north_south = NORTH if to_row > row else SOUTH
    east_west = EAST if to_column > column else WEST
    first, second = north_south, east_west
    if abs(to_column - column) >= abs(to_row - row):
        first, second = east_west, north_south
    if mask[first]:
        return first
    if to_row != row and to_column != column and mask[second]:
        return second
    return NO_OP


@njit(cache=True, nogil=True, error_model="numpy")
def next_action(mission, uav, row, column, battery, tour, count, reached, hovered, mask):
    """Follow the tour; where the battery does not allow that, or at its end, stay as long as possible, then go home.

    Returns:
        action, waypoints reached, hovers flown at the present one
    """
    feasible(mission, uav, row, column, battery, mask)
    while reached < count:
        to_row, to_column, hovers = tour[reached]
        if row == to_row and column == to_column:
            if hovered < hovers and mask[HOVER]:
                return HOVER, reached, hovered + 1
        else:
            action = _towards(mission, uav, row, column, to_row, to_column, mask)
            if action != NO_OP:
                return action, reached, hovered
        reached, hovered = reached + 1, 0
    if mask[HOVER]:
        return HOVER, reached, hovered
    for action in range(ACTION_COUNT):
        if mask[action]:
            to_row, to_column = row + MOVES[action, 0], column + MOVES[action, 1]
            if action == NO_OP or mission.steps_home[uav, to_row, to_column] < mission.steps_home[uav, row, column]:
                return action, reached, hovered
    return NO_OP, reached, hovered


@njit(cache=True, nogil=True, error_model="numpy")
def take_off(mission, devices):
    """The UAVs before the first slot."""
    uavs = len(mission.battery)
    return TourFlight(mission.start.copy(), mission.battery.copy(), mission.data_units.copy(),
                      np.zeros(uavs, np.int64), np.zeros(uavs, np.int64), np.empty((uavs, devices)),
                      np.empty(uavs, np.int16), np.empty(ACTION_COUNT, np.bool_))


@njit(cache=True, nogil=True, error_model="numpy")
def fly_on(mission, value, tour, count, flight, actions):
    """As many slots along the tours as `actions` (T, U) has room for, with the data that is expected."""
    cell, battery, left, reached, hovered, strength, assigned, mask = flight
    uavs, devices = value.shape[:2]
    for slot in range(len(actions)):
        for u in range(uavs):
            for k in range(devices):
                worth = value[u, k, cell[u, 0], cell[u, 1]]
                strength[u, k] = worth if battery[u] > 0 and left[k] > 0 and worth > 0 else -np.inf
        assign(strength, mission.max_rate, assigned)
        for u in range(uavs):
            k = assigned[u]
            if k >= 0:
                left[k] = max(left[k] - value[u, k, cell[u, 0], cell[u, 1]], 0.0)
            action, reached[u], hovered[u] = next_action(mission, u, cell[u, 0], cell[u, 1], battery[u], tour[u],
                                                          count[u], reached[u], hovered[u], mask)
            actions[slot, u] = action
            cell[u, 0] += MOVES[action, 0]
            cell[u, 1] += MOVES[action, 1]
            battery[u] -= COSTS[action]


@njit(cache=True, nogil=True, error_model="numpy")
def _fly_tour(mission, value, tour, count, actions):
    """Expected share of the data that a tour collects; its actions are written into `actions`."""
    flight = take_off(mission, value.shape[1])
    fly_on(mission, value, tour, count, flight, actions)
    return 1.0 - flight.left.sum() / mission.data_units.sum()


@njit(cache=True, nogil=True, error_model="numpy")
def _anneal(mission, value, peaks, tour, count, only, hot, score, best_tour, best_count, best, progress, actions, rng):
    """Try a change at every step of `progress` (0 to 1); keep better ones, and worse ones with falling chance.

    `only` is the UAV whose tour is changed, -1 for any; `hot` the temperature at the start.
    """
    old_tour, old_count = tour.copy(), count.copy()
    for done in progress:
        temperature = hot * (COLD / hot) ** done
        old_tour[:], old_count[:] = tour, count
        _change(tour, count, only, peaks, value.shape[2], value.shape[3], rng)
        new = _fly_tour(mission, value, tour, count, actions)
        if new >= score or rng.random() < np.exp((new - score) / temperature):
            score = new
            if score > best:
                best = score
                best_tour[:], best_count[:] = tour, count
        else:
            tour[:], count[:] = old_tour, old_count
    return score, best


@njit(cache=True, nogil=True, error_model="numpy")
def _change(tour, count, only, peaks, rows, columns, rng):
    """One random change of one tour, or of two."""
    u = only if only >= 0 else rng.integers(0, len(count))
    n = count[u]
    kind = rng.random()
    if n < MOST_WAYPOINTS and (n == 0 or kind < 0.12):  # one more, where a device is heard best or anywhere
        at = rng.integers(0, n + 1)
        for i in range(n, at, -1):
            tour[u, i] = tour[u, i - 1]
        _draw_waypoint(tour[u, at], peaks[u], rows, columns, rng)
        count[u] = n + 1
        return
    at = rng.integers(0, n)
    if kind < 0.24:  # one less
        for i in range(at, n - 1):
            tour[u, i] = tour[u, i + 1]
        count[u] = n - 1
    elif kind < 0.54:  # a little aside
        for axis, limit in ((0, rows), (1, columns)):
            tour[u, at, axis] = min(max(tour[u, at, axis] + rng.integers(-2, 3), 0), limit - 1)
    elif kind < 0.74:  # stay longer or shorter
        tour[u, at, 2] = max(tour[u, at, 2] + rng.integers(-4, 5), 0)
    elif kind < 0.82:  # elsewhere
        _draw_waypoint(tour[u, at], peaks[u], rows, columns, rng)
    elif kind < 0.91:  # in another order
        other = rng.integers(0, n)
        for i in range(3):
            tour[u, at, i], tour[u, other, i] = tour[u, other, i], tour[u, at, i]
    else:  # exchange with another UAV
        v = only if only >= 0 else rng.integers(0, len(count))
        if count[v] > 0:
            other = rng.integers(0, count[v])
            for i in range(3):
                tour[u, at, i], tour[v, other, i] = tour[v, other, i], tour[u, at, i]


@njit(cache=True, nogil=True, error_model="numpy")
def _draw_waypoint(waypoint, peaks, rows, columns, rng):
    if rng.random() < 0.7:
        k = rng.integers(0, len(peaks))
        for axis, limit in ((0, rows), (1, columns)):
            waypoint[axis] = min(max(peaks[k, axis] + rng.integers(-2, 3), 0), limit - 1)
    else:
        waypoint[0], waypoint[1] = rng.integers(0, rows), rng.integers(0, columns)
    waypoint[2] = rng.integers(0, 10)
