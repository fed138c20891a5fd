"""Where the residual stands out: groups of links that read otherwise than their peers.

Before any theory of a cause, held-out residuals of the base are grouped by device, receiver and
flight, by their pairs, by windows of time, directions, distances and places. Each group's level,
scatter and share of blanks is laid beside those of its peers (`radiotwin.inference.groups`). A
greedy cover takes the group that explains most of what stands out, takes its share out of the
residuals, and looks again: one flight is said, not its twenty-four pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import expit, logit, ndtr

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.verdict.criteria import MIN_SURE
from radiotwin.effects.params import QUANTILE_90, Parameter
from radiotwin.inference.groups import (
    HUBER,
    MAX_SCALES,
    Apart,
    Groups,
    Lasting,
    Statistic,
    Units,
    apart,
    levels,
    log_scatters,
    means,
    medians,
    polished,
    together,
    without_shared,
)
from radiotwin.links.correlation import moving_end_m
from radiotwin.links.sites import never_part

PASSING_M, LASTING_M = 25.0, 75.0  # errors of one flight, and of the map, are alike within
TOLERANCE_DB = 0.3  # spread of levels of peers: instruments, antennas, cables
# Share of a base's scatter with line of sight, and without, in which whole groups differ.
LOS_SHARE, NLOS_SHARE = 0.1, 0.4
LOS_DOF, NLOS_DOF = 40.0, 6.0  # tails of these differences of levels, Student's t
BOTH_SHARE = 0.8  # of what stands out does so with line of sight and without
SCATTER_SPREAD, NOISE_SPREAD = 0.2, 0.3  # of peers: logarithm
LOS_BLANKS_SPREAD, NLOS_BLANKS_SPREAD = 0.05, 0.15  # of peers: share of blanks
ANYWHERE_DB, ANYWHERE_LOG, ANYWHERE_SHARE = 5.0, 0.8, 0.3  # scale of what stands out
# Odds that something of a family stands out in one way: a device, receiver or flight; others.
END_ODDS, FAMILY_ODDS = 0.4, 0.03
LEAST_SCALE_DB = 0.5  # half a step of coarse readings
MAX_ANOMALIES = 10
MAX_RIVALS = 4  # groups of which the one that explains most is taken
LIKELY = 0.5  # groups less probable than this are not said
MIN_LINKS = 60  # of a class of line of sight
SECTORS, BANDS, WINDOWS = 8, 8, (2, 4, 8, 16, 32)
RAY_SAMPLES, LOW_M, GRID_M = 24, 40.0, (50.0, 100.0)  # of links that pass through a place
ENDS = "device", "receiver", "flight"
BASE_ERRORS, BASE_ERRORS_DB = ("distance", "altitude", "level"), 2.0  # which every base has
HEIGHTS_M, QUARTERS = (5.0, 20.0, 60.0), 4  # at which a base errs otherwise: street, roofs, above
UNITS = {"level": "dB", "scatter": "times", "noise": "times", "blanks": "share"}
Words = tuple[dict[str, tuple[str, ...]], dict[str, tuple[float, float]]]
"""Members and ranges of a group."""


@dataclass(frozen=True, eq=False)
class Anomaly:
    """A group of links that reads otherwise than its peers.

    Attributes:
        family: what its links share: `device`, `receiver`, `flight`, a pair such as
            `device x flight`, `time`, `direction`, `distance`, `altitude`, `level` or `place`.
        members: names of the devices, receivers and flights.
        ranges: low and high end of each variable that bounds it, by name with unit.
        sight: `los`, `nlos` or `all`: the links that it is of.
        statistic: `level`, `scatter` or `blanks`.
        size: against its peers, with its 90 % interval: dB, times or share.
        probability: that it is real.
        rows: (n,) bool, its links.
        causes: probability of each cause that may explain it, by name of the effect; `another` is
            one that the catalogue does not have. Empty before causes were looked for.
    """

    family: str
    members: Mapping[str, tuple[str, ...]]
    ranges: Mapping[str, tuple[float, float]]
    sight: str
    statistic: str
    size: Parameter
    probability: float
    rows: np.ndarray
    causes: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Readings:
    """n readings with what a model that has not seen them predicts.

    Attributes:
        residual_db: (n,) measured minus predicted; NaN where nothing was heard or predicted.
        blank_excess: (n,) 1 for a blank, 0 for a level, less the probability of a blank.
        los: (n,) bool.
        device, receiver, flight: (n,) int.
        time_s: (n,) NaN where unknown.
        moving_m: (n, 3) end of the link that moves [m].
        device_m, receiver_m: (n, 3) both ends [m].
        angles_deg: azimuth and elevation at the device, and azimuth in the receiver's body, (n,)
            each [degree]; NaN where unknown.
        predicted_db: (n,) level.
        names: of devices, receivers and flights.
    """

    residual_db: np.ndarray
    blank_excess: np.ndarray
    los: np.ndarray
    device: np.ndarray
    receiver: np.ndarray
    flight: np.ndarray
    time_s: np.ndarray
    moving_m: np.ndarray
    device_m: np.ndarray
    receiver_m: np.ndarray
    angles_deg: Mapping[str, np.ndarray]
    predicted_db: np.ndarray
    names: Mapping[str, list[str]]

    @cached_property
    def previous(self) -> np.ndarray:
        """(n,) row of the reading before, of the same ends and flight; -1 where there is none."""
        series = _codes(self.device, self.receiver, self.flight)
        order = np.lexsort((np.arange(len(self)), self.time_s, series))
        found = np.full(len(self), -1)
        follows = series[order[1:]] == series[order[:-1]]
        found[order[1:][follows]] = order[:-1][follows]
        return found

    @property
    def step_db(self) -> np.ndarray:
        """(n,) change since the reading before over the square root of 2; NaN = none.

        What a map has wrong changes slowly along a track; an instrument's noise does not.
        """
        before = self.previous
        alike = (before >= 0) & (self.los == self.los[before])
        return np.where(alike, (self.residual_db - self.residual_db[before]) / np.sqrt(2), np.nan)

    @classmethod
    def of(cls, model: CrossFit) -> Readings:
        """Return the readings of a model's links, held out."""
        links, level_db = model.links, model.links.level_db
        mean_db, scale_db = model.held_out_reading
        predicted_db = model.held_out_mean_db
        with np.errstate(invalid="ignore"):
            blank = ndtr((links.limit_db - mean_db) / scale_db)
        blank_excess = np.where(np.isnan(level_db), 1.0, 0.0) - blank
        return cls(level_db - predicted_db, blank_excess, links.los, links.device, links.receiver,
                   links.flight, links.time_s, moving_end_m(links),
                   links.device_m[links.device], links.receiver_m,
                   {"azimuth": links.azimuth_deg, "elevation": links.elevation_deg,
                    "body azimuth": links.body_azimuth_deg}, mean_db,
                   {"device": list(links.device_names), "receiver": list(links.receiver_names),
                    "flight": list(links.flight_names)})

    def __len__(self) -> int:
        return len(self.los)


