"""Tracks in text: GPX [1], KML (OGC 12-007r2), GeoJSON, and NMEA 0183.

A track of KML (`Track` of 2.3 and `gx:Track` before) is a list of `when` and one of `coord`;
placemarks with a time and a point are a track, too. A line of GeoJSON has its times in the property
`coordTimes` or `times`, as converters write them. Of NMEA, GGA has the height and no date, RMC and
ZDA have the date.

[1] https://www.topografix.com/GPX/1/1/
"""

import io
from abc import abstractmethod
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.importing.log_files import Lines
from radiotwin.importing.tracks.fixes import ANGLES, PLACE, Fixes, make_fixes
from radiotwin.io.budgets import DOCUMENT_BYTES, ROWS
from radiotwin.io.cells import cell_text
from radiotwin.io.inputs import open_gzip, parse_elements, parse_json

_DAY_S = 86_400.0
_CENTURY = 80  # years below it are of this century
_MAX_TEXT = 200  # characters of a time, a place or angles


def read_nmea(path: Path) -> Fixes:
    """Read the track in an NMEA 0183 log; damaged sentences are left out, with a note.

    Raises:
        BadInput: no date, or fewer than two positions.
    """
    rows: list[list[float]] = []  # seconds of the day, day, latitude, longitude, height
    day = np.nan
    damaged = 0
    with open_gzip(path, "NMEA file") as content, \
            io.TextIOWrapper(content, "ascii", "replace", newline="") as text:
        for line in Lines(text, path):
            fields, is_damaged = _sentence(line)
            damaged += is_damaged
            kind = fields[0][-3:]
            try:
                if kind == "ZDA":
                    day = _day(int(fields[4]), int(fields[3]), int(fields[2]))
                    if rows and fields[1] and rows[-1][0] == _seconds(fields[1]):
                        rows[-1][1] = day
                elif kind == "RMC" and fields[2] == "A":
                    year = int(fields[9][4:6])
                    year += 2000 if year < _CENTURY else 1900
                    day = _day(year, int(fields[9][2:4]), int(fields[9][:2]))
                    _add(rows, _seconds(fields[1]), day, fields[3:7], np.nan)
                elif kind == "GGA" and fields[6] not in ("", "0"):
                    height_m = float(fields[9]) if fields[9] else np.nan
                    _add(rows, _seconds(fields[1]), day, fields[2:6], height_m)
            except (ValueError, IndexError, OverflowError):
                damaged += 1
            ROWS.check(len(rows), path)
    columns = np.array(rows, dtype=float).reshape(-1, 5).T
    if len(rows) and np.isnan(columns[1]).all():
        raise BadInput(f"{path} has no date: it needs sentences RMC or ZDA beside GGA")
    time_s = _days(columns[0], columns[1]) * _DAY_S + columns[0]
    notes = (f"{path.name}: {damaged} damaged sentences are left out",) if damaged else ()
    return make_fixes(path, time_s, dict(zip(PLACE, columns[2:])), notes)


def _sentence(line: str) -> tuple[list[str], bool]:
    """Split an NMEA sentence into fields; `[""]` and True if its check sum is wrong."""
    body, star, check = line.strip().partition("*")
    if not body.startswith("$"):
        return [""], False
    if star:
        total = reduce(lambda value, character: value ^ ord(character), body[1:], 0)
        if check[:2].upper() != f"{total:02X}":
            return [""], True
    return body[1:].split(","), False


def _add(rows: list[list[float]], seconds: float, day: float, place: list[str],
         height_m: float) -> None:
    """Add a position to `rows` in place; if the last one has its time, complete that instead.

    The sentences RMC (date) and GGA (height) of one time make one position.
    """
    latitude, longitude = _degrees(place[0], place[1]), _degrees(place[2], place[3])
    if rows and rows[-1][0] == seconds:
        row = rows[-1]
        row[1] = day  # GGA came before RMC, with the date of the previous one
        if np.isnan(row[4]):
            row[2:] = [latitude, longitude, height_m]
        return
    rows.append([seconds, day, latitude, longitude, height_m])


