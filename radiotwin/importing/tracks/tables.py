"""Read tracks from tables: exports of flight logs (Airdata, Litchi, DJI), and of loggers.

A column is recognised by a usual name with its unit at the end: `altitude_above_seaLevel(feet)`,
`OSD.yaw [360]`, `height_m`. Altitudes are above the sea, never above the start or the ground.
"""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.importing.read_source import Expected, read_source
from radiotwin.importing.settings import TrackFile
from radiotwin.importing.source import Source
from radiotwin.importing.tracks.fixes import Fixes, make_fixes
from radiotwin.importing.units import EPOCH_S, ISO, seconds
from radiotwin.io.cells import as_numbers, as_text, listed
from radiotwin.links.site_table import METRES

_NAMES = {
    "time": "timestamp, datetime, time, date time, utc, utc time, time utc, gps time, "
            "utc datetime, gps date time stamp, tst",
    "latitude": "latitude, lat, osd latitude, gps latitude, gps lat, aircraft latitude",
    "longitude": "longitude, lon, lng, long, osd longitude, gps longitude, gps lon, gps long, "
                 "aircraft longitude",
    "altitude": "altitude above sea level, altitude amsl, altitude msl, alt msl, amsl, asl, "
                "osd altitude, gps altitude, gps height msl, altitude, alt, elevation, ele",
    "heading": "heading, compass heading, osd yaw, yaw, course heading",
    "pitch": "pitch, osd pitch", "roll": "roll, osd roll",
    "day": "custom date, date, gps date, utc date", "hour": "custom update time, time, gps time"}
"""Quantity -> column names in order of preference."""
_UNIT = re.compile(r"\s*[(\[]([^)\]]*)[)\]]\s*$|_(m|ft|deg|s|ms|utc)$")
_LENGTHS = {**dict.fromkeys(("m", "meter", "meters", "metre", "metres"), METRES["m"]),
            **dict.fromkeys(("ft", "feet", "foot"), METRES["ft"])}
_DAY_FORMATS = ("%m/%d/%Y", "%d.%m.%Y", "%Y-%m-%d", "%Y/%m/%d")
_HOUR_FORMATS = ("%I:%M:%S.%f %p", "%I:%M:%S %p", "%H:%M:%S.%f", "%H:%M:%S")
QUANTITIES = ("time", "latitude", "longitude", "altitude", "heading", "pitch", "roll")
_ANGLES = ("heading", "pitch", "roll")


def _plain(name: str) -> str:
    return re.sub(r"[\W_]+", "", name.lower())


def _split(name: str) -> tuple[str, str]:
    """Split a column's name into its plain name and its unit (lower case; `""`: none)."""
    unit = _UNIT.search(name)
    if unit is None:
        return _plain(name), ""
    return _plain(name[:unit.start()]), (unit[1] or unit[2] or "").strip().lower()


def _find(header: list[str], quantity: str, unit: str | None = None) -> str | None:
    """Find the column of a quantity by its usual names, in a unit (None: any); None: no column."""
    columns = {_split(name): name for name in reversed(header)}
    for word in map(_plain, _NAMES[quantity].split(",")):
        for (plain, column_unit), name in columns.items():
            if plain == word and (unit is None or column_unit == unit):
                return name
    return None


def read_track_table(path: Path, track: TrackFile, zone: str | None) -> Fixes:
    """Read a table of positions over time.

    `zone` is the time zone of times without an offset if the track declares none; None: UTC, but
    BadInput for a column of local time, or a date and an hour in two columns. The unit in the name
    of an altitude column counts before the track's `length_unit`, then metres.

    Raises:
        BadInput: no column of time, latitude or longitude, or cells that cannot be read.
    """
    words = {quantity: _plain(names.split(",")[0]) for quantity, names in _NAMES.items()}
    source = read_source(path, None, Expected((frozenset(words.values()),)))
    header = list(map(str, source.table))
    if odd := set(track.columns) - set(QUANTITIES):
        raise BadInput(f"{path}: a track has no {', '.join(sorted(odd))}; allowed in its columns "
                       f"are {', '.join(QUANTITIES)}")
    columns = {name: spec for name in QUANTITIES[1:]
               if (spec := track.columns.get(name) or _find(header, name))}
    missing = [name for name in ("latitude", "longitude") if name not in columns]
    time = track.columns.get("time") or _find(header, "time") or _find(header, "day")
    missing += ["time"] * (time is None)
    if missing:
        raise BadInput(f"{path}: no column is known as {' or '.join(missing)} of a track; declare "
                       "them by --track-columns time=…,latitude=…,longitude=…,altitude=…; the file "
                       f"has {listed(header)}")
    source.require(columns | ({"time": track.columns["time"]} if "time" in track.columns else {}))
    values = {}
    for name, spec in columns.items():
        numbers = source.numbers(spec, name)
        if name == "altitude":
            unit = _split(spec)[1]
            numbers = numbers * _LENGTHS.get(unit, METRES[track.length_unit or "m"])
        values[f"{name}_deg" if name in _ANGLES else name] = numbers
    time_s, what = _times(source, header, track, zone)
    note = f"{path.name}: time is {what}; " + ", ".join(
        f"{name} {spec}" for name, spec in columns.items())
    if "altitude" not in columns:
        others = [name for name in header if re.search("(?i)height|ascent|alt", name)]
        note += "; no altitude above the sea is known" + (
            f" ({listed(others)} may be above the start: declare one by --track-columns "
            "altitude=… if it is not)" if others else "")
    return make_fixes(path, time_s, values, (note,))


