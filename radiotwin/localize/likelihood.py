"""How well device positions explain what was measured."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtr

from radiotwin.localize.link_table import DirectChannel, LinkTable
from radiotwin.localize.observations import DeviceObservations, Observations
from radiotwin.localize.overconfidence import DeviceResiduals

if TYPE_CHECKING:
    from radiotwin.scene.citymap import CityMap

OUTLIER_SHARE = 0.02
OUTLIER_SPAN_DB = 100.0
CHUNK_LINKS = 1 << 18
SLOPE_STEP_M = 2.0


class Likelihood:
    """Log-likelihood of positions for devices that share one height, with line of sight from the 3D map.

    A merged level of n repeats scatters about the channel's mean with variance
    sigma^2 (1 - f) + sigma^2 f / n, where sigma^2 is the channel's and f = `repeat_share` is the part of it that
    is drawn anew at every measurement; the rest belongs to the position and no repetition averages it out.
    Every level is, with probability OUTLIER_SHARE, from a uniform density over OUTLIER_SPAN_DB instead, so that
    one link that the model gets wrong by many sigma cannot outvote all others. A link that was not detected
    counts as P(level < limit), with the same share of outliers.
    """

    def __init__(
        self,
        observations: Observations,
        channel: LinkTable | DirectChannel,
        devices: np.ndarray,
        z_m: float,
        city: CityMap | None,
        limit_db: float | None,
        chunk_links: int = CHUNK_LINKS,
    ):
        """devices: (k,) positions in observations.devices, by which the methods know them; limit_db may be None
        only where nothing is `missed`."""
        self.devices, self.z_m, self._channel, self._city = devices, z_m, channel, city
        self.receiver_m, self._limit_db, self._chunk_links = observations.receiver_m, limit_db, chunk_links
        self._all = observations.devices
        self.repeat_share = 1.0

    def of_device(self, k: int, xy_m: np.ndarray) -> np.ndarray:
        """(p,) log-likelihood [nats] of one device's data at positions (p, 2)."""
        data = self._all[k]
        rows = np.union1d(data.seen, data.missed)
        total = np.zeros(len(xy_m))
        for part, los in self._sight(xy_m, rows):
            total[part] = self._score(data, rows, *self._channel.look_up(xy_m[part], rows, los, data.device))
        return total

    def of_all(self, xy_m: np.ndarray) -> np.ndarray:
        """(k, p) log-likelihood [nats] of each device's data at the same positions (p, 2): sight lines (and the
        channel, where it does not tell devices apart) are computed once for all."""
        used = [np.concatenate([self._all[k].seen, self._all[k].missed]) for k in self.devices]
        rows = np.unique(np.concatenate(used))
        total = np.zeros((len(self.devices), len(xy_m)))
        for part, los in self._sight(xy_m, rows):
            link = None
            for i, k in enumerate(self.devices):
                data = self._all[k]
                if link is None or self._channel.by_device:
                    link = self._channel.look_up(xy_m[part], rows, los, data.device)
                total[i, part] = self._score(data, rows, *link)
        return total

    def link_at(self, k: int, xy_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation [dB] of the channel at a device's detected positions (n,), if it were at one
        position (2,)."""
        data = self._all[k]
        los = self._line_of_sight(xy_m[None], data.seen)
        mean, sigma = self._channel.look_up(xy_m[None], data.seen, los, data.device)
        return mean[0], sigma[0]

    def residuals(self, k: int, xy_m: np.ndarray) -> DeviceResiduals:
        """Standardised residuals of a device's merged levels at one position (2,), and how they would change if it
        moved without any change of line of sight."""
        data = self._all[k]
        mean, sigma = self.link_at(k, xy_m)
        deviation = sigma * np.sqrt(self.variance_share(data.count))
        los = np.repeat(self._line_of_sight(xy_m[None], data.seen), 4, axis=0)
        steps = SLOPE_STEP_M * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        around, _ = self._channel.look_up(xy_m + steps, data.seen, los, data.device)
        slope = np.column_stack([around[0] - around[1], around[2] - around[3]]) / (2 * SLOPE_STEP_M)
        return DeviceResiduals(
            self.receiver_m[data.seen], (data.level_db - mean) / deviation, slope / deviation[:, None]
        )

    def variance_share(self, count: np.ndarray) -> np.ndarray:
        """Variance of the mean of `count` repeats, as a share of the channel's variance."""
        return 1.0 - self.repeat_share + self.repeat_share / count

    def _sight(self, xy_m: np.ndarray, rows: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
        step = max(1, self._chunk_links // max(len(rows), 1))
        for start in range(0, len(xy_m), step):
            part = slice(start, start + step)
            yield part, self._line_of_sight(xy_m[part], rows)

    def _line_of_sight(self, xy_m: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """(p, c) bool between positions (p, 2) and receivers (c,)."""
        p, c = len(xy_m), len(rows)
        if self._city is None:
            return np.ones((p, c), bool)
        ends_m = np.repeat(np.column_stack([xy_m, np.full(p, self.z_m)]), c, axis=0)
        return self._city.line_of_sight(ends_m, np.tile(self.receiver_m[rows], (p, 1))).reshape(p, c)

    def _score(
        self, data: DeviceObservations, rows: np.ndarray, mean: np.ndarray, sigma: np.ndarray
    ) -> np.ndarray:
        total = np.zeros(len(mean))
        if len(data.seen):
            columns = _columns(rows, data.seen)
            scale = np.sqrt(self.variance_share(data.count)).astype(np.float32)
            # log[(1 - e) N(level) + e / span] as log(e / span) + log(1 + ratio), ratio >= 0: no cancellation.
            deviation = sigma[:, columns] * scale
            ratio = (data.level_db.astype(np.float32) - mean[:, columns]) / deviation
            ratio *= ratio
            ratio *= np.float32(-0.5)
            np.exp(ratio, out=ratio)
            ratio /= deviation
            ratio *= np.float32((1 - OUTLIER_SHARE) / np.sqrt(2 * np.pi) * OUTLIER_SPAN_DB / OUTLIER_SHARE)
            total += np.log1p(ratio, out=ratio).sum(axis=1, dtype=float)
            total += len(data.seen) * np.log(OUTLIER_SHARE / OUTLIER_SPAN_DB)
        if len(data.missed):
            columns = _columns(rows, data.missed)
            # k misses in one place are worth k only as far as repeats are independent (design effect).
            weight = data.missed_count / (1 + (data.missed_count - 1) * (1 - self.repeat_share))
            below = ndtr((np.float32(self._limit_db) - mean[:, columns]) / sigma[:, columns])
            below *= np.float32(1 - OUTLIER_SHARE)
            below += np.float32(OUTLIER_SHARE / 2)
            total += np.log(below, out=below) @ weight
        return total


def _columns(rows: np.ndarray, wanted: np.ndarray) -> np.ndarray | slice:
    return slice(None) if len(rows) == len(wanted) else np.searchsorted(rows, wanted)
