"""Tracks of GNSS receivers in text: GPX [1], and NMEA 0183.

Of NMEA, GGA has the height and no date, RMC and ZDA have the date.

[1] https://www.topografix.com/GPX/1/1/
"""

import io
from datetime import UTC, datetime, timedelta
from functools import reduce
from pathlib import Path

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.importing.log_files import Lines
from radiotwin.importing.tracks.fixes import Fixes, make_fixes
from radiotwin.io.budgets import ROWS
from radiotwin.io.cells import shown
from radiotwin.io.inputs import open_gzip, parse_elements

_DAY_S = 86_400.0
_CENTURY = 80  # years below it are of this century
_MAX_TEXT = 100  # characters of a time or a height


def read_nmea(path: Path) -> Fixes:
    """Read the positions of NMEA 0183 sentences of any talker.

    Sentences whose check sum is wrong are left out.

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
    return make_fixes(path, time_s, dict(zip(("latitude", "longitude", "altitude"), columns[2:])),
                      notes)


def _sentence(line: str) -> tuple[list[str], bool]:
    """Return the fields of a sentence, and whether its check sum is wrong."""
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
    """Add a position; RMC and GGA of one time are one."""
    latitude, longitude = _degrees(place[0], place[1]), _degrees(place[2], place[3])
    if rows and rows[-1][0] == seconds:
        row = rows[-1]
        row[1] = day  # GGA before RMC had the date before, maybe of another day
        if np.isnan(row[4]):
            row[2:] = [latitude, longitude, height_m]
        return
    rows.append([seconds, day, latitude, longitude, height_m])


def _days(seconds: np.ndarray, day: np.ndarray) -> np.ndarray:
    """Return the day of each position: the last date, one later after each midnight since."""
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


class _Points:
    """Collects track points while the file is parsed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.rows: list[tuple[float, float, float, float]] = []  # time, latitude, longitude, height
        self._point: dict[str, str] | None = None
        self._text = ""
        self._line = 0

    def start(self, tag: str, attributes: dict[str, str], line: int) -> None:
        if _local(tag) == "trkpt":
            self._point, self._line = dict(attributes), line
        self._text = ""

    def text(self, text: str) -> None:
        if self._point is not None and len(self._text) < _MAX_TEXT:
            self._text += text[:_MAX_TEXT]

    def end(self, tag: str) -> None:
        if self._point is None:
            return
        name = _local(tag)
        if name in ("ele", "time"):
            self._point.setdefault(name, self._text.strip())
        elif name == "trkpt":
            ROWS.check(len(self.rows) + 1, self._path)
            self.rows.append((self._time(), self._number("lat"), self._number("lon"),
                              self._number("ele")))
            self._point = None

    def _number(self, name: str) -> float:
        text = (self._point or {}).get(name, "nan")
        try:
            return float(text)
        except ValueError:
            raise BadInput(f"{self._path}, line {self._line}: {name} = {shown(text)} is not a "
                           "number") from None

    def _time(self) -> float:
        text = (self._point or {}).get("time")
        if text is None:
            return np.nan
        try:
            stamp = datetime.fromisoformat(text)
            return (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp()
        except (ValueError, OverflowError):
            raise BadInput(f"{self._path}, line {self._line}: time {shown(text)} is not ISO 8601, "
                           "as GPX prescribes") from None


def read_gpx(path: Path) -> Fixes:
    """Read the track points of a GPX file; times without an offset are UTC, as GPX prescribes.

    Raises:
        BadInput: no GPX, or fewer than two track points have a time.
    """
    points = _Points(path)
    parse_elements(path, points.start, points.end, text=points.text)
    columns = np.array(points.rows, dtype=float).reshape(-1, 4).T
    return make_fixes(path, columns[0], dict(zip(("latitude", "longitude", "altitude"),
                                                 columns[1:])))


def _local(tag: str) -> str:
    return tag.rpartition(":")[2]