def _times(source: Source, header: list[str], track: TrackFile,
           zone: str | None) -> tuple[np.ndarray, str]:
    """Read the times (n,) [s since 1970 UTC]; return also the names of their columns."""
    zone = track.time_zone or zone
    if spec := track.columns.get("time"):
        time_format = track.time_format or _time_format(source, spec)
        time_s = seconds(source, spec, time_format, zone or "UTC")
        return _with_milliseconds(source, header, time_s), spec
    if "time_s" in header:
        return seconds(source, "time_s", "epoch s", "UTC"), "time_s"
    spec = _find(header, "time", "utc")
    if spec is not None:
        time_s = seconds(source, spec, track.time_format or ISO, "UTC")
        return _with_milliseconds(source, header, time_s), spec
    day, hour = _find(header, "day"), _find(header, "hour")
    if day is not None and hour is not None and hour != day:
        is_utc = "utc" in (_split(day)[1], _split(hour)[1])
        return _day_and_hour(source, day, hour, "UTC" if is_utc else zone), f"{day} and {hour}"
    spec = str(_find(header, "time") or day)
    is_local = _split(spec)[1] == "local"
    time_format = track.time_format or _time_format(source, spec)
    return seconds(source, spec, time_format, zone or (None if is_local else "UTC")), spec


def _time_format(source: Source, spec: str) -> str:
    """Return the format of a column of times: ISO 8601, or for numbers s, ms, … since 1970.

    The unit is the one that makes the median a time from 1985 to 2128; BadInput if none does.
    """
    numbers = as_numbers(as_text(source.cells(spec, "time")))
    known = numbers[np.isfinite(numbers)]
    if not len(known):
        return ISO
    for form, unit_s in EPOCH_S.items():
        if 5e8 < np.median(known) * unit_s < 5e9:  # 1985 to 2128
            return form
    raise BadInput(f"{source.path}: column {spec}: {known[0]:g} to {known[-1]:g} is no time since "
                   "1970, but since a start that the file does not say; give another column by "
                   "--track-columns time=…, or time_offset_s of the track in the settings' file "
                   "with --track-time-format 'epoch s' or 'epoch ms'")


def _with_milliseconds(source: Source, header: list[str], time_s: np.ndarray) -> np.ndarray:
    """Refine times of whole seconds by a column of milliseconds since the start, if there is one.

    Whole seconds are cut off, so each row gives a start that is up to 1 s early; the latest is
    taken.
    """
    names = {_split(name): name for name in header}
    spec = next((names[key] for key in names if key[0] == "time"
                 and key[1] in ("millisecond", "milliseconds", "ms")), None)
    known = time_s[np.isfinite(time_s)]
    if spec is None or not len(known) or (known % 1 != 0).any():
        return time_s
    since_s = source.numbers(spec, "time") / 1e3
    return since_s + np.nanmax(time_s - since_s)


def _day_and_hour(source: Source, day: str, hour: str, zone: str | None) -> np.ndarray:
    """Read times [s since 1970] from two columns: dates (month first with slashes) and hours."""
    texts = {name: as_text(source.cells(name, "time")) for name in (day, hour)}
    forms: Mapping[str, tuple[str, ...]] = {day: _DAY_FORMATS, hour: _HOUR_FORMATS}
    chosen = []
    for name, text in texts.items():
        known = text[text != ""]
        form = next((each for each in forms[name] if len(known) and pd.to_datetime(
            known, format=each, errors="coerce").notna().all()), None)
        if form is None:
            raise BadInput(f"{source.path}: column {name}: {known.iloc[0] if len(known) else ''!r} "
                           "is no date or hour of a known form; give --track-columns "
                           f"'time={{{day}}} {{{hour}}}' with --track-time-format")
        chosen.append(form)
    return seconds(source, f"{{{day}}} {{{hour}}}", " ".join(chosen), zone)
