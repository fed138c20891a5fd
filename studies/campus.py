"""A real campus with its real map, from the raw files to causes: `campus`.

The folder `RADIOTWIN_DATA` (default: `shared/data` beside the checkout) holds `duke_cbrs` with
`raw.csv.gz`, `sites.csv`, `import.toml` and `map.osm`; docs/real-data.md says where they come from.
"""

import gzip
import re
import shutil
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import t as student

from radiotwin import BadInput, Loop, Measurements, Scene, close_loop, make_report
from radiotwin.importing import import_files, read_settings
from radiotwin.links.alignment import in_scene_frame
from radiotwin.links.measurements import read_measurements
from radiotwin.scene.build import BuildOptions
from radiotwin.scene.readers import build_scene_from_map
from studies.closeloop import counted, summary
from studies.closeloop_real import (
    AZIMUTHS_DEG,
    DATA,
    azimuth_errors_deg,
    explained,
    one_in_each_cell,
    permuted,
    turned_rmse_db,
)
from studies.runner import Study
from studies.tables import markdown, number

BBOX_DEG = (35.9924, -78.9427, 36.0078, -78.9288)  # of the campus: south, west, north, east
HEIGHT_DEFAULT_M, FREQUENCY_HZ = 14.0, 3.6e9
SPLITS = {"block": "60 m blocks", "quadrant": "a quadrant of the area", "device": "a sector"}
BASES = ("twin", "raytrace", "log-distance")
CONTROLS = {"mirrored": "map mirrored", "shifted": "map shifted by 50 m",
            "permuted": "levels permuted within each sector",
            "permuted-all": "levels permuted over all sectors"}
LACKING = {"no-heights": "a map without heights: 14 m everywhere",
           "one-phone": "the readings of one phone", "thinned": "one reading in each 10 m cell",
           "thinned-quadrant": "the same, a quadrant of the area held out",
           "thinned-device": "the same, a sector held out"}
TOLD = {f"told-{split}": words for split, words in SPLITS.items()} | {
    "turned-device": "a sector, with all azimuths turned by 180°"}
PHONE, CELL_M = "Pixel", 10.0
HEIGHT_TAG = re.compile(r'<tag k="(building:)?(min_)?(height|levels?|min_level)" [^>]*>')
SHIFT_M = 50.0
COVERAGE = 0.9


@contextmanager
def campus(heights: bool = True) -> Iterator[tuple[Measurements, Scene]]:
    """Make the readings in the scene's frame, and the scene, both from the raw files.

    Args:
        heights: False: leave heights and storeys out of the map.

    Raises:
        BadInput: the files are not there.
    """
    source = DATA / "duke_cbrs"
    if not (source / "map.osm").is_file():
        raise BadInput(f"{source / 'map.osm'} is not there: docs/real-data.md says where to get "
                       "it; name the folder above it in RADIOTWIN_DATA")
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of positions indoors and the like: they are in the notes
        folder = Path(name)
        for each in ("sites.csv", "import.toml", "map.osm"):
            shutil.copy(source / each, folder / each)
        if not heights:
            path = folder / "map.osm"
            path.write_text(HEIGHT_TAG.sub("", path.read_text("utf-8")), "utf-8")
        with gzip.open(source / "raw.csv.gz") as raw, (folder / "raw.csv").open("wb") as target:
            shutil.copyfileobj(raw, target)
        import_files(folder / "raw.csv", read_settings(folder / "import.toml", {}, folder),
                    folder / "measured")
        build_scene_from_map(folder / "map.osm", folder / "scene",
                             BuildOptions(frequency_hz=FREQUENCY_HZ, bbox=BBOX_DEG,
                                          default_height_m=HEIGHT_DEFAULT_M))
        scene = Scene.load(folder / "scene")
        measured = in_scene_frame(read_measurements(folder / "measured" / "measurements.csv"),
                                  scene)
        yield measured, scene


