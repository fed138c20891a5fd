"""The whole import: from a file to a folder."""

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.files import atomic_folder
from radiotwin.frames import FRAME_FILE
from radiotwin.importing.averaging import average
from radiotwin.importing.levels import LEVEL_COLUMN
from radiotwin.importing.links import build_links
from radiotwin.importing.positions import PositionedLinks, add_positions
from radiotwin.importing.report import make_report
from radiotwin.importing.settings import Settings
from radiotwin.importing.settings_file import read_settings, write_settings
from radiotwin.importing.source import Source, read_source
from radiotwin.importing.tally import Tally
from radiotwin.measurements import OPTIONAL, REQUIRED, Measurements, read_measurements
from radiotwin.tables import Origin

HASHED_AT_ONCE = 500_000  # rows; bounds the memory of that
FILES = {"measurements.csv", "measurements.csv.gz", "devices.csv", FRAME_FILE, "import.toml",
         "import.json"}
DECIMALS = {"_m": 3, "_db": 4, "_dbm": 4, "_deg": 4, "_s": 6}
"""End of a column's name -> decimals that are written; all finer than any measurement."""


def import_file(path: Path | str, settings: Settings, out: Path | str, compress: bool = False,
                on_progress: Callable[[str], None] = lambda step: None) -> dict[str, Any]:
    """Import a file of measurements into a folder.

    The folder gets `measurements.csv`, `devices.csv`, `frame.toml` where the frame's origin is
    known, `import.toml`, with which the import can be repeated, and `import.json`, the report.

    Args:
        path: `.csv`, `.csv.gz`, `.parquet` or `.geojson`.
        settings: mapping, units and filters.
        out: folder; an earlier import in it is replaced, other files are not.
        compress: write `measurements.csv.gz` instead of `measurements.csv`.
        on_progress: called with the name of each step.

    Returns:
        the report, as in `import.json`.

    Raises:
        BadInput: names file, row and column; nothing is written.
    """
    out = Path(out)
    _check_target(out)
    on_progress("reading")
    source, tally = read_source(path), Tally()
    rows = len(source)
    on_progress("repeated rows")
    source, repeated = _without_repetition(source)
    on_progress("links")
    links, per_row = build_links(source, settings, tally)
    readings = rows * per_row
    tally.count("repeats an earlier row exactly", "", len(repeated) * per_row,
                source.where(repeated[0]) if repeated else "")
    source = source.without_cells()
    on_progress("positions")
    positioned = add_positions(source, links, settings, tally)
    positioned = _filtered(source, positioned, settings, tally)
    if positioned.links.empty:
        reasons = "; ".join(f"{number} {reason}" for (reason, _), number in tally.left_out.items())
        raise BadInput(f"{path}: nothing is left of {readings} readings: {reasons}")
    kept = len(positioned.links)
    table = positioned.links
    if settings.average_m:
        on_progress("averaging")
        table = average(table, settings.average_m, settings.average)
    measurements = _measurements(table, positioned.devices, settings, positioned.frame.origin)
    report = make_report(source, rows, readings, kept, tally, positioned, measurements, settings)
    on_progress("writing")
    used = settings.model_copy(update={"origin": positioned.frame.origin})
    with atomic_folder(out) as folder:
        measurements.write(folder / ("measurements.csv.gz" if compress else "measurements.csv"))
        write_settings(used, folder / "import.toml", out)
        text = json.dumps(report, indent=1, ensure_ascii=False)
        (folder / "import.json").write_text(text + "\n", "utf-8")
    return report


