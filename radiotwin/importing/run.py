"""The whole import: from files to a folder."""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.geo.frames import FRAME_FILE
from radiotwin.importing.log_files import list_files
from radiotwin.importing.positions import PositionedLinks, add_positions
from radiotwin.importing.problems import Tally
from radiotwin.importing.reading import read_logs
from radiotwin.importing.repeats import average, stay_representatives
from radiotwin.importing.report import make_report
from radiotwin.importing.settings import Settings, read_settings, write_settings
from radiotwin.importing.source import Source
from radiotwin.importing.times import clock_notes
from radiotwin.importing.tracks import add_tracks
from radiotwin.io.files import atomic_folder
from radiotwin.io.forms import Origin
from radiotwin.links.measurements import OPTIONAL, REQUIRED, Measurements, read_measurements

FILES = {"measurements.csv", "measurements.csv.gz", "devices.csv", FRAME_FILE, "import.toml",
         "import.json"}
DECIMALS = {"_m": 3, "_db": 4, "_dbm": 4, "_deg": 4, "_s": 6}
"""End of a column's name -> decimals that are written; all finer than any measurement."""


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
        BadInput: all that is wrong, with file, row and column; nothing is written.
    """
    out = Path(out)
    _check_target(out)
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
        positioned = positioned.select(stay_representatives(positioned.links, settings.thin_m),
                                       logs.source, tally, f"stay within {settings.thin_m:g} m")
    if positioned.links.empty:
        reasons = "; ".join(f"{number} {reason}" for (reason, _), number in tally.left_out.items())
        raise BadInput(f"{logs.source.path}: nothing is left of {logs.readings} readings: "
                       f"{reasons}")
    kept = len(positioned.links)
    table = positioned.links
    if settings.average_m:
        on_progress("averaging")
        table = average(table, settings.average_m, settings.average)
    measurements = _measurements(table, positioned.devices, logs.level_column,
                                 positioned.frame.origin)
    report = make_report(logs, [*logs.notes, *notes], others, kept, tally, positioned,
                         measurements, settings)
    on_progress("writing")
    used = settings.model_copy(update={"origin": positioned.frame.origin,
                                       "format": settings.format or logs.format})
    with atomic_folder(out) as folder:
        measurements.write(folder / ("measurements.csv.gz" if compress else "measurements.csv"))
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
        out: folder, see `import_files`; its `import.json` counts what was left out.
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


def _check_target(out: Path) -> None:
    """Refuse a folder that holds anything but an earlier import."""
    if os.path.isdir(out):  # False, not an error, of a name that no folder can have
        others = sorted(path.name for path in out.iterdir() if path.name not in FILES)
        if others or (any(out.iterdir()) and not (out / "import.json").is_file()):
            detail = f" (it has {others[0]})" if others else ""
            raise BadInput(f"{out} is not empty and not an earlier import{detail}; choose another "
                           "output folder")


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
    return positioned if keep.all() else positioned.select(keep)


def _measurements(table: pd.DataFrame, devices: pd.DataFrame, level: str,
                  origin: Origin | None) -> Measurements:
    """Return the two tables with the columns in order and rounded."""
    table = table.rename(columns={"level_db": level})
    order = ["time_s", *REQUIRED, level, *(name for name in OPTIONAL if name != "time_s")]
    table = table[[name for name in order if name in table]].reset_index(drop=True)
    return Measurements(_rounded(table), _rounded(devices), origin)


def _rounded(table: pd.DataFrame) -> pd.DataFrame:
    return table.round({name: decimals for name in table for ending, decimals in DECIMALS.items()
                        if name.endswith(ending)})
