"""Devices on one mast, repeated readings at one place, and receivers compared at shared places.

Two receivers that read one device at the same place share path and device, so their levels differ
by the receivers' errors only. A regression over all links separates these less clearly, since the
model also errs differently at places that one receiver visited alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree
from scipy.stats import t as student

from radiotwin.display import some
from radiotwin.inference.gaussian import MAD_SD
from radiotwin.links.correlation import devices_move
from radiotwin.links.links import Links

SAME_SITE_M = 1.0  # largest distance of sectors on one mast: accuracy of declared positions
OTHER_END = {"device": "receiver", "receiver": "device"}
SAME_DIRECTION_DEG = 5.0  # azimuths this close belong to one antenna, or two side by side
MIN_REPEATS = 20  # of a device, to estimate its scatter
SHARED_DB, SHARED_RATIO = 3.0, 2.0  # scatter of two transmitters: least, and over that of others
MAX_RELATIVES = 4  # further ones add little
SAME_M = 3.0  # accuracy of a phone's position outdoors
PLACE_M = 30.0  # side of squares with correlated errors, in which the median difference is taken
MIN_PAIRS, MIN_PLACES = 30, 6  # for a comparison of two receivers
MIN_DEVICES = 3  # for an interval that is clustered by device
MAX_RECEIVERS = 40  # limits the comparisons to 780
ABOVE_LIMIT_DB = 10.0  # mean level of a pair above the limits, so that censoring selects none
MAX_Z = 3.0  # differences are clipped to this many robust standard deviations
MIN_SD_DB = 0.1
QUANTILE = 0.95  # upper end of a 90 % interval


def site_of(links: Links, device: int) -> list[int]:
    """Return a device and the anchors within `SAME_SITE_M` of it, ascending; empty if at NaN."""
    apart_m = np.linalg.norm(links.device_m - links.device_m[device], axis=1)
    return [int(other) for other in np.flatnonzero(apart_m <= SAME_SITE_M)
            if other == device or other in links.anchors]


def antenna_of(links: Links, device: int) -> list[int]:
    """Return a device and the devices on its mast that point the same way, ascending.

    Directions are declared azimuths, equal within `SAME_DIRECTION_DEG` of any member. Such devices
    are carriers of one antenna, or of antennas side by side.
    """
    found, mast = {device}, np.array(site_of(links, device))
    for _ in mast:  # neighbours of a member are members, so that the groups of a mast are disjoint
        apart_deg = np.abs((links.boresight_deg[mast, None] - links.boresight_deg[sorted(found)]
                            + 180) % 360 - 180)
        found |= set(mast[(apart_deg <= SAME_DIRECTION_DEG).any(axis=1)].tolist())
    return sorted(found)


def relatives_of(links: Links, device: int, heard: set[int]) -> list[int]:
    """Return up to `MAX_RELATIVES` measured devices with nearly the same paths as a given device.

    They are other devices of the same antenna, or if none was measured, of the same mast. `heard`
    are the indices of devices with links, detected or not.
    """
    others = ([other for other in group if other != device and other in heard]
              for group in (antenna_of(links, device), site_of(links, device)))
    return next(filter(None, others), [])[:MAX_RELATIVES]


@dataclass(frozen=True, eq=False)
class Repeats:
    """Scatter of repeated readings, which should be equal, for each device.

    Attributes:
        squares_db2: (k,) sum of squares about the group means [dB²].
        freedom: (k,) degrees of freedom: readings minus group means.
    """

    squares_db2: np.ndarray
    freedom: np.ndarray

    @classmethod
    def of(cls, links: Links, *same: np.ndarray) -> Repeats:
        """Sum the squared scatter [dB²] of detected readings that should be equal, for each device.

        They should be equal if device, receiver and further labels (n, …) are.
        """
        seen = np.isfinite(links.level_db)
        label = np.column_stack([links.device, links.receiver, *same])[seen]
        group = np.unique(label, axis=0, return_inverse=True)[1].ravel()
        level_db, count = links.level_db[seen], np.bincount(group)
        residual_db = level_db - (np.bincount(group, level_db) / count)[group]
        devices, device = len(links.device_names), links.device[seen]
        return cls(np.bincount(device, residual_db**2, devices),
                   np.bincount(device, 1 - 1 / count[group], devices))

    def sd_db(self) -> np.ndarray:
        """Return the standard deviation (k,) of a reading [dB]; NaN if there are few repeats."""
        few = self.freedom < MIN_REPEATS
        return np.where(few, np.nan, np.sqrt(self.squares_db2 / np.maximum(self.freedom, 1)))

    def without(self, devices: Sequence[int]) -> Repeats:
        """Drop some devices (indices)."""
        return Repeats(*(np.delete(each, devices) for each in (self.squares_db2, self.freedom)))


def repeats_at_places(links: Links) -> Repeats:
    """Return the scatter of readings at the same place, rounded to a decimetre."""
    return Repeats.of(links, np.round(links.receiver_m, 1))


def shared_names(links: Links) -> dict[int, str]:
    """Find devices that may be two transmitters with one name: index -> the reason, for a note.

    A receiver then reads two levels at one time, or at one place: these scatter by more than
    `SHARED_DB`, and by more than `SHARED_RATIO` times the median of other devices.
    """
    found: dict[int, str] = {}
    timed = links.select(np.isfinite(links.time_s))
    for when, repeats in (("at one time", Repeats.of(timed, timed.time_s)),
                          ("at one place", repeats_at_places(links))):
        sd_db = repeats.sd_db()
        for device in np.flatnonzero(sd_db > SHARED_DB):
            others_db = np.delete(sd_db, device)
            usual_db = float(np.median(others_db[np.isfinite(others_db)])) \
                if np.isfinite(others_db).any() else np.nan
            if sd_db[device] > SHARED_RATIO * usual_db:
                found.setdefault(int(device), f"its readings {when} scatter by "
                                 f"{sd_db[device]:.1f} dB, those of others by {usual_db:.1f} dB")
    return found


def inseparable_pairs(one: np.ndarray, other: np.ndarray) -> dict[int, int]:
    """Find pairs of labels with exactly the same links: their errors are indistinguishable.

    `one` and `other` (n,) are labels of links, such as device and receiver. Returned is a
    dictionary: label of `one` -> label of `other`.
    """
    code, links = np.unique(one * (int(other.max(initial=0)) + 1) + other, return_counts=True)
    first, second = np.divmod(code, int(other.max(initial=0)) + 1)
    same = (np.bincount(one)[first] == links) & (np.bincount(other)[second] == links)
    return dict(zip(first[same].tolist(), second[same].tolist(), strict=True))


def inseparable_end(links: Links, end: str, members: set[int]) -> str | None:
    """Return the opposite end if one there has exactly the detected links of a member, or None.

    Their errors are then inseparable. `members` are indices at `end`, device or receiver.
    """
    other, detected = OTHER_END[end], np.isfinite(links.level_db)
    together = inseparable_pairs(getattr(links, end)[detected], getattr(links, other)[detected])
    return other if members & together.keys() else None


def end_notes(links: Links) -> list[str]:
    """Note devices that may be two transmitters, or have the same links as a receiver or flight."""
    notes = [f"device {links.device_names[device]} may be two transmitters of one name, such as "
             f"cells of one identity or carriers of a cell: {why}; if so, give each its name"
             for device, why in shared_names(links).items()]
    seen = np.isfinite(links.level_db)
    for end in ("receiver", "flight"):
        names = getattr(links, f"{end}_names")
        pairs = [f"{links.device_names[device]} and {names[member]}" for device, member
                 in inseparable_pairs(links.device[seen], getattr(links, end)[seen]).items()]
        if pairs:
            notes.append(f"device and {end} are never apart ({some(pairs)}): what one of the two "
                         f"has wrong, an offset or a drift, may be the other's; let another {end} "
                         f"read the device, or this one another device")
    return notes


@dataclass(frozen=True)
class ReceiverDifference:
    """Mean difference between the readings of two receivers at shared places.

    Attributes:
        first, second: indices of the receivers.
        difference_db: reading of the second minus that of the first [dB].
        low_db, high_db: 90 % interval [dB], the wider of those clustered by place and by device.
        pairs: number of pairs of readings, one of each receiver, within `SAME_M`.
        places: number of squares of ground with pairs, summed over the devices.
    """

    first: int
    second: int
    difference_db: float
    low_db: float
    high_db: float
    pairs: int
    places: int


def receiver_differences(links: Links) -> list[ReceiverDifference]:
    """Estimate the difference of level [dB] between every two receivers at the same places.

    Two need `MIN_PAIRS` pairs of readings at `MIN_PLACES` places; none if devices move (receivers
    are fixed then), or with more than `MAX_RECEIVERS` receivers.
    """
    members = np.unique(links.receiver[np.isfinite(links.level_db)])
    if not 2 <= len(members) <= MAX_RECEIVERS or devices_move(links):
        return []
    found = [_difference(links, int(first), int(second))
             for first, second in combinations(members, 2)]
    return [each for each in found if each is not None]


def _difference(links: Links, first: int, second: int) -> ReceiverDifference | None:
    """Estimate how much higher the second receiver reads; None with too few readings or places."""
    pairs = _pairs(links, first, second)
    if len(pairs) < MIN_PAIRS:
        return None
    places = pairs.groupby(["device", "x", "y"], as_index=False)["difference_db"].median()
    if len(places) < MIN_PLACES:
        return None
    place_db = places["difference_db"].to_numpy()
    median_db = np.median(place_db)
    clip_db = MAX_Z * max(MAD_SD * np.median(np.abs(place_db - median_db)), MIN_SD_DB)
    place_db = np.clip(place_db, median_db - clip_db, median_db + clip_db)
    mean_db = float(place_db.mean())
    squares = places.groupby(["x", "y"]).ngroup().to_numpy()
    clusterings = [squares]
    if places["device"].nunique() >= MIN_DEVICES:
        clusterings.append(pd.factorize(places["device"])[0])
    half_db = max(_half_interval_db(place_db - mean_db, label) for label in clusterings)
    return ReceiverDifference(first, second, mean_db, mean_db - half_db, mean_db + half_db,
                              len(pairs), len(places))


def _pairs(links: Links, first: int, second: int) -> pd.DataFrame:
    """Pair each reading of a receiver with the nearest one of another receiver, per device.

    Only pairs within `SAME_M` whose mean level is `ABOVE_LIMIT_DB` or more above both limits count:
    weaker ones would be missing at the less sensitive receiver.
    """
    read = np.isfinite(links.level_db)
    parts = []
    for device in np.unique(links.device):
        device_links = read & (links.device == device)
        first_rows, second_rows = (np.flatnonzero(device_links & (links.receiver == each))
                                   for each in (first, second))
        if not (len(first_rows) and len(second_rows)):
            continue
        apart_m, nearest = cKDTree(links.receiver_m[second_rows]).query(
            links.receiver_m[first_rows], distance_upper_bound=SAME_M)
        beside = np.isfinite(apart_m)
        first_rows, second_rows = first_rows[beside], second_rows[nearest[beside]]
        limit_db = np.maximum(links.limit_db[first_rows], links.limit_db[second_rows])
        middle_db = (links.level_db[first_rows] + links.level_db[second_rows]) / 2
        strong = middle_db >= limit_db + ABOVE_LIMIT_DB
        first_rows, second_rows = first_rows[strong], second_rows[strong]
        x, y = np.floor(links.receiver_m[first_rows, :2] / PLACE_M).astype(int).T
        parts.append(pd.DataFrame({
            "device": device, "x": x, "y": y,
            "difference_db": links.level_db[second_rows] - links.level_db[first_rows]}))
    return pd.concat(parts) if parts else pd.DataFrame()


def _half_interval_db(error_db: np.ndarray, label: np.ndarray) -> float:
    """Return half the 90 % interval [dB] of the mean of errors (n,), correlated in clusters (n,).

    Liang and Zeger 1986, 'Longitudinal data analysis using generalized linear models', Biometrika
    73, with the t quantile of the number of clusters.
    """
    sums = np.bincount(label, weights=error_db)
    clusters = len(sums)
    if clusters < 2:
        return 0.0
    sd_db = np.sqrt(clusters / (clusters - 1) * (sums**2).sum()) / len(error_db)
    return float(student.ppf(QUANTILE, clusters - 1) * max(sd_db, MIN_SD_DB))
