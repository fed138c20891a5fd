"""Correlation length of a residual: the distance over which errors of links are correlated.

It is estimated from the robust variogram (Cressie and Hawkins 1980, 'Robust estimation of the
variogram', Math. Geology 12) over the positions of the end that moves, within each device, receiver
and flight, so that errors of a whole device or receiver do not count. The level of each flight and
the trends of each pair of ends are removed before. Detrending removes long shadows, too: a model
variogram that ignored it would be biased to short lengths, by half for flights of a few lengths. So
the model is an exponential field with a nugget (Gudmundson 1991, 'Correlation model for shadow
fading in mobile radio systems') after the same projection, that of generalised increments
(Kitanidis 1983, 'Statistical estimation of polynomial generalized covariance functions', Water
Resources Research 19), fitted by weighted least squares (Cressie 1985, Math. Geology 17).
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

MAX_LINKS = 20_000  # a sample of more has pairs enough
NEIGHBOURS = 8  # nearest, of each link: the short distances
LAGS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144)  # along a track: the longer ones
BINS, MIN_PAIRS = 16, 40  # of distances; and pairs in each
MIN_BINS = 3  # that tell nugget, sill and length
MIN_TREND_LINKS = 60  # of a pair of ends, for its trends
MIN_CORRELATED = 0.1  # share of the variance that is correlated, below which there is no length
NODES = 400  # links of a pair of ends that stand for all in the projection of a field
MAX_PAIRS = 5_000  # of links of a pair of ends, that stand for all of them
MIN_SINGULAR = 1e-9  # singular value of a trend over the greatest: less is linearly dependent
MIN_SERIES = 3  # mean readings of a device by a receiver on a flight, to be a series
MAX_STEPS = 5_000  # places whose nearest one is looked up
MAX_Z = 4.0  # residuals are clipped to this many scales
LENGTHS = 24  # tried, evenly on a logarithmic scale
EXTENT_SHARE = 0.25  # of the extent: a longer correlation looks like a trend
MIN_STEP_M = 0.1
REMEMBERED = 8  # sets of links: of a model and its folds


def pairs_of_links(place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (p,) and rows (p,) of pairs of links of one series: neighbours, and along tracks.

    A place is (n, d) of both ends; its last column separates series.
    """
    n = len(place)
    every = np.arange(n) if n <= MAX_LINKS else np.sort(
        np.random.default_rng(0).choice(n, MAX_LINKS, replace=False))
    near = cKDTree(place).query(place[every], NEIGHBOURS + 1)[1][:, 1:]
    first = [np.repeat(every, NEIGHBOURS)]
    second = [near.ravel()]
    for lag in LAGS:
        first.append(every[every < n - lag])
        second.append(first[-1] + lag)
    a, b = np.concatenate(first), np.concatenate(second)
    same = (b < n) & (a != b)
    a, b = a[same], b[same]
    same = place[a, -1] == place[b, -1]
    return a[same], b[same]


