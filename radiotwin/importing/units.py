"""Convert cells of a log to the project's units: times [s], levels [dB, dBm] and lengths [m].

Times count from 1970-01-01 UTC. Clocks that restart, or overlap, are noted, since a receiver would
be at two places at once.
"""

import re
from collections.abc import Callable
from datetime import timedelta
from zoneinfo import ZoneInfo, available_timezones

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.importing.settings import Settings
from radiotwin.importing.source import ROWS_AT_ONCE, Source, constants_of
from radiotwin.io.cells import EMPTY, as_numbers, as_text, cell_text
from radiotwin.links.links import ELSEWHERE_M
from radiotwin.links.site_table import METRES

_UNIT_IN_NAME = re.compile(r"(?:[_ (\[]|(?<=[a-z])(?=[MF]))((?i:m|met(?:er|re)s?|ft|feet))[)\]]?$")
EPOCH_S = {"epoch s": 1.0, "epoch ms": 1e-3, "epoch us": 1e-6, "epoch ns": 1e-9}
ISO = "ISO 8601"
SERIAL = "serial date"
"""Times of spreadsheets: days since 1899-12-30 (ECMA-376-1, 18.17.4.1)."""
ALLOWED = (f"allowed are {', '.join(EPOCH_S)}, {ISO}, {SERIAL} (days, of a spreadsheet), or a "
           "strftime format, such as '%d.%m.%Y %H:%M:%S'")
_NO_DATE = "it has no date: put the date before it ({file date}: that of the file's name), in " \
           "the time and its format, as in --columns 'time=2024-05-01 {Time}' --time-format " \
           "'%Y-%m-%d %H:%M:%S'"
_DATES = re.compile("%[YymbBdjDFcxsGUVWuw]")
BACK_S, HALF_DAY_S, DAY_S = 3600.0, 43_200.0, 86_400.0
MAX_STEPS_BACK = 5  # more are no midnights, but unsorted rows
YEARS = (1900, 2200)  # of plausible times; milliseconds that are read as seconds are later
_MAX_DAYS = 100_000  # since 1899; the year 2173
SECONDS_PER_YEAR = 31_556_952  # Gregorian mean
UTC_OFFSET = r"[Tt ]\d\d(?::?\d\d){0,2}(?:\.\d+)? ?(?:[Zz]|[+-]\d\d(?::?\d\d)?)$"
"""End of an ISO 8601 time with an offset, extended or basic, from the hour on."""
NEAR_S = 1.0  # between two successive readings whose positions are compared
FAST_M_S = 100.0  # fastest receiver
MIN_PAIRS = 3  # of readings at two places; fewer may be a bad fix
MIN_SHARE = 0.02  # of such pairs among successive readings
LEVEL_COLUMN = {"dBm": "rssi_dbm", "mW": "rssi_dbm", "W": "rssi_dbm", "dB": "gain_db"}
"""Unit in the file -> column of `measurements.csv`."""
NOT_A_NUMBER = "nan"
MAX_OVER, MIN_OVER, MAX_GAP_DB = 0.01, 5, 10.0
"""Share and number of values of impossibly strong levels, and their gap to others, of an
uncalibrated column."""
MILLIWATTS = {"mW": 1.0, "W": 1e3}
POSSIBLE_DB = {"rssi_dbm": (-174.0, 0.0), "gain_db": (-250.0, 0.0)}
"""Column of levels -> possible range [dBm or dB]: thermal noise at 290 K is -174 dBm in 1 Hz (k T
of Johnson and Nyquist), no receiver gets a milliwatt (0 dBm), and no channel amplifies."""


