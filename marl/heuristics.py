"""Flights without learning and without a map: random, greedy, heuristic, between random cells."""

import numpy as np
from typing_extensions import override

from marl.environment import ACTION_COUNT, Frame, assign, feasible, rate
from marl.flights import Policy
from marl.learner import Learner
from marl.mission import COSTS, EAST, HOVER, MOVES, NO_OP, NORTH, SOUTH, WEST, Mission
from radiotwin.maps.survey import fly
from radiotwin.runtime.compiled import njit
from radiotwin.scene import Scene

PATTERN = "random-waypoint"
"""Pattern of `radiotwin.maps.survey` that `waypoint_actions` flies."""


WEIGHTS = np.array([0.75, 2.9, 2.88, 0.28, 0.31, 0.91, 0.06, 0.21, 0.66])
"""Weights of `heuristic`, tuned by `python -m studies.heuristic` on 20 generated missions.

The first seven score a device for a UAV: + share of its data left; - steps to it (over the sides of
the lattice); - battery missing for the way there and home (over a full one); + its rate in this
slot [10 bit/s/Hz]; - steps home from it, more as the battery empties; + steps from the nearest
other UAV; + other devices with data around it (exp(-distance / 200 m) each). The last two are the
distance at which the UAV hovers [steps], and its increase as the device empties.
"""


class HeuristicPolicy:
    """Policy `random`, `greedy`, or `heuristic` with given weights."""

    def __init__(self, name: str, rng: np.random.Generator, weights: np.ndarray = WEIGHTS) -> None:
        self._name, self._rng, self._weights = name, rng, weights

    def start(self, mission: Mission, flights: int) -> None:
        """See `marl.flights.Policy`."""
        self._mission = mission

    def act(self, frame: Frame) -> np.ndarray:
        """See `marl.flights.Policy`."""
        if self._name == "heuristic":
            return weighed_actions(self._mission, frame, self._weights)
        decide = {"random": random_actions, "greedy": greedy_actions}[self._name]
        return decide(self._mission, frame, self._rng)


class Random(Learner):
    """`--algorithm random`: fly a random feasible action in every slot."""

    learns = uses_map = False
    name = "random"

    @override
    def policy(self, rng: np.random.Generator) -> Policy:
        return HeuristicPolicy(self.name, rng)


class Greedy(Random):
    """`--algorithm greedy`: fly to the nearest device with data that no other UAV has claimed."""

    name = "greedy"


class Heuristic(Random):
    """`--algorithm heuristic`: fly to the device with the highest weighted score (`WEIGHTS`)."""

    name = "heuristic"


def waypoint_actions(scene: Scene, mission: Mission, rng: np.random.Generator) -> np.ndarray:
    """Return the actions (T, U) of a measuring flight: straight from one random cell to the next.

    When the battery is too low for another cell and the way home, the UAV flies home and hovers.
    """
    moves = {tuple(move): action for action, move in enumerate(MOVES)
             if action not in (HOVER, NO_OP)}
    actions = np.full((mission.longest, mission.uavs), NO_OP, dtype=np.int8)
    for u, uav in enumerate(scene.config.uavs):
        flown = [moves[tuple(step)] for step in np.diff(fly(scene, uav, PATTERN, rng), axis=0)]
        hovers = int(mission.battery[u]) - COSTS[flown].sum()
        actions[:len(flown) + hovers, u] = [*flown, *[HOVER] * hovers]
    return actions


@njit(cache=True, nogil=True)
def random_actions(mission: Mission, frame: Frame, rng: np.random.Generator) -> np.ndarray:
    """Draw feasible actions (E, U) uniformly."""
    flights, uavs = frame.battery.shape
    action = np.empty((flights, uavs), dtype=np.int64)
    mask = np.empty(ACTION_COUNT, dtype=np.bool_)
    for e in range(flights):
        for u in range(uavs):
            feasible(mission, u, frame.cell[e, u, 0], frame.cell[e, u, 1], frame.battery[e, u],
                     mask)
            action[e, u] = _draw_feasible(mask, rng)
    return action


@njit(cache=True, nogil=True)
def _draw_feasible(mask: np.ndarray, rng: np.random.Generator) -> int:
    """Draw one of the feasible actions of a mask (6,) uniformly."""
    nth = int(rng.random() * mask.sum())
    for a in range(ACTION_COUNT):
        if mask[a]:
            if nth == 0:
                return a
            nth -= 1
    return NO_OP


@njit(cache=True, nogil=True)
def greedy_actions(mission: Mission, frame: Frame, rng: np.random.Generator) -> np.ndarray:
    """Return greedy actions (E, U) with distinct targets.

    One after the other, each flying UAV claims the nearest unclaimed device with data, flies
    towards it along the larger axis, and hovers above it. If that is not feasible, it takes the
    other axis, then a random feasible action. Devices without a known position are never claimed;
    a UAV without a target hovers if that is feasible, else takes a random feasible action.
    """
    flights, uavs = frame.battery.shape
    devices = len(mission.data_units)
    action = np.empty((flights, uavs), dtype=np.int64)
    mask = np.empty(ACTION_COUNT, dtype=np.bool_)
    claimed = np.empty(devices, dtype=np.bool_)
    for e in range(flights):
        claimed[:] = False
        for u in range(uavs):
            if frame.battery[e, u] == 0:  # a landed UAV must not claim a device
                action[e, u] = NO_OP
                continue
            row, column = frame.cell[e, u, 0], frame.cell[e, u, 1]
            target, nearest = -1, np.inf
            for k in range(devices):
                dx = mission.known_m[k, 0] - column * mission.step_m
                dy = mission.known_m[k, 1] - row * mission.step_m
                near = dx**2 + dy**2 < nearest
                if frame.data_units[e, k] > 0 and not claimed[k] and near:
                    target, nearest = k, dx**2 + dy**2
            feasible(mission, u, row, column, frame.battery[e, u], mask)
            if target < 0:
                action[e, u] = HOVER if mask[HOVER] else _draw_feasible(mask, rng)
                continue
            claimed[target] = True
            action[e, u] = _move_towards_point(mission, row, column, mission.known_m[target], 0.0,
                                               mask)
            if action[e, u] < 0:
                action[e, u] = _draw_feasible(mask, rng)
    return action


