"""The report of an import: counts, ranges, and warnings about implausible data."""

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pandas as pd

from radiotwin.importing.positions import PositionedLinks
from radiotwin.importing.problems import Tally
from radiotwin.importing.reading import Logs
from radiotwin.importing.repeats import WAVELENGTHS, in_wavelengths
from radiotwin.importing.settings import Settings
from radiotwin.io.texts import moment
from radiotwin.links.measurements import Measurements

SCHEMA = "radiotwin.import/2"
UNITS = {"_m": "m", "_deg": "°", "_s": "s", "_dbm": "dBm", "_db": "dB"}
"""End of a column's name -> unit."""
# Limits beyond which a value is legal but worth a warning; chosen by the project.
FAR_M = 100_000.0  # between receivers, or receivers and devices: more than a city
HIGH_M = 500.0  # of the lowest receiver: probably above the sea, not above ground
MAX_MISSED = 0.5  # share of levels that were not detected
MAX_IMPOSSIBLE = 0.01  # share of levels that no receiver can have meant
MAX_SMALLEST = 0.1  # share of levels that equal the smallest: probably a placeholder
MIN_SAMPLE = 20  # values from which a share or a range says something
YEARS = (1990, 2100)


def make_report(logs: Logs, notes: list[str], others: int, kept: int, tally: Tally,
                positioned: PositionedLinks, measurements: Measurements,
                settings: Settings) -> dict[str, Any]:
    """Make the content of `import.json`.

    Args:
        logs: what was read.
        notes: on how it was read.
        others: number of files that have a format that is not read.
        kept: readings that were not left out.
        tally: readings that were left out; with `kept` they add up to `readings`.
        positioned: the links that were kept.
        measurements: what is written; fewer rows after averaging.
        settings: of the import.
    """
    table, devices = measurements.table, measurements.devices
    origin = positioned.frame.origin
    time_s = table["time_s"].dropna() if "time_s" in table else pd.Series(dtype=float)
    return {
        "schema": SCHEMA, "files": logs.files,
        "rows": logs.rows, "readings": logs.readings, "kept": kept,
        "left_out": [{"reason": reason, "column": column, "readings": number,
                      "first": tally.first[reason, column]}
                     for (reason, column), number in tally.left_out.items()],
        "written": len(table), "not_detected": int(np.isnan(measurements.level_db).sum()),
        "devices": len(devices), "anchors": int(measurements.is_anchor.sum()),
        "receivers": int(table["receiver"].nunique()), "flights": len(measurements.flights),
        "time": {"first": moment(time_s.min()), "last": moment(time_s.max())}
        if len(time_s) else None,
        "origin": None if origin is None else origin.model_dump(),
        "ranges": _ranges(table, positioned.links),
        "warnings": [*notes, *_file_warnings(others),
                     *_position_warnings(measurements),
                     *_level_warnings(positioned, measurements, tally, logs.readings),
                     *_time_and_angle_warnings(table),
                     *_averaging_warnings(measurements, settings)],
    }


