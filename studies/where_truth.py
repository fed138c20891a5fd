"""Match groups of links with the links of hidden effects.

An effect *acts* on the links that it changes by at least a quarter of its RMS change on the links
that it changes at all; of an effect of nearly all links (rain), by what it changes more or less
than in the median. Where a position, a clock or a track is wrong, it acts on all links of that end.

A group that is said *is there* if one of these holds for some hidden effect:
- its ends are the effect's: all of its links have the device, receiver and flight of the answer, as
  far as it names them (d3 x f2 for device d3, a flight that r1 flew alone for r1; not r1 x f2 for
  r1 x f4). Where there are two of a kind, "the other one reads more" is the same statement;
- at least half of the heard links in it are links that the effect acts on, and half as many again
  as of all links (a device whose links mostly pass the missing building);
- it is a disc that reaches within 30 m of the effect's place, or a band of the variable that the
  law of the effect goes by (distance for rain, level for a receiver's limit).

*Where is right* if a disc or band is; or if the ends are, and the effect changes in time or by
direction; or else if the groups that are there hold at least half of the links that it acts on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import pandas as pd

from radiotwin.links import Links
from radiotwin.links.measurements import Measurements

NEAR_M, PLACE_M = 30.0, 25.0
LEAST_SHARE, LEAST_RATIO = 0.5, 1.5
NEARLY_ALL = 0.7
ENDS = ("device", "receiver", "flight")
BANDS: dict[str, tuple[str, ...]] = {
    "excess_attenuation": ("distance", "altitude"), "shower": ("distance", "time"),
    "warm_front": ("distance", "time"), "refractive_fading": ("distance", "time"),
    "wet_walls": ("time",), "standing_waves": ("distance",), "receiver_saturation": ("level",),
    "noise_floor_censoring": ("level",), "agc_hysteresis": ("level",), "episode": (),
    "interference": ("level",), "duty_cycled_jammer": ("level",)}
CONSTANT = ("receiver_gain_offset", "device_gain_offset", "receiver_gain", "device_gain")
MIRRORED = (*CONSTANT, "receiver_drift", "device_drift", "receiver_step", "device_step")
MISPLACED = ("device_position_error", "receiver_clock_offset")


class Group(Protocol):
    """What the scan or a pivot table says: n links, `rows` a mask or numbers of them."""

    @property
    def family(self) -> str:
        """Such as `device x flight`."""

    @property
    def members(self) -> Mapping[str, tuple[str, ...]]:
        """Names by kind of end."""

    @property
    def statistic(self) -> str:
        """`level`, `scatter`, `blanks` or `slope`."""

    @property
    def rows(self) -> np.ndarray:
        """Links in the group."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Where a hidden effect is.

    Attributes:
        name: of the effect.
        ends: names of its device, receiver and flights, by kind.
        places_m: (k, 4) rectangles x, x, y, y on the ground [m].
        of_ends: (n,) bool, links of its ends.
        acts: (n,) bool, links that it acts on.
        change_db: (n,) what it changes [dB]; NaN where unknown or where it takes the reading away.
        size_db: RMS of that on the heard links that it acts on, less what all links have in common.
    """

    name: str
    ends: dict[str, set[str]]
    places_m: np.ndarray
    of_ends: np.ndarray
    acts: np.ndarray
    change_db: np.ndarray
    size_db: float
    others: dict[str, set[str]] = field(default_factory=dict)


def rows_of_links(links: Links, measurements: Measurements) -> np.ndarray:
    """Return the row (n,) of the measurements' table for each link."""
    names = {"device": links.device_names, "receiver": links.receiver_names,
             "flight": links.flight_names}
    of_links = {end: np.array(name, dtype=object)[getattr(links, end)]
                for end, name in names.items()}
    table = measurements.table
    of_table = {end: table[end].astype(str).to_numpy() for end in names}
    for axis in range(3):
        of_links[f"{axis}"] = np.round(links.receiver_m[:, axis], 2)
        of_table[f"{axis}"] = np.round(measurements.receiver_m[:, axis], 2)
    of_links["level"] = np.round(links.level_db, 2)
    of_table["level"] = np.round(measurements.level_db, 2)
    keys = list(of_links)
    parts = [pd.DataFrame(columns).assign(row=np.arange(len(columns["level"])))
             for columns in (of_links, of_table)]
    for part in parts:  # rows that are equal in all are in the same order in both
        part["level"] = part["level"].fillna(np.inf)
        part["count"] = part.groupby(keys).cumcount()
    found = parts[0].merge(parts[1], on=[*keys, "count"], how="left", suffixes=("", "_table"))
    if found["row_table"].isna().any():
        raise ValueError(f"{found['row_table'].isna().sum()} links are in no row of the table")
    return found.sort_values("row")["row_table"].to_numpy().astype(int)


def truths(effects: Sequence[dict], changes_db: Sequence[np.ndarray], links: Links
           ) -> list[Truth]:
    """Return where each effect of an answer is, with what it changes in each of n links [dB]."""
    return [_truth(effect, change_db, links)
            for effect, change_db in zip(effects, changes_db, strict=True)]


