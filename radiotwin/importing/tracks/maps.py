"""Tracks in formats of maps: KML (OGC 12-007r2, `Track` of 2.3 and `gx:Track` before) and GeoJSON.

A track of KML is a list of `when` and one of `coord`; placemarks with a time and a point are a
track, too. A line of GeoJSON has its times in the property `coordTimes` or `times`, as converters
write them.
"""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.importing.tracks.fixes import Fixes, make_fixes
from radiotwin.io.budgets import DOCUMENT_BYTES, ROWS
from radiotwin.io.cells import shown
from radiotwin.io.inputs import open_gzip, parse_elements, parse_json

_MAX_TEXT = 200  # characters of a time, a place or angles
_ANGLES = ("heading_deg", "pitch_deg", "roll_deg")


def _time_s(path: Path, text: str) -> float:
    try:
        stamp = datetime.fromisoformat(text)
        return (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        raise BadInput(f"{path}: time {shown(text)} is not ISO 8601; leave that point out"
                       ) from None


def _numbers(path: Path, texts: Sequence[Any]) -> list[float]:
    try:
        numbers = [float(text) for text in texts[:3]]
    except (TypeError, ValueError):
        raise BadInput(f"{path}: {shown(texts)} is no place; leave that point out") from None
    return numbers + [np.nan] * (3 - len(numbers))


class _Track:
    """Collects the points of all tracks of a KML while it is parsed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.rows: list[list[float]] = []  # time, longitude, latitude, altitude, angles
        self.modes: set[str] = set()
        self._times: list[float] = []
        self._places: list[list[float]] = []
        self._angles: list[list[float]] = []
        self._text = ""

    def start(self, tag: str, attributes: dict[str, str], line: int) -> None:
        self._text = ""
        if tag.rpartition(":")[2] in ("Track", "Placemark"):
            self._times, self._places, self._angles = [], [], []

    def text(self, text: str) -> None:
        if len(self._text) < _MAX_TEXT:
            self._text += text[:_MAX_TEXT]

    def end(self, tag: str) -> None:
        name, text = tag.rpartition(":")[2], self._text.strip()
        if name == "when":
            self._times.append(_time_s(self._path, text) if text else np.nan)
        elif name == "coord":
            self._places.append(_numbers(self._path, text.split()) if text else [np.nan] * 3)
        elif name == "coordinates" and len(text.split()) == 1:
            self._places.append(_numbers(self._path, text.split(",")))
        elif name == "angles":
            self._angles.append(_numbers(self._path, text.split()) if text else [np.nan] * 3)
        elif name == "altitudeMode":
            self.modes.add(text)
        elif name == "Track" or (name == "Placemark" and len(self._places) == 1):
            if name == "Track" and len(self._times) != len(self._places):
                raise BadInput(f"{self._path}: a track has {len(self._times)} times and "
                               f"{len(self._places)} places; it needs as many")
            unknown = [[np.nan] * 3] * len(self._times)
            angles = self._angles if len(self._angles) == len(self._times) else unknown
            self.rows += [[time, *place, *angle] for time, place, angle in
                          zip(self._times, self._places, angles)]
            ROWS.check(len(self.rows), self._path)
            self._times, self._places, self._angles = [], [], []
        self._text = ""


def read_kml(path: Path) -> Fixes:
    """Read the tracks of a KML file; altitudes that are above the ground are left out.

    Raises:
        BadInput: no KML, or fewer than two places with a time.
    """
    track = _Track(path)
    parse_elements(path, track.start, track.end, text=track.text)
    if not track.rows:
        raise BadInput(f"{path} has no track with times: gx:Track, or placemarks with a TimeStamp "
                       "and a point; export it as GPX, or as a table with a column time")
    columns = np.array(track.rows, dtype=float).T
    names = ("longitude", "latitude", "altitude", *_ANGLES)
    values = {name: column for name, column in zip(names, columns[1:])
              if name not in _ANGLES or np.isfinite(column).any()}
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
    """Read the lines of a GeoJSON file that have times; None if it has none (as of points).

    Raises:
        BadInput: a line has not as many times as places.
    """
    with open_gzip(path, "GeoJSON file") as file:
        text = file.read()
    DOCUMENT_BYTES.check(len(text), path)
    if b"LineString" not in text:
        return None
    data = parse_json(text.decode("utf-8-sig", "replace"), path)
    features = data.get("features", [data]) if isinstance(data, dict) else []
    rows = []
    for feature in features if isinstance(features, list) else []:
        geometry, properties = _part(feature, "geometry"), _part(feature, "properties")
        lines = geometry.get("coordinates") or []
        own = _part(properties, "coordinateProperties")
        times = next((each for each in (
            properties.get("coordTimes"), properties.get("times"),
            own.get("times")) if isinstance(each, list)), None)
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
