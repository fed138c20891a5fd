"""Measurements merged over repeats: one entry for each device and receiver position."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from radiotwin.errors import BadInput

SAME_POSITION_M = 1e-3  # positions that round to the same multiple are one [m]


@dataclass(frozen=True)
class DeviceObservations:
    """One device's measurements, merged over repeats of the same receiver position.

    A position where some were detected and some were not is in both `seen` and `missed`.

    Attributes:
        device: its index, as the channel knows it.
        seen: (n,) rows of `Observations.receiver_m` with detected measurements.
        level_db: (n,) their mean level [dB].
        count: (n,) detected measurements of each.
        squares: (n,) sum of squares about that mean [dB^2].
        missed: (m,) rows with measurements that were not detected; empty where no limit is known.
        missed_count: (m,) such measurements of each.
        n_detected: detected measurements in all.
        n_links: measurements in all.
    """

    device: int
    seen: np.ndarray
    level_db: np.ndarray
    count: np.ndarray
    squares: np.ndarray
    missed: np.ndarray
    missed_count: np.ndarray
    n_detected: int
    n_links: int

    @property
    def usable(self) -> bool:
        """Whether anything bears on the position."""
        return len(self.seen) + len(self.missed) > 0


@dataclass(frozen=True)
class Observations:
    """All devices' measurements from one set of receiver positions.

    Attributes:
        receiver_m: (r, 3) distinct positions [m].
        devices: measurements of each device.
    """

    receiver_m: np.ndarray
    devices: list[DeviceObservations]


def merge_repeats(receiver_m: np.ndarray, device: np.ndarray, level_db: np.ndarray,
                  devices: np.ndarray, *, use_missed: bool) -> Observations:
    """Merge the measurements of each device at each receiver position (equal to the millimetre).

    Args:
        receiver_m: (n, 3) [m].
        device: (n,) int, device of each measurement.
        level_db: (n,) [dB]; NaN: not detected.
        devices: (k,) int, the devices that are wanted; rows of others are not used.
        use_missed: whether links that were not detected are used; without a limit of detection they
            are only counted.

    Returns:
        observations, with the devices in the order of `devices`.

    Raises:
        BadInput: shapes disagree, a position is not finite, or a level is infinite.
    """
    receiver_m, level_db = np.asarray(receiver_m, float), np.asarray(level_db, float)
    device = np.asarray(device)
    n = len(level_db)
    if receiver_m.shape != (n, 3) or device.shape != (n,) or level_db.shape != (n,):
        raise BadInput(
            f"receiver positions {receiver_m.shape}, devices {device.shape} and levels "
            f"{level_db.shape} do not fit together: expected (n, 3), (n,) and (n,)")
    for row in np.flatnonzero(~np.isfinite(receiver_m).all(axis=1))[:1]:
        raise BadInput(
            f"the receiver's position in row {row} is {receiver_m[row].tolist()}: x, y and z must "
            "be finite numbers [m]; fill it in or leave the row out")
    for row in np.flatnonzero(np.isinf(level_db))[:1]:
        raise BadInput(f"the level in row {row} is {level_db[row]} dB: allowed are finite numbers, "
                       "or blank")
    rows = np.isin(device, devices)
    receiver_m, device, level_db = receiver_m[rows], device[rows], level_db[rows]
    _, first, position = np.unique(np.round(receiver_m / SAME_POSITION_M).astype(np.int64), axis=0,
                                   return_index=True, return_inverse=True)
    position = position.ravel()
    merged = [_merge(k, position[device == k], level_db[device == k], use_missed)
              for k in devices]
    return Observations(receiver_m[first], merged)


def _merge(device: int, position: np.ndarray, level_db: np.ndarray,
           use_missed: bool) -> DeviceObservations:
    detected = ~np.isnan(level_db)
    seen, group, count = np.unique(position[detected], return_inverse=True, return_counts=True)
    level = level_db[detected]
    mean = np.bincount(group, level, len(seen)) / np.maximum(count, 1)
    squares = np.bincount(group, (level - mean[group]) ** 2, len(seen))
    missed, missed_count = np.unique(position[~detected & use_missed], return_counts=True)
    return DeviceObservations(int(device), seen, mean, count, squares, missed, missed_count,
                              int(detected.sum()), len(level_db))
