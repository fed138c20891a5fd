"""Scan held-out residuals for anomalies: groups of links that read otherwise than their peers.

Residuals are grouped by device, receiver, flight and their pairs, by time, direction, distance and
place. The level, scatter and share of blanks of each group is compared with those of its peers
(`radiotwin.inference.groups`). A greedy cover takes the group that explains most, subtracts its
deviation from the residuals, and scans again. So one faulty flight is reported once, and not as
its twenty-four pairs with devices.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import expit, logit

from radiotwin.closeloop.families import Family, Readings, combined_labels, families_of, units_of
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

# Prior standard deviation of the levels of faultless groups [dB]: tolerances of instruments,
# antennas and cables for ends, errors of the base by direction, place, distance and height.
PAIR_SPREAD_DB, SPREAD_DB = 0.6, {"device": 0.3, "receiver": 0.3, "flight": 0.3, "direction": 1.0,
                                  "place": 1.0, "distance": 2.0, "altitude": 2.0, "level": 2.0}
# The same as a share of the residual's scale, added in quadrature.
LOS_SHARE, NLOS_SHARE = 0.1, 0.4
LOS_DOF, NLOS_DOF = 60.0, 6.0  # Student-t degrees of freedom of these levels
BOTH_SHARE = 0.8  # share of anomalies that show in LoS and NLoS links alike
SCATTER_SPREAD, NOISE_SPREAD = 0.2, 0.3  # prior sd of the log scatter of faultless groups
LOS_BLANKS_SPREAD, NLOS_BLANKS_SPREAD = 0.03, 0.12  # prior sd of their share of blanks
LOS_CURVE_SHARE, NLOS_CURVE_SHARE = 0.08, 0.1  # sd of faultless curves over the residual's scale
# Standard deviation of anomalies: dB, dB, share; logarithm of the scatter.
ANYWHERE, ANYWHERE_LOG = {"level": 5.0, "curve": 3.0, "blanks": 0.3}, 0.8
# Prior odds that a family has an anomaly; of families that are not named.
ODDS, FAMILY_ODDS = {"device": 0.4, "receiver": 0.4, "flight": 0.4, "place": 1.0}, 0.03
PLACE_BOTH = 0.3  # `BOTH_SHARE` of places: a wrong building changes mostly NLoS links
LEAST_SCALE_DB = 0.5  # half a step of receivers that round to 1 dB
MAX_ANOMALIES = 10
LEFTOVER_SHARE = 1 / 3  # of the first anomaly's size, below which a later one may be left of it
MAX_CANDIDATES = 4  # groups that are tried, to take the one that explains most
MIN_PROBABILITY = 0.5  # below it a group is not an anomaly
MIN_LINKS = 60  # detected links with (or without) line of sight, to be judged apart
ENDS = "device", "receiver", "flight"
BASE_ERRORS = "distance", "altitude", "level"  # families that are judged by the raw residual
HEIGHTS_M, QUARTILES = (5.0, 20.0, 60.0), 4  # street, roofs, above: a base's bias differs [m]
UNITS = {"level": "dB", "curve": "dB", "scatter": "times", "noise": "times", "blanks": "share"}


@dataclass(frozen=True, eq=False)
class Anomaly:
    """A group of links that reads otherwise than its peers.

    Attributes:
        family: what its links share: `device`, `receiver`, `flight`, a pair such as
            `device x flight`, `time`, `direction`, `distance`, `altitude`, `level` or `place`.
        members: names of its devices, receivers and flights.
        ranges: lowest and highest value of each variable that bounds it, by name with unit.
        sight: which of its links differ: `los`, `nlos` or `all`.
        statistic: what differs: `level`, `scatter`, `blanks`, or `curve` (levels along a variable).
        size: difference from its peers with its 90 % interval: dB, times or share.
        probability: that it is real.
        rows: (n,) bool, its links.
        along: the variable along which a curve runs.
        causes: probability of each possible cause, by the effect's name; `another` = not in the
            catalogue. Empty until causes were searched for.
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
    """Log odds (k,) [nats] that k groups (or curves) of a family stand out by one statistic.

    They are of links of one `sight`: `los`, `nlos` or `all`; NaN or -inf if a group is not judged.
    `distance` has the deviations from the peers: dB, share of blanks, or log of the scatter ratio.
    """

    family: Family
    statistic: str
    sight: str
    distance: PeerComparison | Curves
    log_odds: np.ndarray

    @property
    def key(self) -> tuple[int, str, str]:
        """Identity of family, statistic and sight."""
        return id(self.family), self.statistic, self.sight


