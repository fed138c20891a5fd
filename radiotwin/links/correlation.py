"""How far apart two links still err alike: the correlation length of a residual.

From the robust variogram (Cressie and Hawkins 1980, 'Robust estimation of the variogram', Math.
Geology 12) over the positions of the end that moves, within each pair of ends and flight, so that
what a device or a receiver has in common does not count. An exponential model with a nugget
(Gudmundson 1991, 'Correlation model for shadow fading in mobile radio systems') is fitted by
weighted least squares (Cressie 1985, Math. Geology 17).
"""

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from radiotwin.links.link_data import LinkData

MIN_SERIES = 3  # mean readings of a device by a receiver on a flight, to be a series
MAX_LINKS = 20_000  # a sample of more has pairs enough
MAX_STEPS = 5_000  # places whose nearest one is looked up
NEIGHBOURS = 8  # nearest, of each link: the short distances
LAGS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144)  # along a track: the longer ones
BINS, MIN_PAIRS = 16, 40  # of distances; and pairs in each
LENGTHS = 80  # tried, evenly on a logarithmic scale
MIN_TREND_LINKS = 60  # of a pair of ends, for its trends
MAX_Z = 4.0  # outliers count as this many scales
MIN_CORRELATED = 0.1  # share of the variance that is correlated, below which there is no length
EXTENT_SHARE = 0.25  # of the extent: a longer correlation looks like a trend
MIN_STEP_M = 0.1


def devices_move(links: LinkData) -> bool:
    """Return whether devices are positions of one that moves: most are read once by a receiver."""
    series = pd.DataFrame({"device": links.device, "receiver": links.receiver,
                           "flight": links.flight})
    return len(series.drop_duplicates()) > len(links) / MIN_SERIES


def moving_end_m(links: LinkData) -> np.ndarray:
    """Return the positions (n, 3) of the end that moves [m]; 0 where unknown."""
    if devices_move(links):
        return np.nan_to_num(links.device_m[links.device])
    return links.receiver_m


def pair_of_ends(links: LinkData) -> np.ndarray:
    """Return a label (n,) of each link's device and receiver; where devices move, of the latter."""
    if devices_move(links):
        return links.receiver
    return links.receiver * len(links.device_names) + links.device


def extent_m(position_m: np.ndarray) -> float:
    """Return the diagonal of the ground that holds nearly all positions (n, 2 or 3) [m]."""
    low, high = np.quantile(position_m[:, :2], [0.02, 0.98], axis=0)
    return float(np.hypot(*(high - low)))


