"""What was measured, de-duplicated: one entry for each device and receiver position."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from radiotwin.errors import BadInput

SAME_POSITION_M = 1e-3


@dataclass(frozen=True)
class DeviceObservations:
    """One device's measurements, merged over repeats of the same receiver position.

    Detected: `seen` (n,) rows of `Observations.receiver_m`, `level_db` (n,) mean level, `count` (n,) how many
    were averaged, `squares` (n,) sum of squares about that mean [dB^2]. Not detected: `missed` (m,) rows and
    `missed_count` (m,). A position where some were detected and some were not is in both.
    """

    seen: np.ndarray
    level_db: np.ndarray
    count: np.ndarray
    squares: np.ndarray
    missed: np.ndarray
    missed_count: np.ndarray

    @property
    def n_detected(self) -> int:
        """Measurements, not positions."""
        return int(self.count.sum())

    @property
    def n_links(self) -> int:
        return self.n_detected + int(self.missed_count.sum())


@dataclass(frozen=True)
class Observations:
    """All devices' measurements from one set of receiver positions, `receiver_m` (r, 3) [m], each row once."""

    receiver_m: np.ndarray
    devices: list[DeviceObservations]


def merge_repeats(
    receiver_m: np.ndarray, device: np.ndarray, level_db: np.ndarray, n_devices: int, *, use_missed: bool
) -> Observations:
    """Merges the measurements of each device at each receiver position (equal to the millimetre).

    receiver_m: (n, 3) [m]; device: (n,) in 0 … n_devices - 1; level_db: (n,), NaN = not detected. Without
    `use_missed` (no limit of detection is known) links that were not detected are left out.
    Raises BadInput for shapes that disagree, positions that are not finite, infinite levels, unknown devices.
    """
    receiver_m, level_db = np.asarray(receiver_m, float), np.asarray(level_db, float)
    device = np.asarray(device)
    n = len(level_db)
    if receiver_m.shape != (n, 3) or device.shape != (n,) or level_db.shape != (n,):
        raise BadInput(
            f"receiver positions {receiver_m.shape}, devices {device.shape} and levels {level_db.shape} do not "
            "fit together: expected (n, 3), (n,) and (n,)"
        )
    if n and not np.issubdtype(device.dtype, np.integer):
        raise BadInput(f"devices are given as {device.dtype}, expected integers from 0 to {n_devices - 1}")
    if n and not 0 <= device.min() <= device.max() < n_devices:
        raise BadInput(
            f"measurements name devices {device.min()} to {device.max()}, allowed are 0 to {n_devices - 1}"
        )
    for bad, what in ((~np.isfinite(receiver_m).all(axis=1), "receiver position"), (np.isinf(level_db), "level")):
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            value = receiver_m[row].tolist() if what == "receiver position" else level_db[row]
            raise BadInput(f"the {what} in row {row} is {value}: finite numbers are allowed; leave the row out")
    if n == 0:
        nothing = [_merge(np.empty(0, int), np.empty(0), use_missed) for _ in range(n_devices)]
        return Observations(np.empty((0, 3)), nothing)
    _, first, position = np.unique(
        np.round(receiver_m / SAME_POSITION_M).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    position = position.ravel()
    devices = [_merge(position[device == k], level_db[device == k], use_missed) for k in range(n_devices)]
    return Observations(receiver_m[first], devices)


def _merge(position: np.ndarray, level_db: np.ndarray, use_missed: bool) -> DeviceObservations:
    detected = ~np.isnan(level_db)
    seen, group, count = np.unique(position[detected], return_inverse=True, return_counts=True)
    level = level_db[detected]
    mean = np.bincount(group, level, len(seen)) / np.maximum(count, 1)
    squares = np.bincount(group, (level - mean[group]) ** 2, len(seen))
    missed, missed_count = np.unique(position[~detected & use_missed], return_counts=True)
    return DeviceObservations(seen, mean, count, squares, missed, missed_count)