@dataclass(frozen=True)
class _Found:
    """One group of a comparison."""

    compared: Compared
    group: int

    @property
    def log_odds(self) -> float:
        return float(self.compared.log_odds[self.group])

    @property
    def deviation(self) -> float:
        """Deviation from the peers: dB, share of blanks, or logarithm of the scatter's ratio."""
        return float(self.compared.distance.size[self.group])


def scan(readings: Readings) -> list[Anomaly]:
    """Find groups of readings whose held-out residuals stand out, the most evident first.

    At most `MAX_ANOMALIES`, each with a probability over `MIN_PROBABILITY`. In each round the
    deviation of one group is subtracted from the residuals: the one that leaves least unexplained.
    """
    units = units_of(readings)
    families = list(families_of(readings, units))
    end_families = [each for each in families
                    if each.curve is None and (each.name in ENDS or each.pairs)]
    anomalies: list[Anomaly] = []
    found: list[_Found] = []
    remaining, first = readings, None
    while len(anomalies) < MAX_ANOMALIES:
        compared = log_odds_of_groups(remaining, families, units)
        first = first or compared
        candidates = _candidates(compared, first, found)
        if not candidates:
            break
        subtracted = [(each, _without_group(remaining, each)) for each in candidates]
        best = 0
        if len(subtracted) > 1:  # judged on devices, receivers, flights and their pairs only
            best = int(np.argmin([_total_log_odds(log_odds_of_groups(rest, end_families, units))
                                  - each.log_odds for each, rest in subtracted]))
        chosen, remaining = subtracted[best]
        found.append(chosen)
        anomalies.append(_anomaly(chosen, readings))
    return anomalies