def _days(seconds: np.ndarray, day: np.ndarray) -> np.ndarray:
    """Return the day of each position: the last date, plus one day after each midnight since."""
    result = np.array(day)
    first = int(np.argmax(np.isfinite(day))) if len(day) else 0
    if len(day):
        result[:first] = day[first]
        midnights = np.diff(seconds[:first + 1]) < -_DAY_S / 2
        result[:first] -= np.cumsum(midnights[::-1])[::-1]
    for i in range(first + 1, len(day)):
        late = seconds[i] - seconds[i - 1] < -_DAY_S / 2
        if day[i] == day[i - 1]:  # no date has come since
            result[i] = result[i - 1] + late
    return result


def _seconds(text: str) -> float:
    return int(text[:2]) * 3600 + int(text[2:4]) * 60 + float(text[4:])


def _degrees(text: str, side: str) -> float:
    point = text.index(".")
    value = int(text[:point - 2]) + float(text[point - 2:]) / 60
    return -value if side in ("S", "W") else value


def _day(year: int, month: int, day: int) -> float:
    return (datetime(year, month, day, tzinfo=UTC)
            - datetime(1970, 1, 1, tzinfo=UTC)) / timedelta(days=1)


def _time_s(where: object, text: str) -> float:
    """Return an ISO 8601 time [s since 1970 UTC]; without an offset it is UTC."""
    try:
        stamp = datetime.fromisoformat(text)
        return (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        raise BadInput(f"{where}: time {cell_text(text)} is not ISO 8601; leave that point out"
                       ) from None


def _numbers(path: Path, texts: Sequence[Any]) -> list[float]:
    """Return three coordinates as numbers, NaN where missing; BadInput if one is no number."""
    try:
        numbers = [float(text) for text in texts[:3]]
    except (TypeError, ValueError):
        raise BadInput(f"{path}: {cell_text(texts)} is no place; leave that point out") from None
    return numbers + [np.nan] * (3 - len(numbers))


class _Rows:
    """Base of parsers that collect rows from the elements of an XML file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[list[float]] = []
        self._text = ""
        parse_elements(path, self._start, self._end, text=self._add_text)

    @abstractmethod
    def start(self, name: str, attributes: dict[str, str], line: int) -> None:
        """Handle the start of an element."""

    @abstractmethod
    def end(self, name: str, text: str) -> None:
        """Handle the end of an element, with its text."""

    def _start(self, tag: str, attributes: dict[str, str], line: int) -> None:
        self._text = ""
        self.start(tag.rpartition(":")[2], attributes, line)

    def _add_text(self, text: str) -> None:
        if len(self._text) < _MAX_TEXT:
            self._text += text[:_MAX_TEXT]

    def _end(self, tag: str) -> None:
        self.end(tag.rpartition(":")[2], self._text.strip())
        self._text = ""
        ROWS.check(len(self.rows), self.path)


class _Points(_Rows):
    """Track points of GPX: time, latitude, longitude, height."""

    _point: dict[str, str] | None = None
    _line = 0

    def start(self, name: str, attributes: dict[str, str], line: int) -> None:
        if name == "trkpt":
            self._point, self._line = dict(attributes), line

    def end(self, name: str, text: str) -> None:
        """Handle the end of a GPX element: keep a point's time and height, and add it as a row."""
        if self._point is not None and name in ("ele", "time"):
            self._point.setdefault(name, text)
        elif self._point is not None and name == "trkpt":
            time = self._point.get("time")
            self.rows.append([
                np.nan if time is None else _time_s(f"{self.path}, line {self._line}", time),
                *(self._number(self._point.get(each, "nan"), each) for each in
                  ("lat", "lon", "ele"))])
            self._point = None

    def _number(self, text: str, name: str) -> float:
        """Return a text as a number; BadInput names file and line."""
        try:
            return float(text)
        except ValueError:
            raise BadInput(f"{self.path}, line {self._line}: {name} = {cell_text(text)} is not a "
                           "number") from None


def read_gpx(path: Path) -> Fixes:
    """Read the track points of a GPX file (times are UTC); BadInput if fewer than two have one."""
    columns = np.array(_Points(path).rows, dtype=float).reshape(-1, 4).T
    return make_fixes(path, columns[0], dict(zip(PLACE, columns[1:])))


class _Track(_Rows):
    """Points of all tracks of KML: time, longitude, latitude, altitude, angles."""

    def __init__(self, path: Path) -> None:
        self.modes: set[str] = set()
        self._clear()
        super().__init__(path)

    def _clear(self) -> None:
        self._times: list[float] = []
        self._places: list[list[float]] = []
        self._angles: list[list[float]] = []

    def start(self, name: str, attributes: dict[str, str], line: int) -> None:
        if name in ("Track", "Placemark"):
            self._clear()

    def end(self, name: str, text: str) -> None:
        """Handle the end of a KML element: collect times, places and angles; add a track's rows."""
        if name == "when":
            self._times.append(_time_s(self.path, text) if text else np.nan)
        elif name == "coord":
            self._places.append(_numbers(self.path, text.split()) if text else [np.nan] * 3)
        elif name == "coordinates" and len(text.split()) == 1:
            self._places.append(_numbers(self.path, text.split(",")))
        elif name == "angles":
            self._angles.append(_numbers(self.path, text.split()) if text else [np.nan] * 3)
        elif name == "altitudeMode":
            self.modes.add(text)
        elif name == "Track" or (name == "Placemark" and len(self._places) == 1):
            if name == "Track" and len(self._times) != len(self._places):
                raise BadInput(f"{self.path}: a track has {len(self._times)} times and "
                               f"{len(self._places)} places; it needs as many")
            unknown = [[np.nan] * 3] * len(self._times)
            angles = self._angles if len(self._angles) == len(self._times) else unknown
            self.rows += [[time, *place, *angle] for time, place, angle in
                          zip(self._times, self._places, angles)]
            self._clear()


def read_kml(path: Path) -> Fixes:
    """Read the tracks of a KML file; altitudes above the ground are not used (NaN, and a note).

    Raises:
        BadInput: no KML, or fewer than two places with a time.
    """
    track = _Track(path)
    if not track.rows:
        raise BadInput(f"{path} has no track with times: gx:Track, or placemarks with a TimeStamp "
                       "and a point; export it as GPX, or as a table with a column time")
    columns = np.array(track.rows, dtype=float).T
    names = ("longitude", "latitude", "altitude", *ANGLES)
    values = {name: column for name, column in zip(names, columns[1:])
              if name not in ANGLES or np.isfinite(column).any()}
    notes: tuple[str, ...] = ()
    if above := track.modes - {"absolute"}:
        values["altitude"] = np.full(len(columns[0]), np.nan)
        notes = (f"{path.name}: altitudeMode is {', '.join(sorted(above))}: its altitudes are not "
                 "above the sea, and are not used",)
    return make_fixes(path, columns[0], values, notes)


def _part(value: object, name: str) -> dict[str, Any]:
    part = value.get(name) if isinstance(value, dict) else None
    return part if isinstance(part, dict) else {}


def read_geojson(path: Path) -> Fixes | None:
    """Read the tracks of a GeoJSON file: lines with a time at each point; None without any line.

    Lines of a MultiLineString without a list of times are left out.

    Raises:
        BadInput: a LineString has no times, a line has another number of times than of positions,
            or fewer than two positions have a time.
    """
    with open_gzip(path, "GeoJSON file", DOCUMENT_BYTES) as file:
        text = file.read()
    if b"LineString" not in text:
        return None
    data = parse_json(text.decode("utf-8-sig", "replace"), path)
    features = data.get("features", [data]) if isinstance(data, dict) else []
    rows = []
    for feature in features if isinstance(features, list) else []:
        geometry, properties = _part(feature, "geometry"), _part(feature, "properties")
        lines = geometry.get("coordinates") or []
        by_coordinate = _part(properties, "coordinateProperties")
        times = next((each for each in (
            properties.get("coordTimes"), properties.get("times"),
            by_coordinate.get("times")) if isinstance(each, list)), None)
        if geometry.get("type") == "LineString":
            lines, times = [lines], [times]
        elif geometry.get("type") != "MultiLineString":
            continue
        for line, stamps in zip(lines, times or []):
            if not isinstance(stamps, list) or len(stamps) != len(line):
                raise BadInput(f"{path}: a line of {len(line)} places has not as many times (the "
                               "property coordTimes); export the track as GPX")
            rows += [[_time_s(path, str(stamp)), *_numbers(path, place)]
                     for stamp, place in zip(stamps, line)]
            ROWS.check(len(rows), path)
    columns = np.array(rows, dtype=float).reshape(-1, 4).T
    return make_fixes(path, columns[0], dict(zip(("longitude", "latitude", "altitude"),
                                                 columns[1:])))
