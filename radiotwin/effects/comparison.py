"""Residuals compared with those of other flights at the same places.

What a map or a channel gets wrong at a place, it gets wrong on every flight over it. What is left
after the comparison belongs to the flight, the receiver or the time.
"""

from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from radiotwin.effects.base import ResidualView
from radiotwin.inference.gaussian import robust_sd
from radiotwin.links import Links, correlation_length_m
from radiotwin.links.correlation import devices_move, median_step_m

NEIGHBOURS = 24  # nearest links that are looked at, of which some are of other flights
MIN_OTHERS = 2  # links of other flights, for a comparison
MIN_STEPS = 2.0  # between positions, that still count as one place
MAX_REACH_M = 60.0
VIEWS = 8  # whose comparison is remembered
MAX_Z, MIN_SD_DB = 4.0, 0.3  # of a value, over the scatter of its class; of that scatter


@lru_cache(maxsize=VIEWS)
def compared_db(view: ResidualView) -> np.ndarray:
    """Return residuals (n,) minus the median of other flights at the same place [dB]; read-only.

    The same place: the same device (of devices that move: the same receiver) within the
    correlation length of the residual. NaN where no other flight was.
    """
    links, z = view.links, view.residual_db / view.scale_db
    reach_m = min(max(correlation_length_m(links, z), MIN_STEPS * median_step_m(links)),
                  MAX_REACH_M)
    end_m = np.nan_to_num(links.device_m)[links.device] if devices_move(links) \
        else links.receiver_m
    fixed = links.receiver if devices_move(links) else links.device
    result = np.full(len(links), np.nan)
    for member in np.unique(fixed):
        rows = np.flatnonzero(fixed == member)
        if len(rows) > MIN_OTHERS:
            result[rows] = view.residual_db[rows] - _elsewhen_db(
                end_m[rows], links.flight[rows], view.residual_db[rows], reach_m)
    result.setflags(write=False)  # kept for the next effect that asks
    return result


def _elsewhen_db(position_m: np.ndarray, flight: np.ndarray, residual_db: np.ndarray,
                 reach_m: float) -> np.ndarray:
    """Return the median (r,) of the residuals of other flights nearby; NaN where there are few."""
    count = min(NEIGHBOURS, len(position_m))
    distance_m, near = cKDTree(position_m).query(position_m, count, distance_upper_bound=reach_m)
    distance_m, near = distance_m.reshape(len(position_m), -1), near.reshape(len(position_m), -1)
    found = np.isfinite(distance_m)
    near = np.where(found, near, 0)
    other = found & (flight[near] != flight[:, None])
    value = np.where(other, residual_db[near], np.nan)
    enough = other.sum(axis=1) >= MIN_OTHERS
    result = np.full(len(position_m), np.nan)
    result[enough] = np.nanmedian(value[enough], axis=1)
    return result


def compared_where_possible_db(view: ResidualView) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals (n,) as `compared_db`, elsewhere as they are [dB]; and where compared."""
    rest_db = compared_db(view)
    known = np.isfinite(rest_db)
    return np.where(known, rest_db, view.residual_db), known


def by_precision(view: ResidualView, rest_db: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return values (n,) [dB] without outliers, and what each counts (n,) [1/dB²].

    Links with line of sight scatter by one or two decibels, others by ten: what all have in common
    shows in the former, and a median over both hides it. A link counts by the scatter of its class
    and as `MAX_Z` times that at most; links that err alike count as one.

    Args:
        view: n links.
        rest_db: (n,) compared residuals; NaN = unknown, which counts nothing.
    """
    value_db, weight = np.zeros((2, len(rest_db)))
    says = np.isfinite(view.links.level_db) | (view.residual_db < 0)  # a blank that was due
    for members in (view.links.los, ~view.links.los):
        rows = np.flatnonzero(members & says & np.isfinite(rest_db))
        if len(rows):
            centred_db = rest_db[rows] - np.median(rest_db[rows])
            sd_db = max(robust_sd(rest_db[rows]), MIN_SD_DB)
            value_db[rows] = np.clip(centred_db, -MAX_Z * sd_db, MAX_Z * sd_db)
            weight[rows] = 1.0 / sd_db**2 / view.design_effect
    return value_db, weight


def mean_by_precision(value_db: np.ndarray, weight: np.ndarray) -> float:
    """Return the weighted mean [dB]; 0 where nothing counts."""
    total = weight.sum()
    return float(weight @ value_db / total) if total > 0 else 0.0


def share_alike(label: np.ndarray, value_db: np.ndarray, weight: np.ndarray, minimum: int,
                least_db: float) -> float:
    """Return the share of members whose weighted mean is beyond a level, with its sign.

    Args:
        label: (n,) device or receiver.
        value_db: (n,) [dB].
        weight: (n,) of each.
        minimum: values of a member, to count.
        least_db: level; negative: means below it count.

    Returns:
        from 0 to 1; 0 where no member has values enough.
    """
    means = [mean_by_precision(value_db[label == member], weight[label == member])
             for member, count in zip(*np.unique(label, return_counts=True), strict=True)
             if count >= minimum]
    return float(np.mean([np.sign(least_db) * each > abs(least_db) for each in means])) \
        if means else 0.0


def flight_mask(links: Links, receiver: int | None, flight: str | None) -> np.ndarray:
    """Return (n,) bool, links of a receiver on a flight of that name; None: of all."""
    mine = np.ones(len(links), dtype=bool)
    if receiver is not None:
        mine &= links.receiver == receiver
    if flight is not None:
        named = [number for number, name in enumerate(links.flight_names) if str(name) == flight]
        mine &= np.isin(links.flight, named)
    return mine