def seconds(source: Source, spec: str, time_format: str | None, zone: str | None) -> np.ndarray:
    """Read the times of a column [s since 1970 UTC], (n,); NaN: empty.

    Args:
        source: the file.
        spec: the column.
        time_format: one of `EPOCH_S`, `ISO`, `SERIAL`, or a strftime format; None for typed times.
        zone: IANA time zone of times without an offset from UTC.

    Raises:
        BadInput: format or zone is not declared, a cell cannot be read, or a local time was skipped
            or occurred twice when the clocks changed.
    """
    if zone is not None:
        _check_zone(zone)
    cells = source.cells(spec, "time")
    typed = cells.dtype.kind == "M"  # Parquet has typed times
    if time_format is None and not typed:
        raise BadInput(
            f"{source.path}: column {spec}: time_format is not given; {ALLOWED}. The values look "
            f"like {cell_text(cells.iloc[0])} to {cell_text(cells.iloc[-1])}. If they carry no "
            "offset from UTC, give time_zone, too")
    if time_format in EPOCH_S and not typed:
        time_s = source.numbers(spec, "time") * EPOCH_S[time_format]
        return _plausible(source, spec, cells, time_s)
    text = as_text(cells)
    if typed:
        parsed = cells
    elif time_format == SERIAL:
        days = pd.Series(source.numbers(spec, "time"), index=cells.index)
        parsed = pd.Timestamp("1899-12-30") + pd.to_timedelta(
            (days.where(days.abs() < _MAX_DAYS) * DAY_S).round(3), unit="s")
        source.refuse(spec, text, parsed.isna() & days.notna(), "is no serial date")
    else:
        parsed = _parse(source, spec, text, str(time_format))
    if parsed.dt.tz is None:
        if zone is None:
            raise BadInput(f"{source.path}: column {spec}: the times, such as "
                           f"{cell_text(text.iloc[0])}, carry no offset from UTC, and time_zone is "
                           "not given; give UTC or a zone such as Europe/Berlin")
        parsed = _localize(source, spec, text, parsed, zone)
    utc = parsed.dt.tz_convert("UTC").dt.tz_localize(None).to_numpy(dtype="datetime64[us]")
    time_s = (utc - np.datetime64(0, "us")) / np.timedelta64(1, "s")
    return _plausible(source, spec, text, time_s)


def past_midnights(source: Source, spec: str, time_s: np.ndarray,
                   ends: Callable[[], np.ndarray]) -> tuple[np.ndarray, str]:
    """Add a day after each midnight if the date is a constant; else note clocks that go back.

    A clock goes back if a time (n,) [s] is more than `BACK_S` before that of the previous row with
    equal `ends()`, an (n,) label of device and receiver; a midnight is a step of `HALF_DAY_S` or
    more. With more than `MAX_STEPS_BACK` steps the rows are unsorted: nothing is added or noted.
    """
    known = np.flatnonzero(np.isfinite(time_s))
    step_s = np.diff(time_s[known])
    falls = step_s < -BACK_S
    if falls.any():
        falls &= np.diff(ends()[known]) == 0
    back = known[1:][falls]
    if not 0 < len(back) <= MAX_STEPS_BACK:
        return time_s, ""
    first = int(back[0])
    by_s = time_s[known[np.searchsorted(known, first) - 1]] - time_s[first]
    place = source.where(int(source.table.index[first]))
    is_fixed = spec not in source.table and any(
        re.search(r"\d", constant) for constant in constants_of(spec))
    if not is_fixed or by_s < HALF_DAY_S:
        return time_s, (f"{place}: the clock goes back by {timedelta(seconds=int(by_s))} "
                        f"({len(back)} times in the file); are the date, the hour and %p of the "
                        "later rows right?")
    days = np.zeros(len(time_s))
    days[back] = 1
    return time_s + DAY_S * np.cumsum(days), (
        f"{place}: the clock passes midnight under the date that was given ({len(back)} times in "
        "the file): the rows from there on count as the next day")


