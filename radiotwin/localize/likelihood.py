"""How well device positions explain what was measured."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtr

from radiotwin.localize.link_table import DirectChannel, LinkTable
from radiotwin.localize.observations import DeviceObservations, Observations

if TYPE_CHECKING:
    from radiotwin.scene.citymap import CityMap

OUTLIER_SHARE = 0.02
OUTLIER_SPAN_DB = 100.0
CHUNK_LINKS = 1 << 18
MIN_REPEAT_SHARE = 0.01


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
        """devices: (k,) indices into observations.devices; limit_db may be None only where nothing is `missed`."""
        self.devices, self.z_m, self._channel, self._city = devices, z_m, channel, city
        self.receiver_m, self._limit_db, self._chunk_links = observations.receiver_m, limit_db, chunk_links
        self._all = observations.devices
        self.repeat_share = 1.0

    def of_device(self, device: int, xy_m: np.ndarray) -> np.ndarray:
        """(p,) log-likelihood [nats] of one device's data at positions (p, 2)."""
        data = self._all[device]
        rows = np.union1d(data.seen, data.missed)
        total = np.zeros(len(xy_m))
        for part, los in self._sight(xy_m, rows):
            total[part] = self._score(data, rows, *self._channel.look_up(xy_m[part], rows, los, device))
        return total

    def of_all(self, xy_m: np.ndarray) -> np.ndarray:
        """(k, p) log-likelihood [nats] of each device's data at the same positions (p, 2): sight lines (and the
        channel, where it does not tell devices apart) are computed once for all."""
        used = [np.concatenate([self._all[k].seen, self._all[k].missed]) for k in self.devices]
        rows = np.unique(np.concatenate(used))
        total = np.zeros((len(self.devices), len(xy_m)))
        for part, los in self._sight(xy_m, rows):
            link = None
            for i, device in enumerate(self.devices):
                if link is None or self._channel.by_device:
                    link = self._channel.look_up(xy_m[part], rows, los, device)
                total[i, part] = self._score(self._all[device], rows, *link)
        return total

    def residuals(self, device: int, xy_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """At one position (2,): residual of each merged detected level [dB], its link's sigma [dB], and los."""
        data = self._all[device]
        (_, los), = self._sight(xy_m[None], data.seen)
        mean, sigma = self._channel.look_up(xy_m[None], data.seen, los, device)
        return data.level_db - mean[0], sigma[0], los[0]

    def variance_share(self, count: np.ndarray) -> np.ndarray:
        """Variance of the mean of `count` repeats, as a share of the channel's variance."""
        return 1.0 - self.repeat_share + self.repeat_share / count

    def _sight(self, xy_m: np.ndarray, rows: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
        step = max(1, self._chunk_links // max(len(rows), 1))
        for start in range(0, len(xy_m), step):
            part = slice(start, start + step)
            xy = xy_m[part]
            if self._city is None:
                yield part, np.ones((len(xy), len(rows)), bool)
                continue
            ends_m = np.column_stack([xy, np.full(len(xy), self.z_m)])
            los = self._city.line_of_sight(
                np.repeat(ends_m, len(rows), axis=0), np.tile(self.receiver_m[rows], (len(xy), 1))
            )
            yield part, los.reshape(len(xy), len(rows))

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
