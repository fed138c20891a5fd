"""Re-planning in flight from the data seen so far: together over a link, or each UAV by itself."""

from collections.abc import Iterable

import numpy as np

from marl.environment import ACTION_COUNT, Frame
from marl.mission import Mission
from marl.planner import Plan, expected_data, fly_on, improve, next_action, plan, take_off
from radiotwin.runtime.compiled import njit


class ReplanPolicy:
    """A plan that is improved every few slots, from the UAVs' cells and the data believed left.

    The data left at a device is seen where its SNR reaches the threshold. Other devices are
    believed to have what the mission says, less what the first plan takes. With a link the UAVs
    share what they see and where they are, and one search changes all tours. Without, each UAV
    searches its own tour and believes that the others fly the first plan.

    Args:
        believed: the mission in the map that the UAVs have.
        linked: whether they communicate in flight.
        every: slots between searches.
        iterations: plans that a search tries.
        first_iterations: plans that the search before take-off tries.
        seed: of the first plan.
        rng: of the searches in flight.
    """

    def __init__(self, believed: Mission, linked: bool, every: int, iterations: int,
                 first_iterations: int, seed: int, rng: np.random.Generator) -> None:
        self._mission, self._linked, self._every = believed, linked, every
        self._iterations, self._rng = iterations, rng
        self._value = expected_data(believed)
        self._first = plan(believed, first_iterations, seed)
        self._expected = _expected_flight(believed, self._value, self._first.tour,
                                          self._first.visits)

    def start(self, mission: Mission, flights: int) -> None:
        """See `marl.flights.Policy`."""
        first, uavs = self._first, mission.uavs
        self._slot = 0
        self._tour = np.tile(first.tour, (flights, 1, 1, 1))
        self._count = np.tile(first.visits, (flights, 1))
        self._reached, self._hovered = np.zeros((2, flights, uavs), dtype=np.int64)
        # (E, U, K): data that each UAV saw last, and when; before, slot 0 as the mission says
        self._seen = np.tile(mission.data_units, (flights, uavs, 1))
        self._seen_in = np.zeros((flights, uavs, mission.devices), dtype=np.int64)

    def act(self, frame: Frame) -> np.ndarray:
        """See `marl.flights.Policy`."""
        self._look(frame)
        if self._slot and self._slot % self._every == 0:
            for flight in range(len(frame.battery)):
                if frame.battery[flight].any():
                    self._search(frame, flight)
        action = _follow(self._mission, frame, self._tour, self._count, self._reached,
                         self._hovered)
        self._slot += 1
        return action

    def _look(self, frame: Frame) -> None:
        """Remember the data left at the devices in reach."""
        heard = frame.snr_db >= self._mission.threshold_db
        seen = heard & (frame.battery > 0)[:, :, None]
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
            # The data of a device that no UAV hears does not change.
            found = self._improved(cell, battery, self._seen[flight, 0], tours, -1)
            self._take(flight, range(len(tours)), found)
            return
        for u in range(len(tours)):
            if battery[u]:
                cells, batteries, believed = cell.copy(), battery.copy(), tours.copy()
                others = np.arange(len(tours)) != u
                expected_cells, expected_batteries, _, *passed = self._expected
                cells[others] = expected_cells[self._slot][others]
                batteries[others] = expected_batteries[self._slot][others]
                for v in np.flatnonzero(others):
                    believed[v] = _rest(self._first.tour[v], self._first.visits[v],
                                        *(array[self._slot, v] for array in passed))
                left = self._left(flight, u)
                self._take(flight, [u], self._improved(cells, batteries, left, believed, u))

    def _left(self, flight: int, u: int) -> np.ndarray:
        """Return the (K,) data that a UAV without link believes left.

        The data that it saw, less the share that the first plan has taken since.
        """
        planned, devices = self._expected[2], np.arange(self._mission.devices)
        before = planned[self._seen_in[flight, u], devices]
        kept = np.divide(planned[self._slot], before, out=np.zeros(len(before)), where=before > 0)
        return self._seen[flight, u] * kept

    def _improved(self, cell: np.ndarray, battery: np.ndarray, left: np.ndarray,
                  tours: list[tuple[np.ndarray, int]], only: int) -> Plan | None:
        mission = self._mission._replace(start=cell, battery=battery,
                                         data_units=np.maximum(left, 0.0).astype(float))
        if not mission.data_units.any():
            return None
        # Low enough to keep the present plan unless another is better.
        return improve(mission, self._value, np.array([tour for tour, _ in tours]),
                       np.array([count for _, count in tours]), self._iterations, self._rng,
                       only=only, temperature=0.005)

    def _take(self, flight: int, uavs: Iterable[int], found: Plan | None) -> None:
        if found is not None:
            for u in uavs:
                self._tour[flight, u], self._count[flight, u] = found.tour[u], found.visits[u]
                self._reached[flight, u] = self._hovered[flight, u] = 0


def _rest(tour: np.ndarray, count: int, reached: int, hovered: int) -> tuple[np.ndarray, int]:
    """Return the rest of a UAV's tour, and its number of waypoints."""
    rest = np.zeros_like(tour)
    rest[:len(tour) - reached] = tour[reached:]
    if reached < count:
        rest[0, 2] = max(rest[0, 2] - hovered, 0)
    return rest, max(count - reached, 0)


@njit(cache=True, nogil=True, error_model="numpy")
def _follow(mission: Mission, frame: Frame, tour: np.ndarray, count: np.ndarray,
            reached: np.ndarray, hovered: np.ndarray) -> np.ndarray:
    """Return the (E, U) next action of every tour, and update `reached` and `hovered`."""
    flights, uavs = frame.battery.shape
    action = np.empty((flights, uavs), np.int64)
    mask = np.empty(ACTION_COUNT, np.bool_)
    for e in range(flights):
        for u in range(uavs):
            row, column = np.int64(frame.cell[e, u, 0]), np.int64(frame.cell[e, u, 1])
            action[e, u], reached[e, u], hovered[e, u] = next_action(
                mission, u, row, column, np.int64(frame.battery[e, u]),  # type: ignore[arg-type]
                tour[e, u], count[e, u], reached[e, u], hovered[e, u], mask)
    return action


@njit(cache=True, nogil=True, error_model="numpy")
def _expected_flight(mission: Mission, value: np.ndarray, tour: np.ndarray, count: np.ndarray,
                     ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the expected course of a plan, at the beginning of every slot.

    Cells (T, U, 2), batteries (T, U), data left (T, K), waypoints passed and hovers flown at the
    next one (T, U).
    """
    slots, uavs, devices = mission.battery.max() + 1, len(tour), value.shape[1]
    cells = np.empty((slots, uavs, 2), np.int64)
    batteries = np.empty((slots, uavs), np.int64)
    left = np.empty((slots, devices))
    reached, hovered = np.empty((slots, uavs), np.int64), np.empty((slots, uavs), np.int64)
    flight, actions = take_off(mission, devices), np.empty((1, uavs), np.int8)
    for slot in range(slots):
        cells[slot], batteries[slot], left[slot] = flight.cell, flight.battery, flight.left
        reached[slot], hovered[slot] = flight.reached, flight.hovered
        fly_on(mission, value, tour, count, flight, actions)
    return cells, batteries, left, reached, hovered