def campus_cases(seed: int) -> dict[str, dict]:
    """Return all bases with all ways to hold out, and controls with a wrong map or wrong levels."""
    cases = {f"{split}-{base}": {"split": split, "base": base, "control": None}
             for split in SPLITS for base in BASES}
    for name in CONTROLS | LACKING:
        control, _, split = name.rpartition("-")
        other = split in SPLITS
        cases[name] = {"split": split if other else "block", "base": "twin",
                       "control": control if other else name}
    for name in TOLD:
        control, _, split = name.partition("-")
        cases[name] = {"split": split, "base": "twin", "control": control}
    return cases


def find_on_campus(seed: int, settings: dict) -> dict:
    """Close the loop on all readings."""
    has_map = settings["base"] != "log-distance"
    with campus(heights=settings["control"] != "no-heights") as (measured, scene):
        measured = _controlled(measured, settings["control"], seed)
        loop = close_loop(measured, scene if has_map else None, settings["base"], seed,
                          hold_out=settings["split"])
        report = make_report(loop)
    error = report["error"]
    result = summary(report) | {
        "links": len(loop.links), "before_db": error["before"]["rmse_db"],
        "named_db": explained(loop).rmse_db(), "named_bias_db": _bias_db(loop),
        "after_db": error["after"]["rmse_db"], "after_bias_db": error["after"]["bias_db"],
        "combined_db": error["combined"]["rmse_db"], "coverage": coverage(loop),
        "combined_coverage": error["combined"]["in_90_percent_interval"],
        "baselines_db": {name: scores["rmse_db"] for name, scores in report["baselines"].items()},
        "probabilities": report["posterior"], "notes": report["notes"],
        "effects": [{"name": effect["name"], "parameters": effect["parameters"]}
                    for effect in report["effects"]],
        "azimuth_error_deg": azimuth_errors_deg(report)}
    if settings["control"] is None and settings["split"] == "block":
        result["turned_by_180_db"] = turned_rmse_db(loop)
    return result


def _controlled(measured: Measurements, control: str | None, seed: int) -> Measurements:
    """Change the measurements for a control; moving them is the same as moving the map.

    Only the x of both ends is mirrored, so that distances stay.
    """
    table = measured.table
    if control in ("told", "turned"):
        return with_azimuths(measured, 180.0 * (control == "turned"))
    if control == "permuted":
        return permuted(measured, seed)
    if control == "permuted-all":
        levels = np.random.default_rng(seed).permutation(table[measured.level_column].to_numpy())
        return replace(measured, table=table.assign(**{measured.level_column: levels}))
    if control == "one-phone":
        return replace(measured, table=table[table["receiver"] == PHONE].reset_index(drop=True))
    if control == "thinned":
        return replace(measured, table=one_in_each_cell(table, CELL_M, ("device",), seed))
    if control == "shifted":
        return measured.moved(lambda position_m: position_m + [SHIFT_M, 0.0, 0.0], measured.origin)
    if control == "mirrored":
        return measured.moved(lambda position_m: position_m * [-1.0, 1.0, 1.0], measured.origin)
    return measured


def with_azimuths(measured: Measurements, turned_deg: float = 0.0) -> Measurements:
    """Declare the published azimuths in the devices' table, turned by an angle [degree]."""
    azimuth_deg = (measured.devices["device"].map(AZIMUTHS_DEG) + turned_deg) % 360
    return replace(measured, devices=measured.devices.assign(azimuth_deg=azimuth_deg))


def _bias_db(loop: Loop) -> float:
    model = explained(loop)
    return float(np.nanmean(model.links.level_db - model.held_out_mean_db))


def coverage(loop: Loop) -> float:
    """Return the share of held-out readings within their central 90 % interval."""
    mean_db, scale_db = loop.after.held_out_reading
    return share_within(loop.links.level_db - mean_db, scale_db, loop.after.whole.model.dof)


