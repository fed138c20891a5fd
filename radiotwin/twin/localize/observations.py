"""Measurements merged over repeats, and what a channel predicts of very many positions.

There is one entry for each device and receiver position. Predictions are looked up in a table where
the channel allows it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from radiotwin.links import LinkGeometry

SAME_POSITION_M = 1e-3  # positions that round to the same multiple are one [m]
MAX_LEVELS = 256  # differences in height that a table distinguishes
NODES = 1024  # of each row of a table, over the horizontal distance
NEAR_M = 5.0  # softens the logarithmic axis below this horizontal distance [m]
PROBES = 40  # positions at which a table is checked, each to as many receivers
MEAN_TOLERANCE_DB = 0.05  # of a table's mean: an order below the sd of any channel
SD_TOLERANCE = 0.02  # of its standard deviation, relative
MIN_SD_DB = 0.1  # of a channel: the likelihood divides by it
PREDICT_CHUNK = 200_000  # links that are predicted at a time: bounds memory


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
    """

    device: int
    seen: np.ndarray
    level_db: np.ndarray
    count: np.ndarray
    squares: np.ndarray
    missed: np.ndarray
    missed_count: np.ndarray

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
        use_missed: whether links that were not detected are used.

    Returns:
        observations, with the devices in the order of `devices`.
    """
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
    return DeviceObservations(int(device), seen, mean, count, squares, missed, missed_count)


class Channel(Protocol):
    """Any channel: a fitted `radiotwin.propagation.laws.ChannelModel`, or a fixed one."""

    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Return mean [dB] and standard deviation [dB] of n links, (n,) each."""
        ...


