"""Environment: the mission's rules for many flights at once (compiled), and the learners' features.

One slot: collect from the assigned device at the current position, then move, then draw new SNRs
and assign devices anew. So the first position counts and the last one does not.

Features are those of the paper (Sec. III-A), scaled to about one. The replay memory keeps frames,
which take a fifth of the memory, and computes features from them again.
"""

from typing import NamedTuple

import numpy as np
from scipy.fft import fft2, next_fast_len

from marl.mission import COSTS, MOVES, NO_OP, Mission
from radiotwin.errors import BadInput
from radiotwin.runtime.compiled import List, njit

ACTION_COUNT = len(COSTS)
DEVICE_FEATURES = 7  # SNR, reachable, data left, distance, dx, dy, assigned
UAV_FEATURES = 6  # SNR, reachable, distance, dx, dy, battery
OWN_FEATURES = ACTION_COUNT + 2  # feasible actions, battery, battery needed
STATE_UAV_FEATURES = 5  # battery, battery needed, x, y, done
STATE_DEVICE_FEATURES = 3  # data left, x, y


class Frame(NamedTuple):
    """The state of E flights at the beginning of a slot; U UAVs, K devices.

    Attributes:
        cell: (E, U, 2) int16 row and column.
        battery: (E, U) int16 battery left [hovers = half battery units].
        snr_db: (E, U, K) float32 SNR in this slot, with shadowing; -inf = not detected.
        data_units: (E, K) float32 data left at each device.
        assigned: (E, U) int16 device assigned to the UAV in this slot; -1 for none.
    """

    cell: np.ndarray
    battery: np.ndarray
    snr_db: np.ndarray
    data_units: np.ndarray
    assigned: np.ndarray

    def copy(self) -> "Frame":
        """Return a copy in new memory."""
        return Frame(*(array.copy() for array in self))


def empty_frame(shape: tuple[int, ...], mission: Mission) -> Frame:
    """Return frames of zeros, with leading dimensions `shape`."""
    uavs, devices = mission.uavs, mission.devices
    return Frame(np.zeros((*shape, uavs, 2), np.int16), np.zeros((*shape, uavs), np.int16),
                 np.zeros((*shape, uavs, devices), np.float32),
                 np.zeros((*shape, devices), np.float32), np.zeros((*shape, uavs), np.int16))


class Environment:
    """E parallel flights of one mission; a flight ends when all its batteries are empty.

    Attributes:
        mission: the mission.
        frame: the present state; `step` overwrites it.
    """

    def __init__(self, mission: Mission, flights: int, rng: np.random.Generator) -> None:
        self.mission = mission
        self.frame = empty_frame((flights,), mission)
        self._rng = rng
        shape = mission.snr_db.shape[1:]
        self._field = None
        if mission.shadowing_share > 0:
            self._field = CorrelatedField(shape[1:], mission.step_m, mission.shadowing_m)
        # (E, K, ny, nx) part of the shadowing that lasts for a flight [standard deviations]
        self._lasting = np.zeros((flights if self._field else 0, *shape), dtype=np.float32)

    def reset(self, which: np.ndarray | None = None) -> Frame:
        """Start flights: UAVs at their starts with full batteries, all data at the devices.

        Args:
            which: (E,) bool, flights to start while the others continue; None: all.
        """
        frame, mission = self.frame, self.mission
        which = np.ones(len(frame.cell), dtype=np.bool_) if which is None else which
        frame.cell[which] = mission.start
        frame.battery[which] = mission.battery
        frame.data_units[which] = mission.data_units
        if self._field is not None:
            fields = self._field.draw(int(which.sum()) * mission.devices, self._rng)
            fields = fields * mission.shadowing_share**0.5
            self._lasting[which] = fields.reshape(-1, *self._lasting.shape[1:])
        _sense(mission, frame, which, self._lasting, self._rng)
        return frame

    def step(self, action: np.ndarray) -> np.ndarray:
        """Fly one slot.

        Args:
            action: (E, U) int; each must be feasible (`feasible`), which is not checked.

        Returns:
            (E, U) float32 data units that each UAV collected.
        """
        return _step(self.mission, self.frame, np.asarray(action, dtype=np.int64), self._lasting,
                     self._rng)

    @property
    def done(self) -> np.ndarray:
        """(E,) bool, whether all batteries of a flight are empty."""
        return (self.frame.battery == 0).all(axis=1)


