"""Where the residual stands out: groups of links that read otherwise than their peers.

Before any theory of a cause, held-out residuals of the base are grouped by device, receiver and
flight, by their pairs, by windows of time, directions, distances and places. Each group's level,
scatter and share of blanks is laid beside those of its peers (`radiotwin.inference.groups`). A
greedy cover takes the group that explains most of what stands out, takes its share out of the
residuals, and looks again: one flight is said, not its twenty-four pairs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import expit, logit

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.closeloop.families import Family, Readings, codes_of, families_of, units_of
from radiotwin.closeloop.verdict.criteria import MIN_SURE
from radiotwin.effects.params import QUANTILE_90, Parameter
from radiotwin.inference.curves import Curves, combine_curves, compare_curves
from radiotwin.inference.gaussian import robust_sd
from radiotwin.inference.groups import (
    HUBER,
    MAX_SCALES,
    TINY,
    Groups,
    LastingErrors,
    PeerComparison,
    Units,
    combine_parts,
    compare_with_peers,
    levels,
    log_scatters,
    means,
    median_polish,
    medians,
    subtract_end_levels,
    subtract_unit_errors,
)
from radiotwin.links.sites import inseparable_pairs

# Spread of levels of peers. Of ends it is that of instruments, antennas and cables. By direction,
# place, distance and height every base errs.
PAIR_SPREAD_DB, SPREAD_DB = 0.6, {"device": 0.3, "receiver": 0.3, "flight": 0.3, "direction": 1.0,
                                  "place": 1.0, "distance": 2.0, "altitude": 2.0, "level": 2.0}
# Share of a base's scatter with line of sight, and without, in which whole groups differ.
LOS_SHARE, NLOS_SHARE = 0.1, 0.4
LOS_DOF, NLOS_DOF = 60.0, 6.0  # tails of these differences of levels, Student's t
BOTH_SHARE = 0.8  # of what stands out does so with line of sight and without
SCATTER_SPREAD, NOISE_SPREAD = 0.2, 0.3  # of peers: logarithm
LOS_BLANKS_SPREAD, NLOS_BLANKS_SPREAD = 0.03, 0.12  # of peers: share of blanks
LOS_CURVE_SHARE, NLOS_CURVE_SHARE = 0.08, 0.1  # of a base's scatter by which curves change
# Scale of what stands out.
ANYWHERE, ANYWHERE_LOG = {"level": 5.0, "curve": 3.0, "blanks": 0.3}, 0.8
# Odds that something of a family stands out in one way: a device, receiver or flight; others.
ODDS, FAMILY_ODDS = {"device": 0.4, "receiver": 0.4, "flight": 0.4, "place": 1.0}, 0.03
PLACE_BOTH = 0.3
LEAST_SCALE_DB = 0.5  # half a step of coarse readings
MAX_ANOMALIES = 10
ECHO = 1 / 3  # of the first size, below which a later find may be what the first left on others
MAX_RIVALS = 4  # groups of which the one that explains most is taken
LIKELY = 0.5  # groups less probable than this are not said
MIN_LINKS = 60  # of a class of line of sight
ENDS = "device", "receiver", "flight"
BASE_ERRORS = "distance", "altitude", "level"  # in which a base's usual errors differ
HEIGHTS_M, QUARTERS = (5.0, 20.0, 60.0), 4  # at which a base errs otherwise: street, roofs, above
UNITS = {"level": "dB", "curve": "dB", "scatter": "times", "noise": "times", "blanks": "share"}


@dataclass(frozen=True, eq=False)
class Anomaly:
    """A group of links that reads otherwise than its peers.

    Attributes:
        family: what its links share: `device`, `receiver`, `flight`, a pair such as
            `device x flight`, `time`, `direction`, `distance`, `altitude`, `level` or `place`.
        members: names of the devices, receivers and flights.
        ranges: low and high end of each variable that bounds it, by name with unit.
        sight: `los`, `nlos` or `all`: the links that it is of.
        statistic: `level`, `scatter`, `blanks`, or `curve`: levels that change along a variable.
        size: against its peers, with its 90 % interval: dB, times or share.
        probability: that it is real.
        rows: (n,) bool, its links.
        along: of a curve, the variable that the levels change along.
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
    along: str = ""
    causes: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Compared:
    """One statistic of a family, in one class of line of sight or both together."""

    family: Family
    statistic: str
    sight: str
    distance: PeerComparison | Curves
    log_odds: np.ndarray

    @property
    def key(self) -> tuple[int, str, str]:
        """What tells it from the others of one comparison."""
        return id(self.family), self.statistic, self.sight


