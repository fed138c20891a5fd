"""Planning without learning: simulated annealing over waypoints, scored by the mission's rules.

The planner needs only the radio map, not the positions of devices. Shadowing is averaged: each slot
counts with its expected data.
"""

from collections.abc import Callable
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr, ndtr
from typing_extensions import override

from marl.checkpoint import require, require_plan
from marl.environment import ACTION_COUNT, Frame, assign, feasible
from marl.flights import Policy
from marl.learner import Learner, Setup
from marl.mission import COSTS, EAST, HOVER, MOVES, NO_OP, NORTH, SOUTH, WEST, Mission
from marl.settings import stream
from marl.tours import change
from radiotwin.runtime.compiled import njit
from radiotwin.runtime.console import progress

LEAST_WAYPOINTS, HOVERS_PER_WAYPOINT = 8, 12  # limit of a tour: max(8, battery in hovers / 12)
# Temperatures of the annealing [collected share times number of devices]
START_TEMPERATURE, REHEAT_TEMPERATURE, END_TEMPERATURE = 0.2, 0.03, 0.003
STARTS, REHEATS = 5, 10  # searches from an empty tour (at most); then from the best tour
TRIES_OF_A_START = 5000  # least number of tries of a start, for each UAV
STARTS_SHARE = 1 / 2  # share of the tries that the starts get
CHUNK = 5000  # iterations between updates of the progress bar


class Plan(NamedTuple):
    """An open-loop plan for all UAVs.

    Attributes:
        actions: (T, U) int8; feasible from take-off until all batteries are empty.
        ratio: expected share of the data collected, in the map of the plan.
        tour: (U, W, 3) int64 waypoints (row, column, hovers) that the actions follow.
        visits: (U,) int64 number of waypoints of each UAV.
    """

    actions: np.ndarray
    ratio: float
    tour: np.ndarray
    visits: np.ndarray


class TourFlight(NamedTuple):
    """Expected flight of U UAVs along tours: the state at the beginning of each of T slots.

    Attributes:
        action: (T - 1, U) int8.
        cell: (T, U, 2) int64 row and column.
        battery: (T, U) int64 left [hovers].
        left: (T, K) expected data units left at each device.
        reached: (T, U) int64 number of waypoints that each UAV has passed.
        hovered: (T, U) int64 hovers done at the next waypoint.
    """

    action: np.ndarray
    cell: np.ndarray
    battery: np.ndarray
    left: np.ndarray
    reached: np.ndarray
    hovered: np.ndarray


class Candidates(NamedTuple):
    """Devices in reach of each cell, the strongest link first; filled when a cell is first used.

    Attributes:
        value: (L, K, ny, nx) float32 data units a slot, see `expected_data`.
        peak: (L, K, 2) int64 cell (row, column) where each device is heard best.
        listed: (P,) bool, whether the place is filled; place = (level * ny + row) * nx + column.
        device: (P, K) int32 devices, the strongest first.
        worth: (P, K) float32 data units a slot of these devices; 0 beyond reach.
    """

    value: np.ndarray
    peak: np.ndarray
    listed: np.ndarray
    device: np.ndarray
    worth: np.ndarray

    @classmethod
    def of(cls, value: np.ndarray) -> "Candidates":
        """Return lists for a map, to be filled when a cell is used; searches may share them."""
        levels, devices, rows, columns = value.shape
        strongest = value.reshape(levels, devices, -1).argmax(axis=2)
        shape = (levels * rows * columns, devices)
        return cls(value, np.stack(np.unravel_index(strongest, (rows, columns)), axis=-1),
                   np.zeros(shape[0], np.bool_), np.empty(shape, np.int32),
                   np.empty(shape, np.float32))


