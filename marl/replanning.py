"""Replanning in flight (`--algorithm belief`), with a belief updated by received SNRs.

Every few slots a short annealing changes the remaining tours. The map is fixed, or it is that of a
`marl.belief`. The data left at a device are known after its SNR reached the threshold; before, the
prior's are assumed. With a link the UAVs share all readings, and one search changes all tours.
Without a link each UAV has its own belief and assumes that the others fly the first plan. When two
UAVs are in reach of each other, they exchange readings and planned tours.
"""

from collections.abc import Iterable

import numpy as np
from typing_extensions import override

from marl.belief import Belief, Prior
from marl.environment import ACTION_COUNT, Frame, uav_snr_db
from marl.flights import Policy
from marl.learner import Learner, Setup
from marl.mission import Mission
from marl.planner import (
    Candidates,
    Plan,
    expected_data,
    expected_flight,
    improve,
    next_action,
    plan,
)
from marl.settings import stream
from radiotwin.runtime.compiled import njit

LOW_TEMPERATURE = 0.005  # low, so that hardly any worse plan is accepted [collected share]
EVERY, ITERATIONS = 2, 6000  # slots between searches; plans tried in each


class ReplanPolicy:
    """Policy that flies a plan and improves it every few slots.

    Args:
        believed: the mission with the map and data that the UAVs assume.
        prior: prior of the belief; None: the map is fixed.
        linked: whether the UAVs always communicate; otherwise only in reach of each other.
        every: slots between searches of `iterations` plans (half of them without a link);
            `first_iterations` before take-off.
        seed, rng: of the first plan, and of the searches in flight.
    """

    def __init__(self, believed: Mission, prior: Prior | None, linked: bool, every: int,
                 iterations: int, first_iterations: int, seed: int,
                 rng: np.random.Generator) -> None:
        self._mission, self._prior, self._linked = believed, prior, linked
        # Searching one tour needs fewer tries than searching all.
        self._iterations = iterations if linked else iterations // 2
        self._every, self._rng = every, rng
        # One level of the map for each UAV, as beliefs differ between UAVs.
        self._planned = believed._replace(level=np.arange(believed.uavs))
        if prior is None:
            self._value = expected_data(believed)[believed.level]
        else:
            data_units, self._value = weighted(Belief(prior, believed), believed.data_units)
            self._planned = self._planned._replace(data_units=data_units)
        self._first = plan(self._planned, first_iterations, seed, self._value)
        self._expected = expected_flight(self._planned, self._value, self._first.tour,
                                         self._first.visits)

    def start(self, mission: Mission, flights: int) -> None:
        """See `marl.flights.Policy`; the map of the mission that is flown is not read."""
        self._slot = 0
        number = 1 if self._linked else self._mission.uavs
        self._flights = [[_Knowledge(self, range(self._mission.uavs) if self._linked else [u])
                          for u in range(number)] for _ in range(flights)]
        first, uavs = self._first, self._mission.uavs
        self._tour = np.tile(first.tour, (flights, 1, 1, 1))
        self._count = np.tile(first.visits, (flights, 1))
        self._reached, self._hovered = np.zeros((2, flights, uavs), dtype=np.int64)

    def act(self, frame: Frame) -> np.ndarray:
        """Return the action of every UAV of every flight: a step along its planned tour.

        Before that, UAVs learn from what they heard, UAVs in reach exchange it, and every few slots
        the tours are planned again (see `marl.flights.Policy`).
        """
        for flight, of_uavs in enumerate(self._flights):
            if frame.battery[flight].any():
                for knowledge in of_uavs:
                    knowledge.receive(frame, flight, self._slot)
                if len(of_uavs) > 1:
                    self._meet(frame, flight)
                if self._slot and self._slot % self._every == 0:
                    self._search(frame, flight)
        action = _follow(self._mission, frame, self._tour, self._count, self._reached,
                         self._hovered)
        self._slot += 1
        return action

    def _meet(self, frame: Frame, flight: int) -> None:
        """Exchange readings and planned tours between UAVs whose SNR reaches the threshold."""
        mission, of_uavs = self._mission, self._flights[flight]
        cell = frame.cell[flight].astype(float) * mission.step_m
        for u, knowledge in enumerate(of_uavs):
            for v in range(u):
                if not (frame.battery[flight, u] and frame.battery[flight, v]):
                    continue
                away_m = np.hypot(np.hypot(*(cell[u] - cell[v])),
                                  mission.altitude_m[u] - mission.altitude_m[v])
                if uav_snr_db(mission, float(away_m)) >= mission.threshold_db:
                    knowledge.learn_from(of_uavs[v])
                    of_uavs[v].learn_from(knowledge)
                    for one, other in ((knowledge, v), (of_uavs[v], u)):
                        one.others[other] = (
                            self._slot, frame.cell[flight, other].astype(np.int64),
                            int(frame.battery[flight, other]),
                            self._remaining_tour(flight, other))

    def _remaining_tour(self, flight: int, u: int) -> tuple[np.ndarray, int]:
        """Return the remaining tour of UAV `u` in a flight, and its number of waypoints."""
        return _remaining(self._tour[flight, u], self._count[flight, u], self._reached[flight, u],
                          self._hovered[flight, u])

    def _search(self, frame: Frame, flight: int) -> None:
        """Improve a flight's remaining tours: of linked UAVs all together, of others one by one."""
        cell, battery = (array[flight].astype(np.int64) for array in (frame.cell, frame.battery))
        tours = [self._remaining_tour(flight, u) for u in range(self._mission.uavs)]
        for u, knowledge in enumerate(self._flights[flight]):
            if self._linked:
                # A device that no UAV hears is not served, so its data stay as seen last.
                found = self._improved(knowledge, cell, battery, knowledge.seen, tours, -1)
                self._replace_tours(flight, range(len(tours)), found)
            elif battery[u]:
                cells, batteries, believed = self._believed_of_others(knowledge)
                cells[u], batteries[u], believed[u] = cell[u], battery[u], tours[u]
                found = self._improved(knowledge, cells, batteries, self._left(knowledge),
                                       believed, u)
                self._replace_tours(flight, [u], found)

    def _believed_of_others(self, knowledge: "_Knowledge",
                            ) -> tuple[np.ndarray, np.ndarray, list[tuple[np.ndarray, int]]]:
        """Return cells, batteries and remaining tours of all UAVs, as one UAV assumes them.

        UAVs that it met are assumed to fly the tours of that meeting, others those of the first
        plan.
        """
        now, planned = self._slot, self._expected
        cells, batteries = planned.cell[now].copy(), planned.battery[now].copy()
        tours = [_remaining(*each) for each in zip(self._first.tour, self._first.visits,
                                                   planned.reached[now], planned.hovered[now])]
        for v, (slot, cell, battery, tour) in knowledge.others.items():
            # Simulate that UAV from the slot in which they met until now.
            start = self._planned._replace(start=cell[None], battery=np.array([battery]),
                                           level=np.zeros(1, dtype=np.int64),
                                           steps_home=self._mission.steps_home[v:v + 1])
            course = expected_flight(start, self._value[v:v + 1], tour[0][None],
                                     np.array([tour[1]]))
            elapsed = min(self._slot - slot, len(course.cell) - 1)
            cells[v], batteries[v] = course.cell[elapsed, 0], course.battery[elapsed, 0]
            tours[v] = _remaining(*tour, int(course.reached[elapsed, 0]),
                                  int(course.hovered[elapsed, 0]))
        return cells, batteries, tours

    def _left(self, knowledge: "_Knowledge") -> np.ndarray:
        """Return the data (K,) that a UAV without a link assumes to be left.

        It is the amount seen last, less the share that the first plan would have collected since.
        """
        planned, devices = self._expected.left, np.arange(self._mission.devices)
        before = planned[knowledge.seen_in, devices]
        kept = np.divide(planned[self._slot], before, out=np.zeros(len(before)), where=before > 0)
        return knowledge.seen * kept

    def _improved(self, knowledge: "_Knowledge", cell: np.ndarray, battery: np.ndarray,
                  left: np.ndarray, tours: list[tuple[np.ndarray, int]], only: int) -> Plan | None:
        """Improve the tour of UAV `only` (-1: all) by a UAV's belief; None if no data are left."""
        data_units, value = np.maximum(left, 0.0).astype(float), self._value
        if knowledge.belief is not None:
            data_units, value = weighted(knowledge.belief, data_units)
        mission = self._planned._replace(start=cell, battery=battery, data_units=data_units)
        if not mission.data_units.any():
            return None
        return improve(mission, Candidates.of(value), np.array([tour for tour, _ in tours]),
                       np.array([count for _, count in tours]), self._iterations, self._rng,
                       only=only, temperature=LOW_TEMPERATURE)

    def _replace_tours(self, flight: int, uavs: Iterable[int], found: Plan | None) -> None:
        """Replace the tours of some UAVs in a flight by those of a plan; None: keep them."""
        if found is not None:
            for u in uavs:
                self._tour[flight, u], self._count[flight, u] = found.tour[u], found.visits[u]
                self._reached[flight, u] = self._hovered[flight, u] = 0