def calendar_days(time_s: np.ndarray, zone: str | None) -> np.ndarray:
    """Convert times (n,) [s] to dates such as `2022-04-25` in an IANA time zone (None: UTC)."""
    days = np.empty(len(time_s), dtype=object)
    for start in range(0, len(time_s), ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        stamp = pd.Series(pd.to_datetime(time_s[rows], unit="s", utc=True))
        day = stamp.dt.tz_convert(zone or "UTC").dt.strftime("%Y-%m-%d").fillna("")
        number, names = pd.factorize(day)  # one object for each day
        days[rows] = np.asarray(names, dtype=object)[number]
    return days


def _check_zone(zone: str) -> None:
    """Raise BadInput for an unknown time zone; the message names similar ones."""
    try:
        ZoneInfo(zone)
    except (KeyError, ValueError, OSError):  # which one depends on how the name is wrong
        city = zone.rpartition("/")[2].lower()
        similar = sorted(name for name in available_timezones() if city and city in name.lower())
        examples = ", ".join(similar[:3] or ["Europe/Berlin", "America/Denver"])
        raise BadInput(f"time_zone {zone!r} is unknown; allowed are UTC and the names of the IANA "
                       f"data base, such as {examples}") from None


def _parse(source: Source, spec: str, text: pd.Series, time_format: str) -> pd.Series:
    """Parse texts as time stamps, with a zone if the texts have offsets from UTC."""
    iso = time_format == ISO
    if not iso and "%" not in time_format:
        raise BadInput(f"time_format {time_format!r} is unknown; {ALLOWED}")
    if ("%p" in time_format) != ("%I" in time_format):
        raise BadInput(f"time_format {time_format!r}: %p (AM, PM) belongs to %I (1 to 12), %H (0 "
                       "to 23) to neither; write %I with %p, or %H alone")
    if re.search("%[HIMSTX]", time_format) and not _DATES.search(time_format):
        raise BadInput(f"{source.path}: column {spec}: time_format {time_format!r}: {_NO_DATE}")
    has_offset = "%z" in time_format or (iso and text.str.contains(UTC_OFFSET))
    with_offset = np.broadcast_to(has_offset, len(text)) & (text != "")
    if iso and with_offset.any():
        source.refuse(spec, text, ~with_offset & (text != ""),
                      "carries no offset from UTC, other rows do; give it to all or to none")
    try:
        parsed = pd.to_datetime(text.where(text != ""), errors="coerce",
                                format="ISO8601" if iso else time_format,
                                utc=bool(with_offset.any()))
        if parsed.isna().any() and time_format.endswith("%S"):  # some seconds have decimals
            fine = pd.to_datetime(text.where(text != ""), errors="coerce",
                                  format=f"{time_format}.%f", utc=bool(with_offset.any()))
            parsed = fine.where(parsed.isna(), parsed)
    except (ValueError, re.error) as error:  # pandas makes a regular expression of it
        raise BadInput(f"time_format {time_format!r} is not a strftime format: {error}; {ALLOWED}"
                       ) from None
    bad = parsed.isna() & (text != "")
    is_clock = bad.any() and re.fullmatch(r"\d\d?:\d\d.*", text[bad].iloc[0])
    source.refuse(spec, text, bad, f"is no time in the form {time_format}; "
                                   f"{_NO_DATE if is_clock else ALLOWED}")
    return parsed


def _plausible(source: Source, spec: str, text: pd.Series, time_s: np.ndarray) -> np.ndarray:
    """Return times (n,) [s since 1970] unchanged; BadInput if one is outside the years `YEARS`."""
    year = 1970 + time_s / SECONDS_PER_YEAR
    source.refuse(spec, text, (year < YEARS[0]) | (year > YEARS[1]),
                  f"lies outside of the years {YEARS[0]} to {YEARS[1]}; is time_format right "
                  f"({', '.join(EPOCH_S)}, {SERIAL})?")
    return time_s


def _localize(source: Source, spec: str, text: pd.Series, parsed: pd.Series,
              zone: str) -> pd.Series:
    """Add a zone to local times; BadInput if a clock change skipped or repeated one of them."""
    known = parsed.notna()
    local = parsed.dt.tz_localize(zone, ambiguous="NaT", nonexistent="shift_forward")
    source.refuse(spec, text, known & local.isna(),
                  f"happened twice in {zone}: the clocks went back. Give the times in UTC or with "
                  "their offset, or leave these rows out")
    source.refuse(spec, text, known & (local.dt.tz_localize(None) != parsed),
                  f"never happened in {zone}: the clocks went forward. Is it another zone, or UTC?")
    return local


def clock_notes(links: pd.DataFrame) -> list[str]:
    """Note receivers that would be at two places at once by the times of their readings.

    They are if `MIN_PAIRS` successive readings, and a share `MIN_SHARE`, lie too far apart for the
    time between them.
    """
    if "time_s" not in links:
        return []
    notes = []
    columns = ["time_s", "flight", "receiver_x_m", "receiver_y_m"]
    for receiver, track in links.groupby("receiver", sort=False)[columns]:
        track = track.dropna().drop_duplicates(columns[0:1] + columns[2:])
        track = track.sort_values("time_s", kind="stable")
        step_s = np.diff(track["time_s"].to_numpy())
        between_s = step_s + _resolution_s(track["time_s"].to_numpy())
        step_m = np.linalg.norm(np.diff(track[columns[2:]].to_numpy(), axis=0), axis=1)
        near = step_s <= NEAR_S
        apart = near & (step_m > ELSEWHERE_M + FAST_M_S * between_s)
        if apart.sum() < max(MIN_PAIRS, MIN_SHARE * near.sum()):
            continue
        flight = track["flight"].to_numpy()
        at = np.flatnonzero(apart)
        others = at[flight[at] != flight[at + 1]]
        if len(others) > len(at) / 2:
            pair = sorted({flight[others[0]], flight[others[0] + 1]})
            notes.append(
                f"the times of flights {pair[0]!r} and {pair[1]!r} overlap, and receiver "
                f"{receiver!r} would be at two places at once ({len(at)} times): is a clock wrong, "
                "or are they several receivers (--columns receiver=\"by file\")?")
        else:
            notes.append(
                f"receiver {receiver!r} would be at two places at once ({len(at)} times, first in "
                f"flight {flight[at[0]]!r}): its clock began anew, or it is several receivers; "
                "split the log where the clock goes back, or name them")
    return notes


def _resolution_s(time_s: np.ndarray) -> float:
    """Return the resolution [s] of rounded times (n,): 60 or 1, else 0."""
    return next((unit_s for unit_s in (60.0, 1.0) if not np.any(time_s % unit_s)), 0.0)


def in_metres(numbers: np.ndarray, unit: str | None, column: str) -> np.ndarray:
    """Convert lengths (n,) to metres; BadInput if the unit is unknown.

    It is one of `METRES`, or (None) at the end of the column's name: `alt_m`, `Height (ft)`.
    """
    if unit is None and (named := _UNIT_IN_NAME.search(column)):
        unit = "ft" if named[1].lower().startswith("f") else "m"
    known = numbers[np.isfinite(numbers)]
    if unit is None and (known != 0).any():  # zero is so in any unit
        values = f"run from {known.min():g} to {known.max():g}" if len(known) else "are all empty"
        raise BadInput(f"{column}: length_unit is not given; allowed are "
                       f"{' and '.join(METRES)}. The values {values}")
    return numbers * METRES[unit or "m"]


def read_levels(source: Source, spec: str, settings: Settings,
                offset_db: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Read the levels of one column as dB or dBm, and add an offset [dB], one for all or (n,).

    Milliwatts and watts become dBm; path losses become gains (their sign changes). The limit
    `not_detected_at_or_below` is compared before, in the file's unit.

    Returns:
        levels (n,), NaN: not detected, or not to be used; and the reason for the latter (n,): `not
        measured`, `impossible level` (outside `POSSIBLE_DB`), or `""`.

    Raises:
        BadInput: the unit is not declared, a cell is not a number, or the meaning of empty cells is
            not declared.
    """
    cells = source.cells(spec, "level")
    text = as_text(cells)
    is_text = cells.dtype.kind not in "fiu"
    if is_text:  # the word NaN has a meaning of its own, unlike an empty cell
        named = cells.notna() & (cells.astype(str).str.strip().str.lower() == NOT_A_NUMBER)
        text = text.mask(named, NOT_A_NUMBER)
    numbers = as_numbers(text)
    if settings.level_unit and np.isnan(numbers).any():  # some cells are `-80 dBm`
        text = text.str.replace(rf"(?<=[\d.])\s*{settings.level_unit}$", "", case=False, regex=True)
        numbers = as_numbers(text)
    not_measured = _is_one_of(text, numbers, settings.not_measured, is_text)
    not_detected = _is_one_of(text, numbers, settings.not_detected, is_text) & ~not_measured
    declared = not_measured | not_detected
    source.refuse(spec, text, (text == "") & ~declared,
                  "is empty; say what that means: not_detected = [\"empty\"] (it was too weak, "
                  "which is information) or not_measured = [\"empty\"] (nobody listened)")
    source.refuse(spec, text, ~np.isfinite(numbers) & ~declared,
                  "is not a number; if it means that the level was not detected, put it into "
                  "not_detected; if nobody listened, into not_measured")
    _check_unit(source, spec, numbers[~declared], settings.level_unit)
    sign = -1.0 if settings.path_loss else 1.0
    if settings.not_detected_at_or_below is not None:  # of a loss, at or above
        limit = settings.not_detected_at_or_below
        not_detected |= ~declared & (sign * numbers <= sign * limit)
    numbers = sign * numbers
    factor = MILLIWATTS.get(str(settings.level_unit))
    with np.errstate(divide="ignore", invalid="ignore"):  # power <= 0 is found to be impossible
        db = numbers if factor is None else 10 * np.log10(numbers * factor)
    db = db + offset_db
    low, high = POSSIBLE_DB[LEVEL_COLUMN[str(settings.level_unit)]]
    impossible = ~not_measured & ~not_detected & ~((db > low) & (db < high))
    _refuse_uncalibrated(source, spec, db[~not_measured & ~not_detected], high)
    db = np.where(not_measured | not_detected | impossible, np.nan, db)
    return db, np.select([not_measured, impossible], ["not measured", "impossible level"], "")


def _refuse_uncalibrated(source: Source, spec: str, db: np.ndarray, high_db: float) -> None:
    """Raise BadInput if many levels (n,) [dB] are `high_db` or more, as of no calibrated receiver.

    They pass, as codes for "no reading", if they are at most `MAX_OVER` of all, fewer than
    `MIN_OVER` different values, or more than `MAX_GAP_DB` above the rest, or if there is no rest.
    """
    over = np.unique(db[db >= high_db])
    share = float(np.mean(db >= high_db)) if len(db) else 0.0
    below = db[db < high_db]
    if share <= MAX_OVER or len(over) < MIN_OVER or not len(below) \
            or over[0] - below.max() > MAX_GAP_DB:
        return
    raise BadInput(f"{source.path}: column {spec}: {share:.0%} of the levels are {high_db:g} dB or "
                   f"more, up to {over[-1]:g}, which no calibrated receiver reads; all the "
                   f"strongest would be left out. Give a level_offset_db, such as "
                   f"{-10 * np.ceil((over[-1] + 1) / 10):g}, that makes them negative: which one "
                   "does not matter where transmit powers are not known. Path losses need "
                   "path_loss, and codes not_measured")


def _is_one_of(text: pd.Series, numbers: np.ndarray, values: list[float | str],
               is_text: bool) -> np.ndarray:
    """Return which cells (n,) equal one of the values, in upper or lower case.

    `empty`, and but for the NaN of texts (`is_text`) the words for it, mean an empty cell.
    """
    labels = {value.strip().lower() for value in values if isinstance(value, str)}
    labels = {label if label == NOT_A_NUMBER and is_text else
              "" if label in (*EMPTY, "empty") else label for label in labels}
    result = np.isin(numbers, [value for value in values if not isinstance(value, str)])
    if labels:
        result |= text.str.lower().isin(labels).to_numpy(dtype=bool)
    return result


def _check_unit(source: Source, spec: str, numbers: np.ndarray, unit: str | None) -> None:
    """Raise BadInput if the unit of levels is not declared; the message shows their range."""
    if unit is None:
        values = "are all not detected"
        if len(numbers):
            values = (f"run from {numbers.min():g} to {numbers.max():g}, median "
                      f"{np.median(numbers):g}")
        raise BadInput(f"{source.path}: column {spec}: level_unit is not given; allowed are dBm, "
                       "mW and W (received power) and dB (channel gain, negative; with --path-loss "
                       f"a loss, positive). The values {values}")