@dataclass(frozen=True, eq=False)
class _ValuesOfOneSight:
    """Values of one statistic on the LoS links, or on the NLoS links.

    Attributes:
        values: (n,) such as residuals [dB]; NaN outside `rows`.
        rows: (n,) bool, links of the class.
        statistic: `level`, `scatter`, `noise` or `blanks`.
        is_los: whether these are the LoS links.
        scale_db: robust standard deviation of their residuals.
        units: labels of readings with correlated errors.
        lasting: how far errors of `rows` are correlated in those units.
        less_ends: cache: values minus the levels of some ends, by the ends' ids.
    """

    values: np.ndarray
    rows: np.ndarray
    statistic: str
    is_los: bool
    scale_db: float
    units: Units
    lasting: LastingErrors
    less_ends: dict[tuple[int, ...], np.ndarray] = field(default_factory=dict)

    def comparable_values(self, family: Family, groups: Groups) -> np.ndarray:
        """Subtract from the values (n,) the levels of a family's ends, such as of each device.

        If groups share devices and places (`is_crossing`), the lasting error of each place is
        subtracted from levels, too.
        """
        key = tuple(id(end) for end in family.ends)
        if key not in self.less_ends:
            values, ends = self.values.copy(), [end[self.rows] for end in family.ends]
            subtract = _less_group_means if self.statistic == "blanks" else median_polish
            values[self.rows] = subtract(values[self.rows], ends)
            self.less_ends[key] = values
        values = self.less_ends[key]
        if not family.is_crossing or self.statistic != "level":
            return values
        values = values.copy()
        values[groups.row] = subtract_unit_errors(values[groups.row], groups.group,
                                                  self.units.lasting_unit[groups.row])
        return values

    def compare(self, family: Family) -> PeerComparison | Curves | None:
        """Return how far a family's groups deviate from their peers in this class of links.

        None if fewer than two groups have enough links.
        """
        groups = family.groups.restrict_to(self.rows)
        if not len(groups.row):
            return None
        values = self.comparable_values(family, groups)
        in_class, scale_db = values[self.rows], self.scale_db
        if self.statistic == "level":
            # A Huber level is insensitive to outliers, so errors of units are clipped as well, and
            # divided by the share of values within the clip (the slope of Huber's influence).
            centred_db, clip_db = in_class - np.median(in_class), HUBER * scale_db
            clipped_db = self.lasting.sd(np.clip(centred_db, -clip_db, clip_db))
            lasting_db = clipped_db / float((np.abs(centred_db) < clip_db).mean())
            is_bin = family.curve is not None
            found = levels(values, groups, lasting_db, LEAST_SCALE_DB, is_bin)
            if family.curve is not None:
                usual_db = (LOS_CURVE_SHARE if self.is_los else NLOS_CURVE_SHARE) * scale_db
                part = "los" if self.is_los else "nlos"
                return compare_curves(found, family.curve, usual_db, part)
            spread_db = SPREAD_DB.get(family.name, PAIR_SPREAD_DB)
            share = LOS_SHARE if self.is_los else NLOS_SHARE
            prior_sd = float(np.hypot(spread_db, share * scale_db))
        elif self.statistic == "blanks":
            found = means(values, groups, self.lasting.sd(in_class))
            prior_sd = LOS_BLANKS_SPREAD if self.is_los else NLOS_BLANKS_SPREAD
            prior_sd *= 1 if family.name in ENDS else 2
        else:
            magnitude = np.minimum(np.abs(in_class) / scale_db, MAX_SCALES)
            # An instrument's noise is independent from reading to reading.
            lasting_sd = None if self.statistic == "noise" else \
                self.lasting.sd(magnitude / max(magnitude.mean(), TINY))
            found = log_scatters(values, groups, lasting_sd, scale_db)
            prior_sd = NOISE_SPREAD if self.statistic == "noise" else SCATTER_SPREAD
            prior_sd *= 1 if family.name in ENDS else 1.5
        if np.isfinite(found.value).sum() < 2:
            return None
        if family.pairs:
            found = subtract_end_levels(found, family.pairs)
        heavy_tailed = self.statistic == "level" and not self.is_los
        return compare_with_peers(found, prior_sd, NLOS_DOF if heavy_tailed else LOS_DOF)


def _classes(readings: Readings, units: Units) -> dict[str, dict[str, _ValuesOfOneSight]]:
    """Return by statistic the values of LoS links (`los`) and of NLoS links (`nlos`).

    `base` is the raw residual; `level` and `scatter` are relative to the usual error of such links.
    A class with fewer than `MIN_LINKS` detected links is left out.
    """
    usual_db = _usual_errors(readings)
    values = {"level": readings.residual_db - usual_db, "scatter": readings.residual_db - usual_db,
              "noise": readings.step_db, "blanks": readings.blank_excess,
              "base": readings.residual_db}
    found: dict[str, dict[str, _ValuesOfOneSight]] = {name: {} for name in values}
    detected = np.isfinite(readings.residual_db)
    for sight, is_los in (("los", True), ("nlos", False)):
        of_class = readings.los if is_los else ~readings.los
        if (of_class & detected).sum() < MIN_LINKS:
            continue
        scale_db = max(robust_sd(readings.residual_db[of_class & detected]), LEAST_SCALE_DB)
        for name, each in values.items():
            rows = of_class & np.isfinite(each)
            found[name][sight] = _ValuesOfOneSight(
                each, rows, "level" if name == "base" else name, is_los, scale_db, units,
                LastingErrors(units, rows))
    return found


