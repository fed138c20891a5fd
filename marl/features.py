"""Features of a frame for agents and mixer: those of the paper (Sec. III-A), scaled to about one.

The replay memory keeps frames, which take a fifth of the memory, and makes features of them again.
"""

import numpy as np

from marl.environment import ACTION_COUNT, Frame, feasible
from marl.mission import Mission
from radiotwin.runtime.compiled import njit

DEVICE_FEATURES = 7  # SNR, reachable, data left, distance, dx, dy, assigned
UAV_FEATURES = 6  # SNR, reachable, distance, dx, dy, battery
OWN_FEATURES = ACTION_COUNT + 2  # feasible actions, battery, battery needed
STATE_UAV_FEATURES = 5  # battery, battery needed, x, y, done
STATE_DEVICE_FEATURES = 3  # data left, x, y


def observation_size(mission: Mission) -> int:
    """Return the number of features that one agent sees."""
    return DEVICE_FEATURES * mission.devices + UAV_FEATURES * (mission.uavs - 1) + OWN_FEATURES


def state_size(mission: Mission) -> int:
    """Return the number of features that the mixer sees."""
    return STATE_UAV_FEATURES * mission.uavs + STATE_DEVICE_FEATURES * mission.devices


def observe(mission: Mission, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Return observations and feasible actions.

    Args:
        mission: that the frames belong to.
        frame: E frames.

    Returns:
        (E, U, observation_size) float32, and (E, U, 6) bool.
    """
    shape = frame.battery.shape
    observation = np.empty((*shape, observation_size(mission)), dtype=np.float32)
    mask = np.empty((*shape, ACTION_COUNT), dtype=np.bool_)
    _observe(mission, frame, observation, mask)
    return observation, mask


def global_state(mission: Mission, frame: Frame) -> np.ndarray:
    """Return the (E, state_size) float32 state of E frames."""
    state = np.empty((len(frame.battery), state_size(mission)), dtype=np.float32)
    _global_state(mission, frame, state)
    return state


@njit(cache=True, nogil=True)
def _scaled_snr(mission: Mission, snr_db: float) -> float:
    """Return the SNR over the threshold in 20 dB; a link that is not detected shows -2."""
    return min(max((snr_db - mission.threshold_db) / 20.0, -2.0), 3.0)


@njit(cache=True, nogil=True)
def _length_scale_m(mission: Mission) -> float:
    """Return the longer side of the lattice [m]."""
    return max(max(mission.steps_home.shape[1:]) - 1, 1) * mission.step_m


@njit(cache=True, nogil=True)
def _observe(mission: Mission, frame: Frame, observation: np.ndarray, mask: np.ndarray) -> None:
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
                log_distance = np.log10(max(distance_m, 1.0))
                snr_db = mission.uav_link_db[0] + mission.uav_link_db[1] * log_distance
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
