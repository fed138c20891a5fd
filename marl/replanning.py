"""Planning again in flight, from what was seen of the devices' data: together over a link, or each UAV by itself."""

import numpy as np
from numba import njit

from marl.environment import ACTION_COUNT, Frame
from marl.mission import Mission
from marl.planner import expected_data, fly_on, improve, next_action, plan, take_off

WARM = 0.005  # temperature of a search that goes on from a plan: it is kept unless another is better


class ReplanPolicy:
    """A plan, searched on every few slots from where the UAVs are and what they believe to be left at the devices.

    A device whose signal reaches the threshold tells what it has left, as it tells agents. Of the others it is believed
    that they have what the mission says, less what the first plan takes. With a link the UAVs share what they see and
    where they are, and one search changes all tours. Without, each UAV searches its own tour and believes that the
    others fly the first plan.

    Args:
        believed: the mission in the map that the UAVs have.
        linked: whether they talk in flight.
        every: slots between searches.
        iterations: plans that a search tries.
        first_iterations: that the search before take-off tries.
        seed: of the first plan.
        rng: of the searches in flight.
    """

    def __init__(self, believed: Mission, linked: bool, every: int, iterations: int, first_iterations: int, seed: int,
                 rng: np.random.Generator):
        self._mission, self._linked, self._every, self._iterations, self._rng = believed, linked, every, iterations, rng
        self._value = expected_data(believed)
        self._first = plan(believed, first_iterations, seed)
        self._expected = _expected_flight(believed, self._value, self._first.tour, self._first.visits)

    def start(self, mission: Mission, flights: int) -> None:
        first, uavs = self._first, mission.uavs
        self._slot = 0
        self._tour, self._count = np.tile(first.tour, (flights, 1, 1, 1)), np.tile(first.visits, (flights, 1))
        self._reached, self._hovered = np.zeros((2, flights, uavs), dtype=np.int64)
        # (E, U, K): what each UAV saw last, and when; never is slot 0, when all was as the mission says
        self._seen = np.tile(mission.data_units, (flights, uavs, 1))
        self._seen_in = np.zeros((flights, uavs, mission.devices), dtype=np.int64)

    def act(self, frame: Frame) -> np.ndarray:
        self._look(frame)
        if self._slot and self._slot % self._every == 0:
            for flight in range(len(frame.battery)):
                if frame.battery[flight].any():
                    self._search(frame, flight)
        action = _follow(self._mission, frame, self._tour, self._count, self._reached, self._hovered)
        self._slot += 1
        return action

    def _look(self, frame: Frame) -> None:
        """Remember what the devices in reach say."""
        seen = (frame.snr_db >= self._mission.threshold_db) & (frame.battery > 0)[:, :, None]
        if self._linked:
            seen = np.broadcast_to(seen.any(axis=1, keepdims=True), seen.shape)
        left = np.broadcast_to(frame.data_units[:, None], seen.shape)
        self._seen = np.where(seen, left, self._seen)
        self._seen_in = np.where(seen, self._slot, self._seen_in)

    def _search(self, frame: Frame, flight: int) -> None:
        tours = [_rest(self._tour[flight, u], self._count[flight, u], self._reached[flight, u],
                       self._hovered[flight, u]) for u in range(self._mission.uavs)]
        cell, battery = (array[flight].astype(np.int64) for array in (frame.cell, frame.battery))
        if self._linked:
            # Nobody takes from a device that none of them hears, so it has what it had.
            self._take(flight, range(len(tours)), self._improved(cell, battery, self._seen[flight, 0], tours, -1))
            return
        for u in range(len(tours)):
            if battery[u]:
                where, charge, believed = cell.copy(), battery.copy(), tours.copy()
                others = np.arange(len(tours)) != u
                where[others], charge[others] = (array[self._slot][others] for array in self._expected[:2])
                for v in np.flatnonzero(others):
                    believed[v] = _rest(self._first.tour[v], self._first.visits[v],
                                        *(array[self._slot, v] for array in self._expected[3:]))
                self._take(flight, [u], self._improved(where, charge, self._left(flight, u), believed, u))

    def _left(self, flight: int, u: int) -> np.ndarray:
        """(K,) what a UAV without link believes: what it saw, less the share that the first plan has taken since."""
        planned, devices = self._expected[2], np.arange(self._mission.devices)
        before = planned[self._seen_in[flight, u], devices]
        kept = np.divide(planned[self._slot], before, out=np.zeros(len(before)), where=before > 0)
        return self._seen[flight, u] * kept

    def _improved(self, cell, battery, left, tours, only):
        mission = self._mission._replace(start=cell, battery=battery, data_units=np.maximum(left, 0.0).astype(float))
        if not mission.data_units.any():
            return None
        return improve(mission, self._value, np.array([tour for tour, _ in tours]),
                       np.array([count for _, count in tours]), self._iterations, self._rng, only=only, hot=WARM)

    def _take(self, flight: int, uavs, found) -> None:
        if found is not None:
            for u in uavs:
                self._tour[flight, u], self._count[flight, u] = found.tour[u], found.visits[u]
                self._reached[flight, u] = self._hovered[flight, u] = 0


def _rest(tour: np.ndarray, count: int, reached: int, hovered: int) -> tuple[np.ndarray, int]:
    """What is left of a UAV's tour, and how many waypoints that is."""
    rest = np.zeros_like(tour)
    rest[:len(tour) - reached] = tour[reached:]
    if reached < count:
        rest[0, 2] = max(rest[0, 2] - hovered, 0)
    return rest, max(count - reached, 0)


@njit(cache=True, nogil=True, error_model="numpy")
def _follow(mission, frame, tour, count, reached, hovered):
    """(E, U) the next action of every tour; waypoints that are reached are counted."""
    flights, uavs = frame.battery.shape
    action = np.empty((flights, uavs), np.int64)
    mask = np.empty(ACTION_COUNT, np.bool_)
    for e in range(flights):
        for u in range(uavs):
            action[e, u], reached[e, u], hovered[e, u] = next_action(
                mission, u, np.int64(frame.cell[e, u, 0]), np.int64(frame.cell[e, u, 1]),
                np.int64(frame.battery[e, u]), tour[e, u], count[e, u], reached[e, u], hovered[e, u], mask)
    return action


@njit(cache=True, nogil=True, error_model="numpy")
def _expected_flight(mission, value, tour, count):
    """A plan as it is expected to go, at the beginning of every slot: cells (T, U, 2), batteries (T, U), data left
    (T, K), waypoints reached and hovers flown (T, U)."""
    slots, (uavs, devices) = mission.battery.max() + 1, value.shape[:2]
    cells, batteries = np.empty((slots, uavs, 2), np.int64), np.empty((slots, uavs), np.int64)
    lefts = np.empty((slots, devices))
    reacheds, hovereds = np.empty((slots, uavs), np.int64), np.empty((slots, uavs), np.int64)
    flight, actions = take_off(mission, devices), np.empty((1, uavs), np.int8)
    for slot in range(slots):
        cells[slot], batteries[slot], lefts[slot] = flight.cell, flight.battery, flight.left
        reacheds[slot], hovereds[slot] = flight.reached, flight.hovered
        fly_on(mission, value, tour, count, flight, actions)
    return cells, batteries, lefts, reacheds, hovereds
