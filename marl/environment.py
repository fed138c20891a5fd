"""Many flights at once: the mission's rules, compiled.

One slot: collect from the assigned device at the current position, then move, then draw new SNRs and assign devices
anew. So the first position counts and the last one does not.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from marl.mission import COSTS, MOVES, NO_OP, Mission
from marl.shadowing import CorrelatedField

ACTION_COUNT = len(COSTS)


class Frame(NamedTuple):
    """What there is to know of E flights at the beginning of a slot; U UAVs, K devices.

    Attributes:
        cell: (E, U, 2) int16 row and column.
        battery: (E, U) int16 left, in hovers (half battery units).
        snr_db: (E, U, K) float32 of this slot, shadowing included; -inf where not detected.
        data_units: (E, K) float32 left at each device.
        assigned: (E, U) int16 device that serves the UAV in this slot; -1 for none.
    """

    cell: np.ndarray
    battery: np.ndarray
    snr_db: np.ndarray
    data_units: np.ndarray
    assigned: np.ndarray

    def copy(self) -> "Frame":
        return Frame(*(array.copy() for array in self))


def empty_frame(shape: tuple[int, ...], mission: Mission) -> Frame:
    """Arrays for `shape` frames, zero."""
    uavs, devices = mission.uavs, mission.devices
    return Frame(np.zeros((*shape, uavs, 2), np.int16), np.zeros((*shape, uavs), np.int16),
                 np.zeros((*shape, uavs, devices), np.float32), np.zeros((*shape, devices), np.float32),
                 np.zeros((*shape, uavs), np.int16))


class Environment:
    """E flights side by side; each ends when all its batteries are empty, and then stands still.

    Attributes:
        mission: its rules.
        frame: the present; `step` overwrites it.
    """

    def __init__(self, mission: Mission, flights: int, rng: np.random.Generator):
        self.mission = mission
        self.frame = empty_frame((flights,), mission)
        self._rng = rng
        shape = mission.snr_db.shape[1:]
        self._field = None
        if mission.shadowing_share > 0:
            self._field = CorrelatedField(shape[1:], mission.step_m, mission.shadowing_m)
        # (E, K, ny, nx) what stays of each flight's shadowing, in sigmas
        self._lasting = np.zeros((flights if self._field else 0, *shape), dtype=np.float32)

    def reset(self, which: np.ndarray | None = None) -> Frame:
        """All UAVs at their starts with full batteries, all data at their devices.

        Args:
            which: (E,) bool, flights that begin anew while the others go on; None for all.
        """
        frame, mission = self.frame, self.mission
        which = np.ones(len(frame.cell), dtype=np.bool_) if which is None else which
        frame.cell[which] = mission.start
        frame.battery[which] = mission.battery
        frame.data_units[which] = mission.data_units
        if self._field is not None:
            new = self._field.draw(int(which.sum()) * mission.devices, self._rng) * mission.shadowing_share**0.5
            self._lasting[which] = new.reshape(-1, *self._lasting.shape[1:])
        _sense(mission, frame, which, self._lasting, self._rng)
        return frame

    def step(self, action: np.ndarray) -> np.ndarray:
        """Fly one slot.

        Args:
            action: (E, U) int; each must be feasible (`feasible`), which is not checked.

        Returns:
            (E, U) float32 data units that each UAV collected
        """
        return _step(self.mission, self.frame, np.asarray(action, dtype=np.int64), self._lasting, self._rng)

    @property
    def done(self) -> np.ndarray:
        """(E,) bool: all batteries are empty."""
        return (self.frame.battery == 0).all(axis=1)


@njit(cache=True, nogil=True)
def feasible(mission: Mission, uav: int, row: int, column: int, battery: int, out: np.ndarray) -> None:
    """The safety controller (paper, Sec. II-A): exactly the actions after which the UAV is on the map and can still
    fly home; nothing but no-op with an empty battery.

    Args:
        mission, uav: whose terminal is home.
        row, column, battery: where it is and what it has left [hovers].
        out: (6,) bool, overwritten.
    """
    ny, nx = mission.steps_home.shape[1:]
    move_cost = COSTS[1]
    out[NO_OP] = battery == 0
    for action in range(NO_OP):
        to_row, to_column = row + MOVES[action, 0], column + MOVES[action, 1]
        out[action] = (0 <= to_row < ny and 0 <= to_column < nx and
                       mission.steps_home[uav, to_row, to_column] * move_cost <= battery - COSTS[action])


@njit(cache=True, nogil=True)
def rate(snr_db: float, rate_scale: float) -> float:
    """Data units per slot (paper, Eq. 6: R = log2(1 + SNR) [bit/s/Hz])."""
    return rate_scale * np.log2(1.0 + 10.0 ** (snr_db / 10.0))


@njit(cache=True, nogil=True)
def assign(strength: np.ndarray, max_rate: bool, out: np.ndarray) -> None:
    """Give UAVs devices: a UAV has at most one device and a device at most one UAV (paper, Eq. 7 and 8).

    Args:
        strength: (U, K) of each link, -inf where it cannot be used; overwritten.
        max_rate: see `Mission`.
        out: (U,) device or -1, overwritten.
    """
    uavs, devices = strength.shape
    out[:] = -1
    if max_rate:
        for u in range(uavs):
            own = np.argmax(strength[u])
            for k in range(devices):
                if k != own:
                    strength[u, k] = -np.inf
    for _ in range(min(uavs, devices)):
        best_u, best_k, best = -1, -1, -np.inf
        for u in range(uavs):
            for k in range(devices):
                if strength[u, k] > best:
                    best_u, best_k, best = u, k, strength[u, k]
        if best_u < 0:
            return
        out[best_u] = best_k
        strength[best_u, :] = -np.inf
        strength[:, best_k] = -np.inf


@njit(cache=True, nogil=True)
def _sense(mission, frame, flying, lasting, rng):
    """Draw this slot's SNRs and assign devices, in the flights that are still flying."""
    uavs, devices = mission.snr_db.shape[:2]
    of_slot = np.sqrt(1.0 - mission.shadowing_share)
    strength = np.empty((uavs, devices))
    for e in range(len(flying)):
        if not flying[e]:
            continue
        for u in range(uavs):
            row, column = frame.cell[e, u, 0], frame.cell[e, u, 1]
            for k in range(devices):
                snr_db = mission.snr_db[u, k, row, column]
                sigma_db = mission.sigma_db[u, k, row, column]
                if sigma_db > 0:
                    shadowing = of_slot * rng.standard_normal()
                    if mission.shadowing_share > 0:
                        shadowing += lasting[e, k, row, column]
                    snr_db += np.float32(sigma_db * shadowing)
                if snr_db < mission.detection_db:
                    snr_db = np.float32(-np.inf)
                frame.snr_db[e, u, k] = snr_db
                # A UAV with an empty battery has landed and collects no more.
                usable = frame.battery[e, u] > 0 and frame.data_units[e, k] > 0 and snr_db >= mission.threshold_db
                strength[u, k] = snr_db if usable else -np.inf
        assign(strength, mission.max_rate, frame.assigned[e])


@njit(cache=True, nogil=True)
def _step(mission, frame, action, lasting, rng):
    flights, uavs = action.shape
    collected = np.zeros((flights, uavs), dtype=np.float32)
    flying = np.zeros(flights, dtype=np.bool_)
    for e in range(flights):
        for u in range(uavs):
            k = frame.assigned[e, u]
            if frame.battery[e, u] == 0:
                continue
            flying[e] = True
            if k >= 0:
                # Throughput, capped by what is left (paper, Eq. 9).
                left = frame.data_units[e, k]
                taken = min(np.float32(rate(frame.snr_db[e, u, k], mission.rate_scale)), left)
                frame.data_units[e, k] = left - taken
                collected[e, u] = taken
            frame.cell[e, u, 0] += MOVES[action[e, u], 0]
            frame.cell[e, u, 1] += MOVES[action[e, u], 1]
            frame.battery[e, u] -= COSTS[action[e, u]]
    _sense(mission, frame, flying, lasting, rng)
    return collected