class _Knowledge:
    """Knowledge of one UAV in a flight, or of all UAVs with a link.

    Attributes:
        belief: belief of the map; None: the map is fixed.
        seen: (K,) data left at each device when seen last; at first, those of the mission.
        seen_in: (K,) slot in which they were seen; 0: never, or in the first slot, which other
            UAVs do not learn.
        others: slot, cell, battery and remaining tour of each UAV when it was met last.
    """

    def __init__(self, policy: ReplanPolicy, uavs: Iterable[int]) -> None:
        mission, prior = policy._mission, policy._prior
        self._mission, self._uavs = mission, list(uavs)
        self.belief = None if prior is None else Belief(prior, mission)
        self.seen = mission.data_units.copy()
        self.seen_in = np.zeros(mission.devices, dtype=np.int64)
        self.others: dict[int, tuple[int, np.ndarray, int, tuple[np.ndarray, int]]] = {}
        # UAV -> those of its readings that are known: slot, cell (2,), SNR (K,) [dB]
        self._readings: dict[int, list[tuple[int, np.ndarray, np.ndarray]]] = {
            u: [] for u in range(mission.uavs)}

    def receive(self, frame: Frame, flight: int, slot: int) -> None:
        """Update belief and data left by the SNRs that its own UAVs receive in a slot."""
        for u in self._uavs:
            if not frame.battery[flight, u]:
                continue
            snr_db = frame.snr_db[flight, u]
            heard = snr_db >= self._mission.threshold_db
            self.seen = np.where(heard, frame.data_units[flight], self.seen)
            self.seen_in = np.where(heard, slot, self.seen_in)
            self._hear(u, slot, frame.cell[flight, u].astype(np.int64), snr_db.copy())

    def learn_from(self, other: "_Knowledge") -> None:
        """Copy another UAV's new readings, and its counts of data left that are more recent."""
        later = other.seen_in > self.seen_in
        self.seen = np.where(later, other.seen, self.seen)
        self.seen_in = np.where(later, other.seen_in, self.seen_in)
        for u, theirs in other._readings.items():
            for reading in theirs[len(self._readings[u]):]:
                self._hear(u, *reading)

    def _hear(self, u: int, slot: int, cell: np.ndarray, snr_db: np.ndarray) -> None:
        self._readings[u].append((slot, cell, snr_db))
        if self.belief is not None:
            self.belief.hear(u, cell, snr_db)