@dataclass(frozen=True, eq=False)
class Trend:
    """Trends of a pair of ends, which are removed before correlation is estimated.

    A level for each flight, a slope over log-distance, and two harmonics of azimuth: errors of the
    base and of antennas that are common to the whole campaign, and no shadows.

    Attributes:
        rows: (m,) of the links, ascending.
        basis: (m, q) orthonormal.
    """

    rows: np.ndarray
    basis: np.ndarray

    @classmethod
    def of(cls, links: Links, rows: np.ndarray, series: np.ndarray) -> Trend:
        """Return the trend of some rows (m,) of links (n,), with the series (n,) of each link."""
        own = series[rows]
        columns = (own[:, None] == np.unique(own)).astype(float)
        if len(rows) >= MIN_TREND_LINKS:
            azimuth = np.radians(links.azimuth_deg[rows])
            columns = np.column_stack([columns, np.log(links.distance_m[rows]), np.cos(azimuth),
                                       np.sin(azimuth), np.cos(2 * azimuth), np.sin(2 * azimuth)])
        left, singular, _ = np.linalg.svd(columns, full_matrices=False)
        return cls(rows, left[:, singular > MIN_SINGULAR * singular[0]])

    def taken_from(self, z: np.ndarray) -> np.ndarray:
        """Return the detrended residuals (m,) of its rows, from all residuals (n,)."""
        own = z[self.rows]
        return own - self.basis @ (self.basis.T @ own)

    def left_of(self, position_m: np.ndarray, i: np.ndarray, j: np.ndarray,
                lengths_m: np.ndarray) -> np.ndarray:
        """Return the semivariance of fields of unit variance after detrending.

        Args:
            position_m: (n, d) of the links [m].
            i: (p,) of its rows: first links.
            j: (p,) second links.
            lengths_m: (k,) correlation lengths [m].

        Returns:
            (1 + k, p), of white noise and of an exponential field of each length.
        """
        used, place = np.unique(np.concatenate([i, j]), return_inverse=True)
        a, b = place.reshape(2, -1)
        own_m, count = position_m[self.rows], len(self.rows)
        nodes = np.arange(0, count, -(-count // NODES))  # evenly along all tracks
        weight = count / len(nodes)
        turn = self.basis[i] - self.basis[j]
        left = [1 - 0.5 * (turn * turn).sum(axis=1)]
        # In single precision, which is good to a few millionths here and takes a third of the time.
        to_nodes_m, between_m = (cdist(each, own_m[nodes]).astype(np.float32)
                                 for each in (own_m[used], own_m[nodes]))
        basis, apart_m = self.basis[nodes].astype(np.float32), _apart_m(own_m, i, j)
        for length_m in lengths_m.astype(np.float32):
            common = np.exp(to_nodes_m / -length_m) @ basis * weight
            both = basis.T @ np.exp(between_m / -length_m) @ basis
            left.append(1 - np.exp(-apart_m / length_m)
                        - (turn * (common[a] - common[b])).sum(axis=1)
                        + 0.5 * weight**2 * ((turn @ both) * turn).sum(axis=1))
        return np.array(left)


@dataclass(frozen=True, eq=False)
class Variogram:
    """Model variograms of some links: all that depends on nothing but where they are.

    Attributes:
        trends: of each pair of ends; each of n links belongs to one.
        first: (p,) rows of first links.
        second: (p,) of second ones, of the same pair of ends and flight.
        index: (p,) bin of each pair's distance.
        fields: (1 + k, bins) semivariances of detrended white noise, and of a field of each length;
            NaN in a bin without a sampled pair.
        lengths_m: (k,) that are tried, ascending [m].
    """

    trends: list[Trend]
    first: np.ndarray
    second: np.ndarray
    index: np.ndarray
    fields: np.ndarray
    lengths_m: np.ndarray

    @classmethod
    def of(cls, position_m: np.ndarray, trends: list[Trend], first: np.ndarray, second: np.ndarray,
           lengths_m: np.ndarray) -> Variogram:
        """Return that of n links with both ends at (n, d) [m]; other arguments as of the class."""
        distance_m, least_m = _apart_m(position_m, first, second), float(lengths_m[0])
        edges = np.geomspace(least_m, max(float(distance_m.max(initial=0)), 2 * least_m), BINS)
        index = np.searchsorted(edges, distance_m)
        return cls(trends, first, second, index,
                   _fields(position_m, trends, first, second, index, lengths_m), lengths_m)

    def length_m(self, z: np.ndarray) -> float:
        """Return the correlation length whose field, with a nugget, is nearest to a residual's.

        The residuals (n,) are over their scale. The first of `lengths_m` stands for a residual that
        is not correlated, or says too little.
        """
        rest = np.empty(len(z))
        for trend in self.trends:
            rest[trend.rows] = trend.taken_from(z)
        pairs = np.bincount(self.index, minlength=BINS + 1)
        root = np.sqrt(np.abs(rest[self.first] - rest[self.second]))
        mean = np.bincount(self.index, weights=root, minlength=BINS + 1) / np.maximum(pairs, 1)
        gamma = 0.5 * mean**4 / (0.457 + 0.494 / np.maximum(pairs, 1))  # Eq. 2.14
        used = (pairs >= MIN_PAIRS) & np.isfinite(self.fields).all(axis=0)
        if used.sum() < MIN_BINS:
            return float(self.lengths_m[0])
        return _nearest(gamma[used], pairs[used], self.fields[:, used], self.lengths_m)


def _fields(position_m: np.ndarray, trends: list[Trend], first: np.ndarray, second: np.ndarray,
            index: np.ndarray, lengths_m: np.ndarray) -> np.ndarray:
    """Return the mean semivariance (1 + k, bins) of detrended fields; NaN in a bin without a pair.

    Arguments as of `Variogram`, and the positions (n, d) of both ends [m].
    """
    owner = np.empty(len(position_m), dtype=int)
    for number, trend in enumerate(trends):
        owner[trend.rows] = number
    order = np.argsort(owner[first], kind="stable")
    ends = np.searchsorted(owner[first][order], np.arange(len(trends) + 1))
    sums, weights = np.zeros((1 + len(lengths_m), BINS + 1)), np.zeros(BINS + 1)
    for number, trend in enumerate(trends):
        pairs = order[ends[number]:ends[number + 1]]
        if not len(pairs):
            continue
        sampled = pairs[::-(-len(pairs) // MAX_PAIRS)]
        weight = len(pairs) / len(sampled)
        i, j = (np.searchsorted(trend.rows, rows[sampled]) for rows in (first, second))
        left = trend.left_of(position_m, i, j, lengths_m)
        sums += [np.bincount(index[sampled], weights=weight * each, minlength=BINS + 1)
                 for each in left]
        weights += weight * np.bincount(index[sampled], minlength=BINS + 1)
    return np.where(weights > 0, sums / np.maximum(weights, 1e-9), np.nan)


def _nearest(gamma: np.ndarray, pairs: np.ndarray, fields: np.ndarray,
             lengths_m: np.ndarray) -> float:
    """Return the length [m] whose field and nugget are nearest to a variogram (b,) of pairs (b,).

    Fields (1 + k, b) are semivariances of white noise, and of a field of each length (k,).
    """
    # Bins are dependent: beyond some hundreds, more pairs do not make one more certain.
    weight = np.sqrt(np.minimum(pairs, 500)) / np.maximum(gamma, 0.05 * gamma.max(initial=1e-9))
    best, found = nnls((weight * fields[0])[:, None], weight * gamma)[1], float(lengths_m[0])
    for length_m, field in zip(lengths_m.tolist(), fields[1:], strict=True):
        (nugget, sill), misfit = nnls(np.column_stack([fields[0], field]) * weight[:, None],
                                      weight * gamma)
        if misfit < best and sill >= MIN_CORRELATED * (nugget + sill):
            best, found = misfit, length_m
    return found


def _apart_m(position_m: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the distance (p,) between pairs of rows of positions (n, d) [m]."""
    return np.linalg.norm(position_m[first] - position_m[second], axis=1)


def devices_move(links: Links) -> bool:
    """Return whether devices are positions of a moving device: receivers read most of them once."""
    series = pd.DataFrame({"device": links.device, "receiver": links.receiver,
                           "flight": links.flight})
    return len(series.drop_duplicates()) > len(links) / MIN_SERIES


def moving_end_m(links: Links) -> np.ndarray:
    """Return the positions (n, 3) of the end that moves [m]; 0 where unknown."""
    if devices_move(links):
        return np.nan_to_num(links.device_m[links.device])
    return links.receiver_m


def pair_of_ends(links: Links) -> np.ndarray:
    """Return a label (n,) of each link's device and receiver; of the receiver if devices move."""
    if devices_move(links):
        return links.receiver
    return links.receiver * len(links.device_names) + links.device


def extent_m(position_m: np.ndarray) -> float:
    """Return the diagonal of the box that holds 96 % of positions (n, 2 or 3) in x and in y [m]."""
    low, high = np.quantile(position_m[:, :2], [0.02, 0.98], axis=0)
    return float(np.hypot(*(high - low)))


def step_m(links: Links) -> float:
    """Return the median distance between neighbouring places of a device and receiver [m]."""
    place, offset_m = _apart(links, pair_of_ends(links))
    places = pd.DataFrame(np.round(place / MIN_STEP_M)).drop_duplicates().to_numpy() * MIN_STEP_M
    if len(places) < 2:
        return 0.0
    some = places[::-(-len(places) // MAX_STEPS)]
    nearest = cKDTree(places).query(some, 2)[0][:, 1]
    nearest = nearest[nearest < offset_m / 2]  # of the same pair
    return float(np.median(nearest)) if len(nearest) else 0.0


def correlation_length_m(links: Links, z: np.ndarray) -> float:
    """Return the distance over which the correlation of a residual falls to 1/e [m].

    It is at least the usual step between places, which an uncorrelated residual gives, and at most
    a quarter of the extent of the campaign. Residuals (n,) are divided by their scale; blank links
    do not count.
    """
    seen = np.isfinite(links.level_db) & np.isfinite(z)
    least_m, rows, variogram = _variogram(links, seen.tobytes())
    return least_m if variogram is None else variogram.length_m(np.clip(z[rows], -MAX_Z, MAX_Z))


@lru_cache(maxsize=REMEMBERED)
def _variogram(links: Links, seen: bytes) -> tuple[float, np.ndarray, Variogram | None]:
    """Return the least length [m], rows (m,) of the detected links, and their model variogram.

    It is cached: every effect and every step needs it for the same links, and it is slow.
    """
    least_m, most_m = step_m(links), EXTENT_SHARE * extent_m(moving_end_m(links))
    rows = np.flatnonzero(np.frombuffer(seen, dtype=bool))
    if least_m <= 0 or most_m <= least_m or len(rows) < MIN_PAIRS:
        return least_m, rows, None
    part = links.select(rows)
    pair = pair_of_ends(part)
    order = np.lexsort((np.arange(len(rows)), part.time_s, part.flight, pair))
    part, pair = part.select(order), pair[order]
    series = pd.factorize(pair * (part.flight.max() + 2) + part.flight)[0]
    place, borders = _apart(part, series)[0], np.flatnonzero(np.diff(pair)) + 1
    trends = [Trend.of(part, each, series)
              for each in np.split(np.arange(len(pair)), borders)]
    first, second = pairs_of_links(place)
    near = np.linalg.norm(place[first] - place[second], axis=1) < 2 * most_m  # the rest is trends
    return least_m, rows[order], Variogram.of(
        place[:, :-1], trends, first[near], second[near],
        np.geomspace(least_m, most_m, LENGTHS))


def _apart(links: Links, label: np.ndarray) -> tuple[np.ndarray, float]:
    """Return places (n, 7) [m] and the distance between labels in the last coordinate [m].

    A place is the positions of both ends and a coordinate that keeps different labels (n,) apart.
    """
    ends_m = np.column_stack([links.receiver_m, np.nan_to_num(links.device_m[links.device])])
    offset_m = 4.0 * float(np.ptp(ends_m, axis=0).max(initial=0.0)) + 1.0
    return np.column_stack([ends_m, pd.factorize(label)[0] * offset_m]), offset_m