class Course(NamedTuple):
    """Simulated flight along tours, slot by slot, so that a changed tour is simulated only partly.

    Attributes:
        place: (T, U) int32 place (see `Candidates`) at the beginning of each slot; -1 when landed.
        battery: (U, T) int32 battery left [hovers].
        since: (U, W + 1) int32 first slot in which the UAV has passed 0, 1, … W waypoints.
        device: (T, U) int32 device assigned to the UAV; -1 for none.
        before: (T, U) data units left at that device before the slot.
        left: (K,) data units left at the end.
    """

    place: np.ndarray
    battery: np.ndarray
    since: np.ndarray
    device: np.ndarray
    before: np.ndarray
    left: np.ndarray

    @classmethod
    def of(cls, mission: Mission, waypoints: int) -> "Course":
        """Return an empty course for tours of up to `waypoints` waypoints."""
        slots, uavs = mission.longest, mission.uavs
        return cls(np.full((slots, uavs), -1, np.int32), np.zeros((uavs, slots), np.int32),
                   np.zeros((uavs, waypoints + 1), np.int32), np.full((slots, uavs), -1, np.int32),
                   np.zeros((slots, uavs)), mission.data_units.copy())


class Search(NamedTuple):
    """Tours that are annealed, and their flight.

    Attributes:
        tour, visits: present tours, see `Plan`.
        best_tour, best_visits: the best so far.
        share: (2,) share of the data that the present tours collect, and the best.
        course: simulated flight of the present tours.
        trial: the same, for changed tours.
    """

    tour: np.ndarray
    visits: np.ndarray
    best_tour: np.ndarray
    best_visits: np.ndarray
    share: np.ndarray
    course: Course
    trial: Course

    @classmethod
    def of(cls, mission: Mission, candidates: Candidates, tour: np.ndarray, visits: np.ndarray,
           ) -> "Search":
        """Return a search that begins with tours (U, W, 3) and (U,), which it does not change."""
        course = Course.of(mission, tour.shape[1])
        share = _fly_tours(mission, candidates, tour, visits, course)
        return cls(tour.copy(), visits.copy(), tour.copy(), visits.copy(), np.full(2, share),
                   course, Course(*(array.copy() for array in course)))


class PlanPolicy:
    """Policy that flies the actions (T, U) of a plan in all flights."""

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
    """`--algorithm planner`: search a plan in the map, and fly it open-loop."""

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