def step_m(links: LinkData) -> float:
    """Return the usual distance from a place to the nearest other one of its pair of ends [m]."""
    place, offset_m = _apart(links, pair_of_ends(links))
    places = pd.DataFrame(np.round(place / MIN_STEP_M)).drop_duplicates().to_numpy() * MIN_STEP_M
    if len(places) < 2:
        return 0.0
    some = places[::-(-len(places) // MAX_STEPS)]
    nearest = cKDTree(places).query(some, 2)[0][:, 1]
    nearest = nearest[nearest < offset_m / 2]  # of the same pair
    return float(np.median(nearest)) if len(nearest) else 0.0


def correlation_length_m(links: LinkData, z: np.ndarray) -> float:
    """Return the distance over which the correlation of a residual falls to 1/e [m].

    At least the usual step between places, which is also what a residual without any correlation
    gives; at most a quarter of the extent of the campaign.

    Args:
        links: n links.
        z: (n,) residuals over their scale; those of blank links do not count.
    """
    least_m, most_m = step_m(links), EXTENT_SHARE * extent_m(moving_end_m(links))
    seen = np.flatnonzero(np.isfinite(links.level_db) & np.isfinite(z))
    if least_m <= 0 or most_m <= least_m or len(seen) < MIN_PAIRS:
        return least_m
    part = links.select(seen)
    pair = pair_of_ends(part)
    order = np.lexsort((np.arange(len(seen)), part.time_s, part.flight, pair))
    place = _apart(part, pair * (part.flight.max() + 2) + part.flight)[0][order]
    z = _without_trends(part, np.clip(z[seen], -MAX_Z, MAX_Z), pair)[order]
    first, second = _pairs(place)
    distance_m = np.linalg.norm(place[first] - place[second], axis=1)
    kept = distance_m < 2 * most_m  # the rest shows trends
    difference = np.sqrt(np.abs(z[first[kept]] - z[second[kept]]))
    at_m, gamma, pairs = _variogram(distance_m[kept], difference, least_m)
    if len(at_m) < 3:
        return least_m
    return _fitted_length_m(at_m, gamma, pairs, least_m, most_m)


def _without_trends(links: LinkData, z: np.ndarray, pair: np.ndarray) -> np.ndarray:
    """Return z (n,) without the level of each series, and trends of each pair of ends (n,).

    A slope over distance that the base lacks, or an antenna's pattern over azimuth, is alike over
    the whole campaign, and says nothing of how far shadows reach.
    """
    azimuth = np.radians(links.azimuth_deg)
    columns = np.column_stack([z, np.log(links.distance_m), np.cos(azimuth), np.sin(azimuth),
                               np.cos(2 * azimuth), np.sin(2 * azimuth)])
    series = pd.factorize(pair * (links.flight.max() + 2) + links.flight)[0]
    count = np.bincount(series)
    for i, column in enumerate(columns.T):
        columns[:, i] -= (np.bincount(series, weights=column) / count)[series]
    rest = columns[:, 0].copy()
    for own in np.split(np.argsort(pair, kind="stable"),
                        np.cumsum(np.unique(pair, return_counts=True)[1])[:-1]):
        if len(own) >= MIN_TREND_LINKS:
            trend = np.linalg.lstsq(columns[own, 1:], rest[own], rcond=None)[0]
            rest[own] -= columns[own, 1:] @ trend
    return rest


def _apart(links: LinkData, label: np.ndarray) -> tuple[np.ndarray, float]:
    """Return places (n, 7) [m] and the distance between series [m].

    A place is both ends' positions, and far from all places of another label (n,).
    """
    ends_m = np.column_stack([links.receiver_m, np.nan_to_num(links.device_m[links.device])])
    offset_m = 4.0 * float(np.ptp(ends_m, axis=0).max(initial=0.0)) + 1.0
    return np.column_stack([ends_m, pd.factorize(label)[0] * offset_m]), offset_m


def _pairs(place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (p,) and rows (p,) of pairs of places (n, 7) of one series."""
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


def _variogram(distance_m: np.ndarray, difference: np.ndarray, least_m: float,
               ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return distance [m], semivariance and number of pairs of each bin.

    Args:
        distance_m: (p,) of pairs [m].
        difference: (p,) root of the absolute difference of their residuals.
        least_m: where the bins begin [m].
    """
    edges = np.geomspace(least_m, max(float(distance_m.max(initial=0)), 2 * least_m), BINS)
    index = np.searchsorted(edges, distance_m)
    pairs = np.bincount(index, minlength=BINS + 1)
    used = pairs >= MIN_PAIRS
    pairs = np.maximum(pairs, 1)
    mean = np.bincount(index, weights=difference, minlength=BINS + 1) / pairs
    at_m = np.bincount(index, weights=distance_m, minlength=BINS + 1) / pairs
    gamma = 0.5 * mean**4 / (0.457 + 0.494 / pairs)  # Cressie and Hawkins 1980, Eq. 2.14
    return at_m[used], gamma[used], pairs[used]


def _fitted_length_m(at_m: np.ndarray, gamma: np.ndarray, pairs: np.ndarray, least_m: float,
                     most_m: float) -> float:
    """Return the length of the exponential model that is nearest to a variogram [m]."""
    best, found = np.inf, least_m
    # Bins are dependent: beyond some hundreds, more pairs do not make one more certain.
    weight = np.minimum(pairs, 500) / np.maximum(gamma, 0.05 * gamma.max(initial=1e-9)) ** 2
    total = np.linalg.norm(np.sqrt(weight) * (gamma - np.average(gamma, weights=weight)))
    for length_m in np.geomspace(least_m, most_m, LENGTHS):
        rise = 1 - np.exp(-at_m / length_m)
        nugget, sill = _nonnegative_line(rise, gamma, weight)
        misfit = float(np.linalg.norm(np.sqrt(weight) * (gamma - nugget - sill * rise)))
        if misfit < best and sill >= MIN_CORRELATED * (nugget + sill):
            best, found = misfit, float(length_m)
    return found if best < total else least_m


def _nonnegative_line(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Return intercept and slope, neither below 0, of the weighted least squares of y over x."""
    mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
    power = weight @ (x - mean_x) ** 2
    slope = max(float(weight @ ((x - mean_x) * (y - mean_y)) / max(power, 1e-12)), 0.0)
    intercept = float(mean_y - slope * mean_x)
    if intercept < 0:
        return 0.0, float(weight @ (x * y) / (weight @ x**2))
    return intercept, slope