@dataclass(frozen=True, eq=False)
class Family:
    """Groups that are each other's peers.

    Attributes:
        name: of the family.
        groups: of links.
        describe: members and ranges of a group.
        ends: labels (n,) whose levels are taken off first, as they are families of their own.
        statistics: that are compared.
        pairs: label of both ends (k,) each, of groups that are pairs.
        is_crossing: whether several groups may have read one device at one place.
    """

    name: str
    groups: Groups
    describe: Callable[[int], Words]
    ends: tuple[np.ndarray, ...] = ()
    statistics: tuple[str, ...] = ("level", "noise", "scatter", "blanks")
    pairs: tuple[np.ndarray, ...] = ()
    is_crossing: bool = False


@dataclass(frozen=True, eq=False)
class _Compared:
    """One statistic of a family, in one class of line of sight or both together."""

    family: Family
    statistic: str
    sight: str
    distance: Apart
    log_odds: np.ndarray


@dataclass(frozen=True)
class _Found:
    compared: _Compared
    group: int

    @property
    def log_odds(self) -> float:
        return float(self.compared.log_odds[self.group])

    @property
    def size(self) -> float:
        return float(self.compared.distance.size[self.group])


def scan(model: CrossFit) -> list[Anomaly]:
    """Return the groups of a model's held-out links that stand out, most evident first.

    Args:
        model: of n links.

    Returns:
        those that are more probable than not, at most `MAX_ANOMALIES`.
    """
    return scan_readings(Readings.of(model))