def plan(mission: Mission, iterations: int, seed: int, value: np.ndarray | None = None) -> Plan:
    """Search a plan by annealing: a few times from empty tours, then repeatedly from the best.

    Args:
        mission: mission with the map.
        iterations: total number of plans to try.
        seed: random seed of the search.
        value: (L, K, ny, nx) expected data units a slot; None: `expected_data(mission)`.
    """
    rng = stream(seed, "planning")
    candidates = Candidates.of(expected_data(mission) if value is None else value)
    waypoints = max(LEAST_WAYPOINTS, mission.longest // HOVERS_PER_WAYPOINT)
    nothing = (np.zeros((mission.uavs, waypoints, 3), dtype=np.int64),
               np.zeros(mission.uavs, dtype=np.int64))
    starts = int(STARTS_SHARE * iterations / (TRIES_OF_A_START * mission.uavs))
    starts = min(max(starts, 1), STARTS)
    shares = [STARTS_SHARE / starts] * starts + [(1 - STARTS_SHARE) / REHEATS] * REHEATS
    tries = np.diff(np.round(iterations * np.cumsum([0.0, *shares])).astype(int))
    with progress("planning", total=iterations) as advance:
        def search(tries: int, tour: np.ndarray, count: np.ndarray, temperature: float) -> Plan:
            return improve(mission, candidates, tour, count, tries, rng,
                           temperature=temperature / mission.devices, on_progress=advance)

        best = max((search(each, *nothing, START_TEMPERATURE) for each in tries[:starts]),
                   key=attrgetter("ratio"))
        for each in tries[starts:]:
            again = search(each, best.tour, best.visits, REHEAT_TEMPERATURE)
            best = max(best, again, key=attrgetter("ratio"))
    return best


def improve(mission: Mission, candidates: Candidates, tour: np.ndarray, count: np.ndarray,
            iterations: int, rng: np.random.Generator, *, temperature: float, only: int = -1,
            on_progress: Callable[[int], None] = lambda _: None) -> Plan:
    """Improve tours by simulated annealing.

    Args:
        mission: present cells and batteries of the UAVs, and data left at the devices.
        candidates: devices in reach of each cell.
        tour: tours to start from, see `Plan`; not changed.
        count: visits, see `Plan`; not changed.
        iterations: number of plans to try.
        rng: generator of the search.
        temperature: initial temperature [collected share].
        only: the only UAV whose tour is changed; -1: all.
        on_progress: called with the number of plans tried since the last call.
    """
    search = Search.of(mission, candidates, tour, count)
    for start in range(0, iterations, CHUNK):
        if search.share[1] == 1.0:
            break
        stop = min(start + CHUNK, iterations)
        _anneal(mission, candidates, search, only, temperature,
                np.arange(start, stop) / iterations, rng)
        on_progress(stop - start)
    flight = expected_flight(mission, candidates.value, search.best_tour, search.best_visits)
    ratio = 1.0 - flight.left[-1].sum() / mission.data_units.sum()
    return Plan(flight.action, float(ratio), search.best_tour, search.best_visits)


def expected_data(mission: Mission) -> np.ndarray:
    """Return the expected data units (L, K, ny, nx) float32 of one slot on each link.

    It is the probability that the SNR reaches the threshold (that of links or of detection, the
    higher one) times the rate at the mean SNR above it; 0 if the probability is 0.1 % or less.
    """
    value = np.empty(mission.snr_db.shape, np.float32)
    least_db = max(mission.threshold_db, mission.detection_db)
    for links in np.ndindex(value.shape[:2]):  # one device at a time, to save memory
        mean_db = mission.snr_db[links].astype(float)
        sigma_db = np.maximum(mission.sigma_db[links].astype(float), 1e-6)
        short = np.clip((least_db - mean_db) / sigma_db, -40.0, 40.0)
        chance = np.where(mission.sigma_db[links] > 0, ndtr(-short), mean_db >= least_db)
        # Mean of a normal distribution above a threshold; density and tail probability are taken as
        # logarithms, since both may underflow.
        hazard = np.exp(-short**2 / 2 - np.log(2 * np.pi) / 2 - log_ndtr(-short))
        usable_db = np.where(np.isfinite(mean_db), mean_db, 0) + sigma_db * hazard
        data = mission.rate_scale * np.log2(1 + 10 ** (np.minimum(usable_db, 300.0) / 10))
        value[links] = np.where(np.isfinite(mean_db) & (chance > 1e-3), chance * data, 0.0)
    return value


@njit(cache=True, nogil=True, error_model="numpy")
def _move_towards_cell(row: int, column: int, to_row: int, to_column: int,
                       mask: np.ndarray) -> int:
    """Return a feasible move towards a cell, along the larger axis if possible, or NO_OP."""
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
    """Return the next action of a UAV that follows a tour, and the new `reached` and `hovered`.

    A waypoint towards which no move is feasible is skipped, and so are hovers that the battery
    does not allow. After the last waypoint the UAV hovers while it can, then flies home. It has
    passed `reached` of the `count` waypoints of `tour` (W, 3), and hovered `hovered` slots at the
    next one; `mask` (6,) is scratch.
    """
    feasible(mission, uav, row, column, battery, mask)
    while reached < count:
        to_row, to_column = tour[reached, 0], tour[reached, 1]
        if row == to_row and column == to_column:
            if hovered < tour[reached, 2] and mask[HOVER]:
                return HOVER, reached, hovered + 1
        else:
            action = _move_towards_cell(row, column, to_row, to_column, mask)
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
def expected_flight(mission: Mission, value: np.ndarray, tour: np.ndarray, count: np.ndarray,
                    ) -> TourFlight:
    """Fly tours from take-off; a slot yields its expected data `value` (L, K, ny, nx)."""
    slots, uavs, devices = mission.battery.max(), len(tour), value.shape[1]
    actions = np.full((slots, uavs), NO_OP, np.int8)
    cells, lefts = np.empty((slots + 1, uavs, 2), np.int64), np.empty((slots + 1, devices))
    batteries = np.empty((slots + 1, uavs), np.int64)
    passed, hovers = np.zeros((slots + 1, uavs), np.int64), np.zeros((slots + 1, uavs), np.int64)
    cells[0], batteries[0], lefts[0] = mission.start, mission.battery, mission.data_units
    strength, assigned = np.empty((uavs, devices)), np.empty(uavs, np.int16)
    mask = np.empty(ACTION_COUNT, np.bool_)
    for slot in range(slots):
        for state in (batteries, passed, hovers):
            state[slot + 1] = state[slot]
        cells[slot + 1], lefts[slot + 1] = cells[slot], lefts[slot]
        cell, battery, left = cells[slot + 1], batteries[slot + 1], lefts[slot + 1]
        reached, hovered = passed[slot + 1], hovers[slot + 1]
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
    return TourFlight(actions, cells, batteries, lefts, passed, hovers)


@njit(cache=True, nogil=True, error_model="numpy")
def _walk(mission: Mission, candidates: Candidates, uav: int, tour: np.ndarray, count: int,
          changed: int, course: Course, mask: np.ndarray) -> None:
    """Simulate one UAV's moves from when it sets out to the waypoint `changed`, into `course`."""
    level, (rows, columns) = mission.level[uav], mission.steps_home.shape[1:]
    places, batteries, since = course.place[:, uav], course.battery[uav], course.since[uav]
    slot, reached, hovered = since[changed], changed, 0
    if slot >= len(places) or places[slot] < 0:
        return
    row, column = places[slot] // columns - level * rows, places[slot] % columns
    battery = batteries[slot]
    while battery > 0:
        place = (level * rows + row) * columns + column
        if not candidates.listed[place]:
            heard = candidates.value[level, :, row, column]
            order = np.argsort(-heard, kind="mergesort")  # stable: of equal links the first device
            candidates.device[place], candidates.worth[place] = order, heard[order]
            candidates.listed[place] = True
        places[slot], batteries[slot] = place, battery
        before = reached
        action, reached, hovered = next_action(mission, uav, row, column, battery, tour, count,
                                               reached, hovered, mask)
        since[before + 1:reached + 1] = slot
        row, column = row + MOVES[action, 0], column + MOVES[action, 1]
        battery -= COSTS[action]
        slot += 1
    places[slot:] = -1
    since[reached + 1:] = slot


@njit(cache=True, nogil=True, error_model="numpy")
def _collect(mission: Mission, candidates: Candidates, course: Course, start: int,
             holder: np.ndarray, rank: np.ndarray, empty: np.ndarray) -> None:
    """Simulate assignment and collection from slot `start` on, with the rules of `assign`.

    `course.left` is that at the beginning of the slot; `holder` (K,), all -1, `rank` (U,) and
    `empty` (U,) are scratch.
    """
    left, listed, worth = course.left, candidates.device, candidates.worth
    (slots, uavs), devices = course.place.shape, len(course.left)
    for slot in range(start, slots):
        place, device, before = course.place[slot], course.device[slot], course.before[slot]
        for first in range(uavs):
            device[first], at = -1, place[first]
            if at < 0:
                continue
            if slot == start or at != course.place[slot - 1, first]:
                empty[first] = 0  # number of devices at the head of the list without data
            i = empty[first]
            while i < devices and worth[at, i] > 0 and left[listed[at, i]] <= 0:
                i += 1
            empty[first], u = i, first
            while i < devices and worth[at, i] > 0:
                k = listed[at, i]
                if left[k] > 0:
                    v = holder[k]
                    other = worth[place[v], rank[v]] if v >= 0 else -1.0
                    if worth[at, i] > other or (worth[at, i] == other and u < v):
                        holder[k], device[u], rank[u] = u, k, i
                        if v < 0:
                            break
                        device[v] = -1
                        u, at, i = v, place[v], rank[v]  # the loser looks for another device
                    if mission.max_rate:
                        break
                i += 1
        for u in range(uavs):
            k = device[u]
            if k >= 0:
                holder[k] = -1
                before[u] = left[k]
                left[k] = max(left[k] - worth[place[u], rank[u]], 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _fly_tours(mission: Mission, candidates: Candidates, tour: np.ndarray, count: np.ndarray,
               course: Course) -> float:
    """Simulate the tours from take-off into an empty `course`; return the share collected."""
    mask, (rows, columns) = np.empty(ACTION_COUNT, np.bool_), mission.steps_home.shape[1:]
    for u in range(len(tour)):
        if mission.battery[u] > 0:
            row, column = mission.start[u]
            course.place[0, u] = (mission.level[u] * rows + row) * columns + column
            course.battery[u, 0] = mission.battery[u]
            _walk(mission, candidates, u, tour[u], count[u], 0, course, mask)
    holder, scratch = np.full(len(course.left), -1), np.zeros((2, len(tour)), np.int64)
    _collect(mission, candidates, course, 0, holder, scratch[0], scratch[1])
    return 1.0 - course.left.sum() / mission.data_units.sum()


@njit(cache=True, nogil=True, error_model="numpy")
def _anneal(mission: Mission, candidates: Candidates, search: Search, only: int, hot: float,
            progress: np.ndarray, rng: np.random.Generator) -> None:
    """Anneal tours: try a random change at every step, and keep it by the Metropolis rule.

    `progress` (n,) is that of the annealing at every step, 0 to 1; see `improve` for the others.
    """
    tour, count, share, course, trial = (
        search.tour, search.visits, search.share, search.course, search.trial)
    (slots, uavs), cold = course.place.shape, END_TEMPERATURE / len(course.left)
    mask, scratch = np.empty(ACTION_COUNT, np.bool_), np.zeros((2, uavs), np.int64)
    holder = np.full(len(course.left), -1)
    total = mission.data_units.sum()
    new_tour, new_count = tour.copy(), count.copy()
    changed, at = np.zeros(2, np.int64), np.zeros(2, np.int64)
    rows, columns = mission.steps_home.shape[1:]
    for done in progress:
        temperature = hot * (cold / hot) ** done
        n = change(new_tour, new_count, only, mission.level, candidates.peak, course.left, rows,
                   columns, rng, changed, at)
        first = slots
        for i in range(n):
            u = changed[i]
            slot = course.since[u, at[i]]
            _walk(mission, candidates, u, new_tour[u], new_count[u], at[i], trial, mask)
            while slot < first and trial.place[slot, u] == course.place[slot, u]:
                slot += 1
            first = min(first, slot)
        new = share[0]
        if first < slots:
            trial.left[:] = course.left
            for slot in range(slots - 1, first - 1, -1):  # undo the collection back to that slot
                for u in range(uavs):
                    k = course.device[slot, u]
                    if k >= 0:
                        trial.left[k] = course.before[slot, u]
            _collect(mission, candidates, trial, first, holder, scratch[0], scratch[1])
            new = 1.0 - trial.left.sum() / total
        kept = new >= share[0] or rng.random() < np.exp((new - share[0]) / temperature)
        source, target = (trial, course) if kept else (course, trial)
        for i in range(n):
            u = changed[i]
            target.place[:, u] = source.place[:, u]
            target.battery[u] = source.battery[u]
            target.since[u] = source.since[u]
            if kept:
                tour[u], count[u] = new_tour[u], new_count[u]
            else:
                new_tour[u], new_count[u] = tour[u], count[u]
        if kept and first < slots:
            course.left[:] = trial.left
            course.device[first:] = trial.device[first:]
            course.before[first:] = trial.before[first:]
            share[0] = new
            if new > share[1]:
                share[1] = new
                search.best_tour[:], search.best_visits[:] = tour, count
