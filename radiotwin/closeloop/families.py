"""Groups that links may be compared in: by ends, flights, times, directions, distances, places."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import ndtr

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.inference.groups import Groups, Units
from radiotwin.links.correlation import moving_end_m

PASSING_M, LASTING_M = 25.0, 75.0  # errors of one flight, and of the map, are alike within
SECTORS, BANDS, WINDOWS = 8, 8, (2, 4, 8, 16, 32)
RAY_SAMPLES, LOW_M, GRID_M = 24, 40.0, (25.0, 50.0, 100.0)  # of links that pass through a place
READINGS_A_BIN, MAX_WINDOWS, LEVEL_BANDS, CURVE_SECTOR_DEG = 40, 64, 12, 22.5  # of curves
Words = tuple[dict[str, tuple[str, ...]], dict[str, tuple[float, float]]]
"""Members and ranges of a group."""


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
    def track(self) -> np.ndarray:
        """(n,) number of each receiver's flight."""
        return codes_of(self.receiver, self.flight)

    @cached_property
    def previous(self) -> np.ndarray:
        """(n,) row of the reading before, of the same ends and flight; -1 where there is none."""
        series = codes_of(self.device, self.receiver, self.flight)
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
        curve: (k,) of groups that are bins of curves, the number of each one's curve, of which
            `describe` tells; None: each group is judged by itself.
        along: of curves, the variable that they go along, with unit.
    """

    name: str
    groups: Groups
    describe: Callable[[int], Words]
    ends: tuple[np.ndarray, ...] = ()
    statistics: tuple[str, ...] = ("level", "noise", "scatter", "blanks")
    pairs: tuple[np.ndarray, ...] = ()
    is_crossing: bool = False
    curve: np.ndarray | None = None
    along: str = ""

    def members(self, group: int, n: int) -> np.ndarray:
        """Return the mask (n,) of the rows of a group, or of a curve."""
        if self.curve is None:
            return self.groups.members(group, n)
        rows = np.zeros(n, dtype=bool)
        rows[self.groups.row[self.curve[self.groups.group] == group]] = True
        return rows


def units_of(readings: Readings) -> Units:
    """Return which readings err alike: of one flight nearby; of one device, in a larger place."""
    passing, lasting = (_squares_of(readings.moving_m, width_m)
                        for width_m in (PASSING_M, LASTING_M))
    return Units(codes_of(*passing.T, readings.flight), codes_of(*lasting.T, readings.device))


def _squares_of(position_m: np.ndarray, width_m: float) -> np.ndarray:
    """Return the square (n, 2) of each position (n, 3); 0 of one that is not known."""
    return np.floor(np.nan_to_num(position_m[:, :2]) / width_m).astype(np.int64)


def codes_of(*labels: np.ndarray) -> np.ndarray:
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


def families_of(readings: Readings, units: Units) -> Iterator[Family]:
    """Yield all families of groups, with the units in which errors are alike."""
    labels = {"device": readings.device, "receiver": readings.receiver, "flight": readings.flight}
    several = {name: label for name, label in labels.items() if len(np.unique(label)) > 1}
    for name, label in several.items():
        def describe(group: int, name: str = name) -> Words:
            return {name: (readings.names[name][group],)}, {}
        within: tuple[np.ndarray, ...] = ()
        if name == "flight" and "receiver" in several and _is_nested(label, readings.receiver):
            within = (readings.receiver,)  # flights of one receiver share its level
        yield Family(name, Groups.of_labels(label, units), describe, is_crossing=name != "device",
                     pairs=tuple(end[_examples(label)] for end in within))
    for first, second in (("device", "flight"), ("receiver", "flight"), ("device", "receiver")):
        if first in several and second in several:
            yield from _pairs(readings, first, second, labels, units)
    yield from _windows(readings, units)
    yield from _directions(readings, units)
    yield from _bands(readings, units)
    yield from _places(readings, units)
    yield from _curves(readings, units)


def _pairs(readings: Readings, first: str, second: str,
           labels: Mapping[str, np.ndarray], units: Units) -> Iterator[Family]:
    one, other = labels[first], labels[second]
    code = codes_of(one, other)
    count = int(code.max()) + 1
    if count in (len(np.unique(one)), len(np.unique(other))):
        return  # the two never part
    example = _examples(code)

    def describe(group: int) -> Words:
        row = example[group]
        return {first: (readings.names[first][one[row]],),
                second: (readings.names[second][other[row]],)}, {}

    yield Family(f"{first} x {second}", Groups.of_labels(code, units), describe,
                 statistics=("level", "noise", "scatter"),
                 pairs=(one[example], other[example]), is_crossing=True)


def _is_nested(label: np.ndarray, within: np.ndarray) -> bool:
    """Return whether links of each label (n,) share one of fewer labels within (n,)."""
    pairs = len(np.unique(codes_of(label, within)))
    return pairs == len(np.unique(label)) and pairs > len(np.unique(within))


def _examples(label: np.ndarray) -> np.ndarray:
    """Return one row of each label from 0 on; row 0 for one that no link has."""
    example = np.zeros(int(label.max()) + 1, dtype=np.int64)
    example[label] = np.arange(len(label))
    return example


def _windows(readings: Readings, units: Units) -> Iterator[Family]:
    """Yield windows of time within flights, of all receivers and of one."""
    timed = np.isfinite(readings.time_s)
    if timed.mean() < 0.5:
        return
    track = readings.track
    ends = readings.device, track
    scopes = [("flight", readings.flight)]
    if len(np.unique(track)) > len(np.unique(readings.flight)):
        scopes.append(("receiver", track))
    for scope, label in scopes:
        share = _share_of_time(readings, label)
        for number in WINDOWS:
            for shift in (0.0, 0.5):
                window = np.floor(share * number + shift).astype(np.int64)
                code = _packed(label * (number + 1) + window, timed)
                yield Family("time", Groups.of_labels(code, units),
                             _time_words(readings, scope, code), ends, ("level", "blanks"),
                             is_crossing=True)


def _share_of_time(readings: Readings, label: np.ndarray) -> np.ndarray:
    """Return the share (n,) of its label's time that has passed, below 1; 0 where unknown."""
    begin, end = _extremes(readings.time_s, label)
    share = (readings.time_s - begin[label]) / np.maximum(end - begin, 1e-9)[label]
    return np.clip(np.nan_to_num(share), 0, 1 - 1e-9)


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


