"""Bayesian filter of device positions and map errors, updated by received and missing SNRs.

Each device has N candidate positions (particles) with a map each. For each candidate a Kalman
filter estimates two errors: one of the device's level, the same everywhere, and one of the map,
correlated along the flight of a UAV (Gudmundson 1991, Electronics Letters 27). So consecutive
readings do not count as independent. A reading below the limit of detection is censored: it enters
by its probability and the moments of the truncated normal distribution. One more candidate is a
device that does not transmit.
"""

import math
from typing import NamedTuple

import numpy as np

from marl.mission import Mission
from marl.planner import expected_data
from radiotwin.runtime.compiled import njit

NOISE_DB = 1.0  # standard deviation of a reading's noise [dB]
# Exponent of the likelihood of a position, since errors of the map persist over many slots (Holmes
# and Walker 2017, Biometrika 104).
TEMPER = 0.3
TAIL = 4.0  # degrees of freedom of readings (Student's t)
NEGLIGIBLE = 1e-3  # less probable candidates are left out of the expected data
# Grid of the table of expected data: mean SNR and its standard deviation [dB].
_MEANS_DB, _SDS_DB = np.arange(-60.0, 120.5, 0.5), np.arange(0.0, 40.5, 0.5)


class Prior(NamedTuple):
    """Belief before take-off; K devices, N candidates of each, the L levels of the mission.

    Attributes:
        snr_db: (K, N, L, ny, nx) float32 mean SNR of each candidate [dB]; -inf: never received.
        sd_db: (K, N, L, ny, nx) float32 standard deviation of the map's error [dB].
        weight: (K, N) probability of each candidate, given that the device transmits.
        level_sd_db: (K,) standard deviation of the error of each device's level [dB].
        common_sd_db: standard deviation of the level error common to all devices [dB].
        silent: (K,) probability that a device does not transmit.
        data_spread: relative half-width of the uniform distribution of each device's data.
        share, length_m: share of the map's error that lasts, and its correlation length, see
            `Mission.shadowing_share`.
    """

    snr_db: np.ndarray
    sd_db: np.ndarray
    weight: np.ndarray
    level_sd_db: np.ndarray
    common_sd_db: float
    silent: np.ndarray
    data_spread: float
    share: float
    length_m: float

    @classmethod
    def of_mission(cls, mission: Mission, level_sd_db: float = 0.0, silent: float = 0.0,
                   data_spread: float = 0.0) -> "Prior":
        """Return the prior with a single candidate position for each device: the mission's map."""
        devices = mission.devices
        return cls(mission.snr_db.swapaxes(0, 1)[:, None], mission.sigma_db.swapaxes(0, 1)[:, None],
                   np.ones((devices, 1)), np.full(devices, float(level_sd_db)), 0.0,
                   np.full(devices, float(silent)), float(data_spread),
                   float(mission.shadowing_share), float(mission.shadowing_m))


class _State(NamedTuple):
    """State of the filter for K devices, N candidates and U UAVs.

    Attributes:
        log_weight: (K, N) log weights of the candidates.
        mean: (K, N, 1 + U) means of the level error [dB] and of the map error at each UAV [sd].
        covariance: (K, N, 1 + U, 1 + U) their covariances.
    """

    log_weight: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