class LinkTable:
    """Predictions for devices at one height by horizontal distance, height difference and LoS.

    For each difference in height between receiver and device (up to `MAX_LEVELS`) and each of NLoS,
    LoS there is a row over the horizontal distance rho, with NODES nodes evenly spaced in
    log(rho^2 + NEAR_M^2), in which a log-distance law is close to straight; values between nodes
    are interpolated linearly.
    """

    by_device = False

    def __init__(self, channel: Channel, receiver_m: np.ndarray, z_m: float,
                 reach_m: float) -> None:
        """Tabulate a channel.

        Args:
            channel: to tabulate.
            receiver_m: (r, 3) positions of all receivers [m].
            z_m: height of the devices [m].
            reach_m: largest horizontal distance [m].
        """
        rise, step = receiver_m[:, 2] - z_m, 0.01
        while len(levels := np.unique(np.round(rise / step))) > MAX_LEVELS:
            step *= 2.0
        self._x, self._y = receiver_m[:, 0].astype(np.float32), receiver_m[:, 1].astype(np.float32)
        level_index = np.searchsorted(levels, np.round(rise / step))
        self._first_node = (level_index * 2 * NODES).astype(np.int32)
        low, high = np.log(NEAR_M**2), np.log(reach_m**2 + NEAR_M**2)
        axis = np.linspace(low, high, NODES)
        self._low, self._per_node = np.float32(low), np.float32((NODES - 1) / (high - low))
        rho = np.sqrt(np.maximum(np.exp(axis) - NEAR_M**2, 0.0))
        level, los, rho = (axis.ravel() for axis in np.meshgrid(levels * step, [False, True], rho,
                                                                indexing="ij"))
        ends = np.column_stack([rho, np.zeros_like(rho), level + z_m])
        device_m = np.broadcast_to([0.0, 0.0, z_m], ends.shape)
        links = LinkGeometry(device_m, ends, los, np.zeros(len(ends), np.int64))
        mean_db, sd_db = predict_in_chunks(channel, links)
        self._mean_db, self._sd_db = mean_db.astype(np.float32), sd_db.astype(np.float32)

    def look_up(self, xy_m: np.ndarray, rows: np.ndarray, los: np.ndarray,
                device: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the prediction of links between p device positions and c receivers.

        Args:
            xy_m: (p, 2) positions of the device [m].
            rows: (c,) receivers, as rows of `receiver_m`.
            los: (p, c) bool, line of sight.
            device: index of the device; not used, a table holds for all devices.

        Returns:
            (p, c) float32 mean [dB], and (p, c) float32 standard deviation [dB].
        """
        xy_m = xy_m.astype(np.float32)
        at = (xy_m[:, :1] - self._x[rows]) ** 2
        at += (xy_m[:, 1:] - self._y[rows]) ** 2
        at += np.float32(NEAR_M**2)
        np.log(at, out=at)
        at -= self._low
        at *= self._per_node
        node = np.minimum(at.astype(np.int32), NODES - 2)
        at -= node
        node += self._first_node[rows]
        node += los * np.int32(NODES)
        after = node + 1
        mean_db, sd_db = self._mean_db.take(node), self._sd_db.take(node)
        mean_db += at * (self._mean_db.take(after) - mean_db)
        sd_db += at * (self._sd_db.take(after) - sd_db)
        return mean_db, sd_db


class DirectChannel:
    """Predictions of a channel that depends on more, such as position, azimuth, or the device.

    Attributes:
        by_device: whether predictions differ between devices at one position.
    """

    def __init__(self, channel: Channel, receiver_m: np.ndarray, z_m: float,
                 by_device: bool) -> None:
        self._channel, self._receiver_m, self._z_m = channel, receiver_m, z_m
        self.by_device = by_device

    def look_up(self, xy_m: np.ndarray, rows: np.ndarray, los: np.ndarray,
                device: int) -> tuple[np.ndarray, np.ndarray]:
        """Predict as `LinkTable.look_up` does; `device` is passed on to the channel."""
        links = link_grid(xy_m, self._z_m, self._receiver_m[rows], los, device)
        mean_db, sd_db = predict_in_chunks(self._channel, links)
        return (mean_db.reshape(los.shape).astype(np.float32),
                sd_db.reshape(los.shape).astype(np.float32))


def tabulate(
    channel: Channel,
    receiver_m: np.ndarray,
    z_m: float,
    bounds: tuple[float, float, float, float],
    devices: np.ndarray,
    rng: np.random.Generator,
) -> LinkTable | DirectChannel:
    """Return a table if it repeats the channel's predictions at random links of this problem.

    Args:
        channel: to tabulate.
        receiver_m: (r, 3) positions of all receivers [m].
        z_m: height of the devices [m].
        bounds: x_min, x_max, y_min, y_max of the devices [m].
        devices: (k,) indices of the devices at that height.
        rng: random state.

    Returns:
        a table where all predictions agree to MEAN_TOLERANCE_DB and SD_TOLERANCE, the channel
        itself where not.
    """
    x_min, x_max, y_min, y_max = bounds
    corners = np.array([[x, y] for x in (x_min, x_max) for y in (y_min, y_max)])
    reach_m = float(np.linalg.norm(receiver_m[:, None, :2] - corners, axis=2).max()) + 1.0
    table, exact, by_device = LinkTable(channel, receiver_m, z_m, reach_m), True, False
    for device in devices:
        xy_m = rng.uniform([x_min, y_min], [x_max, y_max], (PROBES, 2))
        rows = rng.integers(len(receiver_m), size=PROBES)
        los = rng.random((PROBES, PROBES)) < 0.5
        links = link_grid(xy_m, z_m, receiver_m[rows], los, device)
        mean_db, sd_db = (each.reshape(los.shape) for each in predict_in_chunks(channel, links))
        table_mean_db, table_sd_db = table.look_up(xy_m, rows, los, device)
        exact &= bool((np.abs(table_mean_db - mean_db) < MEAN_TOLERANCE_DB).all())
        exact &= bool((np.abs(table_sd_db - sd_db) <= SD_TOLERANCE * sd_db).all())
        as_first = predict_in_chunks(
            channel, link_grid(xy_m, z_m, receiver_m[rows], los, devices[0]))
        by_device |= not all(np.allclose(own.ravel(), first)
                             for own, first in zip((mean_db, sd_db), as_first, strict=True))
    return table if exact else DirectChannel(channel, receiver_m, z_m, by_device)


def link_grid(xy_m: np.ndarray, z_m: float, receiver_m: np.ndarray, los: np.ndarray,
              device: int) -> LinkGeometry:
    """Return links from every position of a device to every receiver, positions slowest.

    Args:
        xy_m: (p, 2) positions of the device [m].
        z_m: its height [m].
        receiver_m: (c, 3) positions of the receivers [m].
        los: (p, c) bool, line of sight.
        device: index of the device.

    Returns:
        p * c links
    """
    p, c = los.shape
    device_m = np.repeat(np.column_stack([xy_m, np.full(p, z_m)]), c, axis=0)
    return LinkGeometry(device_m, np.tile(receiver_m, (p, 1)), los.ravel(), np.full(p * c, device))


def predict_in_chunks(channel: Channel, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Return `channel.predict` with bounded memory, and at least MIN_SD_DB as deviation."""
    if not len(links):
        return np.zeros(0), np.zeros(0)
    parts = [channel.predict(links.select(slice(start, start + PREDICT_CHUNK)))
             for start in range(0, len(links), PREDICT_CHUNK)]
    mean_db, sd_db = (np.concatenate(each) for each in zip(*parts, strict=True))
    return mean_db, np.maximum(sd_db, MIN_SD_DB)
