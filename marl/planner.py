"""Planning without learning: simulated annealing over waypoints, scored by the mission's rules.

The planner needs the radio map alone: where a device is does not matter, only where it is heard.
Shadowing enters by its expectation: each slot counts with its mean data.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.stats import norm
from typing_extensions import override

from marl.checkpoint import require, require_plan
from marl.environment import ACTION_COUNT, Frame, assign, feasible
from marl.flights import Policy
from marl.learner import Learner, Setup
from marl.mission import COSTS, EAST, HOVER, MOVES, NO_OP, NORTH, SOUTH, WEST, Mission
from marl.settings import stream
from radiotwin.runtime.compiled import njit
from radiotwin.runtime.console import progress

MAX_WAYPOINTS = 8  # of a UAV
START_TEMPERATURE, END_TEMPERATURE = 0.02, 0.0003  # of the annealing, in collected share
CHUNK = 5000  # iterations between updates of the progress bar


class Plan(NamedTuple):
    """An open-loop plan.

    Attributes:
        actions: (T, U) int8; feasible from take-off until all batteries are empty.
        ratio: expected share of the data that it collects in the map that it was planned in.
        tour: (U, MAX_WAYPOINTS, 3) int64 waypoints (row, column, hovers) that the actions follow.
        visits: (U,) int64 number of waypoints of each UAV.
    """

    actions: np.ndarray
    ratio: float
    tour: np.ndarray
    visits: np.ndarray


class TourFlight(NamedTuple):
    """State of U UAVs that follow tours, and scratch arrays.

    Attributes:
        cell: (U, 2) int64 row and column.
        battery: (U,) int64 hovers that are left.
        left: (K,) data units that are expected to be left.
        reached: (U,) int64 waypoints that each UAV has passed.
        hovered: (U,) int64 hovers flown at the next waypoint.
        strength, assigned, mask: (U, K), (U,) and (6,) scratch.
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
    """Fly the (T, U) actions of a plan, the same in all flights."""

    def __init__(self, actions: np.ndarray) -> None:
        self._actions = actions

    def start(self, mission: Mission, flights: int) -> None:
        """See `marl.flights.Policy`."""
        self._slot, self._flights = 0, flights

    def act(self, frame: Frame) -> np.ndarray:
        """See `marl.flights.Policy`."""
        action = np.tile(self._actions[self._slot].astype(np.int64), (self._flights, 1))
        self._slot += 1
        return action


class Planner(Learner):
    """`--algorithm planner`: search a plan in the map and fly it as it is."""

    learns = False

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self._actions = np.empty((0, 0))  # until the first `prepare`

    @override
    def prepare(self, mission: Mission,
                on_progress: Callable[[int], None]) -> list[dict[str, float]]:
        run = self.setup.run
        self._actions = plan(mission, run.planner_iterations, run.seed).actions
        return []

    @override
    def policy(self, rng: np.random.Generator) -> Policy:
        return PlanPolicy(self._actions)

    @override
    def state(self, last: bool) -> dict:
        return {"actions": self._actions}

    @override
    def load_state(self, state: dict) -> None:
        require(state, {"actions": ...})
        self._actions = require_plan(state["actions"], self.setup.mission)


def plan(mission: Mission, iterations: int, seed: int) -> Plan:
    """Search a plan in the map that is known; the annealing is spread over so many tried plans."""
    rng = stream(seed, "planning")
    value = expected_data(mission)
    tour = np.zeros((mission.uavs, MAX_WAYPOINTS, 3), dtype=np.int64)
    count = np.zeros(mission.uavs, dtype=np.int64)
    with progress("planning", total=iterations) as advance:
        return improve(mission, value, tour, count, iterations, rng, on_progress=advance)