@dataclass(frozen=True)
class _Found:
    compared: Compared
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
    units = units_of(readings)
    families = list(families_of(readings, units))
    few = [each for each in families
           if each.curve is None and (each.name in ENDS or each.pairs)]
    found: list[Anomaly] = []
    taken: list[_Found] = []
    left, first = readings, None
    while len(found) < MAX_ANOMALIES:
        compared = compare(left, families, units)
        first = first or compared
        rivals = _likeliest(compared, first, taken)
        if not rivals:
            break
        after = [(each, _without(left, each)) for each in rivals]
        best = 0
        if len(after) > 1:  # what explains most of what ends, flights and their pairs show
            best = int(np.argmin([_evidence(compare(rest, few, units)) - each.log_odds
                                  for each, rest in after]))
        chosen, left = after[best]
        taken.append(chosen)
        found.append(_anomaly(chosen, readings))
    return found


@dataclass(frozen=True, eq=False)
class _Class:
    """Values of one statistic, of the links of one class of line of sight.

    Attributes:
        values: (n,), NaN outside `rows`.
        rows: (n,) bool.
        statistic: `level`, `scatter`, `noise` or `blanks`.
        is_los: whether the class is that with line of sight.
        scale_db: of its residuals.
        units: of the n values.
        lasting: estimator of the error of lasting units, over `rows`.
        taken_off: values less the levels of ends that were asked for, kept.
    """

    values: np.ndarray
    rows: np.ndarray
    statistic: str
    is_los: bool
    scale_db: float
    units: Units
    lasting: LastingErrors
    taken_off: dict[tuple[int, ...], np.ndarray] = field(default_factory=dict)

    def of(self, family: Family, groups: Groups) -> np.ndarray:
        """Return values (n,) in which a family's groups can be compared."""
        key = tuple(id(end) for end in family.ends)
        if key not in self.taken_off:
            values, ends = self.values.copy(), [end[self.rows] for end in family.ends]
            take_off = _centred if self.statistic == "blanks" else median_polish
            values[self.rows] = take_off(values[self.rows], ends)
            self.taken_off[key] = values
        values = self.taken_off[key]
        if not family.is_crossing or self.statistic != "level":
            return values
        values = values.copy()
        values[groups.row] = subtract_unit_errors(values[groups.row], groups.group,
                                                  self.units.lasting[groups.row])
        return values

    def compare(self, family: Family) -> PeerComparison | Curves | None:
        """Return how far a family's groups are from their peers; None if too few are judged."""
        groups = family.groups.restrict_to(self.rows)
        if not len(groups.row):
            return None
        values = self.of(family, groups)
        own, scale_db = values[self.rows], self.scale_db
        if self.statistic == "level":
            # A level gives way to outliers; so much of a unit's error as it follows counts.
            own, limit_db = own - np.median(own), HUBER * scale_db
            followed_db = self.lasting.sd(np.clip(own, -limit_db, limit_db))
            lasting_db = followed_db / float((np.abs(own) < limit_db).mean())
            is_bin = family.curve is not None
            found = levels(values, groups, lasting_db, LEAST_SCALE_DB, is_bin)
            if family.curve is not None:
                usual_db = (LOS_CURVE_SHARE if self.is_los else NLOS_CURVE_SHARE) * scale_db
                part = "los" if self.is_los else "nlos"
                return compare_curves(found, family.curve, usual_db, part)
            prior = SPREAD_DB.get(family.name, PAIR_SPREAD_DB)
            prior = float(np.hypot(prior, (LOS_SHARE if self.is_los else NLOS_SHARE) * scale_db))
        elif self.statistic == "blanks":
            found = means(values, groups, self.lasting.sd(own))
            prior = LOS_BLANKS_SPREAD if self.is_los else NLOS_BLANKS_SPREAD
            prior *= 1 if family.name in ENDS else 2
        else:
            size = np.minimum(np.abs(own) / scale_db, MAX_SCALES)
            # What an instrument adds is another at each reading.
            lasting_sd = None if self.statistic == "noise" else \
                self.lasting.sd(size / max(size.mean(), TINY))
            found = log_scatters(values, groups, lasting_sd, scale_db)
            prior = NOISE_SPREAD if self.statistic == "noise" else SCATTER_SPREAD
            prior *= 1 if family.name in ENDS else 1.5
        if np.isfinite(found.value).sum() < 2:
            return None
        if family.pairs:
            found = subtract_end_levels(found, family.pairs)
        heavy = self.statistic == "level" and not self.is_los
        return compare_with_peers(found, prior, NLOS_DOF if heavy else LOS_DOF)