def scan_readings(readings: Readings) -> list[Anomaly]:
    """Return the groups of readings that stand out, see `scan`."""
    families = list(_families(readings))
    units = _units(readings)
    found: list[Anomaly] = []
    left = readings
    compared = _compare(left, families, units)
    while len(found) < MAX_ANOMALIES:
        rivals = _likeliest(compared)
        if not rivals:
            break
        after = [(each, _without(left, each)) for each in rivals]
        tables = [_compare(rest, families, units) for _, rest in after] if len(after) > 1 else []
        best = int(np.argmin([_evidence(table) for table in tables])) if tables else 0
        chosen, left = after[best]
        compared = tables[best] if tables else _compare(left, families, units)
        found.append(_anomaly(chosen, readings))
    return found


def _units(readings: Readings) -> Units:
    """Return which readings err alike: of one flight nearby; of one device, in a larger place."""
    passing, lasting = (np.floor(readings.moving_m[:, :2] / width_m).astype(np.int64)
                        for width_m in (PASSING_M, LASTING_M))
    return Units(_codes(*passing.T, readings.flight), _codes(*lasting.T, readings.device))


def _codes(*labels: np.ndarray) -> np.ndarray:
    """Return one label (n,) for each combination of labels (n,)."""
    code = np.zeros(len(labels[0]), dtype=np.int64)
    for label in labels:
        code = code * (int(np.ptp(label)) + 1 if len(label) else 1) + (label - label.min(initial=0))
    return np.unique(code, return_inverse=True)[1].ravel()


