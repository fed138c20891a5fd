"""Import files into a folder, with a report: counts, ranges, and warnings of implausible data."""

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.constants import speed_of_light

from radiotwin.display import some
from radiotwin.errors import BadInput
from radiotwin.geo import FRAME_FILE
from radiotwin.importing.log_files import list_files
from radiotwin.importing.positions import PositionedLinks, add_positions
from radiotwin.importing.reading import Logs, read_logs
from radiotwin.importing.repeats import WAVELENGTHS, average, stay_representatives
from radiotwin.importing.settings import Settings, read_settings, write_settings
from radiotwin.importing.source import Source, Tally
from radiotwin.importing.tracks import add_tracks
from radiotwin.importing.units import clock_notes
from radiotwin.io.files import atomic_folder, require_folder
from radiotwin.io.forms import Origin
from radiotwin.io.texts import moment
from radiotwin.links.link_table import OPTIONAL, REQUIRED
from radiotwin.links.measurements import Measurements, read_antenna_files, read_measurements
from radiotwin.links.plausible import FAR_M

SCHEMA = "radiotwin.import/2"
UNITS = {"_m": "m", "_deg": "°", "_s": "s", "_dbm": "dBm", "_db": "dB"}
"""End of a column's name -> unit."""
# Thresholds of warnings, chosen by the project.
HIGH_M = 500.0  # height of the lowest receiver, if it is probably above the sea
MAX_MISSED = 0.5  # share of levels that were not detected
MAX_IMPOSSIBLE = 0.01  # share of levels that no receiver can read
MAX_SMALLEST = 0.1  # share of levels that equal the smallest, if it is probably a placeholder
MIN_SAMPLE = 20  # values for a share or a range
ISOLATED_DB = 30.0  # gap between the smallest or largest level and all others, if it is a code
_IMPOSSIBLE = ("Is level_unit right? Path losses, positive, need --path-loss; uncalibrated levels "
               "above 0 dBm --level-offset-db; codes --not-measured")
YEARS = (1990, 2100)
ANTENNAS = "antennas"  # folder of the devices' antenna patterns
FILES = {"measurements.csv", "measurements.csv.gz", "devices.csv", FRAME_FILE, "import.toml",
         "import.json", ANTENNAS}
_CUT_NUMBER = re.compile(r"(?:.* )?\d(?:[.,]\d+)?[eE]\+\d+")
DECIMALS = {"_m": 3, "_db": 4, "_dbm": 4, "_deg": 4, "_s": 6}
"""End of a column's name -> decimals that are written, finer than any measurement."""