class ManyWorlds:
    """W parallel flights, each in a mission of its own.

    Missions may differ in size; arrays over UAVs are padded to `uavs`. All shadowing is drawn anew
    in every slot: a mission with a `shadowing_share` is refused (BadInput).

    Attributes:
        missions: W missions.
        frames: their states, of a single flight each; `step` overwrites them.
        battery: (W, uavs) int64 battery left [hovers]; 0 for padding.
    """

    def __init__(self, missions: list[Mission], uavs: int, rng: np.random.Generator) -> None:
        self.missions, self._rng = List(missions), rng
        self.frames = List([empty_frame((1,), mission) for mission in missions])
        self.battery = np.zeros((len(missions), uavs), np.int64)
        self._lasting = np.zeros((0, 1, 1, 1), np.float32)
        for world, mission in enumerate(missions):
            self.put(world, mission)

    def put(self, world: int, mission: Mission) -> None:
        """Replace the flight of a world (0 to W - 1) by a new flight of a mission."""
        if mission.shadowing_share > 0:
            raise BadInput(f"a mission has shadowing_share = {mission.shadowing_share:g}; "
                           "ManyWorlds needs 0: all shadowing is drawn anew in every slot")
        frame = empty_frame((1,), mission)
        frame.cell[0], frame.battery[0] = mission.start, mission.battery
        frame.data_units[0] = mission.data_units
        _sense(mission, frame, np.ones(1, np.bool_), self._lasting, self._rng)
        self.missions[world], self.frames[world] = mission, frame
        self.battery[world] = 0
        self.battery[world, :mission.uavs] = mission.battery

    def step(self, action: np.ndarray) -> np.ndarray:
        """Fly one slot with actions (W, uavs); return the collected data units (W, uavs)."""
        collected = np.zeros(action.shape, np.float32)
        _step_all(self.missions, self.frames, action, self._lasting, self._rng, collected,
                  self.battery)
        return collected


class CorrelatedField:
    """Gaussian random fields over a grid, of unit variance and correlation exp(-distance / length).

    Drawn by circulant embedding (Dietrich and Newsam 1997, SIAM J. Sci. Comput. 18); the
    correlation is that of Gudmundson 1991, Electronics Letters 27.
    """

    def __init__(self, shape: tuple[int, int], step_m: float, length_m: float) -> None:
        self._shape = shape
        # A torus that keeps opposite sides of the map three lengths apart (correlation 0.05 at
        # most), or a whole side if that is shorter: then no distance is shorter the other way.
        around = [next_fast_len(side + min(side, int(np.ceil(3.0 * length_m / step_m))))
                  for side in shape]
        rows, columns = (np.minimum(np.arange(n), n - np.arange(n)) * step_m for n in around)
        spectrum = fft2(np.exp(-np.hypot(rows[:, None], columns) / length_m)).real.clip(0)
        self._amplitude = np.sqrt(spectrum / spectrum.mean() / spectrum.size).astype(np.float32)

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return (count, rows, columns) float32 independent fields."""
        pairs = -(-count // 2)
        parts = rng.standard_normal((pairs, *self._amplitude.shape, 2), dtype=np.float32)
        noise = parts.view(np.complex64)[..., 0]
        fields = fft2(noise * self._amplitude)[:, :self._shape[0], :self._shape[1]]
        return np.concatenate([fields.real, fields.imag])[:count]  # both parts are independent


@njit(cache=True, nogil=True)
def feasible(mission: Mission, uav: int, row: int, column: int, battery: int,
             out: np.ndarray) -> None:
    """Write the safe actions (paper, Sec. II-A) to `out` (6,): on the map, with a way home.

    With an empty battery only the no-op is feasible.
    """
    ny, nx = mission.steps_home.shape[1:]
    move_cost = COSTS[1]
    out[NO_OP] = battery == 0
    for action in range(NO_OP):
        to_row, to_column = row + MOVES[action, 0], column + MOVES[action, 1]
        out[action] = (
            0 <= to_row < ny and 0 <= to_column < nx and
            mission.steps_home[uav, to_row, to_column] * move_cost <= battery - COSTS[action])


def safe_actions(action: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Replace actions (E, U) that the `mask` (E, U, 6) forbids by the first feasible action.

    That is to hover if the battery allows it, else a move from which home can be reached, and the
    no-op after landing.
    """
    action = np.asarray(action, dtype=np.int64)
    allowed = np.take_along_axis(mask, action[..., None], axis=-1)[..., 0]
    return np.where(allowed, action, mask.argmax(axis=-1))