def _truth(effect: dict, change_db: np.ndarray, links: Links) -> Truth:
    ends = {end: {effect[end]} for end in ENDS if effect.get(end) not in (None, "all")}
    if "flights" in effect and effect["name"] != "antenna_swap":  # its other flights differ as much
        ends["flight"] = set(effect["flights"])
    of_ends = np.ones(len(links), dtype=bool)
    for end, names in ends.items():
        named = getattr(links, f"{end}_names")
        of_ends &= np.isin(getattr(links, end), [named.index(name) for name in names
                                                  if name in named])
    heard = np.isfinite(links.level_db)
    change_db = np.where(of_ends, change_db, 0.0)
    lost = np.isnan(change_db)
    changed = heard & (np.abs(change_db) > 0.05)
    if changed.sum() > NEARLY_ALL * heard.sum():
        change_db = change_db - np.median(change_db[heard])
    rms_db = float(np.sqrt(np.mean(change_db[changed]**2))) if changed.any() else 0.0
    acts = lost | (heard & (np.abs(change_db) > max(0.25 * rms_db, 0.05)))
    if effect["name"] in MISPLACED or effect.get("kind") == "stale":
        acts = of_ends & heard
    of_acts = acts & heard & ~lost
    size_db = float(np.sqrt(np.mean(change_db[of_acts]**2))) if of_acts.any() else 0.0
    others = {}
    for end in ends if effect["name"] in MIRRORED else ():
        names = set(getattr(links, f"{end}_names"))
        if len(names) == 2:
            others[end] = names
    return Truth(effect["name"], ends, _places_m(effect), of_ends, acts, change_db, size_db, others)


def _places_m(effect: dict) -> np.ndarray:
    found = []
    for each in (effect, *effect.get("groves", ()), *effect.get("obstacles", ())):
        if "x_m" in each and "y_m" in each:
            found.append([*each["x_m"], *each["y_m"]])
        elif "corners_m" in each:
            x_m, y_m = np.array(each["corners_m"]).T
            found.append([x_m.min(), x_m.max(), y_m.min(), y_m.max()])
        elif "centre_m" in each:
            x_m, y_m = each["centre_m"][:2]
            half_m = 0.5 * max(each.get("widths_m", [0.0]))
            found.append([x_m - half_m, x_m + half_m, y_m - half_m, y_m + half_m])
    return np.array(found, dtype=float).reshape(-1, 4)


def visibility(truth: Truth, residual_db: np.ndarray, links: Links) -> float | None:
    """Return the t statistic of the residual regressed on the effect's true change.

    Each class of sight has its own mean and scale, and residuals count up to four scales. Readings
    of a device on one flight at one place of 25 m count as one. None: it changes no level, or all
    alike.
    """
    used = np.isfinite(residual_db) & np.isfinite(truth.change_db)
    x, y = truth.change_db[used], residual_db[used]
    los = links.los[used]
    for one in (los, ~los):
        if one.any():
            middle_db = np.median(y[one])
            scatter_db = 1.4826 * np.median(np.abs(y[one] - middle_db)) + 0.1
            y[one] = np.clip((y[one] - middle_db) / scatter_db, -4, 4)
            x[one] = (x[one] - x[one].mean()) / scatter_db
            y[one] -= y[one].mean()
    if not np.any(np.abs(x) > 1e-6):
        return None
    slope = (x @ y) / (x @ x)
    cell = np.floor(links.receiver_m[used, :2] / PLACE_M).astype(int)
    keys = np.column_stack([cell, links.flight[used], links.device[used]])
    place = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
    scores = np.bincount(place, x * (y - slope * x))
    return float(slope * (x @ x) / max(np.sqrt(scores @ scores), 1e-9))


def is_there(group: Group, truth: Truth, heard: np.ndarray) -> bool:
    """Return whether a group is of a hidden effect, see the module; `heard` (n,) bool."""
    return (_has_its_ends(group, truth) or holds_mostly(group, truth.acts, heard)
            or _is_its_place_or_band(group, truth))


def where_is_right(groups: Sequence[Group], truth: Truth, heard: np.ndarray) -> bool:
    """Return whether the groups that are said tell where an effect is, see the module."""
    there = [group for group in groups if is_there(group, truth, heard)]
    if any(_is_its_place_or_band(group, truth) for group in there):
        return True
    if truth.name not in CONSTANT and any(_has_its_ends(group, truth) for group in there):
        return True
    if any(set(group.members) == set(truth.ends) and getattr(group, "ranges", {}) == {}
           and _has_its_ends(group, truth) for group in there):
        return True
    union = np.zeros(len(heard), dtype=bool)
    for group in there:
        union[group.rows] = True
    return bool(there) and (union & truth.acts).sum() >= LEAST_SHARE * truth.acts.sum()


def holds_mostly(group: Group, acts: np.ndarray, heard: np.ndarray) -> bool:
    """Return whether an effect acts on most detected links of a group; `acts` (n,) bool."""
    rows = np.zeros(len(heard), dtype=bool)
    rows[group.rows] = True
    rows &= heard | acts
    usual = LEAST_RATIO * acts.sum() / max((heard | acts).sum(), 1)
    return bool(rows.any()) and acts[rows].mean() >= max(LEAST_SHARE, min(usual, 0.9))


def _has_its_ends(group: Group, truth: Truth) -> bool:
    if not truth.ends:
        return False
    if len(group.members) == 1 and all(set(names) <= truth.others.get(end, set())
                                       for end, names in group.members.items()):
        return True
    return bool(truth.of_ends[group.rows].all())


def _is_its_place_or_band(group: Group, truth: Truth) -> bool:
    if group.family in BANDS.get(truth.name, ()):
        return all(set(names) <= truth.ends[end] for end, names in group.members.items()
                   if end in truth.ends)
    ranges = getattr(group, "ranges", {})
    if group.family != "place" or not {"x_m", "y_m"} <= set(ranges):
        return False
    (west, east), (south, north) = ranges["x_m"], ranges["y_m"]
    return any(west - NEAR_M <= right and left <= east + NEAR_M and south - NEAR_M <= top
               and bottom <= north + NEAR_M for left, right, bottom, top in truth.places_m)
