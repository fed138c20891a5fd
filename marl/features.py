"""What agents and mixer see of a frame: observations, feasible actions, state; the paper's, scaled to about one.

The replay memory keeps frames, which are a fifth of the size, and this module makes the same features of them again.
"""

import numpy as np
from numba import njit

from marl.environment import ACTION_COUNT, Frame, feasible
from marl.mission import Mission

DEVICE_FEATURES = 7  # SNR, reachable, data left, distance, dx, dy, assigned
UAV_FEATURES = 6  # SNR, reachable, distance, dx, dy, battery
OWN_FEATURES = ACTION_COUNT + 2  # feasible actions, battery, battery needed
STATE_UAV_FEATURES = 5  # battery, battery needed, x, y, done
STATE_DEVICE_FEATURES = 3  # data left, x, y

SNR_SCALE_DB = 20.0
SNR_RANGE = (-2.0, 3.0)  # a link that is not detected shows the lowest value


def observation_size(mission: Mission) -> int:
    return DEVICE_FEATURES * mission.devices + UAV_FEATURES * (mission.uavs - 1) + OWN_FEATURES


def state_size(mission: Mission) -> int:
    return STATE_UAV_FEATURES * mission.uavs + STATE_DEVICE_FEATURES * mission.devices


def observe(mission: Mission, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Observations and feasible actions (paper, Sec. III-A).

    Args:
        mission: the one that the frames belong to.
        frame: E frames.

    Returns:
        (E, U, observation_size) float32, and (E, U, 6) bool
    """
    shape = frame.battery.shape
    observation = np.empty((*shape, observation_size(mission)), dtype=np.float32)
    mask = np.empty((*shape, ACTION_COUNT), dtype=np.bool_)
    _observe(mission, frame, observation, mask)
    return observation, mask


def global_state(mission: Mission, frame: Frame) -> np.ndarray:
    """State of E frames (paper, Sec. III-A): (E, state_size) float32."""
    state = np.empty((len(frame.battery), state_size(mission)), dtype=np.float32)
    _global_state(mission, frame, state)
    return state


@njit(cache=True, nogil=True)
def _scaled_snr(mission, snr_db):
    return min(max((snr_db - mission.threshold_db) / SNR_SCALE_DB, SNR_RANGE[0]), SNR_RANGE[1])


@njit(cache=True, nogil=True)
def _length_scale_m(mission):
    """The longer side of the lattice."""
    return max(max(mission.steps_home.shape[1:]) - 1, 1) * mission.step_m


@njit(cache=True, nogil=True)
def _observe(mission, frame, observation, mask):
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
                dx, dy = (mission.known_m[k, 0] - x_m) / scale_m, (mission.known_m[k, 1] - y_m) / scale_m
                if np.isnan(dx):  # a device that nobody has located yet: no direction
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
                distance_m = np.sqrt(dx**2 + dy**2 + (mission.altitude_m[v] - mission.altitude_m[u]) ** 2)
                snr_db = mission.uav_link_db[0] + mission.uav_link_db[1] * np.log10(max(distance_m, 1.0))
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
def _global_state(mission, frame, state):
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