def _directions(readings: Readings, units: Units) -> Iterator[Family]:
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
            code = _packed(codes_of(end, sector), known)

            def describe(group: int, code: np.ndarray = code, end: np.ndarray = end,
                         names: str = names, angle: str = angle, shift: float = shift,
                         width: float = width, values: np.ndarray = values
                         ) -> Words:
                row = np.flatnonzero(code == group)[0]
                low = (np.floor(values[row] / width + shift) - shift) * width
                return ({names: (readings.names[names][end[row]],)},
                        {f"{angle.replace(' ', '_')}_deg": (float(low), float(low + width))})
            yield Family("direction", Groups.of_labels(code, units), describe, (end, sector),
                         ("level",))


def _bands(readings: Readings, units: Units) -> Iterator[Family]:
    """Yield bands of distance, altitude and level, of all links."""
    distance_m = np.linalg.norm(readings.receiver_m - readings.device_m, axis=1)
    for name, values, key in (("distance", distance_m, "distance_m"),
                              ("altitude", readings.moving_m[:, 2], "height_m"),
                              ("level", readings.predicted_db, "predicted_db")):
        known = np.isfinite(values)
        edges = _quantiles(values, BANDS)
        if len(edges) < 2:
            continue
        code = _packed(np.searchsorted(edges, values), known)

        def describe(group: int, code: np.ndarray = code, values: np.ndarray = values,
                     key: str = key
                     ) -> Words:
            rows = code == group
            return {}, {key: (float(values[rows].min()), float(values[rows].max()))}
        yield Family(name, Groups.of_labels(code, units), describe, (readings.device,),
                     ("level", "scatter"))