def _classes(readings: Readings, units: Units) -> dict[str, dict[str, _Class]]:
    """Return the values of each statistic, in each class that has enough links."""
    usual_db = _usual_errors(readings)
    values = {"level": readings.residual_db - usual_db, "scatter": readings.residual_db - usual_db,
              "noise": readings.step_db, "blanks": readings.blank_excess,
              "base": readings.residual_db}
    found: dict[str, dict[str, _Class]] = {name: {} for name in values}
    heard = np.isfinite(readings.residual_db)
    for sight, is_los in (("los", True), ("nlos", False)):
        of_class = readings.los if is_los else ~readings.los
        if (of_class & heard).sum() < MIN_LINKS:
            continue
        scale_db = _scale(readings.residual_db[of_class & heard])
        for name, each in values.items():
            rows = of_class & np.isfinite(each)
            found[name][sight] = _Class(each, rows, "level" if name == "base" else name, is_los,
                                        scale_db, units, LastingErrors(units, rows))
    return found


def compare(readings: Readings, families: list[Family], units: Units) -> list[Compared]:
    """Return all statistics of families, in each class and in both together."""
    found, classes = [], _classes(readings, units)
    alike = Counter((family.name, family.curve is None) for family in families)
    for family in families:
        for statistic in family.statistics:
            is_base = family.name in BASE_ERRORS and statistic == "level"
            of = "base" if is_base else "level" if statistic == "curve" else statistic
            parts: dict[str, PeerComparison | Curves] = {}
            for name, each in classes[of].items():
                part = each.compare(family)
                if part is not None:
                    parts[name] = part
            if len(parts) > 1:
                parts["all"] = _together(list(parts.values()))
            elif len(classes["level"]) == 1 and parts:
                parts["all"] = parts.popitem()[1]
            outlier = ANYWHERE.get(statistic, ANYWHERE_LOG)
            for name, part in parts.items():
                odds = ODDS.get(family.name, FAMILY_ODDS)
                odds /= alike[family.name, family.curve is None]
                if len(parts) > 1:
                    both = PLACE_BOTH if family.name == "place" else BOTH_SHARE
                    odds *= both if name == "all" else (1 - both) / 2
                log_odds = part.log_odds(outlier, odds)
                if statistic != "level":  # less scatter, or fewer blanks, is no fault
                    log_odds = np.where(part.size > 0, log_odds, -np.inf)
                found.append(Compared(family, statistic, name, part, log_odds))
    return found


def _together(parts: list[PeerComparison | Curves]) -> PeerComparison | Curves:
    of_groups = [each for each in parts if isinstance(each, PeerComparison)]
    of_curves = [each for each in parts if isinstance(each, Curves)]
    return combine_parts(of_groups) if of_groups else combine_curves(of_curves)


def _usual_errors(readings: Readings) -> np.ndarray:
    """Return the median residual (n,) at like height and distance, of one class of sight [dB].

    A base errs otherwise in a street than above the roofs, which is no fault of a flight there.
    """
    heard = np.isfinite(readings.residual_db)
    height = np.searchsorted(HEIGHTS_M, readings.moving_m[:, 2])
    distance_m = np.linalg.norm(readings.receiver_m - readings.device_m, axis=1)
    cell = codes_of(readings.los.astype(int), height)
    quarter = np.zeros(len(readings), dtype=np.int64)
    for each in np.unique(cell[heard]):
        rows = heard & (cell == each)
        edges = np.quantile(distance_m[rows], np.linspace(0, 1, QUARTERS + 1)[1:-1])
        quarter[rows] = np.searchsorted(edges, distance_m[rows])
    cell = codes_of(cell, quarter)
    receivers, flights = (_members(cell[heard], end[heard], int(cell.max()) + 1)
                          for end in (readings.receiver, readings.track))
    # What several flights of one receiver share may be its own level.
    own = heard & ~((receivers == 1) & (flights > 1))[cell]
    found = np.zeros(len(readings))
    found[own] = medians(readings.residual_db[own], cell[own], int(cell.max()) + 1)[cell[own]]
    return found