def improve(mission: Mission, value: np.ndarray, tour: np.ndarray, count: np.ndarray,
            iterations: int, rng: np.random.Generator, *, only: int = -1,
            temperature: float = START_TEMPERATURE,
            on_progress: Callable[[int], None] = lambda _: None) -> Plan:
    """Continue the search from a tour.

    Args:
        mission: cells and batteries of the UAVs, and the data believed to be left at the devices.
        value: `expected_data` of its map.
        tour: see `Plan`; not changed.
        count: visits of `Plan`; not changed.
        iterations: plans that are tried.
        rng: of the search.
        only: UAV whose tour is changed while the others keep theirs; -1 for all.
        temperature: at the start, in collected share.
        on_progress: called with the number of plans tried since the last call.
    """
    strongest = value.reshape(*value.shape[:2], -1).argmax(axis=2)
    peaks = np.stack(np.unravel_index(strongest, value.shape[2:]), axis=-1)[mission.level]
    tour, count = tour.copy(), count.copy()
    best_tour, best_count = tour.copy(), count.copy()
    actions = np.full((mission.longest, mission.uavs), NO_OP, dtype=np.int8)
    score = best = _fly_tour(mission, value, tour, count, actions)
    for start in range(0, iterations, CHUNK):
        stop = min(start + CHUNK, iterations)
        score, best = _anneal(mission, value, peaks, tour, count, only, temperature, score,
                              best_tour, best_count, best, np.arange(start, stop) / iterations,
                              actions, rng)
        on_progress(stop - start)
    best = _fly_tour(mission, value, best_tour, best_count, actions)
    return Plan(actions, float(best), best_tour, best_count)


