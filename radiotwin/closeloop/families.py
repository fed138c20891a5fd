"""Group links by device, receiver, flight, time, direction, distance or place, to compare them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import ndtr

from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.inference.groups import Groups, Units
from radiotwin.links.correlation import moving_end_m

# Squares within which errors are correlated [m]: in one flight; in all flights (errors of the map).
PASSING_M, LASTING_M = 25.0, 75.0
SECTORS, BANDS, WINDOWS = 8, 8, (2, 4, 8, 16, 32)  # directions; distance bands; windows a flight
# Links through a place: points sampled along a link, greatest height there [m], square sides [m].
RAY_SAMPLES, LOW_M, GRID_M = 24, 40.0, (25.0, 50.0, 100.0)
READINGS_A_BIN, MAX_WINDOWS, LEVEL_BANDS, CURVE_SECTOR_DEG = 40, 64, 12, 22.5  # bins of curves
Description = tuple[dict[str, tuple[str, ...]], dict[str, tuple[float, float]]]
"""Names of a group's devices, receivers and flights; ranges of the variables that bound it."""


@dataclass(frozen=True, eq=False)
class Readings:
    """n readings with their held-out prediction.

    Attributes:
        residual_db: (n,) measured minus predicted [dB]; NaN if not detected or not predicted.
        blank_excess: (n,) 1 if not detected (blank), else 0, minus the predicted probability of 1.
        los: (n,) bool, line of sight.
        device, receiver, flight: (n,) int indices into `names`.
        time_s: (n,) [s]; NaN if unknown.
        moving_m: (n, 3) position of the moving end of the link [m].
        device_m, receiver_m: (n, 3) positions of both ends [m]; NaN if not located.
        angles_deg: (n,) "azimuth" and "elevation" at the device, "body azimuth" at the receiver
            [degree]; NaN if unknown.
        predicted_db: (n,) mean level, predicted as if there were no limit of detection [dB].
        names: names by "device", "receiver" and "flight".
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
        """(n,) label of each pair of receiver and flight."""
        return combined_labels(self.receiver, self.flight)

    @cached_property
    def previous(self) -> np.ndarray:
        """(n,) row of the previous reading of the same link in the flight; -1 for the first."""
        series = combined_labels(self.device, self.receiver, self.flight)
        order = np.lexsort((np.arange(len(self)), self.time_s, series))
        found = np.full(len(self), -1)
        follows = series[order[1:]] == series[order[:-1]]
        found[order[1:][follows]] = order[:-1][follows]
        return found

    @property
    def step_db(self) -> np.ndarray:
        """(n,) change of the residual since the previous reading of the same link, over √2 [dB].

        It estimates the receiver's noise, since errors of the map change slowly along a track. NaN
        for the first reading, and where line of sight changes.
        """
        previous = self.previous
        same_sight = (previous >= 0) & (self.los == self.los[previous])
        change_db = self.residual_db - self.residual_db[previous]
        return np.where(same_sight, change_db / np.sqrt(2), np.nan)

    @classmethod
    def of(cls, model: CrossFit) -> Readings:
        """Return the readings of a model's links with their held-out prediction."""
        links, level_db = model.links, model.links.level_db
        mean_db, scale_db = model.held_out_reading
        if_detected_db = model.held_out_mean_db
        with np.errstate(invalid="ignore"):
            blank_probability = ndtr((links.limit_db - mean_db) / scale_db)
        blank_excess = np.where(np.isnan(level_db), 1.0, 0.0) - blank_probability
        return cls(level_db - if_detected_db, blank_excess, links.los, links.device, links.receiver,
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
    """Groups of links that are compared with each other, such as all receivers.

    Attributes:
        name: what the links of a group share: `device`, `direction`, `place`, …
        groups: the k groups of links.
        describe: returns the names and ranges of a group (or of a curve) by its number.
        ends: labels (n,) of ends whose mean levels are subtracted before the comparison.
        statistics: names of the statistics to compare.
        pairs: if groups are pairs of ends, the label (k,) of each end.
        is_crossing: whether several groups may contain readings of one device at one place.
        curve: (k,) if groups are bins of curves, the curve of each; None: groups are judged singly.
        along: variable along which curves run, with its unit.
    """

    name: str
    groups: Groups
    describe: Callable[[int], Description]
    ends: tuple[np.ndarray, ...] = ()
    statistics: tuple[str, ...] = ("level", "noise", "scatter", "blanks")
    pairs: tuple[np.ndarray, ...] = ()
    is_crossing: bool = False
    curve: np.ndarray | None = None
    along: str = ""

    def members(self, group: int, n: int) -> np.ndarray:
        """Return the mask (n,) of the links in a group, or in all bins of a curve."""
        if self.curve is None:
            return self.groups.members(group, n)
        rows = np.zeros(n, dtype=bool)
        rows[self.groups.row[self.curve[self.groups.group] == group]] = True
        return rows


def units_of(readings: Readings) -> Units:
    """Label readings that share errors, by squares of ground around the moving end.

    Readings of one flight in a square of `PASSING_M` share errors of that moment. Readings of one
    device in a square of `LASTING_M` share errors of the map, on all flights.
    """
    passing, lasting = (_squares_of(readings.moving_m, width_m)
                        for width_m in (PASSING_M, LASTING_M))
    return Units(combined_labels(*passing.T, readings.flight),
                 combined_labels(*lasting.T, readings.device))


def _squares_of(position_m: np.ndarray, width_m: float) -> np.ndarray:
    """Return the ground square (n, 2) of each position (n, 3) [m], as indices; NaN counts as 0."""
    return np.floor(np.nan_to_num(position_m[:, :2]) / width_m).astype(np.int64)


def combined_labels(*labels: np.ndarray) -> np.ndarray:
    """Return consecutive numbers (n,) of the combinations of several labels (n,)."""
    code = np.zeros(len(labels[0]), dtype=np.int64)
    for label in labels:
        code = code * (int(np.ptp(label)) + 1 if len(label) else 1) + (label - label.min(initial=0))
    return np.unique(code, return_inverse=True)[1].ravel()


def _renumber(label: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Renumber labels (n,) consecutively from 0 within a mask (n,); -1 outside it."""
    code = np.full(len(label), -1)
    code[known] = np.unique(label[known], return_inverse=True)[1].ravel()
    return code


def families_of(readings: Readings, units: Units) -> Iterator[Family]:
    """Yield all families: sets of groups that are compared with each other, e.g. all receivers.

    Args:
        readings: n readings.
        units: labels of readings with correlated errors, see `units_of`.
    """
    labels = {"device": readings.device, "receiver": readings.receiver, "flight": readings.flight}
    varying = {name: label for name, label in labels.items() if len(np.unique(label)) > 1}
    for name, label in varying.items():
        def describe(group: int, name: str = name) -> Description:
            return {name: (readings.names[name][group],)}, {}
        nested_in: tuple[np.ndarray, ...] = ()
        if name == "flight" and "receiver" in varying and _is_nested(label, readings.receiver):
            nested_in = (readings.receiver,)  # flights of one receiver share its level
        yield Family(name, Groups.of_labels(label, units), describe, is_crossing=name != "device",
                     pairs=tuple(end[_row_of_label(label)] for end in nested_in))
    for first, second in (("device", "flight"), ("receiver", "flight"), ("device", "receiver")):
        if first in varying and second in varying:
            yield from _pairs(readings, first, second, labels, units)
    yield from _windows(readings, units)
    yield from _directions(readings, units)
    yield from _bands(readings, units)
    yield from _places(readings, units)
    yield from _curves(readings, units)


def _pairs(readings: Readings, first: str, second: str,
           labels: Mapping[str, np.ndarray], units: Units) -> Iterator[Family]:
    """Yield pairs such as device and flight; none if each member of one kind has one partner."""
    first_label, second_label = labels[first], labels[second]
    code = combined_labels(first_label, second_label)
    count = int(code.max()) + 1
    if count in (len(np.unique(first_label)), len(np.unique(second_label))):
        return
    row_of_pair = _row_of_label(code)

    def describe(group: int) -> Description:
        row = row_of_pair[group]
        return {first: (readings.names[first][first_label[row]],),
                second: (readings.names[second][second_label[row]],)}, {}

    yield Family(f"{first} x {second}", Groups.of_labels(code, units), describe,
                 statistics=("level", "noise", "scatter"),
                 pairs=(first_label[row_of_pair], second_label[row_of_pair]), is_crossing=True)


def _is_nested(label: np.ndarray, within: np.ndarray) -> bool:
    """Return whether each label (n,) occurs within only one of fewer outer labels `within` (n,)."""
    pairs = len(np.unique(combined_labels(label, within)))
    return pairs == len(np.unique(label)) and pairs > len(np.unique(within))


def _row_of_label(label: np.ndarray) -> np.ndarray:
    """Return the last row with each label 0, 1, …; 0 for labels that do not occur."""
    row = np.zeros(int(label.max()) + 1, dtype=np.int64)
    row[label] = np.arange(len(label))
    return row


def _windows(readings: Readings, units: Units) -> Iterator[Family]:
    """Yield windows of time of each flight, for all its receivers together and for each receiver.

    A flight is cut into 2, 4, … 32 equal windows, and again shifted by half a window. Nothing is
    yielded if under half of the readings have a time.
    """
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
                code = _renumber(label * (number + 1) + window, timed)
                yield Family("time", Groups.of_labels(code, units),
                             _describe_window(readings, scope, code), ends, ("level", "blanks"),
                             is_crossing=True)


def _share_of_time(readings: Readings, label: np.ndarray) -> np.ndarray:
    """Return each time (n,) as a share, 0 to below 1, of its label's duration; 0 if not known."""
    begin_s, end_s = np.full(label.max() + 1, np.inf), np.full(label.max() + 1, -np.inf)
    known = np.isfinite(readings.time_s)
    np.minimum.at(begin_s, label[known], readings.time_s[known])
    np.maximum.at(end_s, label[known], readings.time_s[known])
    share = (readings.time_s - begin_s[label]) / np.maximum(end_s - begin_s, 1e-9)[label]
    return np.clip(np.nan_to_num(share), 0, 1 - 1e-9)


def _describe_window(readings: Readings, scope: str, code: np.ndarray) -> Callable:
    """Return the function that names flight, receiver and time range of each window in `code`."""
    def describe(group: int) -> Description:
        rows = code == group
        flight = readings.flight[rows][0]
        members: dict[str, tuple[str, ...]] = {"flight": (readings.names["flight"][flight],)}
        if scope == "receiver":
            members["receiver"] = (readings.names["receiver"][readings.receiver[rows][0]],)
        time_s = readings.time_s[rows]
        return members, {"time_s": (float(time_s.min()), float(time_s.max()))}
    return describe


def _directions(readings: Readings, units: Units) -> Iterator[Family]:
    """Yield sectors of azimuth and elevation at each device, and of body azimuth at receivers.

    They are 45° and 22.5° wide, and yielded again shifted by half. An angle is left out if under
    half of the readings have it.
    """
    for angle, end, kind in (("azimuth", readings.device, "device"),
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
            code = _renumber(combined_labels(end, sector), known)

            def describe(group: int, code: np.ndarray = code, end: np.ndarray = end,
                         kind: str = kind, angle: str = angle, shift: float = shift,
                         width: float = width, values: np.ndarray = values
                         ) -> Description:
                row = np.flatnonzero(code == group)[0]
                low = (np.floor(values[row] / width + shift) - shift) * width
                return ({kind: (readings.names[kind][end[row]],)},
                        {f"{angle.replace(' ', '_')}_deg": (float(low), float(low + width))})
            yield Family("direction", Groups.of_labels(code, units), describe, (end, sector),
                         ("level",))


def _bands(readings: Readings, units: Units) -> Iterator[Family]:
    """Yield bands of distance, moving end's altitude and predicted level, of equally many links."""
    distance_m = np.linalg.norm(readings.receiver_m - readings.device_m, axis=1)
    for name, values, key in (("distance", distance_m, "distance_m"),
                              ("altitude", readings.moving_m[:, 2], "height_m"),
                              ("level", readings.predicted_db, "predicted_db")):
        known = np.isfinite(values)
        edges = _quantiles(values, BANDS)
        if len(edges) < 2:
            continue
        code = _renumber(np.searchsorted(edges, values), known)

        def describe(group: int, code: np.ndarray = code, values: np.ndarray = values,
                     key: str = key
                     ) -> Description:
            rows = code == group
            return {}, {key: (float(values[rows].min()), float(values[rows].max()))}
        yield Family(name, Groups.of_labels(code, units), describe, (readings.device,),
                     ("level", "scatter"))


def _curves(readings: Readings, units: Units) -> Iterator[Family]:
    """Yield curves: levels of each device, receiver or flight in bins along one variable.

    The variable is time, flight, body azimuth or predicted level; left out if under half of the
    readings have it. A device has no curve over direction: a wrong building nearby would change it.
    """
    track, device, receiver = readings.track, readings.device, readings.receiver
    timed, predicted_db = np.isfinite(readings.time_s), readings.predicted_db
    body_deg = readings.angles_deg["body azimuth"]
    ends = device, track
    by_receiver, by_flight = (_window_of_reading(readings, label, READINGS_A_BIN)
                              for label in (track, readings.flight))
    windows = _window_of_reading(readings, readings.flight, READINGS_A_BIN * len(np.unique(device)))
    sector = np.floor(np.nan_to_num(body_deg) / CURVE_SECTOR_DEG).astype(np.int64)
    level = np.searchsorted(_quantiles(predicted_db, LEVEL_BANDS), predicted_db)
    for end, along, bins, known, subtracted in (
            ("receiver", "time_s", (track, by_receiver), timed, ends),
            ("receiver", "flight", (readings.flight,), None, (device, receiver)),
            ("receiver", "body_azimuth_deg", (sector,), np.isfinite(body_deg), ends),
            ("receiver", "predicted_db", (level,), np.isfinite(predicted_db), ends),
            ("flight", "time_s", (by_flight,), timed, ends),
            ("device", "time_s", (readings.flight, windows), timed, ends),
            ("device", "flight", (readings.flight,), None, ends)):
        label = getattr(readings, end)
        known = np.ones(len(readings), dtype=bool) if known is None else known
        if known.mean() < 0.5 or (along == "flight" and readings.flight.max() == 0):
            continue
        code = _renumber(combined_labels(label, *bins), known)

        def describe(group: int, end: str = end) -> Description:
            return {end: (readings.names[end][group],)}, {}
        yield Family(end, Groups.of_labels(code, units), describe, subtracted, ("curve",),
                     is_crossing=True, curve=label[known][_row_of_label(code[known])], along=along)


def _window_of_reading(readings: Readings, label: np.ndarray, count: int) -> np.ndarray:
    """Return each reading's window (n,) in its label's time: 2 to `MAX_WINDOWS` of `count`."""
    number = np.clip(np.bincount(label) // count, 2, MAX_WINDOWS)
    return np.floor(_share_of_time(readings, label) * number[label]).astype(np.int64)


def _quantiles(values: np.ndarray, count: int) -> np.ndarray:
    """Return the inner edges of up to `count` bands with equally many known values (n,)."""
    known = np.isfinite(values)
    return np.unique(np.quantile(values[known], np.linspace(0, 1, count + 1)[1:-1])) \
        if known.any() else np.zeros(0)


def _places(readings: Readings, units: Units) -> Iterator[Family]:
    """Yield ground squares that hold the moving end of links, or that links cross below `LOW_M`."""
    fraction = (np.arange(RAY_SAMPLES) + 0.5) / RAY_SAMPLES
    along_m = readings.device_m[:, None] + fraction[:, None] * (
        readings.receiver_m - readings.device_m)[:, None]
    low = along_m[..., 2] < LOW_M
    link = np.broadcast_to(np.arange(len(readings))[:, None], low.shape)[low]
    ends = readings.device, readings.track
    for width_m in GRID_M:
        square = _squares_of(readings.moving_m, width_m)
        yield _square_family(np.arange(len(readings)), square, width_m, ends, units)
        crossed = _squares_of(along_m[low], width_m)
        if len(crossed):
            yield _square_family(link, crossed, width_m, ends, units)


def _square_family(link: np.ndarray, cell: np.ndarray, width_m: float,
                   ends: tuple[np.ndarray, ...], units: Units) -> Family:
    """Return a family with one group for each square of ground: the links in it, or across it.

    `link` (m,) and `cell` (m, 2) are pairs of a link and a square that it is in; they may repeat.
    """
    least = cell.min(axis=0)
    columns = np.int64(np.ptp(cell[:, 1]) + 1)
    code, group = np.unique((cell - least) @ np.array([columns, 1]), return_inverse=True)
    squares, count = np.column_stack(np.divmod(code, columns)) + least, len(code)
    pair = np.unique(link * np.int64(count) + group.ravel())  # once for each link

    def describe(group: int) -> Description:
        low_m = squares[group] * width_m
        return {}, {name: (float(low), float(low + width_m))
                    for name, low in zip(("x_m", "y_m"), low_m, strict=True)}
    return Family("place", Groups.of_members(pair // count, pair % count, count, units),
                  describe, ends, ("level",))
