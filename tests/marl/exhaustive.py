"""The best plan of small missions, by trying all flights of two UAVs.

Flights are valued by the mission's rules, written here a second time.
"""

import numpy as np

from marl.mission import COSTS, MOVES, NO_OP, Mission
from marl.planner import expected_data
from radiotwin.maps.survey import LOS_LAW
from radiotwin.runtime.compiled import njit

SIDE, STEP_M = 5, 100.0


def small_mission(seed: int) -> Mission:
    """Draw 2 UAVs, 3 devices and batteries of 10 to 14 hovers over 5 x 5 cells."""
    rng = np.random.default_rng(seed)
    device_m = np.column_stack([rng.uniform(0, STEP_M * (SIDE - 1), (3, 2)), np.zeros(3)])
    row, column = np.indices((SIDE, SIDE))
    cell_m = np.stack([STEP_M * column, STEP_M * row, np.full(row.shape, 50.0)], axis=-1)
    distance_m = np.linalg.norm(cell_m - device_m[:, None, None], axis=-1)
    snr_db = 100.0 + LOS_LAW.mean_db(np.log10(distance_m)) + rng.normal(0, 4, distance_m.shape)
    start, terminal = rng.integers(0, SIDE, (2, 2))
    home = abs(row - terminal[0]) + abs(column - terminal[1])
    battery = np.maximum(rng.integers(10, 15, 2), 2 * home[tuple(start)])
    return Mission(
        snr_db[None].astype(np.float32), np.zeros((1, 3, SIDE, SIDE), np.float32),
        np.tile(home, (2, 1, 1)), np.tile(start, (2, 1)), battery, np.zeros(2, np.int64),
        np.full(2, 50.0), rng.uniform(3000, 8000, 3), device_m[:, :2].copy(), STEP_M, 100.0, 10.0,
        -np.inf, np.array([70.0, -25.0]), False)


def most_data(mission: Mission) -> float:
    """Return the largest share of the data that any pair of flights of two UAVs collects."""
    value = expected_data(mission).astype(float)
    worth = []
    for u in range(2):
        flights = np.array(_flights(mission, u))  # (n, T) cells; -1 after landing
        of_cell = np.append(value[mission.level[u]].reshape(mission.devices, -1).T,
                            np.zeros((1, mission.devices)), axis=0)
        order = np.argsort(-of_cell[flights].max(axis=2).sum(axis=1))
        worth.append(of_cell[flights[order]])
    return float(_most(worth[0], worth[1], mission.data_units) / mission.data_units.sum())


def _flights(mission: Mission, u: int) -> list[list[int]]:
    """Return all flights of a UAV that end at its terminal with an empty battery."""
    shape, found = mission.steps_home.shape[1:], []

    def fly(row: int, column: int, battery: int, cells: list[int]) -> None:
        if battery == 0:
            found.append(cells + [-1] * (mission.longest - len(cells)))
            return
        for action in range(NO_OP):
            to, rest = (row + MOVES[action, 0], column + MOVES[action, 1]), battery - COSTS[action]
            if 0 <= to[0] < shape[0] and 0 <= to[1] < shape[1] and \
                    2 * mission.steps_home[u][to] <= rest:
                fly(to[0], to[1], rest, [*cells, row * shape[1] + column])

    row, column = mission.start[u]
    fly(int(row), int(column), int(mission.battery[u]), [])
    return found


@njit(cache=True, error_model="numpy")
def _most(one: np.ndarray, other: np.ndarray, data_units: np.ndarray) -> float:
    """Return the most data of any pair of flights (n, T, K) [data units of a slot].

    The flights with the highest sum of their best links come first, and bound the rest.
    """
    slots, devices = one.shape[1:]
    best, left = 0.0, np.empty(devices)
    bound = np.empty(len(other))
    for j in range(len(other)):
        bound[j] = 0.0
        for slot in range(slots):
            bound[j] += other[j, slot].max()
    for i in range(len(one)):
        most = 0.0
        for slot in range(slots):
            most += one[i, slot].max()
        for j in range(len(other)):
            if most + bound[j] <= best:
                break
            left[:] = data_units
            for slot in range(slots):
                # The strongest pair first, then the other UAV with what is left to it.
                first, k_first, strongest = -1, -1, 0.0
                for k in range(devices):
                    if left[k] > 0 and one[i, slot, k] > strongest:
                        first, k_first, strongest = 0, k, one[i, slot, k]
                for k in range(devices):
                    if left[k] > 0 and other[j, slot, k] > strongest:
                        first, k_first, strongest = 1, k, other[j, slot, k]
                if first < 0:
                    continue
                k_second, second = -1, 0.0
                for k in range(devices):
                    worth = other[j, slot, k] if first == 0 else one[i, slot, k]
                    if k != k_first and left[k] > 0 and worth > second:
                        k_second, second = k, worth
                left[k_first] = max(left[k_first] - strongest, 0.0)
                if k_second >= 0:
                    left[k_second] = max(left[k_second] - second, 0.0)
            best = max(best, data_units.sum() - left.sum())
    return best