def import_measurements(path: Path | str, out: Path | str,
                        columns: Mapping[str, str] | Path | str | None = None, *,
                        compress: bool = False,
                        on_progress: Callable[[str], None] = lambda step: None,
                        **settings: Any) -> Measurements:
    """Import a file of measurements into a folder, and return them.

    Args:
        path: `.csv`, `.csv.gz`, `.parquet` or `.geojson`.
        out: folder, see `import_file`; its `import.json` counts what was left out.
        columns: column of each quantity, such as `{"latitude": "lat", "level": "rsrp"}`; or a TOML
            file with these and all other settings.
        compress: write `measurements.csv.gz` instead of `measurements.csv`.
        on_progress: called with the name of each step.
        settings: fields of `Settings`, such as `level_unit="dBm"`; they replace those of the file.

    Raises:
        BadInput: names file, row and column, or the setting; nothing is written.
    """
    path, out = Path(path), Path(out)
    mapping = None if isinstance(columns, Mapping) else columns
    given: dict[str, Any] = {"columns": columns} if isinstance(columns, Mapping) else {}
    given |= {name: str(value) if isinstance(value, Path) else value
              for name, value in settings.items()}
    import_file(path, read_settings(mapping, given, path.parent), out, compress, on_progress)
    return read_measurements(out / ("measurements.csv.gz" if compress else "measurements.csv"))


def _check_target(out: Path) -> None:
    """Refuse a folder that holds anything but an earlier import."""
    if os.path.isdir(out):  # False, not an error, of a name that no folder can have
        others = sorted(path.name for path in out.iterdir() if path.name not in FILES)
        if others or (any(out.iterdir()) and not (out / "import.json").is_file()):
            detail = f" (it has {others[0]})" if others else ""
            raise BadInput(f"{out} is not empty and not an earlier import{detail}; choose another "
                           "output folder")


def _without_repetition(source: Source) -> tuple[Source, list[int]]:
    """Remove the rows that equal an earlier one in every column; return also their indices."""
    table = source.table
    rows = np.arange(len(table))  # that repeat, or are repeated, in the columns so far
    key = np.zeros(len(table), dtype=np.uint64)
    for name in table:
        key = key * np.uint64(0x9E3779B97F4A7C15) + _hashes(table[name], rows)
        again = pd.Series(key).duplicated(keep=False).to_numpy()
        rows, key = rows[again], key[again]
    if not len(rows):
        return source, []
    comparable = table.iloc[rows]  # equal hashes may be of different rows
    if table.dtypes.eq(object).any():
        comparable = comparable.astype(str)
    repeats = np.zeros(len(table), dtype=bool)
    repeats[rows] = comparable.duplicated()
    unique = Source(source.path, table[~repeats], source.where)
    return unique, list(table.index[repeats])


def _hashes(cells: pd.Series, rows: np.ndarray) -> np.ndarray:
    """Return hashes (n,) of the cells of some rows; equal cells have equal ones."""
    parts = [np.empty(0, dtype=np.uint64)]
    for start in range(0, len(rows), HASHED_AT_ONCE):
        part = cells.iloc[rows[start:start + HASHED_AT_ONCE]]
        if part.dtype.kind == "O":
            part = part.astype(str)
        elif part.dtype.kind == "f":
            part = part + 0.0  # of two zeros that are equal, one is negative
        parts.append(pd.util.hash_pandas_object(part, index=False).to_numpy())
    return np.concatenate(parts)


def _filtered(source: Source, positioned: PositionedLinks, settings: Settings,
              tally: Tally) -> PositionedLinks:
    """Apply the limits of distance and level; a link whose value is unknown passes."""
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
    if keep.all():
        return positioned
    links = links[keep]
    devices = positioned.devices
    devices = devices[devices["device"].isin(links["device"])].reset_index(drop=True)
    return PositionedLinks(links, devices, positioned.device_m[keep], positioned.frame)


def _measurements(table: pd.DataFrame, devices: pd.DataFrame, settings: Settings,
                  origin: Origin | None) -> Measurements:
    """Return the two tables with the columns in order and rounded."""
    level = LEVEL_COLUMN[str(settings.level_unit)]
    table = table.rename(columns={"level_db": level})
    order = ["time_s", *REQUIRED, level, *(name for name in OPTIONAL if name != "time_s")]
    table = table[[name for name in order if name in table]].reset_index(drop=True)
    return Measurements(_rounded(table), _rounded(devices), origin)


def _rounded(table: pd.DataFrame) -> pd.DataFrame:
    return table.round({name: decimals for name in table for ending, decimals in DECIMALS.items()
                        if name.endswith(ending)})