class BeliefPlanner(Learner):
    """`--algorithm belief`: plan, and replan in flight by the received SNRs."""

    learns, believes = False, True

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup)
        self._prior: Prior | None = None

    @override
    def believe(self, prior: Prior | None) -> None:
        self._prior = prior

    @override
    def policy(self, rng: np.random.Generator) -> Policy:
        run = self.setup.run
        prior = Prior.of_mission(self.mission) if self._prior is None else self._prior
        return ReplanPolicy(self.mission, prior, True, EVERY, ITERATIONS, run.planner_iterations,
                            run.seed, stream(run.seed, "planning", 1))


def weighted(belief: Belief, data_units: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weight data left (K,) and rates by the probability that devices transmit, for planning.

    Returns:
        (K,) expected data left, and (U, K, ny, nx) expected data of a slot on each link, both
        multiplied by the probability.
    """
    transmits = 1.0 - belief.silent
    return data_units * transmits, belief.expected_data() * transmits[None, :, None, None]


def _remaining(tour: np.ndarray, count: int, reached: int, hovered: int) -> tuple[np.ndarray, int]:
    """Return the remaining tour (W, 3) of a UAV, and its number of waypoints."""
    rest = np.zeros_like(tour)
    rest[:len(tour) - reached] = tour[reached:]
    if reached < count:
        rest[0, 2] = max(rest[0, 2] - hovered, 0)
    return rest, max(count - reached, 0)


@njit(cache=True, nogil=True, error_model="numpy")
def _follow(mission: Mission, frame: Frame, tour: np.ndarray, count: np.ndarray,
            reached: np.ndarray, hovered: np.ndarray) -> np.ndarray:
    """Return the next actions (E, U) along the tours, and update `reached` and `hovered` (E, U)."""
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
