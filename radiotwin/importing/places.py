"""Devices at several places over time: each place becomes a device `NAME@1`, `NAME@2`, ….

A device of `devices.csv` has one position.
"""

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.importing.source import Source

SINCE, UNTIL = "since_s", "until_s"
"""Columns of a table of devices: from when until when a device was there [s]; NaN = always."""
_MAX_PLACES = 1000  # of one device; one that moves all the time has no places


def numbered(names: pd.Series, since_s: np.ndarray) -> pd.Series:
    """Return names in which the places of a device are numbered in the order of time.

    Args:
        names: of devices, (n,).
        since_s: since when each was there, (n,).

    Returns:
        `NAME@1`, … where a name occurs more than once, else the name.
    """
    order = np.lexsort((np.arange(len(names)), np.nan_to_num(since_s, nan=-np.inf)))
    number = names.iloc[order].groupby(names.iloc[order]).cumcount() + 1
    several = names.duplicated(keep=False)
    return names.mask(several, names + "@" + number.reindex(names.index).astype(str))


def at_times(source: Source, links: pd.DataFrame, table: pd.DataFrame | None) -> pd.DataFrame:
    """Name the device of each link after the place where it was at the time.

    Args:
        source: the log, for messages.
        links: with `device`, and `time_s`.
        table: of devices, as of `read_positions`.

    Returns:
        links; a device that was nowhere at a time keeps its name, and has no position then.

    Raises:
        BadInput: a device has places over time, and its readings have no times.
    """
    if table is None or SINCE not in table:
        return links
    place_of = pd.Series(table.index, index=table.index)
    owner = place_of.str.replace(r"@\d+$", "", regex=True)
    # Of `numbered` there are several and none without a number; others are called so.
    numbered_ones = owner.duplicated(keep=False) & ~owner.isin(place_of)
    owner = owner.where(numbered_ones, place_of).to_numpy()
    names = links["device"].to_numpy(dtype=object, copy=True)
    for device in dict.fromkeys(owner[place_of.to_numpy() != owner]):
        own = np.flatnonzero(links["device"].to_numpy() == device)
        if not len(own):
            continue
        if "time_s" not in links or links["time_s"].iloc[own].isna().any():
            raise BadInput(f"{source.path}: device {device!r} is at several places over time, and "
                           "some of its readings have no time; give the column of the time")
        rows = np.flatnonzero(owner == device)
        since_s = np.nan_to_num(table[SINCE].to_numpy()[rows], nan=-np.inf)
        rows, since_s = rows[np.argsort(since_s)], np.sort(since_s)
        time_s = links["time_s"].to_numpy()[own]
        place = np.searchsorted(since_s, time_s, side="right") - 1
        there = place >= 0
        until_s = table[UNTIL].to_numpy()[rows][place.clip(0)]
        there &= ~(time_s >= until_s)  # NaN: until the next one
        names[own[there]] = table.index.to_numpy()[rows[place[there]]]
    return links.assign(device=names)


def place_names(source: Source, links: pd.DataFrame, device_m: np.ndarray,
                place_m: float) -> np.ndarray:
    """Name the device of each link after the place where the log says that it was.

    Places are numbered as they occur; a position within `place_m` of one belongs to it.

    Args:
        source: the log, for messages.
        links: n rows with `device`.
        device_m: position of each link's device [m], (n, 3); NaN where unknown.
        place_m: [m].

    Returns:
        names, (n,): `NAME@1`, … of devices at more than one place.

    Raises:
        BadInput: a device is at very many places.
    """
    names = links["device"].to_numpy(dtype=object, copy=True)
    filled_m = np.nan_to_num(device_m)
    for device, rows in links.groupby(np.array(names), sort=False).indices.items():
        rows = rows[np.isfinite(device_m[rows, :2]).all(axis=1)]
        if not len(rows) or (np.ptp(filled_m[rows], axis=0) <= place_m / np.sqrt(3)).all():
            continue
        different_m, first, inverse = np.unique(filled_m[rows], axis=0, return_index=True,
                                                return_inverse=True)
        place = np.full(len(different_m), -1)
        centres_m = np.empty((0, 3))
        for i in np.argsort(first):
            near = np.linalg.norm(centres_m - different_m[i], axis=1) <= place_m
            place[i] = np.argmax(near) if near.any() else len(centres_m)
            if not near.any():
                centres_m = np.vstack([centres_m, different_m[i]])
            if len(centres_m) > _MAX_PLACES:
                raise BadInput(f"{source.path}: device {device!r} is at more than {_MAX_PLACES} "
                               f"places that are {place_m:g} m apart: it moves all the time. Take "
                               "it for the receiver, and the other end for the device: the gain "
                               "is that of both directions")
        if len(centres_m) > 1:
            names[rows] = [f"{device}@{number + 1}" for number in place[inverse.ravel()]]
    return names