def share_within(error_db: np.ndarray, scale_db: np.ndarray, dof: float) -> float:
    """Return the share of errors within their central 90 % interval; Student's t."""
    known = np.isfinite(error_db)
    half_db = student.ppf(0.5 + COVERAGE / 2, dof) * scale_db
    return float((np.abs(error_db[known]) <= half_db[known]).mean())


def campus_table(rows: pd.DataFrame) -> str:
    """Return errors by split and base, azimuths, and the controls."""
    by_name = rows.set_index("name")
    named = [name for name in campus_cases(0) if name in by_name.index]
    parts = [markdown(
        ["held out", "base", "base alone [dB]", "named effects", "mean error", "with the rest",
         "combined", "best of the others", "in 90 %", "combined in 90 %", "named"],
        [[SPLITS[split], f"`{base}`", *(number(row[key], 2) for key in (
            "before_db", "named_db", "named_bias_db", "after_db", "combined_db")),
          _best(row["baselines_db"]), *_in_90(row), counted(row["named"])]
         for name in named if name not in CONTROLS | LACKING | TOLD
         for split, _, base in [name.partition("-")] for row in [by_name.loc[name]]],
        "A campus with its map", ": RMSE of held-out readings")]
    found = [(name, by_name.loc[name]) for name in named if name.startswith("block-")]
    sectors = sorted({each for _, row in found for each in row["azimuth_error_deg"]})
    parts.append(markdown(
        ["base", *sectors, "turned by 180° [dB]"],
        [[f"`{name.removeprefix('block-')}`",
          *(number(row["azimuth_error_deg"].get(each, np.nan), 0) for each in sectors),
          number(row["turned_by_180_db"], 2)] for name, row in found],
        "Azimuths found", ": how far off [°]"))
    told = [(name, by_name.loc[name]) for name in named if name in TOLD]
    if told:
        parts.append(markdown(
            ["held out", "base with them [dB]", "named effects", "mean error", "with the rest",
             "combined", "best of the others", "in 90 %", "combined in 90 %", "named",
             "all azimuths turned by [°]"],
            [[TOLD[name], *(number(row[key], 2) for key in (
                "before_db", "named_db", "named_bias_db", "after_db", "combined_db")),
              _best(row["baselines_db"]), *_in_90(row), counted(row["named"]),
              number(_turn_deg(row["effects"]), 1)] for name, row in told],
            "Azimuths declared", ", base `twin`: RMSE of held-out readings"))
    for title, words in (("Controls", CONTROLS), ("Less to learn from", LACKING)):
        if not set(words) & set(named):
            continue
        parts.append(markdown(
            [title.lower(), "links", "base alone [dB]", "named effects", "combined",
             "best of the others", "azimuths off by up to [°]", "named"],
            [[words[name], str(row["links"]), *(number(row[key], 2) for key in (
                "before_db", "named_db", "combined_db")), _best(row["baselines_db"]),
              number(max(map(abs, row["azimuth_error_deg"].values()), default=np.nan), 0),
              counted(row["named"])]
             for name in named if name in words for row in [by_name.loc[name]]],
            title, ", base `twin`; 60 m blocks held out, or what the row says"))
    return "\n\n".join(parts)


def _in_90(row: pd.Series) -> list[str]:
    """Return the shares of held-out readings in 90 % intervals, with shadowing and combined."""
    return [f"{100 * share:.0f} %" if np.isfinite(share) else "–"
            for share in (row["coverage"], row.get("combined_coverage", np.nan))]


def _turn_deg(effects: list[dict]) -> float:
    """Return the common rotation found of all declared azimuths [degree]; NaN if not used."""
    return next((effect["parameters"]["azimuth_offset_deg"]["value"] for effect in effects
                 if "azimuth_offset_deg" in effect["parameters"]), np.nan)


def _best(baselines_db: dict[str, float]) -> str:
    name = min(baselines_db, key=baselines_db.__getitem__)
    return f"{number(baselines_db[name], 2)} (`{name}`)"


STUDIES = {"campus": Study("What does the loop make of a real campus with its real map?",
                           find_on_campus, campus_cases, campus_table, seeds=1)}