class Belief:
    """Belief of one UAV, or of UAVs that share readings, during one flight.

    `mission` is that which the UAVs assume.
    """

    def __init__(self, prior: Prior, mission: Mission) -> None:
        self.prior, self._mission = prior, mission
        devices, candidates = prior.weight.shape
        errors = 1 + mission.uavs
        covariance = np.zeros((devices, candidates, errors, errors))
        covariance[:, :, 0, 0] = prior.level_sd_db[:, None]**2 + prior.common_sd_db**2
        for u in range(1, errors):
            covariance[:, :, u, u] = 1.0
        with np.errstate(divide="ignore"):
            self._state = _State(np.log(prior.weight), np.zeros((devices, candidates, errors)),
                                 covariance)
        self._detected = np.zeros(devices, dtype=bool)
        self._cell = mission.start.copy()  # cell of each UAV's last readings
        self._table = _expected_table(mission)

    def hear(self, uav: int, cell: np.ndarray, snr_db: np.ndarray) -> None:
        """Update the belief by a UAV's readings (K,) [dB] in a cell; -inf: not detected."""
        moved_m = self._mission.step_m * float(np.hypot(*(cell - self._cell[uav])))
        correlation = math.exp(-moved_m / self.prior.length_m)
        _update_filters(self.prior, self._state, uav, int(self._mission.level[uav]), int(cell[0]),
                        int(cell[1]), correlation, snr_db.astype(float),
                        float(self._mission.detection_db))
        self._detected |= np.isfinite(snr_db)
        self._cell[uav] = cell

    @property
    def silent(self) -> np.ndarray:
        """(K,) posterior probability that a device does not transmit; 0 once it was heard."""
        top = self._state.log_weight.max(axis=1)
        evidence = np.exp(top) * np.exp(self._state.log_weight - top[:, None]).sum(axis=1)
        prior = self.prior.silent
        posterior = prior / np.maximum(prior + (1 - prior) * evidence, 1e-300)
        return np.where(self._detected, 0.0, posterior)

    @property
    def weight(self) -> np.ndarray:
        """(K, N) posterior probability of each candidate, given that the device transmits."""
        weight = np.exp(self._state.log_weight - self._state.log_weight.max(axis=1, keepdims=True))
        return weight / weight.sum(axis=1, keepdims=True)

    def expected_data(self) -> np.ndarray:
        """Return the expected data units (U, K, ny, nx) of a slot on each link.

        It is conditional on the device transmitting, see `silent`.
        """
        prior = self.prior
        mission = self._mission
        value = np.zeros((mission.uavs, mission.devices, *prior.snr_db.shape[3:]), np.float32)
        _add_expected_data(prior, self._state, self.weight, mission.level, self._cell,
               float(mission.step_m), self._table, value)
        return value


def _expected_table(mission: Mission) -> np.ndarray:
    """Return `expected_data` for each mean SNR and standard deviation of the grid."""
    mean_db, sd_db = (grid.astype(np.float32)[None, None] for grid in np.meshgrid(
        _MEANS_DB, _SDS_DB, indexing="ij"))
    return expected_data(mission._replace(snr_db=mean_db, sigma_db=sd_db))[0, 0]


@njit(cache=True, nogil=True, error_model="numpy")
def _update_filters(prior: Prior, state: _State, uav: int, level: int, row: int, column: int,
                    correlation: float, snr_db: np.ndarray, limit_db: float) -> None:
    """Update the Kalman filters of all candidate positions in `state` by a UAV's readings.

    `correlation` is that of the map's errors at this and at the UAV's last cell, `snr_db` (K,)
    are the readings, -inf if not detected, and `limit_db` is the limit of detection. A reading of
    a candidate that is never received in the cell lowers its log weight by 20; candidates with a
    log weight below -700 are not updated any more.
    """
    devices, candidates, errors = state.mean.shape
    at, lasting_sd = uav + 1, math.sqrt(prior.share)
    gain = np.empty(errors)
    for k in range(devices):
        for i in range(candidates):
            if state.log_weight[k, i] < -700.0:
                continue
            mean, covariance = state.mean[k, i], state.covariance[k, i]
            mean[at] *= correlation
            for j in range(errors):
                covariance[at, j] *= correlation
                covariance[j, at] *= correlation
            covariance[at, at] += 1.0 - correlation * correlation
            expected_db = prior.snr_db[k, i, level, row, column]
            if expected_db == -np.inf:  # a candidate that is not heard here
                if snr_db[k] > -np.inf:
                    state.log_weight[k, i] -= 20.0
                continue
            sd_db = prior.sd_db[k, i, level, row, column]
            slope = sd_db * lasting_sd
            variance = sd_db * sd_db * (1.0 - prior.share) + NOISE_DB * NOISE_DB
            for j in range(errors):
                gain[j] = covariance[j, 0] + slope * covariance[j, at]
            spread = gain[0] + slope * gain[at] + variance
            expected_db += mean[0] + slope * mean[at]
            if snr_db[k] == -np.inf:  # below the limit
                depth = (limit_db - expected_db) / math.sqrt(spread)
                log_tail, hazard = _below(depth)
                state.log_weight[k, i] += TEMPER * log_tail
                shift = -hazard / math.sqrt(spread)
                shrink = hazard * (hazard + depth) / spread
            else:
                off_db = snr_db[k] - expected_db
                square = off_db * off_db / spread
                state.log_weight[k, i] -= 0.5 * TEMPER * (
                    math.log(spread) + (TAIL + 1.0) * math.log1p(square / TAIL))
                # Outliers update the errors less (Student's t as a scale mixture).
                spread *= max((TAIL + square) / (TAIL + 1.0), 1.0)
                shift, shrink = off_db / spread, 1.0 / spread
            for j in range(errors):
                mean[j] += gain[j] * shift
            for j in range(errors):
                for m in range(errors):
                    covariance[j, m] -= gain[j] * gain[m] * shrink