def _members(cell: np.ndarray, end: np.ndarray, count: int) -> np.ndarray:
    """Return how many different ends (n,) each of some cells (n,) has, (count,)."""
    size = int(end.max(initial=0)) + 1
    return np.bincount(np.unique(cell * np.int64(size) + end) // size, minlength=count)


def _centred(values: np.ndarray, labels: list[np.ndarray]) -> np.ndarray:
    """Return values (n,) less the means of each label's groups in turn."""
    for _ in range(2):
        for label in labels:
            number = np.maximum(np.bincount(label), 1)
            values = values - (np.bincount(label, values) / number)[label]
    return values


def _scale(values: np.ndarray) -> float:
    return max(robust_sd(values), LEAST_SCALE_DB)


def _likeliest(compared: list[Compared], first: list[Compared],
               taken: list[_Found]) -> list[_Found]:
    """Return the most probable groups, at most `MAX_RIVALS`, of each group only once.

    No group is taken twice. Beside what was taken first, one that did not stand out then and is
    much smaller is its echo.
    """
    found, before = [], {table.key: table.log_odds for table in first}
    for table in compared:
        likely = table.log_odds > logit(LIKELY)
        for other in taken:
            if other.compared.key[:2] == table.key[:2]:
                likely[other.group] = False
        for other in taken[:1]:
            if other.compared.statistic == table.statistic:
                likely &= (before.get(table.key, table.log_odds) > logit(LIKELY)) | (
                    np.abs(table.distance.size) > ECHO * abs(other.size))
        found += [_Found(table, int(group)) for group in np.flatnonzero(likely)]
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


def _evidence(compared: list[Compared]) -> float:
    """Return how much stands out in all [nats]."""
    return float(sum(np.nansum(np.maximum(each.log_odds, 0.0)) for each in compared))


def _rows(found: _Found, readings: Readings) -> np.ndarray:
    rows = found.compared.family.members(found.group, len(readings))
    sight = found.compared.sight
    return rows & (readings.los if sight == "los" else ~readings.los if sight == "nlos" else True)


def _without(readings: Readings, found: _Found) -> Readings:
    """Return readings of which a group's size is taken off."""
    rows = _rows(found, readings)
    if found.compared.statistic == "blanks":
        excess = readings.blank_excess.copy()
        excess[rows] = np.nan
        return replace(readings, blank_excess=excess)
    if isinstance(found.compared.distance, Curves):
        return _without_curve(readings, found, found.compared.distance)
    return moved(readings, rows, found.compared.statistic, -found.size)


def _without_curve(readings: Readings, found: _Found, distance: Curves) -> Readings:
    residual_db, groups = readings.residual_db.copy(), found.compared.family.groups
    for sight in distance.bins:
        level_db = np.zeros(len(readings))
        level_db[groups.row] = distance.fitted(found.group, sight)[groups.group]
        rows = _rows(found, readings) & (readings.los == (sight == "los"))
        residual_db[rows] -= level_db[rows]
    return replace(readings, residual_db=residual_db)


def moved(readings: Readings, rows: np.ndarray, statistic: str, size: float) -> Readings:
    """Return readings with the level [dB] or log scatter of some rows (n,) off by a size more."""
    residual_db = readings.residual_db.copy()
    if statistic == "level":
        residual_db[rows] += size
    else:
        middle_db = np.nanmedian(residual_db[rows])
        residual_db[rows] = middle_db + (residual_db[rows] - middle_db) * np.exp(size)
    return replace(readings, residual_db=residual_db)


def _anomaly(found: _Found, readings: Readings) -> Anomaly:
    compared = found.compared
    members, ranges = compared.family.describe(found.group)
    if compared.family.name in ENDS:  # another end that has the same links may be meant
        labels = {end: getattr(readings, end) for end in ENDS}
        for other in (end for end in ENDS if end != compared.family.name):
            same = inseparable_pairs(labels[compared.family.name], labels[other])
            if found.group in same:
                members = {**members, other: (readings.names[other][same[found.group]],)}
    value, distance = found.size, compared.distance
    if isinstance(distance, Curves):
        low, high = (float(distance.sd(share)[found.group]) for share in (0.05, 0.95))
    else:
        error = QUANTILE_90 * float(distance.error[found.group])
        low, high = value - error, value + error
    if compared.statistic in ("scatter", "noise"):
        value, low, high = np.exp([value, low, high]).tolist()
    return Anomaly(compared.family.name, members, ranges, compared.sight,
                   "scatter" if compared.statistic == "noise" else compared.statistic,
                   Parameter(value, low, high, UNITS[compared.statistic]),
                   float(expit(found.log_odds)), _rows(found, readings),
                   along=compared.family.along)


