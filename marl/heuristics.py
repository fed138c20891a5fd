"""Flights without learning and map: random, greedy, and from one random cell to the next."""

from collections.abc import Callable

import numpy as np
from typing_extensions import override

from marl.environment import ACTION_COUNT, Frame, feasible
from marl.flights import Policy
from marl.learner import Learner
from marl.mission import COSTS, EAST, HOVER, MOVES, NO_OP, NORTH, SOUTH, WEST, Mission
from radiotwin.maps.survey import fly
from radiotwin.runtime.compiled import njit
from radiotwin.scene import Scene

PATTERN = "random-waypoint"
"""Pattern of `radiotwin.maps.survey` that `waypoint_actions` flies."""


class HeuristicPolicy:
    """Fly `random` or `greedy`."""

    def __init__(self, name: str, rng: np.random.Generator) -> None:
        self._decide = {"random": random_actions, "greedy": greedy_actions}[name]
        self._rng = rng

    def start(self, mission: Mission, flights: int) -> None:
        """See `marl.flights.Policy`."""
        self._mission = mission

    def act(self, frame: Frame) -> np.ndarray:
        """See `marl.flights.Policy`."""
        return self._decide(self._mission, frame, self._rng)


class Random(Learner):
    """`--algorithm random`: any feasible action in every slot."""

    learns = uses_map = False
    name = "random"

    @override
    def prepare(self, mission: Mission,
                on_progress: Callable[[int], None]) -> list[dict[str, float]]:
        return []

    @override
    def policy(self, rng: np.random.Generator) -> Policy:
        return HeuristicPolicy(self.name, rng)


class Greedy(Random):
    """`--algorithm greedy`: to the nearest device with data that no other UAV has claimed."""

    name = "greedy"


def waypoint_actions(scene: Scene, mission: Mission, rng: np.random.Generator) -> np.ndarray:
    """Return flights (T, U) of all UAVs that measure: straight from one random cell to the next.

    Battery that is left when no other cell can be flown to and home from is used to hover.
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
    """Return (E, U) feasible actions, all with the same probability."""
    flights, uavs = frame.battery.shape
    action = np.empty((flights, uavs), dtype=np.int64)
    mask = np.empty(ACTION_COUNT, dtype=np.bool_)
    for e in range(flights):
        for u in range(uavs):
            feasible(mission, u, frame.cell[e, u, 0], frame.cell[e, u, 1], frame.battery[e, u],
                     mask)
            action[e, u] = _any_of(mask, rng)
    return action


@njit(cache=True, nogil=True)
def _any_of(mask: np.ndarray, rng: np.random.Generator) -> int:
    nth = int(rng.random() * mask.sum())
    for a in range(ACTION_COUNT):
        if mask[a]:
            if nth == 0:
                return a
            nth -= 1
    return NO_OP


@njit(cache=True, nogil=True)
def greedy_actions(mission: Mission, frame: Frame, rng: np.random.Generator) -> np.ndarray:
    """Return (E, U) greedy actions with distinct targets.

    Each UAV that has not landed, one after the other, claims the nearest device with data that
    nobody claimed, flies towards it along the larger axis and hovers on top. Where that is not
    feasible: the other axis, then any feasible action.
    """
    flights, uavs = frame.battery.shape
    devices = len(mission.data_units)
    action = np.empty((flights, uavs), dtype=np.int64)
    mask = np.empty(ACTION_COUNT, dtype=np.bool_)
    claimed = np.empty(devices, dtype=np.bool_)
    wanted = np.empty(2, dtype=np.int64)
    for e in range(flights):
        claimed[:] = False
        for u in range(uavs):
            if frame.battery[e, u] == 0:  # it has landed: what it claimed nobody would fly to
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
                action[e, u] = HOVER if mask[HOVER] else _any_of(mask, rng)
                continue
            claimed[target] = True
            dx = mission.known_m[target, 0] - column * mission.step_m
            dy = mission.known_m[target, 1] - row * mission.step_m
            east_west, north_south = EAST if dx > 0 else WEST, NORTH if dy > 0 else SOUTH
            half = mission.step_m / 2
            along_x, along_y = abs(dx) > half, abs(dy) > half
            wanted[:] = HOVER
            if along_x and (abs(dx) >= abs(dy) or not along_y):
                wanted[0] = east_west
                wanted[1] = north_south if along_y else HOVER
            elif along_y:
                wanted[0] = north_south
                wanted[1] = east_west if along_x else HOVER
            if mask[wanted[0]]:
                action[e, u] = wanted[0]
            elif mask[wanted[1]]:
                action[e, u] = wanted[1]
            else:
                action[e, u] = _any_of(mask, rng)
    return action
