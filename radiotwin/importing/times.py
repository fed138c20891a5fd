"""Clock readings -> seconds since 1970-01-01 UTC."""

from zoneinfo import ZoneInfo, available_timezones

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.importing.read import Source, as_text

EPOCH_S = {"epoch s": 1.0, "epoch ms": 1e-3}
ISO = "ISO 8601"
YEARS = (1900, 2200)
OFFSET = r":\d\d(?:\.\d+)?(?:[Zz]|[+-]\d\d(?::?\d\d)?)$"
ALLOWED = f"allowed are {', '.join(EPOCH_S)}, {ISO}, or as of strftime, such as '%d.%m.%Y %H:%M:%S'"


def seconds(source: Source, spec: str, form: str | None, zone: str | None) -> np.ndarray:
    """(n,) seconds since the epoch, UTC; NaN where the cell is empty.

    Args:
        source: the file.
        spec: column of the time.
        form: one of `EPOCH_S`, `ISO`, or a format of strftime; not needed where the file has a type for times.
        zone: of clock readings that carry no offset from UTC; a name of the IANA data base.

    Raises:
        BadInput: not declared, cannot be read, or a local time that the zone's clocks skipped or showed twice.
    """
    if zone is not None:
        check_zone(zone)
    cells = source.cells(spec, "time")
    typed = cells.dtype.kind == "M"  # Parquet has times of its own
    if form is None and not typed:
        raise BadInput(f"{source.path}: column {spec}: time_format is not given; {ALLOWED}. The values look like "
                       f"{str(cells.iloc[0])!r} to {str(cells.iloc[-1])!r}")
    if form in EPOCH_S and not typed:
        return _checked(source, spec, as_text(cells), source.numbers(spec, "time") * EPOCH_S[form])
    if not typed and form != ISO and "%" not in str(form):
        raise BadInput(f"time_format {form!r} is unknown; {ALLOWED}")
    parsed, text = (cells, as_text(cells)) if typed else _parse(source, spec, cells, str(form))
    if parsed.dt.tz is None:
        if zone is None:
            raise BadInput(f"{source.path}: column {spec}: the times, such as {text.iloc[0]!r}, carry no offset from "
                           "UTC, and time_zone is not given; give UTC or a zone such as Europe/Berlin")
        parsed = _localize(source, spec, text, parsed, zone)
    moments = parsed.dt.tz_convert("UTC").dt.tz_localize(None).to_numpy(dtype="datetime64[us]")
    return _checked(source, spec, text, (moments - np.datetime64(0, "us")) / np.timedelta64(1, "s"))


def day(time_s: np.ndarray, zone: str | None) -> np.ndarray:
    """(n,) dates such as 2022-04-25, in the zone's calendar [UTC]; "" where the time is unknown."""
    stamp = pd.Series(pd.to_datetime(time_s, unit="s", utc=True))
    return stamp.dt.tz_convert(zone or "UTC").dt.strftime("%Y-%m-%d").fillna("").to_numpy(dtype=object)


def check_zone(zone: str) -> None:
    """Raise BadInput unless the IANA data base knows `zone`."""
    try:
        ZoneInfo(zone)
    except (KeyError, ValueError, OSError):  # what zoneinfo raises depends on how the name is wrong
        city = zone.rpartition("/")[2].lower()
        near = sorted(name for name in available_timezones() if city and city in name.lower())[:3]
        raise BadInput(f"time_zone {zone!r} is unknown; allowed are UTC and the names of the IANA data base, such as "
                       f"{', '.join(near or ['Europe/Berlin', 'America/Denver'])}") from None


def _parse(source: Source, spec: str, cells: pd.Series, form: str) -> tuple[pd.Series, pd.Series]:
    """Stamps, with a zone where the cells carry offsets, and the cells' texts."""
    text = as_text(cells)
    offset = "%z" in form or (form == ISO and text.str.contains(OFFSET))
    some = np.broadcast_to(offset, len(text)) & (text != "")
    if form == ISO and some.any():
        source.refuse(spec, text, ~some & (text != ""), "carries no offset from UTC, other rows do; give it to all or "
                      "to none")
    try:
        parsed = pd.to_datetime(text.where(text != ""), format="ISO8601" if form == ISO else form, errors="coerce",
                                utc=bool(some.any()))
    except ValueError as error:
        raise BadInput(f"time_format {form!r} is no format of strftime: {error}; {ALLOWED}") from None
    source.refuse(spec, text, parsed.isna() & (text != ""), f"is no time in the form {form}; {ALLOWED}")
    return parsed, text


def _checked(source: Source, spec: str, text: pd.Series, time_s: np.ndarray) -> np.ndarray:
    """`time_s`, none of it out of all reason."""
    year = 1970 + time_s / 31_556_952
    source.refuse(spec, text, (year < YEARS[0]) | (year > YEARS[1]),
                  f"lies outside of the years {YEARS[0]} to {YEARS[1]}; is time_format right (epoch s, epoch ms)?")
    return time_s


def _localize(source: Source, spec: str, text: pd.Series, parsed: pd.Series, zone: str) -> pd.Series:
    """Local clock readings as moments; those that are none or two are refused rather than guessed."""
    known = parsed.notna()
    moved = parsed.dt.tz_localize(zone, ambiguous="NaT", nonexistent="shift_forward")
    source.refuse(spec, text, known & moved.isna(),
                  f"happened twice in {zone}: the clocks went back. Give the times in UTC or with their offset, or "
                  "leave these rows out")
    source.refuse(spec, text, known & (moved.dt.tz_localize(None) != parsed),
                  f"never happened in {zone}: the clocks went forward. Is it another zone, or UTC?")
    return moved
