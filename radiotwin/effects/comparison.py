"""Compare residuals with those of other flights at the same place, which share the map's errors.

The remaining difference is due to the flight, the receiver or the time.
"""

from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from radiotwin.effects.base import ResidualView
from radiotwin.inference.gaussian import robust_sd
from radiotwin.links import Links, correlation_length_m
from radiotwin.links.correlation import devices_move, median_step_m

NEIGHBOURS = 24  # nearest links that are searched for links of other flights
MIN_OTHERS = 2  # links of other flights needed for a comparison
MIN_STEPS = 2.0  # steps between readings that still count as one place
MAX_REACH_M = 60.0  # largest radius of a place
VIEWS = 8  # number of views whose comparison is cached
MAX_Z, MIN_SD_DB = 4.0, 0.3  # clip of a value [sd of its class], and least such sd [dB]


@lru_cache(maxsize=VIEWS)
def compared_db(view: ResidualView) -> np.ndarray:
    """Subtract from residuals (n,) the median residual of other flights at the same place [dB].

    Same place: same device (same receiver, if devices move) within the residual's correlation
    length. NaN if too few links of other flights were there; read-only, as it is cached.
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
            result[rows] = view.residual_db[rows] - _other_flights_db(
                end_m[rows], links.flight[rows], view.residual_db[rows], reach_m)
    result.setflags(write=False)  # cached, so no caller may change it
    return result


def _other_flights_db(position_m: np.ndarray, flight: np.ndarray, residual_db: np.ndarray,
                      reach_m: float) -> np.ndarray:
    """Compute the median residual (r,) of nearby links of other flights; NaN if too few [dB]."""
    count = min(NEIGHBOURS, len(position_m))
    distance_m, near = cKDTree(position_m).query(position_m, count, distance_upper_bound=reach_m)
    distance_m, near = distance_m.reshape(len(position_m), -1), near.reshape(len(position_m), -1)
    in_reach = np.isfinite(distance_m)
    near = np.where(in_reach, near, 0)
    other = in_reach & (flight[near] != flight[:, None])
    value = np.where(other, residual_db[near], np.nan)
    enough = other.sum(axis=1) >= MIN_OTHERS
    result = np.full(len(position_m), np.nan)
    result[enough] = np.nanmedian(value[enough], axis=1)
    return result


def compared_where_possible_db(view: ResidualView) -> tuple[np.ndarray, np.ndarray]:
    """Return `compared_db` (n,) [dB], plain residuals where it is NaN, and where it is finite."""
    rest_db = compared_db(view)
    known = np.isfinite(rest_db)
    return np.where(known, rest_db, view.residual_db), known


def by_precision(view: ResidualView, rest_db: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre, clip and weight residuals, separately for links with and without line of sight.

    Links with line of sight scatter by 1 to 2 dB, others by 10 dB: a common change shows in the
    former, and a median over both would hide it. Values are clipped at `MAX_Z` standard deviations
    of their class; weights are inverse variances, divided by the design effect.

    Args:
        view: n links.
        rest_db: (n,) residuals minus the median of other flights at the place; NaN: unknown.

    Returns:
        (n,) values [dB], (n,) weights [1/dB²]; both 0 if unknown, or blank as predicted.
    """
    value_db, weight = np.zeros((2, len(rest_db)))
    # A blank has information only if its predicted level is above the limit.
    informative = np.isfinite(view.links.level_db) | (view.residual_db < 0)
    for members in (view.links.los, ~view.links.los):
        rows = np.flatnonzero(members & informative & np.isfinite(rest_db))
        if len(rows):
            centred_db = rest_db[rows] - np.median(rest_db[rows])
            sd_db = max(robust_sd(rest_db[rows]), MIN_SD_DB)
            value_db[rows] = np.clip(centred_db, -MAX_Z * sd_db, MAX_Z * sd_db)
            weight[rows] = 1.0 / sd_db**2 / view.design_effect
    return value_db, weight


def mean_by_precision(value_db: np.ndarray, weight: np.ndarray) -> float:
    """Compute the weighted mean [dB]; 0 if all weights are 0."""
    total = weight.sum()
    return float(weight @ value_db / total) if total > 0 else 0.0


def share_alike(label: np.ndarray, value_db: np.ndarray, weight: np.ndarray, minimum: int,
                least_db: float) -> float:
    """Compute the share of devices (or receivers) whose weighted mean is beyond a threshold.

    Args:
        label: (n,) device or receiver.
        value_db: (n,) values [dB].
        weight: (n,) weights.
        minimum: least number of values of a device or receiver, else it does not count.
        least_db: threshold [dB]; if negative, means below it are counted.

    Returns:
        0 to 1; 0 if no device or receiver has enough values.
    """
    means = [mean_by_precision(value_db[label == member], weight[label == member])
             for member, count in zip(*np.unique(label, return_counts=True), strict=True)
             if count >= minimum]
    return float(np.mean(np.sign(least_db) * np.array(means) > abs(least_db))) if means else 0.0


def flight_mask(links: Links, receiver: int | None, flight: str | None) -> np.ndarray:
    """Mark the links (n,) of one receiver on all flights of that name; None: of any."""
    mask = np.ones(len(links), dtype=bool)
    if receiver is not None:
        mask &= links.receiver == receiver
    if flight is not None:
        named = [number for number, name in enumerate(links.flight_names) if str(name) == flight]
        mask &= np.isin(links.flight, named)
    return mask