def _make_report(logs: Logs, notes: list[str], others: int, kept: int, tally: Tally,
                positioned: PositionedLinks, measurements: Measurements,
                settings: Settings) -> dict[str, Any]:
    """Return the content of `import.json`; `kept` is the number of links before averaging."""
    table, devices = measurements.table, measurements.devices
    origin = positioned.origin
    time_s = table["time_s"].dropna() if "time_s" in table else pd.Series(dtype=float)
    return {
        "schema": SCHEMA, "files": logs.files,
        "rows": sum(each["rows"] for each in logs.files), "readings": logs.readings, "kept": kept,
        "left_out": [{"reason": reason, "column": column, "readings": number,
                      "first": tally.first[reason, column]}
                     for (reason, column), number in tally.left_out.items()],
        "bad_rows": logs.bad_rows,
        "written": len(table), "not_detected": int(np.isnan(measurements.level_db).sum()),
        "devices": len(devices), "anchors": int(measurements.is_anchor.sum()),
        "receivers": int(table["receiver"].nunique()), "flights": len(measurements.flights),
        "time": {"first": moment(time_s.min()), "last": moment(time_s.max())}
        if len(time_s) else None,
        "origin": None if origin is None else origin.model_dump(),
        "ranges": _ranges(table, positioned.links),
        "warnings": [*notes, *["1 file of another format is left out"] * (others == 1),
                     *[f"{others} files of other formats are left out"] * (others > 1),
                     *_name_warnings(measurements),
                     *_position_warnings(measurements, settings.devices),
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


def _position_warnings(measurements: Measurements, devices: str | None) -> Iterator[str]:
    """Warn about implausible extents and heights, and devices without height or position."""
    receiver_m = measurements.receiver_m
    extent_m = np.linalg.norm(np.ptp(receiver_m[:, :2], axis=0))
    if extent_m > FAR_M:
        yield (f"the receivers lie {extent_m / 1000:.0f} km apart; is a position wrong, or its "
               "unit?")
    z_m = receiver_m[np.isfinite(receiver_m[:, 2]), 2]
    if len(z_m):
        if (z_m == 0).all():
            yield ("the height of every receiver is 0; is it not measured? Then leave it out, or "
                   "give above_ground=always 1.5")
        if z_m.min() > HIGH_M:
            yield (f"the lowest receiver is at {z_m.min():.0f} m; if that is above the sea, give "
                   "the ground's altitude with --origin LATITUDE,LONGITUDE,ALTITUDE")
    heights = measurements.devices.reindex(columns=["z_m", "above_ground_m"])
    low = measurements.devices["device"][heights.isna().all(axis=1)]
    if len(low):
        table = Path(devices).name if devices else "a table of devices"
        yield (f"{len(low)} of {len(measurements.devices)} devices have no height "
               f"({some(low)}): give it in {table} (column above_ground_m). `fit` over a 3D map "
               "needs it; without a map 1.5 m is taken")
    unknown = int((~measurements.is_anchor).sum())
    if unknown:
        anchors = ("" if measurements.is_anchor.any() else
                   ", but needs some of known position: give them with --devices TABLE")
        yield (f"{unknown} of {len(measurements.devices)} devices have no position: `fit` locates "
               f"them{anchors}")


def _name_warnings(measurements: Measurements) -> Iterator[str]:
    """Warn about names that are long numbers, of which a spreadsheet has cut the last digits."""
    for end in ("device", "receiver"):
        cut = [name for name in measurements.table[end].unique() if _CUT_NUMBER.fullmatch(name)]
        if cut:
            yield (f"{end} {cut[0]!r} is a number whose last digits a spreadsheet has cut "
                   f"({len(cut)} such names): several may be one; export the column as text")


def _level_warnings(positioned: PositionedLinks, measurements: Measurements, tally: Tally,
                    readings: int) -> Iterator[str]:
    """Warn about levels that look like codes: the smallest too often, or far from all others."""
    missed = np.isnan(measurements.level_db).mean()
    if missed > MAX_MISSED:
        yield f"{missed:.0%} of the levels are not detected"
    impossible = sum(number for (reason, _), number in tally.left_out.items()
                     if reason == "impossible level")
    if impossible > MAX_IMPOSSIBLE * readings:
        yield f"{impossible / readings:.0%} of the levels are impossible. {_IMPOSSIBLE}"
    detected = positioned.links["level_db"].dropna()
    if len(detected) > MIN_SAMPLE and detected.min() < detected.max():
        share = (detected == detected.min()).mean()
        if share > MAX_SMALLEST:
            yield (f"{share:.0%} of the levels are {detected.min():g}, the smallest; if that means "
                   "not detected, put it into not_detected")
        levels_db = np.unique(detected)
        for i, other, side in ((0, 1, "below"), (-1, -2, "above")):
            apart_db = abs(levels_db[i] - levels_db[other])
            if apart_db >= ISOLATED_DB:
                number = int((detected == levels_db[i]).sum())
                yield (f"{number} of the levels {'is' if number == 1 else 'are'} "
                       f"{levels_db[i]:g}, {apart_db:.0f} dB {side} all others; if that is a code "
                       f"for unknown, give --not-measured {levels_db[i]:g}, if for too weak, "
                       f"--not-detected {levels_db[i]:g}")


def _time_and_angle_warnings(table: pd.DataFrame) -> Iterator[str]:
    """Warn about times outside the years `YEARS`, and headings that look like radians."""
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
    """Warn about a length of averaging outside of `WAVELENGTHS` (Lee 1985)."""
    if settings.average_m and "frequency_hz" in measurements.devices:
        frequency_hz = measurements.devices["frequency_hz"].median()
        length = settings.average_m * frequency_hz / speed_of_light
        if not WAVELENGTHS[0] <= length <= WAVELENGTHS[1]:
            low_m, high_m = (number * settings.average_m / length for number in WAVELENGTHS)
            yield (f"average_m = {settings.average_m:g} is {length:.0f} wavelengths; "
                   f"{WAVELENGTHS[0]} to {WAVELENGTHS[1]} (Lee 1985) are {low_m:.1f} to "
                   f"{high_m:.1f} m")


def import_files(paths: Path | str | Sequence[Path | str], settings: Settings, out: Path | str,
                 compress: bool = False,
                 on_progress: Callable[[str], None] = lambda step: None) -> dict[str, Any]:
    """Import files of measurements into a folder.

    The folder gets `measurements.csv`, `devices.csv`, `frame.toml` where the frame's origin is
    known, `import.toml`, with which the import can be repeated, and `import.json`, the report.

    Args:
        paths: files, folders of files, or zip files; several become one table with one origin.
        settings: mapping, units and filters.
        out: folder; an earlier import in it is replaced, other files are not.
        compress: write `measurements.csv.gz` instead of `measurements.csv`.
        on_progress: called with the name of each step.

    Returns:
        the report, as in `import.json`.

    Raises:
        BadInput: all errors, with file, row and column; nothing is written.
    """
    out = Path(out)
    require_folder(out, FILES, mark="import.json")
    paths = [paths] if isinstance(paths, (str, Path)) else paths
    tables = [out, settings.devices, settings.receivers, *(track.file for track in settings.track)]
    files, others = list_files(paths, filter(None, tables))
    tally = Tally()
    logs = read_logs(files, settings, tally, on_progress)
    on_progress("positions")
    links, notes = add_tracks(logs.source, logs.links, settings, tally)
    positioned = add_positions(logs.source, links, settings, tally)
    positioned = _filtered(logs.source, positioned, settings, tally)
    notes += clock_notes(positioned.links)
    if settings.thin_m:
        on_progress("thinning")
        keep = stay_representatives(positioned.links, settings.thin_m)
        tally.drop(positioned.links, ~keep, f"stay within {settings.thin_m:g} m", "",
                   logs.source.where)
        positioned = positioned.select(keep)
    if positioned.links.empty:
        reasons = "; ".join(f"{number} {reason}" for (reason, _), number in tally.left_out.items())
        hint = f". {_IMPOSSIBLE}" if "impossible level" in reasons else ""
        if "impossible height" in reasons:
            hint += ". Where the file has no heights, leave their column out of the mapping"
        raise BadInput(f"{logs.source.path}: nothing is left of {logs.readings} readings: "
                       f"{reasons}{hint}")
    kept = len(positioned.links)
    table = positioned.links
    if settings.average_m:
        on_progress("averaging")
        table = average(table, settings.average_m, settings.average)
    measurements = _measurements(table, positioned.devices, logs.level_column, positioned.origin)
    if settings.devices is not None:
        measurements = _with_antennas(measurements, Path(settings.devices))
    report = _make_report(logs, [*logs.notes, *notes, *positioned.notes], others, kept, tally,
                         positioned, measurements, settings)
    on_progress("writing")
    formats = {each["format"] for each in logs.files}
    used = settings.model_copy(update={
        "origin": positioned.origin,
        "format": settings.format or (formats.pop() if len(formats) == 1 else None)})
    with atomic_folder(out) as folder:
        measurements.save(folder / ("measurements.csv.gz" if compress else "measurements.csv"))
        write_settings(used, folder / "import.toml", out)
        text = json.dumps(report, indent=1, ensure_ascii=False)
        (folder / "import.json").write_text(text + "\n", "utf-8")
    return report


def import_measurements(paths: Path | str | Sequence[Path | str], out: Path | str,
                        columns: Mapping[str, str] | Path | str | None = None, *,
                        compress: bool = False,
                        on_progress: Callable[[str], None] = lambda step: None,
                        **settings: Any) -> Measurements:
    """Import files of measurements into a folder, and return them.

    Args:
        paths: logs and tables, folders of them, or zip files, see `import_files`.
        out: folder, see `import_files`; its `import.json` counts the readings that were left out.
        columns: column of each quantity, such as `{"latitude": "lat", "level": "rsrp"}`; or a TOML
            file with these and all other settings.
        compress: write `measurements.csv.gz` instead of `measurements.csv`.
        on_progress: called with the name of each step.
        settings: fields of `Settings`, such as `level_unit="dBm"`; they replace those of the file.

    Raises:
        BadInput: names file, row and column, or the setting; nothing is written.
    """
    paths, out = [paths] if isinstance(paths, (str, Path)) else paths, Path(out)
    mapping = None if isinstance(columns, Mapping) else columns
    given: dict[str, Any] = {"columns": columns} if isinstance(columns, Mapping) else {}
    given |= {name: str(value) if isinstance(value, Path) else value
              for name, value in settings.items()}
    folder = Path(paths[0]).parent if paths else None
    import_files(paths, read_settings(mapping, given, folder), out, compress, on_progress)
    return read_measurements(out / ("measurements.csv.gz" if compress else "measurements.csv"))


def _filtered(source: Source, positioned: PositionedLinks, settings: Settings,
              tally: Tally) -> PositionedLinks:
    """Drop links outside the ranges of distance and level in the settings; unknown values pass.

    The distance is in 3D [m]; a difference of unknown heights counts as 0.
    """
    links = positioned.links
    distance_m: Any = None
    level_db = links["level_db"].to_numpy()
    if settings.min_distance_m is not None or settings.max_distance_m is not None:
        difference_m = (links[[f"receiver_{axis}_m" for axis in "xyz"]].to_numpy()
                        - positioned.device_m)
        difference_m[np.isnan(difference_m[:, 2]), 2] = 0.0
        distance_m = np.linalg.norm(difference_m, axis=1)
    keep = np.ones(len(links), dtype=bool)
    for limit, values, is_minimum, text in (
            (settings.min_distance_m, distance_m, True, "nearer than {} m"),
            (settings.max_distance_m, distance_m, False, "further than {} m"),
            (settings.min_level, level_db, True, "level below {}"),
            (settings.max_level, level_db, False, "level above {}")):
        if limit is None:
            continue
        bad = keep & (values < limit if is_minimum else values > limit)
        if bad.any():
            where = source.where(links.index[int(np.argmax(bad))])
            tally.count(text.format(limit), "", bad.sum(), where)
            keep &= ~bad
    return positioned if keep.all() else positioned.select(keep)


def _measurements(table: pd.DataFrame, devices: pd.DataFrame, level: str,
                  origin: Origin | None) -> Measurements:
    """Make the measurements: `level_db` renamed to `level`, columns in order, values rounded."""
    table = table.rename(columns={"level_db": level})
    order = ["time_s", *REQUIRED, level, *(name for name in OPTIONAL if name != "time_s")]
    table = table[[name for name in order if name in table]].reset_index(drop=True)
    return Measurements(_rounded(table), _rounded(devices), origin)


def _with_antennas(measurements: Measurements, path: Path) -> Measurements:
    """Add the files of antennas that the table of devices at `path` names, under new names."""
    names = measurements.devices.get("antenna", pd.Series(dtype=str)).fillna("")
    if not names.any():
        return measurements
    files = read_antenna_files(path, names, are_rows=False)
    placed = names.map(lambda name: name and f"{ANTENNAS}/{Path(name).name}")
    if placed.nunique() < names.nunique():
        raise BadInput(f"{path}: two files of antennas have one name in different folders; give "
                       "each a name of its own")
    return replace(measurements, devices=measurements.devices.assign(antenna=placed),
                   antenna_files={f"{ANTENNAS}/{Path(name).name}": content
                                  for name, content in files.items()})


def _rounded(table: pd.DataFrame) -> pd.DataFrame:
    """Round the columns of a table to `DECIMALS`."""
    return table.round({name: decimals for name in table for ending, decimals in DECIMALS.items()
                        if name.endswith(ending)})