def log_odds_of_groups(readings: Readings, families: list[Family], units: Units) -> list[Compared]:
    """Return the log odds that each group of the families deviates from its peers.

    Each statistic is compared among LoS links, NLoS links and both together (`all`). Less scatter
    or fewer blanks than the peers' are no fault: log odds of -inf.
    """
    found, classes = [], _classes(readings, units)
    family_count = Counter((family.name, family.curve is None) for family in families)
    for family in families:
        for statistic in family.statistics:
            is_base = family.name in BASE_ERRORS and statistic == "level"
            values_of = "base" if is_base else "level" if statistic == "curve" else statistic
            parts: dict[str, PeerComparison | Curves] = {}
            for name, each in classes[values_of].items():
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
                odds /= family_count[family.name, family.curve is None]
                if len(parts) > 1:
                    both_share = PLACE_BOTH if family.name == "place" else BOTH_SHARE
                    odds *= both_share if name == "all" else (1 - both_share) / 2
                log_odds = part.log_odds(outlier, odds)
                if statistic != "level":  # less scatter, or fewer blanks, is no fault
                    log_odds = np.where(part.size > 0, log_odds, -np.inf)
                found.append(Compared(family, statistic, name, part, log_odds))
    return found


def _together(parts: list[PeerComparison | Curves]) -> PeerComparison | Curves:
    """Combine the deviations from peers in LoS and in NLoS links, weighted by precision."""
    of_groups = [each for each in parts if isinstance(each, PeerComparison)]
    of_curves = [each for each in parts if isinstance(each, Curves)]
    return combine_parts(of_groups) if of_groups else combine_curves(of_curves)


def _usual_errors(readings: Readings) -> np.ndarray:
    """Return the median residual (n,) of links of similar height, distance and LoS state [dB].

    It is the base model's bias: by height class of the moving end, and quartile of the distance. It
    is 0 for links not detected, and where one receiver on several flights may have caused it.
    """
    detected = np.isfinite(readings.residual_db)
    height = np.searchsorted(HEIGHTS_M, readings.moving_m[:, 2])
    distance_m = np.linalg.norm(readings.receiver_m - readings.device_m, axis=1)
    cell = combined_labels(readings.los.astype(int), height)
    quartile = np.zeros(len(readings), dtype=np.int64)
    for each in np.unique(cell[detected]):
        rows = detected & (cell == each)
        edges = np.quantile(distance_m[rows], np.linspace(0, 1, QUARTILES + 1)[1:-1])
        quartile[rows] = np.searchsorted(edges, distance_m[rows])
    cell = combined_labels(cell, quartile)
    receivers, flights = (_count_distinct(label[detected], cell[detected], int(cell.max()) + 1)
                          for label in (readings.receiver, readings.track))
    rows = detected & ~((receivers == 1) & (flights > 1))[cell]
    median_db = np.zeros(len(readings))
    of_cell_db = medians(readings.residual_db[rows], cell[rows], int(cell.max()) + 1)
    median_db[rows] = of_cell_db[cell[rows]]
    return median_db


