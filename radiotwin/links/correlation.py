"""Correlation length of a residual: the distance over which errors of links are correlated.

It is estimated from the robust variogram (Cressie and Hawkins 1980, 'Robust estimation of the
variogram', Math. Geology 12) over the positions of the moving end. Pairs of links share device,
receiver and flight, so that offsets of a device or receiver do not count. The level of each flight
and the trends of each device and receiver are removed first. That also removes part of the long
shadows, which would halve the length on flights of a few lengths. The model is therefore an
exponential field with a nugget (Gudmundson 1991, 'Correlation model for shadow fading in mobile
radio systems') after the same projection (generalised increments; Kitanidis 1983, 'Statistical
estimation of polynomial generalized covariance functions', Water Resources Research 19), fitted by
weighted least squares (Cressie 1985, Math. Geology 17).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pandas as pd
from scipy.optimize import nnls
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from radiotwin.links.links import Links

MAX_LINKS = 20_000  # larger campaigns are sampled
NEIGHBOURS = 8  # nearest links that each link is paired with, for short distances
LAGS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144)  # links along a track, for longer distances
BINS, MIN_PAIRS = 16, 40  # distance bins; smallest number of pairs in a bin
MIN_BINS = 3  # for nugget, sill and length
MIN_TREND_LINKS = 60  # of a device and receiver, to fit trends beyond the levels of flights
MIN_CORRELATED = 0.1  # smallest correlated share of the variance; with less there is no length
NODES = 400  # links that sample a device and receiver in the projection of a field
MAX_PAIRS = 5_000  # pairs that sample those of a device and receiver
MIN_SINGULAR = 1e-9  # relative singular value below which trends are linearly dependent
MIN_SERIES = 3  # readings of a device by a receiver on a flight, in the mean, if devices stand
MAX_STEPS = 5_000  # sampled places whose nearest neighbour is searched
MAX_Z = 4.0  # residuals are clipped to this many scales
LENGTHS = 24  # candidate lengths, evenly spaced on a logarithmic scale
EXTENT_SHARE = 0.25  # longest length over the extent; longer correlation looks like a trend
MIN_STEP_M = 0.1  # closer positions count as one place
REMEMBERED = 8  # cached variograms: a model and its folds


def pairs_of_links(place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Choose pairs of links to compare: return first and second row of each pair, (p,) each.

    Each of at most `MAX_LINKS` sampled links is paired with its `NEIGHBOURS` nearest in `place` (n,
    d) [m], positions of both ends and a last coordinate that tells series apart, and with the links
    `LAGS` rows on, in its series; rows are sorted by series and time.
    """
    n = len(place)
    sampled = np.arange(n) if n <= MAX_LINKS else np.sort(
        np.random.default_rng(0).choice(n, MAX_LINKS, replace=False))
    near = cKDTree(place).query(place[sampled], NEIGHBOURS + 1)[1][:, 1:]
    first = [np.repeat(sampled, NEIGHBOURS)]
    second = [near.ravel()]
    for lag in LAGS:
        first.append(sampled[sampled < n - lag])
        second.append(first[-1] + lag)
    a, b = np.concatenate(first), np.concatenate(second)
    valid = (b < n) & (a != b)
    a, b = a[valid], b[valid]
    valid = place[a, -1] == place[b, -1]
    return a[valid], b[valid]