@njit(cache=True, nogil=True)
def _move_towards_point(mission: Mission, row: int, column: int, target_m: np.ndarray,
                        stop_m: float, mask: np.ndarray) -> int:
    """Return a feasible move from a cell towards a point (2,) [m], or hover within `stop_m` of it.

    The larger axis comes first, then the other one, or a hover if the cell is within half a step
    of the point on that axis; -1 if neither is feasible. Within half a step on both axes it hovers.
    """
    dx, dy = target_m[0] - column * mission.step_m, target_m[1] - row * mission.step_m
    along_x, along_y = abs(dx) > mission.step_m / 2, abs(dy) > mission.step_m / 2
    if (not along_x and not along_y) or dx**2 + dy**2 <= stop_m**2:
        return HOVER if mask[HOVER] else -1
    first, second = EAST if dx > 0 else WEST, NORTH if dy > 0 else SOUTH
    if not along_x or (along_y and abs(dx) < abs(dy)):
        first, second, along_x, along_y = second, first, along_y, along_x
    if mask[first]:
        return first
    second = second if along_y else HOVER
    return second if mask[second] else -1


@njit(cache=True, nogil=True)
def weighed_actions(mission: Mission, frame: Frame, weights: np.ndarray) -> np.ndarray:
    """Return actions (E, U) towards the device with the best score, see `WEIGHTS`.

    Each device goes to one UAV, the highest score first. A UAV that gets none flies to its best
    one. If no move towards it is feasible, the UAV hovers while it can, then flies home. Devices
    without a known position get no score.

    Args:
        mission: mission with the known positions of the devices.
        frame: present state of E flights.
        weights: (9,) see `WEIGHTS`.
    """
    flights, uavs = frame.battery.shape
    devices, (ny, nx) = len(mission.data_units), mission.steps_home.shape[1:]
    action = np.empty((flights, uavs), dtype=np.int64)
    mask, target = np.empty(ACTION_COUNT, dtype=np.bool_), np.empty(uavs, dtype=np.int64)
    score = np.empty((uavs, devices))
    side, step_m = ny + nx, mission.step_m
    for e in range(flights):
        for u in range(uavs):
            row, column = frame.cell[e, u, 0], frame.cell[e, u, 1]
            battery = frame.battery[e, u]
            for k in range(devices):
                score[u, k] = -np.inf
                x_m, y_m = mission.known_m[k]
                if battery == 0 or frame.data_units[e, k] <= 0 or np.isnan(x_m):
                    continue
                at_row = min(max(int(np.rint(y_m / step_m)), 0), ny - 1)
                at_column = min(max(int(np.rint(x_m / step_m)), 0), nx - 1)
                steps = abs(at_row - row) + abs(at_column - column)
                home = min(mission.steps_home[u, at_row, at_column], side)
                nearest, company = float(side), 0.0
                for v in range(uavs):
                    if v != u and frame.battery[e, v] > 0:
                        other = abs(at_row - frame.cell[e, v, 0]) + abs(at_column -
                                                                        frame.cell[e, v, 1])
                        nearest = min(nearest, other)
                for j in range(devices):
                    way_m = np.hypot(mission.known_m[j, 0] - x_m, mission.known_m[j, 1] - y_m)
                    if j != k and frame.data_units[e, j] > 0 and not np.isnan(way_m):
                        company += np.exp(-way_m / 200.0)
                snr_db = frame.snr_db[e, u, k]
                now = rate(snr_db, 0.1) if snr_db >= mission.threshold_db else 0.0
                lacking = max(2 * (steps + home) - battery, 0) / mission.battery[u]
                score[u, k] = (
                    weights[0] * frame.data_units[e, k] / mission.data_units[k]
                    - weights[1] * steps / side - weights[2] * lacking + weights[3] * now
                    - weights[4] * home / side * (1 - battery / mission.battery[u])
                    + weights[5] * nearest / side + weights[6] * company)
        for u in range(uavs):
            target[u] = np.argmax(score[u]) if score[u].max() > -np.inf else -1
        claimed = np.empty(uavs, np.int64)
        assign(score, False, claimed)
        for u in range(uavs):
            row, column = frame.cell[e, u, 0], frame.cell[e, u, 1]
            feasible(mission, u, row, column, frame.battery[e, u], mask)
            k, chosen = claimed[u] if claimed[u] >= 0 else target[u], -1
            if k >= 0:
                emptied = 1 - frame.data_units[e, k] / mission.data_units[k]
                stop_m = step_m * (weights[7] + weights[8] * emptied)
                chosen = _move_towards_point(mission, row, column, mission.known_m[k], stop_m,
                                             mask)
            if chosen < 0 and mask[HOVER]:
                chosen = HOVER
            for move in range(ACTION_COUNT):
                if chosen < 0 and mask[move] and (
                        move == NO_OP or mission.steps_home[u, row + MOVES[move, 0], column + MOVES[
                            move, 1]] < mission.steps_home[u, row, column]):
                    chosen = move
            action[e, u] = chosen
    return action
