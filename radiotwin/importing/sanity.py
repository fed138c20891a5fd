"""What was read, what was kept, what looks odd."""

from datetime import UTC, datetime

import numpy as np
import pandas as pd

from radiotwin.importing.averaging import WAVELENGTHS, in_wavelengths
from radiotwin.importing.places import Placed
from radiotwin.importing.read import Source
from radiotwin.importing.settings import Settings
from radiotwin.importing.tally import Tally
from radiotwin.measurements import Measurements

SCHEMA = "radiotwin.import/1"
UNITS = {"_m": "m", "_deg": "°", "_s": "s", "_dbm": "dBm", "_db": "dB"}
FAR_M = 100_000.0
HIGH_M = 500.0
MANY = 0.5
LEAST_CLUSTER = 0.1
YEARS_S = (datetime(1990, 1, 1, tzinfo=UTC).timestamp(), datetime(2100, 1, 1, tzinfo=UTC).timestamp())


def make_report(source: Source, rows: int, readings: int, kept: int, tally: Tally, placed: Placed,
                measurements: Measurements, settings: Settings) -> dict:
    """The content of `import.json`: `readings` = `kept` + all that was left out; `written` is fewer after averaging."""
    table, devices, origin = measurements.table, measurements.devices, placed.frame.origin
    time_s = table["time_s"].dropna() if "time_s" in table else pd.Series(dtype=float)
    return {
        "schema": SCHEMA, "file": source.path.name, "rows": rows, "readings": readings, "kept": kept,
        "left_out": [{"reason": reason, "column": column, "readings": number, "first": tally.first[reason, column]}
                     for (reason, column), number in tally.left_out.items()],
        "written": len(table), "not_detected": int(np.isnan(measurements.level_db).sum()),
        "devices": len(devices), "anchors": int(measurements.is_anchor.sum()),
        "receivers": int(table["receiver"].nunique()), "flights": len(measurements.flights),
        "time": {"first": _stamp(time_s.min()), "last": _stamp(time_s.max())} if len(time_s) else None,
        "origin": None if origin is None else origin.model_dump(),
        "ranges": _ranges(table, placed.links),
        "warnings": _warnings(placed, measurements, tally, settings, readings),
    }


def _stamp(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).isoformat(sep=" ", timespec="seconds")


def _ranges(table: pd.DataFrame, links: pd.DataFrame) -> dict[str, dict]:
    """Of each column of numbers: least, median, greatest, unit, and how many cells are empty."""
    columns = {name: links[name] for name in ("latitude", "longitude") if name in links}
    columns |= {name: table[name] for name in table if table[name].dtype.kind == "f"}
    result = {}
    for name, values in columns.items():
        known = values.dropna()
        low, middle, high = (float(f()) for f in (known.min, known.median, known.max)) if len(known) else (None,) * 3
        unit = "°" if name in ("latitude", "longitude") else next(
            (unit for ending, unit in UNITS.items() if name.endswith(ending)), "")
        result[name] = {"min": low, "median": middle, "max": high, "unit": unit, "empty": int(values.isna().sum())}
    return result


def _warnings(placed: Placed, measurements: Measurements, tally: Tally, settings: Settings,
              readings: int) -> list[str]:
    return [text for text in (
        *_odd_positions(placed, measurements), *_odd_levels(placed, measurements, tally, readings),
        *_odd_times_and_angles(measurements.table), *_odd_averaging(measurements, settings)) if text]


def _odd_positions(placed: Placed, measurements: Measurements):
    receiver_m, device_m = measurements.receiver_m, measurements.device_m
    extent_m = np.linalg.norm(np.ptp(receiver_m[:, :2], axis=0))
    if extent_m > FAR_M:
        yield f"the receivers lie {extent_m / 1000:.0f} km apart; is a position wrong, or its unit?"
    known_m = device_m[measurements.is_anchor]
    if len(known_m):
        apart_m = np.linalg.norm(np.median(receiver_m[:, :2], axis=0) - np.median(known_m[:, :2], axis=0))
        if apart_m > FAR_M:
            yield (f"devices and receivers lie {apart_m / 1000:.0f} km apart; are latitude and longitude swapped in "
                   "one of them, or a sign lost?")
    z_m = receiver_m[:, 2]
    if np.isfinite(z_m).any():
        if (z_m[np.isfinite(z_m)] == 0).all():
            yield "the height of every receiver is 0; is it not measured? Then leave it out, or give always 1.5"
        if np.nanmin(z_m) > HIGH_M:
            yield (f"the lowest receiver is at {np.nanmin(z_m):.0f} m; if that is above the sea, give the ground's "
                   "altitude with --origin LATITUDE,LONGITUDE,ALTITUDE")
    unknown = int((~measurements.is_anchor).sum())
    if unknown:
        yield f"{unknown} of {len(device_m)} devices have no position: their role is unknown, they are to be found"


def _odd_levels(placed: Placed, measurements: Measurements, tally: Tally, readings: int):
    level_db = measurements.level_db
    missed = np.isnan(level_db).mean()
    if missed > MANY:
        yield f"{missed:.0%} of the levels are not detected"
    impossible = sum(number for (reason, _), number in tally.left_out.items() if reason == "impossible level")
    if impossible > 0.01 * readings:
        yield (f"{impossible / readings:.0%} of the levels are impossible; is level_unit right? A path loss needs a "
               "minus sign")
    seen = placed.links["level_db"].dropna()
    if len(seen) > 20 and seen.min() < seen.max():
        share = (seen == seen.min()).mean()
        if share > LEAST_CLUSTER:
            yield (f"{share:.0%} of the levels are {seen.min():g}, the least; if that means not detected, put it "
                   "into not_detected")


def _odd_times_and_angles(table: pd.DataFrame):
    if "time_s" in table and table["time_s"].notna().any():
        low, high = table["time_s"].min(), table["time_s"].max()
        if not YEARS_S[0] <= low <= high <= YEARS_S[1]:
            yield f"the times run from {low:.0f} to {high:.0f} s since 1970; is time_format right (epoch s, epoch ms)?"
    if "heading_deg" in table and len(table) > 20 and 0 < table["heading_deg"].abs().max() <= 2 * np.pi + 0.01:
        yield "all headings lie within 6.3; are they radians? Degrees are needed"


def _odd_averaging(measurements: Measurements, settings: Settings):
    if settings.average_m and "frequency_hz" in measurements.devices:
        frequency_hz = measurements.devices["frequency_hz"].median()
        long = in_wavelengths(settings.average_m, frequency_hz)
        if not WAVELENGTHS[0] <= long <= WAVELENGTHS[1]:
            low_m, high_m = (n * settings.average_m / long for n in WAVELENGTHS)
            yield (f"average_m = {settings.average_m:g} is {long:.0f} wavelengths; {WAVELENGTHS[0]} to "
                   f"{WAVELENGTHS[1]} (Lee 1985) are {low_m:.1f} to {high_m:.1f} m")
