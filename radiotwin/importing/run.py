"""From a file to a folder: the whole import."""

import json
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.files import atomic_folder
from radiotwin.importing.averaging import average
from radiotwin.importing.levels import COLUMN
from radiotwin.importing.links import build_links
from radiotwin.importing.places import Placed, place
from radiotwin.importing.read import Source, read_source
from radiotwin.importing.sanity import make_report
from radiotwin.importing.settings import Settings
from radiotwin.importing.settings_file import write_settings
from radiotwin.importing.tally import Tally
from radiotwin.measurements import OPTIONAL, REQUIRED, Measurements

OWN_FILES = {"measurements.csv", "measurements.csv.gz", "devices.csv", "import.toml", "import.json"}
DECIMALS = {"_m": 3, "_db": 4, "_dbm": 4, "_deg": 4, "_s": 6}  # of what is written: all below what is measured


def import_file(path: Path | str, settings: Settings, out: Path | str, compress: bool = False,
                advance=lambda text: None) -> dict:
    """Import `path` into the folder `out`: `measurements.csv` (`compress`: `.csv.gz`), `devices.csv`, `import.toml`
    with which it can be repeated, and `import.json`, the report.

    Args:
        path: .csv, .csv.gz, .parquet or .geojson.
        settings: what the file does not say.
        out: folder; an earlier import there is replaced, anything else is not.
        compress: for files that are large.
        advance: called with the name of each step.

    Returns:
        the report, as in `import.json`

    Raises:
        BadInput: names file, row and column; nothing is written.
    """
    out = Path(out)
    _check_target(out)
    advance("reading")
    source, tally = read_source(path), Tally()
    rows = len(source)
    advance("repeated rows")
    source, repeated = _without_repetition(source)
    advance("links")
    links, width = build_links(source, settings, tally)
    readings = rows * width
    tally.count("repeats an earlier row exactly", "", len(repeated) * width,
                source.where(repeated[0]) if repeated else "")
    advance("positions")
    placed = _filtered(source, place(source, links, settings, tally), settings, tally)
    if placed.links.empty:
        raise BadInput(f"{path}: nothing is left of {readings} readings: " + "; ".join(
            f"{number} {reason}" for (reason, _), number in tally.left_out.items()))
    kept = len(placed.links)
    table = placed.links
    if settings.average_m:
        advance("averaging")
        table = average(table, settings.average_m, settings.average)
    measurements = _measurements(table, placed.devices, settings)
    report = make_report(source, rows, readings, kept, tally, placed, measurements, settings)
    advance("writing")
    with atomic_folder(out) as folder:
        measurements.write(folder / ("measurements.csv.gz" if compress else "measurements.csv"))
        write_settings(settings.model_copy(update={"origin": placed.frame.origin}), folder / "import.toml", out)
        (folder / "import.json").write_text(json.dumps(report, indent=1, ensure_ascii=False) + "\n", "utf-8")
    return report


def _check_target(out: Path) -> None:
    if out.is_dir():
        others = sorted(path.name for path in out.iterdir() if path.name not in OWN_FILES)
        if others or (any(out.iterdir()) and not (out / "import.json").is_file()):
            raise BadInput(f"{out} is not empty and not an earlier import"
                           + (f" (it has {others[0]})" if others else "") + "; choose another output folder")


def _without_repetition(source: Source) -> tuple[Source, list[int]]:
    """The rows that are not the same as an earlier one in every column, and the places of the others."""
    repeats = source.table.astype(str).duplicated() if source.table.dtypes.eq(object).any() \
        else source.table.duplicated()
    return Source(source.path, source.table[~repeats], source.where), list(source.table.index[repeats])


def _filtered(source: Source, placed: Placed, settings: Settings, tally: Tally) -> Placed:
    """Without the links that the filters leave out; what is unknown passes."""
    receiver_m = placed.links[[f"receiver_{axis}_m" for axis in "xyz"]].to_numpy()
    apart_m = receiver_m - placed.device_m
    apart_m[np.isnan(apart_m[:, 2]), 2] = 0.0
    distance_m = np.linalg.norm(apart_m, axis=1)
    level_db = placed.links["level_db"].to_numpy()
    links = placed.links
    keep = np.ones(len(links), dtype=bool)
    for bad, reason in ((distance_m < (settings.min_distance_m or 0), f"nearer than {settings.min_distance_m} m"),
                        (distance_m > (settings.max_distance_m or np.inf), f"further than {settings.max_distance_m} m"),
                        (level_db < _or(settings.min_level, -np.inf), f"level below {settings.min_level}"),
                        (level_db > _or(settings.max_level, np.inf), f"level above {settings.max_level}")):
        bad = bad & keep
        tally.count(reason, "", bad.sum(), source.where(links.index[int(np.argmax(bad))]) if bad.any() else "")
        keep &= ~bad
    links = links[keep]
    devices = placed.devices[placed.devices["device"].isin(links["device"])].reset_index(drop=True)
    return Placed(links, devices, placed.device_m[keep], placed.frame)


def _or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value


def _measurements(table: pd.DataFrame, devices: pd.DataFrame, settings: Settings) -> Measurements:
    level = COLUMN[str(settings.level_unit)]
    table = table.rename(columns={"level_db": level})
    order = ["time_s", *REQUIRED, level, *(name for name in OPTIONAL if name != "time_s")]
    table = table[[name for name in order if name in table]].reset_index(drop=True)
    return Measurements(_rounded(table), _rounded(devices))


def _rounded(table: pd.DataFrame) -> pd.DataFrame:
    return table.round({name: decimals for name in table for ending, decimals in DECIMALS.items()
                        if name.endswith(ending)})