@njit(cache=True, nogil=True)
def rate(snr_db: float, rate_scale: float) -> float:
    """Return the data units per slot at an SNR [dB] (paper, Eq. 6: log2(1 + SNR) [bit/s/Hz])."""
    return rate_scale * np.log2(1.0 + 10.0 ** (snr_db / 10.0))


@njit(cache=True, nogil=True)
def assign(strength: np.ndarray, max_rate: bool, assigned: np.ndarray) -> None:
    """Assign at most one device to each UAV, and one UAV to each device (paper, Eq. 7 and 8).

    `strength` (U, K), -inf if not usable, is overwritten, and so is `assigned` (U,), -1 for none.
    With `max_rate` a UAV that loses its best device gets none, not its next best.
    """
    assigned[:] = -1
    for first in range(len(strength)):
        # Deferred acceptance: a UAV that loses a device proposes to the next one. As both sides
        # prefer the stronger link, the result is the greedy matching by strongest pair.
        u = first
        while u >= 0:
            k = np.argmax(strength[u])
            if strength[u, k] == -np.inf:
                break
            loser = -1
            for v in range(len(assigned)):
                if assigned[v] == k:
                    stronger = strength[u, k] > strength[v, k]
                    loser = v if stronger or (strength[u, k] == strength[v, k] and u < v) else u
            if loser != u:
                assigned[u] = k
            if loser >= 0:
                strength[loser, k] = -np.inf
                if loser != u:
                    assigned[loser] = -1
            u = -1 if max_rate else loser


@njit(cache=True, nogil=True)
def _sense(mission: Mission, frame: Frame, flying: np.ndarray, lasting: np.ndarray,
           rng: np.random.Generator) -> None:
    """Draw the SNRs of a slot into `frame`, and assign devices, in the flights `flying` (E,).

    `lasting` (E, K, ny, nx) is the part of the shadowing that lasts for a flight [sd].
    """
    uavs, devices = len(mission.start), len(mission.data_units)
    of_slot = np.sqrt(1.0 - mission.shadowing_share)
    strength = np.empty((uavs, devices))
    for e in range(len(flying)):
        if not flying[e]:
            continue
        for u in range(uavs):
            level, row, column = mission.level[u], frame.cell[e, u, 0], frame.cell[e, u, 1]
            for k in range(devices):
                snr_db = mission.snr_db[level, k, row, column]
                sigma_db = mission.sigma_db[level, k, row, column]
                if sigma_db > 0:
                    shadowing = of_slot * rng.standard_normal()
                    if mission.shadowing_share > 0:
                        shadowing += lasting[e, k, row, column]
                    snr_db += np.float32(sigma_db * shadowing)
                if snr_db < mission.detection_db:
                    snr_db = np.float32(-np.inf)
                frame.snr_db[e, u, k] = snr_db
                # A UAV with an empty battery has landed and does not collect.
                usable = (frame.battery[e, u] > 0 and frame.data_units[e, k] > 0
                          and snr_db >= mission.threshold_db)
                strength[u, k] = snr_db if usable else -np.inf
        assign(strength, mission.max_rate, frame.assigned[e])


