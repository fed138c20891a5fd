"""Merge repeated measurements, and predict a channel for millions of candidate positions.

Observations have one entry for each device and receiver position. Predictions are looked up in a
table if the channel depends on distance, height difference and line of sight only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from radiotwin.links import LinkGeometry

SAME_POSITION_M = 1e-3  # positions that round to the same multiple are equal
MAX_LEVELS = 256  # height differences that a table distinguishes
NODES = 1024  # nodes of each row of a table, over the horizontal distance
NEAR_M = 5.0  # the logarithmic axis of a table is compressed below this horizontal distance
PROBES = 40  # positions at which a table is checked, each to as many receivers
MEAN_TOLERANCE_DB = 0.05  # error of a table's mean: far below the sd of any channel
SD_TOLERANCE = 0.02  # relative error of its standard deviation
MIN_SD_DB = 0.1  # least standard deviation, since the likelihood divides by it
PREDICT_CHUNK = 200_000  # links predicted at a time: bounds memory


@dataclass(frozen=True)
class DeviceObservations:
    """One device's measurements, merged over repeats of the same receiver position.

    A position with detected and undetected measurements is in both `seen` and `missed`.

    Attributes:
        device: index of the device in the channel's links.
        seen: (n,) rows of `Observations.receiver_m` with detected measurements.
        level_db: (n,) mean level of the detected measurements [dB].
        count: (n,) number of detected measurements.
        squares: (n,) sum of squared deviations from the mean [dB²].
        missed: (m,) rows with undetected measurements; empty if the limit is unknown.
        missed_count: (m,) number of undetected measurements.
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
        """Return True if there is any measurement that depends on the position."""
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
    """Merge the measurements (n,) of each device at each receiver position (to the millimetre).

    Kept are measurements of `devices` (k,), in this order; those not detected (level NaN) only with
    `use_missed`.
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
    """Average one device's levels (n,) [dB] by receiver position, an index (n,); NaN: missed."""
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
    """Table of predictions for devices at one height, by horizontal distance, rise and LoS.

    For each height difference between receiver and device (up to `MAX_LEVELS`), and NLoS and LoS,
    there is a row of NODES values over the horizontal distance rho. Nodes are evenly spaced in
    log(rho^2 + NEAR_M^2), over which a log-distance law is nearly straight; values between nodes
    are interpolated linearly.
    """

    by_device = False

    def __init__(self, channel: Channel, receiver_m: np.ndarray, z_m: float,
                 reach_m: float) -> None:
        """Tabulate a channel from devices at a height to receivers (r, 3), up to `reach_m` away."""
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
        """Look up mean and sd (p, c) [dB] of links between positions (p, 2) [m] and receivers (c,).

        Line of sight (p, c) is given; a table is for all devices.
        """
        xy_m = xy_m.astype(np.float32)
        offset = (xy_m[:, :1] - self._x[rows]) ** 2
        offset += (xy_m[:, 1:] - self._y[rows]) ** 2
        offset += np.float32(NEAR_M**2)
        np.log(offset, out=offset)
        offset -= self._low
        offset *= self._per_node
        node = np.minimum(offset.astype(np.int32), NODES - 2)
        offset -= node
        node += self._first_node[rows]
        node += los * np.int32(NODES)
        after = node + 1
        mean_db, sd_db = self._mean_db.take(node), self._sd_db.take(node)
        mean_db += offset * (self._mean_db.take(after) - mean_db)
        sd_db += offset * (self._sd_db.take(after) - sd_db)
        return mean_db, sd_db


class DirectChannel:
    """Predictions of a channel without a table, such as one that depends on position or device.

    Attributes:
        by_device: True if predictions differ between devices at one position.
    """

    def __init__(self, channel: Channel, receiver_m: np.ndarray, z_m: float,
                 by_device: bool) -> None:
        self._channel, self._receiver_m, self._z_m = channel, receiver_m, z_m
        self.by_device = by_device

    def look_up(self, xy_m: np.ndarray, rows: np.ndarray, los: np.ndarray,
                device: int) -> tuple[np.ndarray, np.ndarray]:
        """Predict links between p device positions and c receivers; see `LinkTable.look_up`."""
        links = link_grid(xy_m, self._z_m, self._receiver_m[rows], los, device)
        mean_db, sd_db = predict_in_chunks(self._channel, links)
        return (mean_db.reshape(los.shape).astype(np.float32),
                sd_db.reshape(los.shape).astype(np.float32))


def tabulate(channel: Channel, receiver_m: np.ndarray, z_m: float,
             bounds: tuple[float, float, float, float], devices: np.ndarray,
             rng: np.random.Generator) -> LinkTable | DirectChannel:
    """Tabulate a channel if a table reproduces its predictions at random links, else only wrap it.

    They must agree to MEAN_TOLERANCE_DB and SD_TOLERANCE for all `devices` (k,), which are at the
    height `z_m` within the bounds [m].
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
        mean_db, sd_db = (values.reshape(los.shape)
                          for values in predict_in_chunks(channel, links))
        table_mean_db, table_sd_db = table.look_up(xy_m, rows, los, device)
        exact &= bool((np.abs(table_mean_db - mean_db) < MEAN_TOLERANCE_DB).all())
        exact &= bool((np.abs(table_sd_db - sd_db) <= SD_TOLERANCE * sd_db).all())
        of_first = predict_in_chunks(
            channel, link_grid(xy_m, z_m, receiver_m[rows], los, devices[0]))
        by_device |= not all(np.allclose(values.ravel(), first)
                             for values, first in zip((mean_db, sd_db), of_first, strict=True))
    return table if exact else DirectChannel(channel, receiver_m, z_m, by_device)


def link_grid(xy_m: np.ndarray, z_m: float, receiver_m: np.ndarray, los: np.ndarray,
              device: int) -> LinkGeometry:
    """Pair every position (p, 2) of a device with every receiver (c, 3): p * c, positions slowest.

    Line of sight is (p, c).
    """
    p, c = los.shape
    device_m = np.repeat(np.column_stack([xy_m, np.full(p, z_m)]), c, axis=0)
    return LinkGeometry(device_m, np.tile(receiver_m, (p, 1)), los.ravel(), np.full(p * c, device))


def predict_in_chunks(channel: Channel, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
    """Predict links in chunks to bound memory; clip the standard deviation to MIN_SD_DB or more."""
    if not len(links):
        return np.zeros(0), np.zeros(0)
    parts = [channel.predict(links.select(slice(start, start + PREDICT_CHUNK)))
             for start in range(0, len(links), PREDICT_CHUNK)]
    mean_db, sd_db = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return mean_db, np.maximum(sd_db, MIN_SD_DB)