def _curves(readings: Readings, units: Units) -> Iterator[Family]:
    """Yield how the levels of each device, receiver and flight go along a variable.

    A device's levels by direction are left to the directions: a wrong building nearby changes them.
    """
    track, device, receiver = readings.track, readings.device, readings.receiver
    timed, predicted_db = np.isfinite(readings.time_s), readings.predicted_db
    body_deg = readings.angles_deg["body azimuth"]
    ends = device, track
    by_receiver, by_flight = (_windows_of(readings, label, READINGS_A_BIN)
                              for label in (track, readings.flight))
    few = _windows_of(readings, readings.flight, READINGS_A_BIN * len(np.unique(device)))
    sector = np.floor(np.nan_to_num(body_deg) / CURVE_SECTOR_DEG).astype(np.int64)
    level = np.searchsorted(_quantiles(predicted_db, LEVEL_BANDS), predicted_db)
    for end, along, bins, known, off in (
            ("receiver", "time_s", (track, by_receiver), timed, ends),
            ("receiver", "flight", (readings.flight,), None, (device, receiver)),
            ("receiver", "body_azimuth_deg", (sector,), np.isfinite(body_deg), ends),
            ("receiver", "predicted_db", (level,), np.isfinite(predicted_db), ends),
            ("flight", "time_s", (by_flight,), timed, ends),
            ("device", "time_s", (readings.flight, few), timed, ends),
            ("device", "flight", (readings.flight,), None, ends)):
        label = getattr(readings, end)
        known = np.ones(len(readings), dtype=bool) if known is None else known
        if known.mean() < 0.5 or (along == "flight" and readings.flight.max() == 0):
            continue
        code = _packed(codes_of(label, *bins), known)

        def describe(group: int, end: str = end) -> Words:
            return {end: (readings.names[end][group],)}, {}
        yield Family(end, Groups.of_labels(code, units), describe, off, ("curve",),
                     is_crossing=True, curve=label[known][_examples(code[known])], along=along)


def _windows_of(readings: Readings, label: np.ndarray, count: int) -> np.ndarray:
    """Return the window (n,) of time within its label (n,), of about `count` readings each."""
    number = np.clip(np.bincount(label) // count, 2, MAX_WINDOWS)
    return np.floor(_share_of_time(readings, label) * number[label]).astype(np.int64)


def _quantiles(values: np.ndarray, count: int) -> np.ndarray:
    """Return the different edges between `count` bands with as many known values each."""
    known = np.isfinite(values)
    return np.unique(np.quantile(values[known], np.linspace(0, 1, count + 1)[1:-1])) \
        if known.any() else np.zeros(0)


def _places(readings: Readings, units: Units) -> Iterator[Family]:
    """Yield squares of ground that links end in, or pass low above."""
    share = (np.arange(RAY_SAMPLES) + 0.5) / RAY_SAMPLES
    along_m = readings.device_m[:, None] + share[:, None] * (
        readings.receiver_m - readings.device_m)[:, None]
    low = along_m[..., 2] < LOW_M
    link = np.broadcast_to(np.arange(len(readings))[:, None], low.shape)[low]
    ends = readings.device, readings.track
    for width_m in GRID_M:
        end = _squares_of(readings.moving_m, width_m)
        yield _squares(np.arange(len(readings)), end, width_m, ends, units)
        cell = _squares_of(along_m[low], width_m)
        if len(cell):
            yield _squares(link, cell, width_m, ends, units)


def _squares(link: np.ndarray, cell: np.ndarray, width_m: float, ends: tuple[np.ndarray, ...],
             units: Units) -> Family:
    least = cell.min(axis=0)
    columns = np.int64(np.ptp(cell[:, 1]) + 1)
    code, group = np.unique((cell - least) @ np.array([columns, 1]), return_inverse=True)
    squares, count = np.column_stack(np.divmod(code, columns)) + least, len(code)
    pair = np.unique(link * np.int64(count) + group.ravel())  # once for each link

    def describe(group: int) -> Words:
        low_m = squares[group] * width_m
        return {}, {name: (float(low), float(low + width_m))
                    for name, low in zip(("x_m", "y_m"), low_m, strict=True)}
    return Family("place", Groups.of_members(pair // count, pair % count, count, units),
                  describe, ends, ("level",))