@njit(cache=True, nogil=True)
def _step(mission: Mission, frame: Frame, action: np.ndarray, lasting: np.ndarray,
          rng: np.random.Generator) -> np.ndarray:
    """Fly one slot of all flights of a mission; return the collected data units (E, U)."""
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
                units = min(np.float32(rate(frame.snr_db[e, u, k], mission.rate_scale)), left)
                frame.data_units[e, k] = left - units
                collected[e, u] = units
            frame.cell[e, u, 0] += MOVES[action[e, u], 0]
            frame.cell[e, u, 1] += MOVES[action[e, u], 1]
            frame.battery[e, u] -= COSTS[action[e, u]]
    _sense(mission, frame, flying, lasting, rng)
    return collected


@njit(cache=True, nogil=True)
def _step_all(missions: "List[Mission]", frames: "List[Frame]", action: np.ndarray,
              lasting: np.ndarray, rng: np.random.Generator, collected: np.ndarray,
              battery: np.ndarray) -> None:
    """Fly one slot of one flight in each mission; write collected data and batteries (W, uavs)."""
    for w in range(len(missions)):
        uavs = len(missions[w].start)
        collected[w, :uavs] = _step(missions[w], frames[w], action[w:w + 1, :uavs], lasting, rng)[0]
        battery[w, :uavs] = frames[w].battery[0]


def observation_size(mission: Mission) -> int:
    """Return the number of features of one agent's observation."""
    return DEVICE_FEATURES * mission.devices + UAV_FEATURES * (mission.uavs - 1) + OWN_FEATURES


def state_size(mission: Mission) -> int:
    """Return the number of features of the mixer's global state."""
    return STATE_UAV_FEATURES * mission.uavs + STATE_DEVICE_FEATURES * mission.devices