def _ranges(table: pd.DataFrame, links: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Return minimum, median, maximum, unit and empty cells of each numeric column."""
    columns = {name: links[name] for name in ("latitude", "longitude") if name in links}
    columns |= {name: table[name] for name in table if table[name].dtype.kind == "f"}
    result = {}
    for name, values in columns.items():
        known = values.dropna()
        low, middle, high = (None,) * 3
        if len(known):
            low, middle, high = float(known.min()), float(known.median()), float(known.max())
        unit = "°" if name in ("latitude", "longitude") else next(
            (unit for ending, unit in UNITS.items() if name.endswith(ending)), "")
        result[name] = {"min": low, "median": middle, "max": high, "unit": unit,
                        "empty": int(values.isna().sum())}
    return result


def _file_warnings(others: int) -> Iterator[str]:
    if others:
        yield (f"{others} files of other formats are left out" if others > 1
               else "1 file of another format is left out")


def _position_warnings(measurements: Measurements) -> Iterator[str]:
    receiver_m, device_m = measurements.receiver_m, measurements.device_m
    extent_m = np.linalg.norm(np.ptp(receiver_m[:, :2], axis=0))
    if extent_m > FAR_M:
        yield (f"the receivers lie {extent_m / 1000:.0f} km apart; is a position wrong, or its "
               "unit?")
    known_m = device_m[measurements.is_anchor]
    if len(known_m):
        apart_m = np.linalg.norm(np.median(receiver_m[:, :2], axis=0)
                                 - np.median(known_m[:, :2], axis=0))
        if apart_m > FAR_M:
            yield (f"devices and receivers lie {apart_m / 1000:.0f} km apart; are latitude and "
                   "longitude swapped in one of them, or is a sign wrong?")
    z_m = receiver_m[np.isfinite(receiver_m[:, 2]), 2]
    if len(z_m):
        if (z_m == 0).all():
            yield ("the height of every receiver is 0; is it not measured? Then leave it out, or "
                   "give above_ground=always 1.5")
        if z_m.min() > HIGH_M:
            yield (f"the lowest receiver is at {z_m.min():.0f} m; if that is above the sea, give "
                   "the ground's altitude with --origin LATITUDE,LONGITUDE,ALTITUDE")
    unknown = int((~measurements.is_anchor).sum())
    if unknown:
        yield (f"{unknown} of {len(device_m)} devices have no position: their role is unknown, "
               "they are to be found")


def _level_warnings(positioned: PositionedLinks, measurements: Measurements, tally: Tally,
                    readings: int) -> Iterator[str]:
    missed = np.isnan(measurements.level_db).mean()
    if missed > MAX_MISSED:
        yield f"{missed:.0%} of the levels are not detected"
    impossible = sum(number for (reason, _), number in tally.left_out.items()
                     if reason == "impossible level")
    if impossible > MAX_IMPOSSIBLE * readings:
        yield (f"{impossible / readings:.0%} of the levels are impossible; is level_unit right? A "
               "path loss needs a minus sign")
    detected = positioned.links["level_db"].dropna()
    if len(detected) > MIN_SAMPLE and detected.min() < detected.max():
        share = (detected == detected.min()).mean()
        if share > MAX_SMALLEST:
            yield (f"{share:.0%} of the levels are {detected.min():g}, the smallest; if that means "
                   "not detected, put it into not_detected")


def _time_and_angle_warnings(table: pd.DataFrame) -> Iterator[str]:
    if "time_s" in table and table["time_s"].notna().any():
        first_s, last_s = table["time_s"].min(), table["time_s"].max()
        start_s, end_s = (datetime(year, 1, 1, tzinfo=UTC).timestamp() for year in YEARS)
        if not start_s <= first_s <= last_s <= end_s:
            yield (f"the times run from {first_s:.0f} to {last_s:.0f} s since 1970; is time_format "
                   "right (epoch s, epoch ms)?")
    if "heading_deg" in table and len(table) > MIN_SAMPLE:
        if 0 < table["heading_deg"].abs().max() <= 2 * np.pi + 0.01:
            yield "all headings lie within 6.3; are they radians? Degrees are needed"


def _averaging_warnings(measurements: Measurements, settings: Settings) -> Iterator[str]:
    if settings.average_m and "frequency_hz" in measurements.devices:
        frequency_hz = measurements.devices["frequency_hz"].median()
        length = in_wavelengths(settings.average_m, frequency_hz)
        if not WAVELENGTHS[0] <= length <= WAVELENGTHS[1]:
            low_m, high_m = (number * settings.average_m / length for number in WAVELENGTHS)
            yield (f"average_m = {settings.average_m:g} is {length:.0f} wavelengths; "
                   f"{WAVELENGTHS[0]} to {WAVELENGTHS[1]} (Lee 1985) are {low_m:.1f} to "
                   f"{high_m:.1f} m")
