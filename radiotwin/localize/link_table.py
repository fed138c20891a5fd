"""Means and deviations of very many links: looked up in a table where the channel allows it, predicted where not."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from radiotwin.links.geometry import LinkGeometry

MAX_LEVELS = 256
NODES = 1024
NEAR_M = 5.0  # softens the logarithmic axis below this horizontal distance
PROBES = 40  # positions, each to as many receivers
MEAN_TOLERANCE_DB = 0.05
SIGMA_TOLERANCE = 0.02
MIN_SIGMA_DB = 0.1
PREDICT_CHUNK = 200_000


class Channel(Protocol):
    """Any channel: a fitted `radiotwin.channel.ChannelModel`, or a fixed one."""

    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Mean [dB] and standard deviation [dB] of n links, (n,) each."""
        ...


class LinkTable:
    """Channel of links from devices at one height, as a function of horizontal distance and line of sight.

    For each difference in height between receiver and device (to `MAX_LEVELS` of them) and each of NLoS, LoS
    there is a row over the horizontal distance rho, with NODES nodes evenly spaced in log(rho^2 + NEAR_M^2), in
    which a log-distance law is close to straight; values between nodes are interpolated linearly.
    """

    by_device = False

    def __init__(self, channel: Channel, receiver_m: np.ndarray, z_m: float, reach_m: float):
        """receiver_m: (r, 3) [m]; z_m: the devices' height [m]; reach_m: the largest horizontal distance [m]."""
        rise, step = receiver_m[:, 2] - z_m, 0.01
        while len(levels := np.unique(np.round(rise / step))) > MAX_LEVELS:
            step *= 2.0
        self._x, self._y = receiver_m[:, 0].astype(np.float32), receiver_m[:, 1].astype(np.float32)
        self._first_node = (np.searchsorted(levels, np.round(rise / step)) * 2 * NODES).astype(np.int32)
        low, high = np.log(NEAR_M**2), np.log(reach_m**2 + NEAR_M**2)
        axis = np.linspace(low, high, NODES)
        self._low, self._per_node = np.float32(low), np.float32((NODES - 1) / (high - low))
        rho = np.sqrt(np.maximum(np.exp(axis) - NEAR_M**2, 0.0))
        level, los, rho = (a.ravel() for a in np.meshgrid(levels * step, [False, True], rho, indexing="ij"))
        ends = np.column_stack([rho, np.zeros_like(rho), level + z_m])
        device_m = np.broadcast_to([0.0, 0.0, z_m], ends.shape)
        links = LinkGeometry(device_m, ends, los, np.zeros(len(ends), np.int64))
        mean, sigma = predict_in_chunks(channel, links)
        self._mean, self._sigma = mean.astype(np.float32), sigma.astype(np.float32)

    def look_up(
        self, xy_m: np.ndarray, rows: np.ndarray, los: np.ndarray, device: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation [dB], (p, c) float32, between p device positions and c receivers.

        xy_m: (p, 2) [m]; rows: (c,) of receiver_m; los: (p, c) bool; device: not looked at.
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
        mean, sigma = self._mean.take(node), self._sigma.take(node)
        mean += at * (self._mean.take(after) - mean)
        sigma += at * (self._sigma.take(after) - sigma)
        return mean, sigma


class DirectChannel:
    """The same for a channel that depends on more, such as the place, the azimuth, or which device it is."""

    def __init__(self, channel: Channel, receiver_m: np.ndarray, z_m: float, by_device: bool):
        self._channel, self._receiver_m, self._z_m = channel, receiver_m, z_m
        self.by_device = by_device

    def look_up(
        self, xy_m: np.ndarray, rows: np.ndarray, los: np.ndarray, device: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `LinkTable.look_up`; device: the index that `predict` is told."""
        links = link_grid(xy_m, self._z_m, self._receiver_m[rows], los, device)
        mean, sigma = predict_in_chunks(self._channel, links)
        return mean.reshape(los.shape).astype(np.float32), sigma.reshape(los.shape).astype(np.float32)


def tabulate(
    channel: Channel,
    receiver_m: np.ndarray,
    z_m: float,
    bounds: tuple[float, float, float, float],
    devices: np.ndarray,
    rng: np.random.Generator,
) -> LinkTable | DirectChannel:
    """A table if it repeats the channel's own predictions at random links of this very problem, else not.

    bounds: (x_min, x_max, y_min, y_max) of the devices [m]; devices: (k,) the indices of those at height z_m.
    The predictions must agree to MEAN_TOLERANCE_DB, an order below the deviation of any channel, in all of them.
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
        mean, sigma = (each.reshape(los.shape) for each in predict_in_chunks(channel, links))
        table_mean, table_sigma = table.look_up(xy_m, rows, los, device)
        exact &= bool((np.abs(table_mean - mean) < MEAN_TOLERANCE_DB).all())
        exact &= bool((np.abs(table_sigma - sigma) <= SIGMA_TOLERANCE * sigma).all())
        as_first = predict_in_chunks(channel, link_grid(xy_m, z_m, receiver_m[rows], los, devices[0]))
        by_device |= not all(np.allclose(a.ravel(), b) for a, b in zip((mean, sigma), as_first, strict=True))
    return table if exact else DirectChannel(channel, receiver_m, z_m, by_device)


def link_grid(xy_m: np.ndarray, z_m: float, receiver_m: np.ndarray, los: np.ndarray, device: int) -> LinkGeometry:
    """LinkGeometry from every one of p device positions (p, 2) to every one of c receivers (c, 3), p slowest."""
    p, c = los.shape
    device_m = np.repeat(np.column_stack([xy_m, np.full(p, z_m)]), c, axis=0)
    return LinkGeometry(device_m, np.tile(receiver_m, (p, 1)), los.ravel(), np.full(p * c, device))


def predict_in_chunks(channel: Channel, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
    """`channel.predict` with bounded memory; sigma at least MIN_SIGMA_DB, since the likelihood divides by it."""
    if not len(links):
        return np.zeros(0), np.zeros(0)
    parts = [
        channel.predict(links.select(slice(start, start + PREDICT_CHUNK)))
        for start in range(0, len(links), PREDICT_CHUNK)
    ]
    mean, sigma = (np.concatenate(each) for each in zip(*parts, strict=True))
    return mean, np.maximum(sigma, MIN_SIGMA_DB)