def observe(mission: Mission, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Return observations (E, U, observation_size) float32 and feasible actions (E, U, 6) bool.

    The data left at a device are 0 below the SNR threshold. Distance, dx and dy are 0 for a device
    without a known position. Of a UAV out of reach only the SNR is seen; its other features are 0.
    """
    shape = frame.battery.shape
    observation = np.empty((*shape, observation_size(mission)), dtype=np.float32)
    mask = np.empty((*shape, ACTION_COUNT), dtype=np.bool_)
    _observe(mission, frame, observation, mask)
    return observation, mask


def global_state(mission: Mission, frame: Frame) -> np.ndarray:
    """Return the global state (E, state_size) float32 for the mixer.

    The data left at all devices are exact; an unknown device position is (0.5, 0.5).
    """
    state = np.empty((len(frame.battery), state_size(mission)), dtype=np.float32)
    _global_state(mission, frame, state)
    return state


@njit(cache=True, nogil=True)
def uav_snr_db(mission: Mission, distance_m: float) -> float:
    """Return the SNR between two UAVs at a distance [m] by the LoS law [dB]."""
    return mission.uav_link_db[0] + mission.uav_link_db[1] * np.log10(max(distance_m, 1.0))


@njit(cache=True, nogil=True)
def _scaled_snr(mission: Mission, snr_db: float) -> float:
    """Return the SNR above the threshold over 20 dB, clipped to -2 (also not detected) to 3."""
    return min(max((snr_db - mission.threshold_db) / 20.0, -2.0), 3.0)


@njit(cache=True, nogil=True)
def _length_scale_m(mission: Mission) -> float:
    """Return the longer side of the lattice [m]."""
    return max(max(mission.steps_home.shape[1:]) - 1, 1) * mission.step_m


@njit(cache=True, nogil=True)
def _observe(mission: Mission, frame: Frame, observation: np.ndarray, mask: np.ndarray) -> None:
    """Write each UAV's observation, scaled to about one, and its feasible actions (`mask`)."""
    flights, uavs, devices = frame.snr_db.shape
    scale_m = _length_scale_m(mission)
    for e in range(flights):
        for u in range(uavs):
            out = observation[e, u]
            row, column = frame.cell[e, u, 0], frame.cell[e, u, 1]
            x_m, y_m = column * mission.step_m, row * mission.step_m
            at = 0
            for k in range(devices):
                snr_db = frame.snr_db[e, u, k]
                reachable = snr_db >= mission.threshold_db
                out[at] = _scaled_snr(mission, snr_db)
                out[at + 1] = reachable
                out[at + 2] = frame.data_units[e, k] / mission.data_units[k] if reachable else 0.0
                dx = (mission.known_m[k, 0] - x_m) / scale_m
                dy = (mission.known_m[k, 1] - y_m) / scale_m
                if np.isnan(dx):  # not located yet: no direction
                    dx, dy = 0.0, 0.0
                out[at + 3] = np.sqrt(dx**2 + dy**2)
                out[at + 4] = dx
                out[at + 5] = dy
                out[at + 6] = frame.assigned[e, u] == k
                at += DEVICE_FEATURES
            for v in range(uavs):
                if v == u:
                    continue
                dx = (frame.cell[e, v, 1] - column) * mission.step_m
                dy = (frame.cell[e, v, 0] - row) * mission.step_m
                dz = mission.altitude_m[v] - mission.altitude_m[u]
                distance_m = np.sqrt(dx**2 + dy**2 + dz**2)
                snr_db = uav_snr_db(mission, distance_m)
                out[at] = _scaled_snr(mission, snr_db)
                if snr_db >= mission.threshold_db:
                    out[at + 1] = 1.0
                    out[at + 2] = distance_m / scale_m
                    out[at + 3] = dx / scale_m
                    out[at + 4] = dy / scale_m
                    out[at + 5] = frame.battery[e, v] / mission.battery[v]
                else:
                    out[at + 1: at + UAV_FEATURES] = 0.0
                at += UAV_FEATURES
            feasible(mission, u, row, column, frame.battery[e, u], mask[e, u])
            for action in range(ACTION_COUNT):
                out[at + action] = mask[e, u, action]
            at += ACTION_COUNT
            out[at] = frame.battery[e, u] / mission.battery[u]
            out[at + 1] = 2 * mission.steps_home[u, row, column] / mission.battery[u]


@njit(cache=True, nogil=True)
def _global_state(mission: Mission, frame: Frame, state: np.ndarray) -> None:
    """Write the features of all UAVs and devices into `state` (E, state_size)."""
    flights, uavs, devices = frame.snr_db.shape
    scale_m = _length_scale_m(mission)
    for e in range(flights):
        out, at = state[e], 0
        for u in range(uavs):
            row, column = frame.cell[e, u, 0], frame.cell[e, u, 1]
            out[at] = frame.battery[e, u] / mission.battery[u]
            out[at + 1] = 2 * mission.steps_home[u, row, column] / mission.battery[u]
            out[at + 2] = column * mission.step_m / scale_m
            out[at + 3] = row * mission.step_m / scale_m
            out[at + 4] = frame.battery[e, u] == 0
            at += STATE_UAV_FEATURES
        for k in range(devices):
            out[at] = frame.data_units[e, k] / mission.data_units[k]
            known = not np.isnan(mission.known_m[k, 0])
            out[at + 1] = mission.known_m[k, 0] / scale_m if known else 0.5
            out[at + 2] = mission.known_m[k, 1] / scale_m if known else 0.5
            at += STATE_DEVICE_FEATURES
