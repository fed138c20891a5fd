"""What needs no learning and no map: random flights, and greedy ones with distinct targets."""

import numpy as np
from numba import njit

from marl.environment import ACTION_COUNT, Frame, feasible
from marl.mission import EAST, HOVER, NO_OP, NORTH, SOUTH, WEST, Mission


def random_actions(mission: Mission, frame: Frame, rng: np.random.Generator) -> np.ndarray:
    """(E, U) any feasible action, each with the same chance."""
    return _random(mission, frame, rng)


def greedy_actions(mission: Mission, frame: Frame, rng: np.random.Generator) -> np.ndarray:
    """(E, U) each UAV, one after the other, claims the nearest device with data that nobody claimed, flies towards it
    along the larger axis and hovers on top. Where that is not feasible: the other axis, then any feasible action."""
    return _greedy(mission, frame, rng)


@njit(cache=True, nogil=True)
def _random(mission, frame, rng):
    flights, uavs = frame.battery.shape
    action = np.empty((flights, uavs), dtype=np.int64)
    mask = np.empty(ACTION_COUNT, dtype=np.bool_)
    for e in range(flights):
        for u in range(uavs):
            feasible(mission, u, frame.cell[e, u, 0], frame.cell[e, u, 1], frame.battery[e, u], mask)
            action[e, u] = _any_of(mask, rng)
    return action


@njit(cache=True, nogil=True)
def _any_of(mask, rng):
    nth = int(rng.random() * mask.sum())
    for a in range(ACTION_COUNT):
        if mask[a]:
            if nth == 0:
                return a
            nth -= 1
    return NO_OP


@njit(cache=True, nogil=True)
def _greedy(mission, frame, rng):
    flights, uavs = frame.battery.shape
    devices = len(mission.data_units)
    action = np.empty((flights, uavs), dtype=np.int64)
    mask = np.empty(ACTION_COUNT, dtype=np.bool_)
    claimed = np.empty(devices, dtype=np.bool_)
    wanted = np.empty(2, dtype=np.int64)
    for e in range(flights):
        claimed[:] = False
        for u in range(uavs):
            row, column = frame.cell[e, u, 0], frame.cell[e, u, 1]
            target, nearest = -1, np.inf
            for k in range(devices):
                dx = mission.known_m[k, 0] - column * mission.step_m
                dy = mission.known_m[k, 1] - row * mission.step_m
                if frame.data_units[e, k] > 0 and not claimed[k] and dx**2 + dy**2 < nearest:
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
