"""Likelihood of device positions, corrected for correlated errors of the channel model.

A channel model that is wrong in one street is wrong in the same way along all of it. Multiplying
the likelihoods of all links as if they were independent then gives too small a credible region.
The remedy is a composite likelihood [1]: the log-likelihood is divided by the design effect, the
factor by which the correlation of residuals widens the distribution of the position's estimate.

[1] Varin, Reid, Firth, "An overview of composite likelihood methods", Statistica Sinica 21, 2011,
section 2.3.

A law that was learnt from few links has a common error on all links of a device, which adds to the
correlation of the residuals (`LawError`).
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
SIGNIFICANT = 3.0  # standard errors above which a correlation is significant
MAX_Z = 3.0  # residuals are clipped to so many standard deviations
MAX_POSITIONS = 1500  # receiver positions of one device: memory grows with their square
OUTLIER_SHARE = 0.02  # probability that a level is an outlier
OUTLIER_SPAN_DB = 100.0  # width of the outliers' uniform density: the range of plausible levels
CHUNK_LINKS = 1 << 18  # links predicted at a time: bounds memory
SLOPE_STEP_M = 2.0  # step to each side for the slope of a link's mean
# Prior sd of errors of a law's level at 100 m [dB] and slope [dB per decade], for LoS or NLoS
# without an anchor. Laws published for cities differ by less.
LAW_SD_DB = 10.0


@dataclass(frozen=True)
class DeviceResiduals:
    """Residuals of a device at its most likely position.

    Attributes:
        receiver_m: (n, 3) positions of the receivers [m].
        z: (n,) residuals in standard deviations.
        slope: (n, 2) change of the link's mean with the device's x and y at constant line of sight,
            in standard deviations per metre.
        law: (n, p) change of the link's mean for each of p independent errors of the law, in
            standard deviations.
        links_per_row: number of detected links that a row stands for, after thinning.
    """

    receiver_m: np.ndarray
    z: np.ndarray
    slope: np.ndarray
    law: np.ndarray
    links_per_row: float = 1.0

    def thinned(self) -> DeviceResiduals:
        """Keep every k-th row, so that at most MAX_POSITIONS are left, and clip outliers."""
        pick = slice(None, None, -(-len(self.z) // MAX_POSITIONS) or 1)
        return DeviceResiduals(self.receiver_m[pick], np.clip(self.z[pick], -MAX_Z, MAX_Z),
                               self.slope[pick], self.law[pick],
                               len(self.z) / max(len(self.z[pick]), 1))


@dataclass(frozen=True, eq=False)
class LawError:
    """Standard errors of a law's level and slope in NLoS and LoS.

    Any channel model is assumed to know them no better than a line fitted to the same links.

    Attributes:
        by_class: True if the law distinguishes LoS and NLoS.
        root_db: (4, 4) R, where R R' is the covariance of level at 100 m and slope per decade in
            NLoS, then in LoS [dB].
    """

    by_class: bool
    root_db: np.ndarray

    @classmethod
    def learnt(cls, channel: Channel, by_class: bool, links: LinkGeometry,
               level_db: np.ndarray) -> LawError:
        """Estimate how well level and slope of a channel are known from the n links of its fit.

        As in a weighted least-squares line, with the sandwich covariance A^-1 (sum_ij rho_ij x_i
        x_j') A^-1, since residuals of one device are correlated between receivers.
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
        for residuals in parts:
            information += residuals.links_per_row * residuals.law.T @ residuals.law
            covariance += _score_covariance(residuals, residuals.law, correlation)
        inverse = np.linalg.inv(information)
        value, vector = np.linalg.eigh(inverse @ covariance @ inverse)
        return cls(by_class, vector * np.sqrt(np.maximum(value, 0.0)))

    def of_links(self, links: LinkGeometry) -> np.ndarray:
        """Return the change (n, 4) [dB] of n links' means for each independent error of the law."""
        return _law_columns(links, self.by_class) @ self.root_db


def _law_columns(links: LinkGeometry, by_class: bool) -> np.ndarray:
    """Return design columns (n, 4): level and slope in NLoS, level and slope in LoS."""
    line = np.column_stack([np.ones(len(links)), np.log10(links.distance_m / 100.0)])
    los = links.los[:, None] if by_class else np.ones((len(links), 1), dtype=bool)
    return np.column_stack([line * ~los, line * los])


def _score_covariance(residuals: DeviceResiduals, columns: np.ndarray,
                      correlation: np.ndarray) -> np.ndarray:
    """Return a device's score covariance (p, p), sum_ij rho_ij c_i c_j' of columns (n, p)."""
    bins = np.minimum((squareform(pdist(residuals.receiver_m)) / BIN_M).astype(int), N_BINS)
    rho = np.append(correlation, 0.0)[bins]
    np.fill_diagonal(rho, 1.0 / residuals.links_per_row)  # pairs grow with the square of links
    return residuals.links_per_row**2 * columns.T @ rho @ columns


def residual_correlation(devices: list[DeviceResiduals]) -> np.ndarray:
    """Estimate the correlation of residuals by distance between receivers, pooled over devices.

    The result (N_BINS,) is 0 from the first bin of BIN_M that is not significant, so that
    uncorrelated data give zeros.
    """
    product, pairs, square, n = np.zeros(N_BINS), np.zeros(N_BINS), 0.0, 0
    for residuals in devices:
        z = residuals.z
        if len(z) < 2:
            continue
        bins = np.minimum((pdist(residuals.receiver_m) / BIN_M).astype(int), N_BINS)
        first, second = np.triu_indices(len(z), k=1)
        product += np.bincount(bins, z[first] * z[second], N_BINS + 1)[:N_BINS]
        pairs += np.bincount(bins, minlength=N_BINS + 1)[:N_BINS]
        square += float(z @ z)
        n += len(z)
    if n == 0 or square == 0.0:
        return np.zeros(N_BINS)
    correlation = product / np.maximum(pairs, 1) / (square / n)
    noise = (pairs > 0) & (correlation <= SIGNIFICANT / np.sqrt(np.maximum(pairs, 1)))
    return np.where(np.cumsum(noise) > 0, 0.0, correlation)


def design_effect(residuals: DeviceResiduals, correlation: np.ndarray) -> float:
    """Return the design effect, at least 1, by which to divide a device's log-likelihood.

    It is how much errors with a correlation (N_BINS,) widen the position's variance: trace(H^-1 J)
    / 2, where H = sum_i a_i a_i' and J = sum_ij (rho_ij + l_i l_j') a_i a_j' over links, with
    slopes a of the levels and errors l of the law, times the mean square residual if above 1. It is
    1 for fewer than three links.
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
    """Log-likelihood of positions for devices of one height.

    The mean of n repeated levels has the variance sd^2 (1 - f) + sd^2 f / n around the channel's
    mean, where f = `repeat_share` is the share of the channel's variance that is independent in
    every measurement; the other share belongs to the position and does not average out. With
    probability OUTLIER_SHARE a level is from a uniform density over OUTLIER_SPAN_DB, so that one
    link far from the model cannot outweigh all others. A link that was not detected has the
    likelihood P(level < limit), with the same share of outliers.

    Attributes:
        observations: observations of all devices.
        channel: predicts links to the receivers of the observations.
        devices: (k,) indices in `observations.devices`, by which methods identify devices.
        z_m: height of the devices [m].
        city: 3D map; None: every link has line of sight.
        limit_db: limit of detection [dB]; None only if nothing is `missed`.
        law_error: standard errors of the channel; None: it is exact.
        declared: declared powers, cables and antennas, added to the channel's levels.
        repeat_share: f; 1 until it is estimated.
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
        """Return the log-likelihood (k, p) [nats] of devices at candidate positions (p, 2) [m].

        Line of sight is computed once for all devices, and so is the channel if it does not
        distinguish devices.
        """
        observed = [self.observations.devices[k] for k in devices]
        rows = np.unique(np.concatenate([part for data in observed
                                         for part in (data.seen, data.missed)]))
        total = np.zeros((len(observed), len(xy_m)))
        step = max(1, CHUNK_LINKS // max(len(rows), 1))
        for part in (slice(start, start + step) for start in range(0, len(xy_m), step)):
            los, predicted = self._line_of_sight(xy_m[part], rows), None
            for i, data in enumerate(observed):
                if predicted is None or self.channel.by_device:
                    predicted = self.channel.look_up(xy_m[part], rows, los, data.device)
                mean_db, sd_db = predicted
                mean_db = self._with_declared(mean_db, xy_m[part], rows, data.device)
                total[i, part] = self._score(data, rows, mean_db, sd_db)
        return total

    def link_at(self, k: int, xy_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predict mean and sd (n,) [dB] of a device's detected links at a position (2,) [m]."""
        data = self.observations.devices[k]
        los = self._line_of_sight(xy_m[None], data.seen)
        mean_db, sd_db = self.channel.look_up(xy_m[None], data.seen, los, data.device)
        return self._with_declared(mean_db, xy_m[None], data.seen, data.device)[0], sd_db[0]

    def residuals(self, k: int, xy_m: np.ndarray) -> DeviceResiduals:
        """Return standardised residuals (n,) of a device at a position (2,) [m], and their slopes.

        Repeats are merged, and slopes are at constant line of sight.
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
        """Add a device's declared power, cable and antenna gain to the mean (p, c) [dB]."""
        if self.declared.adds_nothing:
            return mean_db
        ends_m = np.column_stack([xy_m, np.full(len(xy_m), self.z_m)])
        ray_m = (self.observations.receiver_m[rows] - ends_m[:, None]).reshape(-1, 3)
        added_db = self.declared.added_db(np.full(len(ray_m), device), ray_m)
        return mean_db + np.reshape(added_db, mean_db.shape).astype(np.float32)

    def _line_of_sight(self, xy_m: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the line of sight (p, c) from positions (p, 2) [m] to receivers `rows` (c,)."""
        p, c = len(xy_m), len(rows)
        if self.city is None:
            return np.ones((p, c), bool)
        ends_m = np.repeat(np.column_stack([xy_m, np.full(p, self.z_m)]), c, axis=0)
        others_m = np.tile(self.observations.receiver_m[rows], (p, 1))
        return self.city.line_of_sight(ends_m, others_m).reshape(p, c)

    def _score(self, data: DeviceObservations, rows: np.ndarray, mean_db: np.ndarray,
               sd_db: np.ndarray) -> np.ndarray:
        """Return a device's log-likelihood (p,), given mean and sd (p, c) at receivers `rows`."""
        total = np.zeros(len(mean_db))
        if len(data.seen):
            columns = _columns(rows, data.seen)
            scale = np.sqrt(self.variance_share(data.count)).astype(np.float32)
            # log[(1 - e) N(level) + e / span] = log(e / span) + log(1 + ratio): no cancellation
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
            # k misses at one position count k only if repeats are independent (design effect).
            weight = data.missed_count / (1 + (data.missed_count - 1) * (1 - self.repeat_share))
            below = ndtr((np.float32(self.limit_db) - mean_db[:, columns]) / sd_db[:, columns])
            below *= np.float32(1 - OUTLIER_SHARE)
            below += np.float32(OUTLIER_SHARE / 2)
            total += np.log(below, out=below) @ weight
        return total


def _columns(rows: np.ndarray, wanted: np.ndarray) -> np.ndarray | slice:
    """Return the index of each of `wanted` in the sorted `rows`; a slice if they are equal."""
    return slice(None) if len(rows) == len(wanted) else np.searchsorted(rows, wanted)