@dataclass(frozen=True, eq=False)
class Trend:
    """Trends of one device and receiver, which are removed before correlation is estimated.

    They are a level for each flight, a slope over log-distance, and two harmonics of azimuth:
    errors of the base model and of antennas, which are not shadowing.

    Attributes:
        rows: (m,) rows of the links, ascending.
        basis: (m, q) orthonormal basis of the trends.
    """

    rows: np.ndarray
    basis: np.ndarray

    @classmethod
    def of(cls, links: Links, rows: np.ndarray, series: np.ndarray) -> Trend:
        """Build the trend of rows (m,) of links: what is removed from residuals before comparing.

        It is the mean of each flight, labelled by `series` (n,), and for at least `MIN_TREND_LINKS`
        rows a slope over ln distance and two harmonics of the azimuth. The basis is orthonormal.
        """
        label = series[rows]
        columns = (label[:, None] == np.unique(label)).astype(float)
        if len(rows) >= MIN_TREND_LINKS:
            azimuth = np.radians(links.azimuth_deg[rows])
            columns = np.column_stack([columns, np.log(links.distance_m[rows]), np.cos(azimuth),
                                       np.sin(azimuth), np.cos(2 * azimuth), np.sin(2 * azimuth)])
        left, singular, _ = np.linalg.svd(columns, full_matrices=False)
        return cls(rows, left[:, singular > MIN_SINGULAR * singular[0]])

    def detrended(self, z: np.ndarray) -> np.ndarray:
        """Select the residuals (m,) of this device and receiver from all (n,), and detrend them."""
        part = z[self.rows]
        return part - self.basis @ (self.basis.T @ part)

    def semivariances(self, position_m: np.ndarray, i: np.ndarray, j: np.ndarray,
                lengths_m: np.ndarray) -> np.ndarray:
        """Compute semivariances of unit-variance fields without this trend, for pairs of links.

        Pairs are `i` and `j` (p,), indices into `rows`; `position_m` (n, d) is of all links. The
        result (1 + k, p) is that of white noise, then of a field for each of `lengths_m` (k,).
        """
        used, place = np.unique(np.concatenate([i, j]), return_inverse=True)
        a, b = place.reshape(2, -1)
        part_m, count = position_m[self.rows], len(self.rows)
        nodes = np.arange(0, count, -(-count // NODES))  # evenly along all tracks
        weight = count / len(nodes)
        step = self.basis[i] - self.basis[j]
        found = [1 - 0.5 * (step * step).sum(axis=1)]
        # Single precision is accurate to a few millionths here, in a third of the time.
        to_nodes_m, between_m = (cdist(each, part_m[nodes]).astype(np.float32)
                                 for each in (part_m[used], part_m[nodes]))
        basis, distance_m = self.basis[nodes].astype(np.float32), _distance_m(part_m, i, j)
        for length_m in lengths_m.astype(np.float32):
            common = np.exp(to_nodes_m / -length_m) @ basis * weight
            projected = basis.T @ np.exp(between_m / -length_m) @ basis
            found.append(1 - np.exp(-distance_m / length_m)
                         - (step * (common[a] - common[b])).sum(axis=1)
                         + 0.5 * weight**2 * ((step @ projected) * step).sum(axis=1))
        return np.array(found)


@dataclass(frozen=True, eq=False)
class Variogram:
    """Model variograms of n links; they depend on the positions only.

    Attributes:
        trends: one for each device and receiver; together they cover all n links.
        first: (p,) first link of each pair, a row.
        second: (p,) second link, of the same device, receiver and flight.
        index: (p,) distance bin of each pair.
        model_semivariances: (1 + k, bins) semivariances of detrended white noise, and of a
            field of each length; NaN in a bin without a sampled pair.
        lengths_m: (k,) candidate correlation lengths, ascending [m].
    """

    trends: list[Trend]
    first: np.ndarray
    second: np.ndarray
    index: np.ndarray
    model_semivariances: np.ndarray
    lengths_m: np.ndarray

    @classmethod
    def of(cls, position_m: np.ndarray, trends: list[Trend], first: np.ndarray, second: np.ndarray,
           lengths_m: np.ndarray) -> Variogram:
        """Compute the model semivariance of pairs of links over distance, for correlation lengths.

        Pairs are rows `first` and `second` (p,) of `position_m` (n, d). Distance bins begin at the
        first of `lengths_m` (k,), which ascend.
        """
        distance_m, least_m = _distance_m(position_m, first, second), float(lengths_m[0])
        edges = np.geomspace(least_m, max(float(distance_m.max(initial=0)), 2 * least_m), BINS)
        index = np.searchsorted(edges, distance_m)
        return cls(trends, first, second, index,
                   _model_semivariances(position_m, trends, first, second, index, lengths_m),
                   lengths_m)

    def length_m(self, z: np.ndarray) -> float:
        """Fit the correlation length [m] of residuals (n,), divided by their scale.

        It is the shortest of `lengths_m` if they are uncorrelated, or fewer than `MIN_BINS` bins
        have `MIN_PAIRS` pairs. The measured semivariance is that of Cressie and Hawkins.
        """
        detrended = np.empty(len(z))
        for trend in self.trends:
            detrended[trend.rows] = trend.detrended(z)
        pairs = np.bincount(self.index, minlength=BINS + 1)
        root = np.sqrt(np.abs(detrended[self.first] - detrended[self.second]))
        mean = np.bincount(self.index, weights=root, minlength=BINS + 1) / np.maximum(pairs, 1)
        gamma = 0.5 * mean**4 / (0.457 + 0.494 / np.maximum(pairs, 1))  # Eq. 2.14
        used = (pairs >= MIN_PAIRS) & np.isfinite(self.model_semivariances).all(axis=0)
        if used.sum() < MIN_BINS:
            return float(self.lengths_m[0])
        return _best_length_m(gamma[used], pairs[used], self.model_semivariances[:, used],
                              self.lengths_m)


def _model_semivariances(position_m: np.ndarray, trends: list[Trend], first: np.ndarray,
                         second: np.ndarray, index: np.ndarray, lengths_m: np.ndarray,
                         ) -> np.ndarray:
    """Average the model semivariances (1 + k, bins) of pairs of links in bins (p,) of distance.

    First that of white noise, then of a field of each length (k,); NaN in a bin without a pair.
    """
    trend_of = np.empty(len(position_m), dtype=int)
    for number, trend in enumerate(trends):
        trend_of[trend.rows] = number
    order = np.argsort(trend_of[first], kind="stable")
    ends = np.searchsorted(trend_of[first][order], np.arange(len(trends) + 1))
    sums, weights = np.zeros((1 + len(lengths_m), BINS + 1)), np.zeros(BINS + 1)
    for number, trend in enumerate(trends):
        pairs = order[ends[number]:ends[number + 1]]
        if not len(pairs):
            continue
        sampled = pairs[::-(-len(pairs) // MAX_PAIRS)]
        weight = len(pairs) / len(sampled)
        i, j = (np.searchsorted(trend.rows, rows[sampled]) for rows in (first, second))
        sums += [np.bincount(index[sampled], weights=weight * gamma, minlength=BINS + 1)
                 for gamma in trend.semivariances(position_m, i, j, lengths_m)]
        weights += weight * np.bincount(index[sampled], minlength=BINS + 1)
    return np.where(weights > 0, sums / np.maximum(weights, 1e-9), np.nan)


def _best_length_m(gamma: np.ndarray, pairs: np.ndarray, model_semivariances: np.ndarray,
                   lengths_m: np.ndarray) -> float:
    """Return the correlation length [m] whose model semivariances fit the measured ones best.

    For each length a nugget and a sill of the models (1 + k, b) are fitted to `gamma` (b,). It is
    the first length if no sill reaches a share `MIN_CORRELATED`.
    """
    # Bins are dependent: beyond some hundreds of pairs, more make a bin no more certain.
    weight = np.sqrt(np.minimum(pairs, 500)) / np.maximum(gamma, 0.05 * gamma.max(initial=1e-9))
    noise, *fields = model_semivariances
    best, found = nnls((weight * noise)[:, None], weight * gamma)[1], float(lengths_m[0])
    for length_m, field in zip(lengths_m.tolist(), fields, strict=True):
        (nugget, sill), misfit = nnls(np.column_stack([noise, field]) * weight[:, None],
                                      weight * gamma)
        if misfit < best and sill >= MIN_CORRELATED * (nugget + sill):
            best, found = misfit, length_m
    return found


def _distance_m(position_m: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the distance (p,) between pairs of rows of positions (n, d) [m]."""
    return np.linalg.norm(position_m[first] - position_m[second], axis=1)


def devices_move(links: Links) -> bool:
    """Return whether devices are places of one moving device, with few links each per flight."""
    series = pd.DataFrame({"device": links.device, "receiver": links.receiver,
                           "flight": links.flight})
    return len(series.drop_duplicates()) > len(links) / MIN_SERIES


def moving_end_m(links: Links) -> np.ndarray:
    """Return receiver positions (n, 3) [m] of links, or device positions if the devices move.

    An unknown position is 0.
    """
    if devices_move(links):
        return np.nan_to_num(links.device_m[links.device])
    return links.receiver_m


def pair_label(links: Links) -> np.ndarray:
    """Label each link's pair of device and receiver, (n,); the receiver only if devices move."""
    if devices_move(links):
        return links.receiver
    return links.receiver * len(links.device_names) + links.device


def extent_m(position_m: np.ndarray) -> float:
    """Return the diagonal [m] of the box around the central 96 % of positions (n, 2 or 3) [m]."""
    low, high = np.quantile(position_m[:, :2], [0.02, 0.98], axis=0)
    return float(np.hypot(*(high - low)))


def median_step_m(links: Links) -> float:
    """Return the median distance [m] between nearest positions of one device and receiver.

    The distance is over x, y, z of both ends; 0 if no device and receiver have two positions.
    """
    place, offset_m = _separated_places(links, pair_label(links))
    places = pd.DataFrame(np.round(place / MIN_STEP_M)).drop_duplicates().to_numpy() * MIN_STEP_M
    if len(places) < 2:
        return 0.0
    sampled = places[::-(-len(places) // MAX_STEPS)]
    nearest_m = cKDTree(places).query(sampled, 2)[0][:, 1]
    nearest_m = nearest_m[nearest_m < offset_m / 2]  # of the same device and receiver
    return float(np.median(nearest_m)) if len(nearest_m) else 0.0


def correlation_length_m(links: Links, z: np.ndarray) -> float:
    """Return the distance [m] over which the correlation of residuals `z` (n,) falls to 1/e.

    `z` is in error scales, clipped to ±`MAX_Z`; links not detected, or with NaN, are ignored. The
    result is between the median step (if uncorrelated) and a quarter of the campaign's extent.
    """
    seen = np.isfinite(links.level_db) & np.isfinite(z)
    least_m, rows, variogram = _variogram(links, seen.tobytes())
    return least_m if variogram is None else variogram.length_m(np.clip(z[rows], -MAX_Z, MAX_Z))


@lru_cache(maxsize=REMEMBERED)
def _variogram(links: Links, seen: bytes) -> tuple[float, np.ndarray, Variogram | None]:
    """Return shortest length [m], rows (m,) in the order of the variogram, and variogram or None.

    `seen` is the mask of detected links as bytes: the key of a cache, as this takes long.
    """
    least_m, most_m = median_step_m(links), EXTENT_SHARE * extent_m(moving_end_m(links))
    rows = np.flatnonzero(np.frombuffer(seen, dtype=bool))
    if least_m <= 0 or most_m <= least_m or len(rows) < MIN_PAIRS:
        return least_m, rows, None
    part = links.select(rows)
    pair = pair_label(part)
    order = np.lexsort((np.arange(len(rows)), part.time_s, part.flight, pair))
    part, pair = part.select(order), pair[order]
    series = pd.factorize(pair * (part.flight.max() + 2) + part.flight)[0]
    place, borders = _separated_places(part, series)[0], np.flatnonzero(np.diff(pair)) + 1
    trends = [Trend.of(part, pair_rows, series)
              for pair_rows in np.split(np.arange(len(pair)), borders)]
    first, second = pairs_of_links(place)
    near = _distance_m(place, first, second) < 2 * most_m  # farther pairs only show trends
    return least_m, rows[order], Variogram.of(
        place[:, :-1], trends, first[near], second[near],
        np.geomspace(least_m, most_m, LENGTHS))


def _separated_places(links: Links, label: np.ndarray) -> tuple[np.ndarray, float]:
    """Return ends of links, with a coordinate that sets labels apart (n, 7), and by how much [m].

    Nearest neighbours in these coordinates always have the same label (n,).
    """
    ends_m = np.column_stack([links.receiver_m, np.nan_to_num(links.device_m[links.device])])
    offset_m = 4.0 * float(np.ptp(ends_m, axis=0).max(initial=0.0)) + 1.0
    return np.column_stack([ends_m, pd.factorize(label)[0] * offset_m]), offset_m