def _packed(label: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return labels (n,) without gaps; -1 where a mask (n,) is not set."""
    code = np.full(len(label), -1)
    code[known] = np.unique(label[known], return_inverse=True)[1].ravel()
    return code


def _compare(readings: Readings, families: list[Family],
             units: Units) -> list[_Compared]:
    found = []
    usual_db = _usual_errors(readings)
    values = {"level": readings.residual_db - usual_db, "scatter": readings.residual_db - usual_db,
              "noise": readings.step_db, "blanks": readings.blank_excess}
    heard = np.isfinite(readings.residual_db)
    classes = {name: rows for name, rows in (("los", readings.los), ("nlos", ~readings.los))
               if (rows & heard).sum() >= MIN_LINKS}
    scale = {name: _scale(readings.residual_db[rows & heard]) for name, rows in classes.items()}
    usual = np.where(readings.los, scale.get("los", 1.0), scale.get("nlos", 1.0))
    for family in families:
        for statistic in family.statistics:
            parts = {}
            for name, rows in classes.items():
                rows = rows & np.isfinite(values[statistic])
                of_family = readings.residual_db if family.name in BASE_ERRORS and \
                    statistic == "level" else values[statistic]
                part = _distances(of_family, family, statistic, rows, units, usual, readings.los)
                if part is not None:
                    parts[name] = part
            if len(parts) > 1:
                parts["all"] = together(list(parts.values()))
            elif len(classes) == 1 and parts:
                parts["all"] = parts.popitem()[1]
            outlier = {"level": ANYWHERE_DB, "blanks": ANYWHERE_SHARE}.get(statistic, ANYWHERE_LOG)
            for name, part in parts.items():
                odds = END_ODDS if family.name in ENDS else FAMILY_ODDS
                if len(parts) > 1:
                    odds *= BOTH_SHARE if name == "all" else (1 - BOTH_SHARE) / 2
                log_odds = part.log_odds(outlier, odds)
                if statistic in ("scatter", "noise"):  # a group that scatters less is no fault
                    log_odds = np.where(part.size > 0, log_odds, -np.inf)
                found.append(_Compared(family, statistic, name, part, log_odds))
    return found


def _usual_errors(readings: Readings) -> np.ndarray:
    """Return the median residual (n,) at like height and distance, of one class of sight [dB].

    A base errs otherwise in a street than above the roofs, which is no fault of a flight there.
    """
    heard = np.isfinite(readings.residual_db)
    height = np.searchsorted(HEIGHTS_M, readings.moving_m[:, 2])
    distance_m = np.linalg.norm(readings.receiver_m - readings.device_m, axis=1)
    cell = _codes(readings.los.astype(int), height)
    quarter = np.zeros(len(readings), dtype=np.int64)
    for each in np.unique(cell[heard]):
        rows = heard & (cell == each)
        edges = np.quantile(distance_m[rows], np.linspace(0, 1, QUARTERS + 1)[1:-1])
        quarter[rows] = np.searchsorted(edges, distance_m[rows])
    cell = _codes(cell, quarter)
    found = np.zeros(len(readings))
    found[heard] = medians(readings.residual_db[heard], cell[heard], int(cell.max()) + 1)[
        cell[heard]]
    return found


def _distances(values: np.ndarray, family: Family, statistic: str, rows: np.ndarray,
               units: Units, usual: np.ndarray, los: np.ndarray) -> Apart | None:
    """Return how far the groups of one class are from their peers; None if too few are judged."""
    groups = family.groups.among(rows)
    if not len(groups.row):
        return None
    is_los = bool(los[groups.row[0]])
    scale = float(usual[groups.row[0]])
    if family.ends:
        values = values.copy()
        take_off = _centred if statistic == "blanks" else polished
        values[rows] = take_off(values[rows], [label[rows] for label in family.ends])
    if family.is_crossing and statistic in ("level", "scatter"):
        label = np.full(len(values), -1)
        label[groups.row] = groups.group
        own = label >= 0
        values = values.copy()
        values[own] = without_shared(values[own], label[own], units.lasting[own])
    if statistic == "level":
        # A level gives way to outliers; so much of a unit's error as it follows counts.
        limit_db, most_db = HUBER * scale, MAX_SCALES * scale
        centred = values - np.median(values[rows])
        followed = units.errors(np.clip(centred, -limit_db, limit_db), rows).sd
        lasting = Lasting(followed / float((np.abs(centred[rows]) < limit_db).mean()),
                          units.errors(np.clip(centred, -most_db, most_db), rows).kurtosis)
        found = levels(values, groups, units, lasting, LEAST_SCALE_DB)
        prior = BASE_ERRORS_DB if family.name in BASE_ERRORS else TOLERANCE_DB
        prior = np.hypot(prior, (LOS_SHARE if is_los else NLOS_SHARE) * scale)
    elif statistic in ("scatter", "noise"):
        size = np.minimum(np.abs(values) / usual, MAX_SCALES)
        lasting = units.errors(size / size[rows].mean(), rows)
        found = log_scatters(values, groups, units, lasting, usual)
        prior = NOISE_SPREAD if statistic == "noise" else SCATTER_SPREAD
    else:
        found = means(values, groups, units, units.errors(values, rows))
        prior = LOS_BLANKS_SPREAD if is_los else NLOS_BLANKS_SPREAD
    if np.isfinite(found.value).sum() < 2:
        return None
    if family.pairs:
        found = _additive(found, family.pairs)
    heavy = statistic == "level" and not is_los
    return apart(found, float(prior), NLOS_DOF if heavy else LOS_DOF)


def _centred(values: np.ndarray, labels: list[np.ndarray]) -> np.ndarray:
    """Return values (n,) less the means of each label's groups in turn."""
    for _ in range(2):
        for label in labels:
            number = np.maximum(np.bincount(label), 1)
            values = values - (np.bincount(label, values) / number)[label]
    return values


def _additive(found: Statistic, ends: tuple[np.ndarray, ...]) -> Statistic:
    """Return the statistic of pairs less the medians of both ends' pairs."""
    judged = np.isfinite(found.value)
    value, error = found.value.copy(), found.error.copy()
    own = [end[judged] for end in ends]
    value[judged] = polished(value[judged], own)
    error[judged] *= np.sqrt(1 + sum(1.57 / np.bincount(end)[end] for end in own))
    return replace(found, value=value, error=error)


def _scale(values: np.ndarray) -> float:
    middle = np.median(values)
    return max(1.4826 * float(np.median(np.abs(values - middle))), LEAST_SCALE_DB)


def _likeliest(compared: list[_Compared]) -> list[_Found]:
    """Return the most probable groups, at most `MAX_RIVALS`, of each group only once."""
    found = [_Found(each, int(group)) for each in compared
             for group in np.flatnonzero(each.log_odds > logit(LIKELY))]
    found.sort(key=lambda each: -each.log_odds)
    seen, rivals = set(), []
    for each in found:
        key = id(each.compared.family), each.group
        if key not in seen:
            seen.add(key)
            rivals.append(each)
    best: dict[str, _Found] = {}
    for each in rivals:
        best.setdefault(each.compared.family.name, each)
    # What is sure comes before what may explain more: a receiver that scatters covers its flights.
    sure = [each for each in best.values() if each.log_odds > logit(MIN_SURE)]
    return (sure or list(best.values()))[:MAX_RIVALS]


def _evidence(compared: list[_Compared]) -> float:
    """Return how much stands out in all [nats]."""
    return float(sum(np.nansum(np.maximum(each.log_odds, 0.0)) for each in compared))


def _rows(found: _Found, readings: Readings) -> np.ndarray:
    rows = found.compared.family.groups.members(found.group, len(readings))
    sight = found.compared.sight
    return rows & (readings.los if sight == "los" else ~readings.los if sight == "nlos" else True)


def _without(readings: Readings, found: _Found) -> Readings:
    """Return readings of which a group's size is taken off."""
    rows = _rows(found, readings)
    if found.compared.statistic == "blanks":
        excess = readings.blank_excess.copy()
        excess[rows] = np.nan
        return replace(readings, blank_excess=excess)
    residual_db = readings.residual_db.copy()
    if found.compared.statistic == "level":
        residual_db[rows] -= found.size
    else:
        middle = np.nanmedian(residual_db[rows])
        residual_db[rows] = middle + (residual_db[rows] - middle) / np.exp(found.size)
    return replace(readings, residual_db=residual_db)


def _anomaly(found: _Found, readings: Readings) -> Anomaly:
    compared = found.compared
    members, ranges = compared.family.describe(found.group)
    if compared.family.name in ENDS:  # another end that has the same links may be meant
        labels = {end: getattr(readings, end) for end in ENDS}
        for other in (end for end in ENDS if end != compared.family.name):
            same = never_part(labels[compared.family.name], labels[other])
            if found.group in same:
                members = {**members, other: (readings.names[other][same[found.group]],)}
    error = QUANTILE_90 * float(compared.distance.error[found.group])
    value, low, high = found.size, found.size - error, found.size + error
    if compared.statistic in ("scatter", "noise"):
        value, low, high = np.exp([value, low, high]).tolist()
    return Anomaly(compared.family.name, members, ranges, compared.sight,
                   "scatter" if compared.statistic == "noise" else compared.statistic,
                   Parameter(value, low, high, UNITS[compared.statistic]),
                   float(expit(found.log_odds)), _rows(found, readings))


def _families(readings: Readings) -> Iterator[Family]:
    labels = {"device": readings.device, "receiver": readings.receiver, "flight": readings.flight}
    several = {name: label for name, label in labels.items() if len(np.unique(label)) > 1}
    for name, label in several.items():
        def describe(group: int, name: str = name) -> Words:
            return {name: (readings.names[name][group],)}, {}
        within: tuple[np.ndarray, ...] = ()
        if name == "flight" and "receiver" in several and _is_nested(label, readings.receiver):
            within = (readings.receiver,)  # flights of one receiver share its level
        yield Family(name, Groups.of_labels(label), describe, is_crossing=name != "device",
                     pairs=tuple(end[_examples(label)] for end in within))
    for first, second in (("device", "flight"), ("receiver", "flight"), ("device", "receiver")):
        if first in several and second in several:
            yield from _pairs(readings, first, second, labels)
    yield from _windows(readings)
    yield from _directions(readings)
    yield from _bands(readings)
    yield from _places(readings)


def _pairs(readings: Readings, first: str, second: str,
           labels: Mapping[str, np.ndarray]) -> Iterator[Family]:
    one, other = labels[first], labels[second]
    code = _codes(one, other)
    count = int(code.max()) + 1
    if count in (len(np.unique(one)), len(np.unique(other))):
        return  # the two never part
    example = _examples(code)

    def describe(group: int) -> Words:
        row = example[group]
        return {first: (readings.names[first][one[row]],),
                second: (readings.names[second][other[row]],)}, {}

    yield Family(f"{first} x {second}", Groups.of_labels(code), describe,
                 pairs=(one[example], other[example]), is_crossing=True)


def _is_nested(label: np.ndarray, within: np.ndarray) -> bool:
    """Return whether links of each label (n,) share one of fewer labels within (n,)."""
    pairs = len(np.unique(_codes(label, within)))
    return pairs == len(np.unique(label)) and pairs > len(np.unique(within))


def _examples(label: np.ndarray) -> np.ndarray:
    """Return one row of each label from 0 on; row 0 for one that no link has."""
    example = np.zeros(int(label.max()) + 1, dtype=np.int64)
    example[label] = np.arange(len(label))
    return example


def _windows(readings: Readings) -> Iterator[Family]:
    """Yield windows of time within flights, of all receivers and of one."""
    timed = np.isfinite(readings.time_s)
    if timed.mean() < 0.5:
        return
    track = _codes(readings.receiver, readings.flight)
    scopes = [("flight", readings.flight)]
    if len(np.unique(track)) > len(np.unique(readings.flight)):
        scopes.append(("receiver", track))
    for scope, label in scopes:
        begin, end = _extremes(readings.time_s, label)
        lasts = np.maximum(end - begin, 1e-9)
        for number in WINDOWS:
            for shift in (0.0, 0.5):
                share = (readings.time_s - begin[label]) / lasts[label]
                window = np.floor(np.clip(np.where(timed, share, 0.0), 0, 1 - 1e-9) * number
                                  + shift).astype(np.int64)
                code = _packed(label * (number + 1) + window, timed)
                yield Family("time", Groups.of_labels(code), _time_words(readings, scope, code),
                             (readings.device, track), ("level", "blanks"), is_crossing=True)


def _extremes(values: np.ndarray, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.full(label.max() + 1, np.inf), np.full(label.max() + 1, -np.inf)
    known = np.isfinite(values)
    np.minimum.at(low, label[known], values[known])
    np.maximum.at(high, label[known], values[known])
    return low, high


def _time_words(readings: Readings, scope: str, code: np.ndarray) -> Callable:
    def describe(group: int) -> Words:
        rows = code == group
        flight = readings.flight[rows][0]
        members: dict[str, tuple[str, ...]] = {"flight": (readings.names["flight"][flight],)}
        if scope == "receiver":
            members["receiver"] = (readings.names["receiver"][readings.receiver[rows][0]],)
        time_s = readings.time_s[rows]
        return members, {"time_s": (float(time_s.min()), float(time_s.max()))}
    return describe


def _directions(readings: Readings) -> Iterator[Family]:
    """Yield directions at each device, and in the body of each receiver."""
    for angle, end, names in (("azimuth", readings.device, "device"),
                              ("elevation", readings.device, "device"),
                              ("body azimuth", readings.receiver, "receiver")):
        values = readings.angles_deg[angle]
        known = np.isfinite(values)
        if known.mean() < 0.5:
            continue
        width = 360 / SECTORS if angle != "elevation" else 180 / SECTORS
        for shift in (0.0, 0.5):
            sector = np.floor(np.where(known, values, 0.0) / width + shift).astype(np.int64)
            if angle != "elevation":
                sector %= SECTORS
            sector -= sector.min()
            code = _packed(_codes(end, sector), known)

            def describe(group: int, code: np.ndarray = code, end: np.ndarray = end,
                         names: str = names, angle: str = angle, shift: float = shift,
                         width: float = width, values: np.ndarray = values
                         ) -> Words:
                row = np.flatnonzero(code == group)[0]
                low = (np.floor(values[row] / width + shift) - shift) * width
                return ({names: (readings.names[names][end[row]],)},
                        {f"{angle.replace(' ', '_')}_deg": (float(low), float(low + width))})
            yield Family("direction", Groups.of_labels(code), describe, (end, sector), ("level",))


def _bands(readings: Readings) -> Iterator[Family]:
    """Yield bands of distance, altitude and level, of all links."""
    distance_m = np.linalg.norm(readings.receiver_m - readings.device_m, axis=1)
    for name, values, key in (("distance", distance_m, "distance_m"),
                              ("altitude", readings.moving_m[:, 2], "height_m"),
                              ("level", readings.predicted_db, "predicted_db")):
        known = np.isfinite(values)
        edges = np.unique(np.quantile(values[known], np.linspace(0, 1, BANDS + 1)[1:-1])) \
            if known.any() else np.zeros(0)
        if len(edges) < 2:
            continue
        code = _packed(np.searchsorted(edges, values), known)

        def describe(group: int, code: np.ndarray = code, values: np.ndarray = values,
                     key: str = key
                     ) -> Words:
            rows = code == group
            return {}, {key: (float(values[rows].min()), float(values[rows].max()))}
        yield Family(name, Groups.of_labels(code), describe, (readings.device,),
                     ("level", "scatter"))


def _places(readings: Readings) -> Iterator[Family]:
    """Yield squares of ground that links end in, or pass low above."""
    share = (np.arange(RAY_SAMPLES) + 0.5) / RAY_SAMPLES
    along_m = readings.device_m[:, None] + share[:, None] * (
        readings.receiver_m - readings.device_m)[:, None]
    low = along_m[..., 2] < LOW_M
    link = np.broadcast_to(np.arange(len(readings))[:, None], low.shape)[low]
    for width_m in GRID_M:
        end = np.floor(readings.moving_m[:, :2] / width_m).astype(np.int64)
        yield _squares(np.arange(len(readings)), end, width_m, readings)
        cell = np.floor(along_m[low][:, :2] / width_m).astype(np.int64)
        if len(cell):
            yield _squares(link, cell, width_m, readings)


def _squares(link: np.ndarray, cell: np.ndarray, width_m: float, readings: Readings) -> Family:
    squares, group = np.unique(cell, axis=0, return_inverse=True)
    pairs = np.unique(np.column_stack([link, group.ravel()]), axis=0)

    def describe(group: int) -> Words:
        low_m = squares[group] * width_m
        return {}, {name: (float(low), float(low + width_m))
                    for name, low in zip(("x_m", "y_m"), low_m, strict=True)}
    return Family("place", Groups(pairs[:, 0], pairs[:, 1], len(squares)), describe,
                  (readings.device, _codes(readings.receiver, readings.flight)), ("level",))
