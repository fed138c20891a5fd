"""Residuals compared with those of other flights at the same places.

What a map or a channel gets wrong at a place, it gets wrong on every flight over it. What is left
after the comparison belongs to the flight, the receiver or the time.
"""

import numpy as np
from scipy.spatial import cKDTree

from radiotwin.effects.residual_view import ResidualView
from radiotwin.links import LinkData, correlation_length_m
from radiotwin.links.correlation import devices_move, step_m

NEIGHBOURS = 24  # nearest links that are looked at, of which some are of other flights
MIN_OTHERS = 2  # links of other flights, for a comparison
MIN_STEPS = 2.0  # between positions, that still count as one place
MAX_REACH_M = 60.0


def compared_db(view: ResidualView) -> np.ndarray:
    """Return residuals (n,) minus the median of other flights at the same place [dB].

    The same place: the same device (of devices that move: the same receiver) within the
    correlation length of the residual. NaN where no other flight was.
    """
    links, z = view.links, view.residual_db / view.scale_db
    reach_m = min(max(correlation_length_m(links, z), MIN_STEPS * step_m(links)), MAX_REACH_M)
    end_m = np.nan_to_num(links.device_m)[links.device] if devices_move(links) \
        else links.receiver_m
    fixed = links.receiver if devices_move(links) else links.device
    result = np.full(len(links), np.nan)
    for member in np.unique(fixed):
        rows = np.flatnonzero(fixed == member)
        if len(rows) > MIN_OTHERS:
            result[rows] = view.residual_db[rows] - _elsewhen_db(
                end_m[rows], links.flight[rows], view.residual_db[rows], reach_m)
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


def share_alike(label: np.ndarray, value_db: np.ndarray, minimum: int, least_db: float) -> float:
    """Return the share of members whose median is beyond a level, with its sign.

    Args:
        label: (n,) device or receiver.
        value_db: (n,) [dB].
        minimum: values of a member, to count.
        least_db: level; negative: medians below it count.

    Returns:
        from 0 to 1; 0 where no member has values enough.
    """
    medians = [float(np.median(value_db[label == member])) for member, count in
               zip(*np.unique(label, return_counts=True), strict=True) if count >= minimum]
    return float(np.mean([np.sign(least_db) * each > abs(least_db) for each in medians])) \
        if medians else 0.0


def flight_mask(links: LinkData, receiver: int | None, flight: str | None) -> np.ndarray:
    """Return (n,) bool, links of a receiver on a flight of that name; None: of all."""
    mine = np.ones(len(links), dtype=bool)
    if receiver is not None:
        mine &= links.receiver == receiver
    if flight is not None:
        named = [number for number, name in enumerate(links.flight_names) if str(name) == flight]
        mine &= np.isin(links.flight, named)
    return mine
