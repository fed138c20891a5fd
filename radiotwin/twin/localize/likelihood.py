"""Log-likelihood of device positions given the measurements, and how many links count as one.

A channel model that is wrong in one street is wrong in the same way at every position along it.
Multiplying the likelihoods of all links as if they were independent then claims too small a
credible region. The remedy here is a composite likelihood [1]: the log-likelihood is divided by the
design effect, the factor by which correlation between residuals widens the distribution of the
position's estimate beyond what independence would give.

[1] Varin, Reid, Firth, "An overview of composite likelihood methods", Statistica Sinica 21, 2011,
section 2.3.

A law that was learnt from few links is wrong in the same way on all links of a device. That error
adds to the correlation of the residuals (`LawError`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.distance import pdist, squareform
from scipy.special import ndtr

from radiotwin.links import LinkGeometry
from radiotwin.links.declared import NOTHING, Declared
from radiotwin.twin.localize.observations import (
    Channel,
    DeviceObservations,
    DirectChannel,
    LinkTable,
    Observations,
    link_grid,
)

if TYPE_CHECKING:
    from radiotwin.scene.citymap import CityMap

BIN_M, N_BINS = 20.0, 20  # width of a bin of distance [m], and number of bins
SIGNIFICANT = 3.0  # standard errors above which a correlation is taken for real
MAX_Z = 3.0  # an outlier counts as this many standard deviations
MAX_POSITIONS = 1500  # of one device: memory grows with their square
OUTLIER_SHARE = 0.02  # probability that the channel does not explain a level at all
OUTLIER_SPAN_DB = 100.0  # width of the outliers' uniform density: the range of plausible levels
CHUNK_LINKS = 1 << 18  # links that are predicted at a time: bounds memory
SLOPE_STEP_M = 2.0  # to each side, of the difference quotient of a link's mean
# Prior standard deviation of a law's level at 100 m [dB], and of its slope [dB per decade]: what a
# class of links that no anchor has may be off by. Laws published for cities spread by less.
LAW_SD_DB = 10.0


@dataclass(frozen=True)
class DeviceResiduals:
    """Residuals of a device at its most likely position.

    Attributes:
        receiver_m: (n, 3) positions of the receivers [m].
        z: (n,) residuals in standard deviations.
        slope: (n, 2) change of the link's mean with the device's x and y at constant line of sight,
            in standard deviations per metre.
        law: (n, p) error of the link's mean from each of the p independent errors of the law, in
            standard deviations.
        links_per_row: detected links for each of the n that were kept.
    """

    receiver_m: np.ndarray
    z: np.ndarray
    slope: np.ndarray
    law: np.ndarray
    links_per_row: float = 1.0

    def thinned(self) -> DeviceResiduals:
        """Return at most MAX_POSITIONS of them, evenly over the rows, with outliers clipped."""
        pick = slice(None, None, -(-len(self.z) // MAX_POSITIONS) or 1)
        return DeviceResiduals(self.receiver_m[pick], np.clip(self.z[pick], -MAX_Z, MAX_Z),
                               self.slope[pick], self.law[pick],
                               len(self.z) / max(len(self.z[pick]), 1))


@dataclass(frozen=True, eq=False)
class LawError:
    """Standard error of a law's level and slope, for each class of line of sight.

    Whatever the form of a channel, it knows the level and the slope of its class no better than a
    line through the same links does.

    Attributes:
        by_class: whether the law distinguishes line of sight.
        root_db: (4, 4) R, where R R' is the covariance of level at 100 m and slope per decade
            without line of sight, then with it [dB].
    """

    by_class: bool
    root_db: np.ndarray

    @classmethod
    def learnt(cls, channel: Channel, by_class: bool, links: LinkGeometry,
               level_db: np.ndarray) -> LawError:
        """Return the error of a channel that was learnt from n links.

        The weighted least squares of a line, with the sandwich covariance A^-1 (sum_ij rho_ij x_i
        x_j') A^-1 where residuals of one device are correlated between receivers.

        Args:
            channel: as it was learnt.
            by_class: whether it distinguishes line of sight.
            links: n links.
            level_db: (n,) [dB]; NaN: not detected.
        """
        detected = np.flatnonzero(np.isfinite(level_db))
        links, level_db = links.select(detected), level_db[detected]
        mean_db, sd_db = channel.predict(links)
        z, columns = (level_db - mean_db) / sd_db, _law_columns(links, by_class) / sd_db[:, None]
        parts = []
        for device in np.unique(links.device):
            rows = links.device == device
            parts.append(DeviceResiduals(links.receiver_m[rows], z[rows], np.zeros((rows.sum(), 2)),
                                         columns[rows]).thinned())
        correlation = residual_correlation(parts)
        information, covariance = np.zeros((2, 4, 4)) + np.eye(4) / LAW_SD_DB**2
        for each in parts:
            information += each.links_per_row * each.law.T @ each.law
            covariance += _score_covariance(each, each.law, correlation)
        inverse = np.linalg.inv(information)
        value, vector = np.linalg.eigh(inverse @ covariance @ inverse)
        return cls(by_class, vector * np.sqrt(np.maximum(value, 0.0)))

    def of_links(self, links: LinkGeometry) -> np.ndarray:
        """Return the errors (n, 4) [dB] of n links' means: R, seen by each link."""
        return _law_columns(links, self.by_class) @ self.root_db


def _law_columns(links: LinkGeometry, by_class: bool) -> np.ndarray:
    """Return level and slope (n, 4) without line of sight, and with it."""
    line = np.column_stack([np.ones(len(links)), np.log10(links.distance_m / 100.0)])
    los = links.los[:, None] if by_class else np.ones((len(links), 1), dtype=bool)
    return np.column_stack([line * ~los, line * los])


def _score_covariance(residuals: DeviceResiduals, columns: np.ndarray,
                      correlation: np.ndarray) -> np.ndarray:
    """Return sum_ij rho_ij c_i c_j' (p, p) over all links, of columns c (n, p) of those kept.

    Args:
        residuals: of the device.
        columns: (n, p)
        correlation: (N_BINS,) of residuals by distance, as from `residual_correlation`.
    """
    bins = np.minimum((squareform(pdist(residuals.receiver_m)) / BIN_M).astype(int), N_BINS)
    rho = np.append(correlation, 0.0)[bins]
    np.fill_diagonal(rho, 1.0 / residuals.links_per_row)  # pairs of links grow with its square
    return residuals.links_per_row**2 * columns.T @ rho @ columns


def residual_correlation(devices: list[DeviceResiduals]) -> np.ndarray:
    """Return the correlation of residuals by distance between receivers, pooled over devices.

    Args:
        devices: residuals of each.

    Returns:
        (N_BINS,) in bins of BIN_M. It is 0 from the first bin on that is not above SIGNIFICANT
        standard errors of independent residuals, so that uncorrelated data give zeros.
    """
    product, pairs, square, n = np.zeros(N_BINS), np.zeros(N_BINS), 0.0, 0
    for each in devices:
        if len(each.z) < 2:
            continue
        bins = np.minimum((pdist(each.receiver_m) / BIN_M).astype(int), N_BINS)
        first, second = np.triu_indices(len(each.z), k=1)
        product += np.bincount(bins, each.z[first] * each.z[second], N_BINS + 1)[:N_BINS]
        pairs += np.bincount(bins, minlength=N_BINS + 1)[:N_BINS]
        square += float(each.z @ each.z)
        n += len(each.z)
    if n == 0 or square == 0.0:
        return np.zeros(N_BINS)
    correlation = product / np.maximum(pairs, 1) / (square / n)
    noise = (pairs > 0) & (correlation <= SIGNIFICANT / np.sqrt(np.maximum(pairs, 1)))
    return np.where(np.cumsum(noise) > 0, 0.0, correlation)


def design_effect(residuals: DeviceResiduals, correlation: np.ndarray) -> float:
    """Return the factor by which to divide a device's log-likelihood.

    trace(H^-1 J) / 2 with H = sum_i a_i a_i', J = sum_ij (rho_ij + l_i l_j') a_i a_j' over the
    slopes a and the errors l of the law: the mean widening of the position's variance; times the
    residuals' mean square, where that is above 1 (the standard deviation is too small).

    Args:
        residuals: of the device.
        correlation: (N_BINS,) as from `residual_correlation`.

    Returns:
        at least 1
    """
    if len(residuals.z) < 3:
        return 1.0
    information = residuals.links_per_row * residuals.slope.T @ residuals.slope
    by_law = residuals.links_per_row * residuals.slope.T @ residuals.law
    score_covariance = _score_covariance(residuals, residuals.slope, correlation) \
        + by_law @ by_law.T
    widening = np.trace(np.linalg.pinv(information) @ score_covariance) / 2.0
    return float(max(1.0, widening) * max(1.0, np.mean(residuals.z**2)))


@dataclass(eq=False)
class Likelihood:
    """Log-likelihood of positions for devices that share one height.

    A merged level of n repeats varies about the channel's mean with the variance
    sd^2 (1 - f) + sd^2 f / n, where sd is the channel's and f = `repeat_share` is the part of its
    variance that is drawn anew at every measurement; the rest belongs to the position and no
    repetition averages it out. Every level is, with probability OUTLIER_SHARE, from a uniform
    density over OUTLIER_SPAN_DB instead, so that one link far from the model cannot outweigh all
    others. A link that was not detected counts as P(level < limit), with the same share of
    outliers.

    Attributes:
        observations: of all devices.
        channel: predicts links to the receivers of the observations.
        devices: (k,) indices in `observations.devices`, by which the methods identify them.
        z_m: height of the devices [m].
        city: 3D map; None: every link has line of sight.
        limit_db: limit of detection [dB]; None only where nothing is `missed`.
        law_error: of the channel; None: it is exact.
        declared: of the devices by their index: what is in the levels beside the channel.
        repeat_share: f, 1 until it is set.
    """

    observations: Observations
    channel: LinkTable | DirectChannel
    devices: np.ndarray
    z_m: float
    city: CityMap | None
    limit_db: float | None
    law_error: LawError | None = None
    declared: Declared = NOTHING
    repeat_share: float = 1.0

    def of_devices(self, devices: Sequence[int] | np.ndarray, xy_m: np.ndarray) -> np.ndarray:
        """Return the log-likelihood of the data of some devices at the same positions.

        Lines of sight are computed once for all, and so is the channel where it does not
        distinguish devices.

        Args:
            devices: (k,) indices in `observations.devices`.
            xy_m: (p, 2) [m].

        Returns:
            (k, p) [nats]
        """
        every = [self.observations.devices[k] for k in devices]
        rows = np.unique(np.concatenate([part for data in every
                                         for part in (data.seen, data.missed)]))
        total = np.zeros((len(every), len(xy_m)))
        step = max(1, CHUNK_LINKS // max(len(rows), 1))
        for part in (slice(start, start + step) for start in range(0, len(xy_m), step)):
            los, link = self._line_of_sight(xy_m[part], rows), None
            for i, data in enumerate(every):
                if link is None or self.channel.by_device:
                    link = self.channel.look_up(xy_m[part], rows, los, data.device)
                mean_db, sd_db = link
                mean_db = self._with_declared(mean_db, xy_m[part], rows, data.device)
                total[i, part] = self._score(data, rows, mean_db, sd_db)
        return total

    def link_at(self, k: int, xy_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the channel between one position of a device and the receivers that detected it.

        Args:
            k: index in `observations.devices`.
            xy_m: (2,) position [m].

        Returns:
            (n,) mean [dB], and (n,) standard deviation [dB].
        """
        data = self.observations.devices[k]
        los = self._line_of_sight(xy_m[None], data.seen)
        mean_db, sd_db = self.channel.look_up(xy_m[None], data.seen, los, data.device)
        return self._with_declared(mean_db, xy_m[None], data.seen, data.device)[0], sd_db[0]

    def residuals(self, k: int, xy_m: np.ndarray) -> DeviceResiduals:
        """Return standardised residuals of a device's merged levels, and their slopes.

        Args:
            k: index in `observations.devices`.
            xy_m: (2,) position of the device [m].

        Returns:
            n residuals, with slopes at constant line of sight.
        """
        data = self.observations.devices[k]
        mean_db, sd_db = self.link_at(k, xy_m)
        merged_sd_db = sd_db * np.sqrt(self.variance_share(data.count))
        los = self._line_of_sight(xy_m[None], data.seen)
        receiver_m = self.observations.receiver_m[data.seen]
        law_db = np.zeros((len(data.seen), 0)) if self.law_error is None else \
            self.law_error.of_links(link_grid(xy_m[None], self.z_m, receiver_m, los, data.device))
        los = np.repeat(los, 4, axis=0)
        steps = SLOPE_STEP_M * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        around, _ = self.channel.look_up(xy_m + steps, data.seen, los, data.device)
        around = self._with_declared(around, xy_m + steps, data.seen, data.device)
        slope = np.column_stack([around[0] - around[1], around[2] - around[3]])
        slope = slope / (2 * SLOPE_STEP_M)
        return DeviceResiduals(receiver_m, (data.level_db - mean_db) / merged_sd_db,
                               slope / merged_sd_db[:, None], law_db / merged_sd_db[:, None])

    def variance_share(self, count: np.ndarray) -> np.ndarray:
        """Return the variance of the mean of `count` repeats over the channel's variance."""
        return 1.0 - self.repeat_share + self.repeat_share / count

    def _with_declared(self, mean_db: np.ndarray, xy_m: np.ndarray, rows: np.ndarray,
                       device: int) -> np.ndarray:
        """Return the channel's mean (p, c) with what is declared of a device [dB].

        Args:
            mean_db: (p, c) [dB].
            xy_m: (p, 2) positions of the device [m].
            rows: (c,) of the receivers.
            device: its index.
        """
        if self.declared.adds_nothing:
            return mean_db
        ends_m = np.column_stack([xy_m, np.full(len(xy_m), self.z_m)])
        ray_m = (self.observations.receiver_m[rows] - ends_m[:, None]).reshape(-1, 3)
        added_db = self.declared.added_db(np.full(len(ray_m), device), ray_m)
        return mean_db + np.reshape(added_db, mean_db.shape).astype(np.float32)

    def _line_of_sight(self, xy_m: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return line of sight (p, c) between positions (p, 2) and rows (c,) of the receivers."""
        p, c = len(xy_m), len(rows)
        if self.city is None:
            return np.ones((p, c), bool)
        ends_m = np.repeat(np.column_stack([xy_m, np.full(p, self.z_m)]), c, axis=0)
        others_m = np.tile(self.observations.receiver_m[rows], (p, 1))
        return self.city.line_of_sight(ends_m, others_m).reshape(p, c)

    def _score(self, data: DeviceObservations, rows: np.ndarray, mean_db: np.ndarray,
               sd_db: np.ndarray) -> np.ndarray:
        """Return the log-likelihood (p,) given the channel (p, c) at rows (c,) of the receivers."""
        total = np.zeros(len(mean_db))
        if len(data.seen):
            columns = _columns(rows, data.seen)
            scale = np.sqrt(self.variance_share(data.count)).astype(np.float32)
            # log[(1 - e) N(level) + e / span] as log(e / span) + log(1 + ratio), ratio >= 0: no
            # cancellation.
            merged_sd_db = sd_db[:, columns] * scale
            ratio = (data.level_db.astype(np.float32) - mean_db[:, columns]) / merged_sd_db
            ratio *= ratio
            ratio *= np.float32(-0.5)
            np.exp(ratio, out=ratio)
            ratio /= merged_sd_db
            ratio *= np.float32(
                (1 - OUTLIER_SHARE) / np.sqrt(2 * np.pi) * OUTLIER_SPAN_DB / OUTLIER_SHARE)
            total += np.log1p(ratio, out=ratio).sum(axis=1, dtype=float)
            total += len(data.seen) * np.log(OUTLIER_SHARE / OUTLIER_SPAN_DB)
        if len(data.missed):
            columns = _columns(rows, data.missed)
            # k misses at one position count k only as far as repeats are independent (design
            # effect).
            weight = data.missed_count / (1 + (data.missed_count - 1) * (1 - self.repeat_share))
            below = ndtr((np.float32(self.limit_db) - mean_db[:, columns]) / sd_db[:, columns])
            below *= np.float32(1 - OUTLIER_SHARE)
            below += np.float32(OUTLIER_SHARE / 2)
            total += np.log(below, out=below) @ weight
        return total


def _columns(rows: np.ndarray, wanted: np.ndarray) -> np.ndarray | slice:
    return slice(None) if len(rows) == len(wanted) else np.searchsorted(rows, wanted)