def _count_distinct(label: np.ndarray, cell: np.ndarray, cells: int) -> np.ndarray:
    """Count the distinct labels in each cell (cells,), given label and cell of each link (n,)."""
    labels = int(label.max(initial=0)) + 1
    return np.bincount(np.unique(cell * np.int64(labels) + label) // labels, minlength=cells)


def _less_group_means(values: np.ndarray, labels: list[np.ndarray]) -> np.ndarray:
    """Subtract the mean of each group of each label (n,) from values (n,), in two rounds."""
    for _ in range(2):
        for label in labels:
            number = np.maximum(np.bincount(label), 1)
            values = values - (np.bincount(label, values) / number)[label]
    return values


def _candidates(compared: list[Compared], first: list[Compared],
                known: list[_Found]) -> list[_Found]:
    """Return the most probable group of each family, up to `MAX_CANDIDATES`, by probability.

    If any exceeds `MIN_SURE`, the others are dropped. Excluded are groups already found (`known`),
    and what the subtraction of the first of them may have left: deviations in the same statistic by
    under `LEFTOVER_SHARE` of its own that did not stand out in the `first` comparison.
    """
    found, before = [], {table.key: table.log_odds for table in first}
    for table in compared:
        likely = table.log_odds > logit(MIN_PROBABILITY)
        for other in known:
            if other.compared.key[:2] == table.key[:2]:
                likely[other.group] = False
        for other in known[:1]:
            if other.compared.statistic == table.statistic:
                likely &= (before.get(table.key, table.log_odds) > logit(MIN_PROBABILITY)) | (
                    np.abs(table.distance.size) > LEFTOVER_SHARE * abs(other.deviation))
        found += [_Found(table, int(group)) for group in np.flatnonzero(likely)]
    best: dict[str, _Found] = {}
    for each in sorted(found, key=lambda each: -each.log_odds):
        best.setdefault(each.compared.family.name, each)
    # Only sure groups if any: a receiver that scatters, not a flight of it that may explain more.
    sure = [each for each in best.values() if each.log_odds > logit(MIN_SURE)]
    return (sure or list(best.values()))[:MAX_CANDIDATES]


def _total_log_odds(compared: list[Compared]) -> float:
    """Sum the positive log odds of all groups [nats]: how much still stands out."""
    return float(sum(np.nansum(np.maximum(each.log_odds, 0.0)) for each in compared))


def _rows(found: _Found, readings: Readings) -> np.ndarray:
    """Return the mask (n,) of a group's links that stand out: its LoS, NLoS or all links."""
    rows = found.compared.family.members(found.group, len(readings))
    sight = found.compared.sight
    return rows & (readings.los if sight == "los" else ~readings.los if sight == "nlos" else True)


def _without_group(readings: Readings, found: _Found) -> Readings:
    """Subtract a group's deviation from its residuals; if it is of blanks, set them to NaN."""
    rows = _rows(found, readings)
    if found.compared.statistic == "blanks":
        excess = readings.blank_excess.copy()
        excess[rows] = np.nan
        return replace(readings, blank_excess=excess)
    if isinstance(found.compared.distance, Curves):
        return _without_curve(readings, found, found.compared.distance)
    return shift_group(readings, rows, found.compared.statistic, -found.deviation)


def _without_curve(readings: Readings, found: _Found, distance: Curves) -> Readings:
    """Subtract a group's fitted curve from its residuals, separately for LoS and NLoS links."""
    residual_db, groups = readings.residual_db.copy(), found.compared.family.groups
    for sight in distance.bins:
        level_db = np.zeros(len(readings))
        level_db[groups.row] = distance.fitted(found.group, sight)[groups.group]
        rows = _rows(found, readings) & (readings.los == (sight == "los"))
        residual_db[rows] -= level_db[rows]
    return replace(readings, residual_db=residual_db)


def shift_group(readings: Readings, rows: np.ndarray, statistic: str, size: float) -> Readings:
    """Shift the level of some readings, or scale their scatter around the median.

    Args:
        readings: n readings.
        rows: (n,) bool, readings to change.
        statistic: `level`, or any other for the scatter.
        size: shift of the level [dB], or natural logarithm of the scatter's factor.
    """
    residual_db = readings.residual_db.copy()
    if statistic == "level":
        residual_db[rows] += size
    else:
        middle_db = np.nanmedian(residual_db[rows])
        residual_db[rows] = middle_db + (residual_db[rows] - middle_db) * np.exp(size)
    return replace(readings, residual_db=residual_db)


def _anomaly(found: _Found, readings: Readings) -> Anomaly:
    """Describe a group that stands out: its names, ranges, size with interval and probability."""
    compared = found.compared
    members, ranges = compared.family.describe(found.group)
    if compared.family.name in ENDS:  # also name another end that has exactly the same links
        labels = {end: getattr(readings, end) for end in ENDS}
        for other in (end for end in ENDS if end != compared.family.name):
            partner = inseparable_pairs(labels[compared.family.name], labels[other])
            if found.group in partner:
                members = {**members, other: (readings.names[other][partner[found.group]],)}
    value, distance = found.deviation, compared.distance
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


