"""How far apart two links still err alike: the correlation length of a residual.

From the variogram over the positions of the end that moves, within each pair of ends and flight, so
that what a device or a receiver has in common does not count (`radiotwin.links.variogram`).
"""

from functools import lru_cache

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from radiotwin.links.link_data import LinkData
from radiotwin.links.variogram import MIN_PAIRS, Trend, Variogram, pairs_of_links

MIN_SERIES = 3  # mean readings of a device by a receiver on a flight, to be a series
MAX_STEPS = 5_000  # places whose nearest one is looked up
MAX_Z = 4.0  # outliers count as this many scales
LENGTHS = 24  # tried, evenly on a logarithmic scale
EXTENT_SHARE = 0.25  # of the extent: a longer correlation looks like a trend
MIN_STEP_M = 0.1
REMEMBERED = 8  # sets of links: of a model and its folds


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
    seen = np.isfinite(links.level_db) & np.isfinite(z)
    least_m, rows, variogram = _variogram(links, seen.tobytes())
    return least_m if variogram is None else variogram.length_m(np.clip(z[rows], -MAX_Z, MAX_Z))


@lru_cache(maxsize=REMEMBERED)
def _variogram(links: LinkData, seen: bytes) -> tuple[float, np.ndarray, Variogram | None]:
    """Return the least length [m], rows (m,) of the links that were seen, and what they allow.

    Every effect and every step asks for the same links, of which this is the slow part.
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


def _apart(links: LinkData, label: np.ndarray) -> tuple[np.ndarray, float]:
    """Return places (n, 7) [m] and the distance between series [m].

    A place is both ends' positions, and far from all places of another label (n,).
    """
    ends_m = np.column_stack([links.receiver_m, np.nan_to_num(links.device_m[links.device])])
    offset_m = 4.0 * float(np.ptp(ends_m, axis=0).max(initial=0.0)) + 1.0
    return np.column_stack([ends_m, pd.factorize(label)[0] * offset_m]), offset_m