@njit(cache=True, nogil=True, error_model="numpy")
def _below(depth: float) -> tuple[float, float]:
    """Return log Φ(depth) and φ(depth) / Φ(depth) of the standard normal distribution."""
    if depth < -8.0:  # the series of Mills's ratio
        log_tail = -0.5 * depth * depth - math.log(-depth) - 0.9189385332046727
        return log_tail, -depth - 1.0 / depth
    tail = 0.5 * math.erfc(-depth / math.sqrt(2.0))
    return math.log(tail), math.exp(-0.5 * depth * depth) * 0.3989422804014327 / tail


@njit(cache=True, nogil=True, error_model="numpy")
def _add_expected_data(prior: Prior, state: _State, weight: np.ndarray, levels: np.ndarray,
                       cell: np.ndarray, step_m: float, table: np.ndarray,
                       value: np.ndarray) -> None:
    """Add the data expected in a slot, averaged over candidate positions, to `value`, in place.

    Candidates with a weight below `NEGLIGIBLE` and links that are never received add 0.
    """
    uavs, devices, rows, columns = value.shape
    lasting_sd = math.sqrt(prior.share)
    near = np.zeros((rows, columns))
    for u in range(uavs):
        level, at = levels[u], u + 1
        for r in range(rows):
            for c in range(columns):
                away = math.hypot(r - cell[u, 0], c - cell[u, 1]) * step_m
                near[r, c] = math.exp(-away / prior.length_m)
        for k in range(devices):
            for i in range(weight.shape[1]):
                if weight[k, i] < NEGLIGIBLE:
                    continue
                mean, covariance = state.mean[k, i], state.covariance[k, i]
                for r in range(rows):
                    for c in range(columns):
                        snr_db = prior.snr_db[k, i, level, r, c]
                        if snr_db == -np.inf:
                            continue
                        sd_db = prior.sd_db[k, i, level, r, c]
                        slope = sd_db * lasting_sd * near[r, c]
                        snr_db += mean[0] + slope * mean[at]
                        variance = (sd_db * sd_db + covariance[0, 0] + 2 * slope * covariance[0, at]
                                    + slope * slope * (covariance[at, at] - 1.0))
                        value[u, k, r, c] += weight[k, i] * _interpolated(
                            table, snr_db, math.sqrt(max(variance, 0.0)))


@njit(cache=True, nogil=True, error_model="numpy")
def _interpolated(table: np.ndarray, snr_db: float, sd_db: float) -> float:
    """Interpolate the table of expected data bilinearly at a mean SNR and its sd [dB].

    Values outside the grid are clipped to it: -60 to 120 dB, sd 0 to 40 dB.
    """
    x = min(max((snr_db + 60.0) * 2.0, 0.0), table.shape[0] - 1.000001)
    y = min(max(sd_db * 2.0, 0.0), table.shape[1] - 1.000001)
    a, b = int(x), int(y)
    x, y = x - a, y - b
    return ((1 - x) * ((1 - y) * table[a, b] + y * table[a, b + 1])
            + x * ((1 - y) * table[a + 1, b] + y * table[a + 1, b + 1]))