def expected_data(mission: Mission) -> np.ndarray:
    """Return the data units (L, K, ny, nx) that one slot on each link is expected to bring.

    The probability that the SNR reaches the threshold times the rate at the mean SNR of the cases
    in which it does.
    """
    mean_db = mission.snr_db.astype(float)
    sigma_db = np.maximum(mission.sigma_db.astype(float), 1e-6)
    least_db = max(mission.threshold_db, mission.detection_db)
    short = np.clip((least_db - mean_db) / sigma_db, -40.0, 40.0)
    chance = np.where(mission.sigma_db > 0, norm.sf(short), mean_db >= least_db)
    # Mean of a normal distribution above a threshold; density and tail in logarithms, because
    # both may vanish.
    hazard = np.exp(norm.logpdf(short) - norm.logsf(short))
    usable_db = np.where(np.isfinite(mean_db), mean_db, 0) + sigma_db * hazard
    data = mission.rate_scale * np.log2(1 + 10 ** (np.minimum(usable_db, 300.0) / 10))
    return np.where(np.isfinite(mean_db) & (chance > 1e-3), chance * data, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _towards(row: int, column: int, to_row: int, to_column: int, mask: np.ndarray) -> int:
    """Return a feasible move towards a cell, along the larger axis if possible; NO_OP for none."""
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
def next_action(mission: Mission, uav: int, row: int, column: int, battery: int, tour: np.ndarray,
                count: int, reached: int, hovered: int, mask: np.ndarray) -> tuple[int, int, int]:
    """Follow a tour; at its end, or for lack of battery, stay as long as possible, then go home.

    The tour (MAX_WAYPOINTS, 3) has `count` waypoints; the UAV has passed `reached` of them, and has
    hovered so long at the next one. `battery` is in hovers, `mask` (6,) is scratch.

    Returns:
        Action, and the new `reached` and `hovered`.
    """
    feasible(mission, uav, row, column, battery, mask)
    while reached < count:
        to_row, to_column, hovers = tour[reached]
        if row == to_row and column == to_column:
            if hovered < hovers and mask[HOVER]:
                return HOVER, reached, hovered + 1
        else:
            action = _towards(row, column, to_row, to_column, mask)
            if action != NO_OP:
                return action, reached, hovered
        reached, hovered = reached + 1, 0
    if mask[HOVER]:
        return HOVER, reached, hovered
    for action in range(ACTION_COUNT):
        if mask[action]:
            to_row, to_column = row + MOVES[action, 0], column + MOVES[action, 1]
            home = mission.steps_home[uav]
            if action == NO_OP or home[to_row, to_column] < home[row, column]:
                return action, reached, hovered
    return NO_OP, reached, hovered


@njit(cache=True, nogil=True, error_model="numpy")
def take_off(mission: Mission, devices: int) -> TourFlight:
    """Return the state before the first slot."""
    uavs = len(mission.battery)
    return TourFlight(mission.start.copy(), mission.battery.copy(), mission.data_units.copy(),
                      np.zeros(uavs, np.int64), np.zeros(uavs, np.int64),
                      np.empty((uavs, devices)), np.empty(uavs, np.int16),
                      np.empty(ACTION_COUNT, np.bool_))


@njit(cache=True, nogil=True, error_model="numpy")
def fly_on(mission: Mission, value: np.ndarray, tour: np.ndarray, count: np.ndarray,
           flight: TourFlight, actions: np.ndarray) -> None:
    """Fly as many slots along the tours as `actions` (T, U) has rows, with the expected data."""
    cell, battery, left, reached, hovered, strength, assigned, mask = flight
    uavs, devices = strength.shape
    for slot in range(len(actions)):
        for u in range(uavs):
            for k in range(devices):
                worth = value[mission.level[u], k, cell[u, 0], cell[u, 1]]
                usable = battery[u] > 0 and left[k] > 0 and worth > 0
                strength[u, k] = worth if usable else -np.inf
        assign(strength, mission.max_rate, assigned)
        for u in range(uavs):
            k = assigned[u]
            if k >= 0:
                worth = value[mission.level[u], k, cell[u, 0], cell[u, 1]]
                left[k] = max(left[k] - worth, 0.0)
            action, reached[u], hovered[u] = next_action(
                mission, u, cell[u, 0], cell[u, 1], battery[u], tour[u], count[u], reached[u],
                hovered[u], mask)
            actions[slot, u] = action
            cell[u, 0] += MOVES[action, 0]
            cell[u, 1] += MOVES[action, 1]
            battery[u] -= COSTS[action]


@njit(cache=True, nogil=True, error_model="numpy")
def _fly_tour(mission: Mission, value: np.ndarray, tour: np.ndarray, count: np.ndarray,
              actions: np.ndarray) -> float:
    """Return the share of the data that a tour should collect; write its actions to `actions`."""
    flight = take_off(mission, value.shape[1])
    fly_on(mission, value, tour, count, flight, actions)
    return 1.0 - flight.left.sum() / mission.data_units.sum()


@njit(cache=True, nogil=True, error_model="numpy")
def _anneal(mission: Mission, value: np.ndarray, peaks: np.ndarray, tour: np.ndarray,
            count: np.ndarray, only: int, hot: float, score: float, best_tour: np.ndarray,
            best_count: np.ndarray, best: float, progress: np.ndarray, actions: np.ndarray,
            rng: np.random.Generator) -> tuple[float, float]:
    """Try a change at every step of `progress` (0 to 1) and keep it by the Metropolis rule.

    `only` is the UAV whose tour is changed, -1 for any; `hot` the temperature at the start.
    """
    old_tour, old_count = tour.copy(), count.copy()
    for done in progress:
        temperature = hot * (END_TEMPERATURE / hot) ** done
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
def _change(tour: np.ndarray, count: np.ndarray, only: int, peaks: np.ndarray, rows: int,
            columns: int, rng: np.random.Generator) -> None:
    """Make one random change of one tour, or of two."""
    u = only if only >= 0 else rng.integers(0, len(count))
    n = count[u]
    kind = rng.random()
    if n < MAX_WAYPOINTS and (n == 0 or kind < 0.12):  # insert one
        at = rng.integers(0, n + 1)
        for i in range(n, at, -1):
            tour[u, i] = tour[u, i - 1]
        _draw_waypoint(tour[u, at], peaks[u], rows, columns, rng)
        count[u] = n + 1
        return
    at = rng.integers(0, n)
    if kind < 0.24:  # delete one
        for i in range(at, n - 1):
            tour[u, i] = tour[u, i + 1]
        count[u] = n - 1
    elif kind < 0.54:  # shift it
        for axis, limit in ((0, rows), (1, columns)):
            tour[u, at, axis] = min(max(tour[u, at, axis] + rng.integers(-2, 3), 0), limit - 1)
    elif kind < 0.74:  # hover longer or shorter
        tour[u, at, 2] = max(tour[u, at, 2] + rng.integers(-4, 5), 0)
    elif kind < 0.82:  # move it anywhere
        _draw_waypoint(tour[u, at], peaks[u], rows, columns, rng)
    elif kind < 0.91:  # change the order
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
def _draw_waypoint(waypoint: np.ndarray, peaks: np.ndarray, rows: int, columns: int,
                   rng: np.random.Generator) -> None:
    """Draw a waypoint near a cell where a device is heard best, or anywhere."""
    if rng.random() < 0.7:
        k = rng.integers(0, len(peaks))
        for axis, limit in ((0, rows), (1, columns)):
            waypoint[axis] = min(max(peaks[k, axis] + rng.integers(-2, 3), 0), limit - 1)
    else:
        waypoint[0], waypoint[1] = rng.integers(0, rows), rng.integers(0, columns)
    waypoint[2] = rng.integers(0, 10)
