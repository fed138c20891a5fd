"""What `close-loop` makes of real measurements, against what is known of them: `real`.

The folder `RADIOTWIN_DATA` (default: `shared/data` beside the checkout) holds `duke_cbrs` and
`powder_frs`, each with `measurements.csv.gz` and `devices.csv`, and `powder_frs/noise_only.csv`;
docs/real-data.md says where they come from. Five to fifteen minutes a row.
"""

import os
import warnings
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin import BadInput, Measurements, close_loop, make_report, read_measurements
from studies.closeloop import counted, summary
from studies.closeloop_internals import locate_held_out, named_rmse_db, turned_rmse_db
from studies.runner import Study
from studies.tables import markdown, number

DATA = Path(os.environ.get("RADIOTWIN_DATA", Path(__file__).parents[2] / "shared" / "data"))
AZIMUTHS_DEG = {"A": 212, "B": 212, "C": 30, "D": 30, "E": 216, "F": 216}  # published; from north
WHEN = ("before", "after")


def real_cases(seed: int) -> dict[str, dict]:
    """Return both sets, and both with levels permuted within each device: a control."""
    return {name + "_shuffled" * shuffled: {"set": name, "hold_out": hold_out, "shuffled": shuffled}
            for shuffled in (False, True)
            for name, hold_out in (("duke_cbrs", "block"), ("powder_frs", "flight"))}


def find_in_real(seed: int, settings: dict) -> dict:
    """Close the loop on the real `set`, with links held out by `hold_out`."""
    folder = DATA / settings["set"]
    if not folder.is_dir():
        raise BadInput(f"{folder} is not there: docs/real-data.md says where to get it; name its "
                       "folder in RADIOTWIN_DATA")
    measurements = read_measurements(folder / "measurements.csv.gz")
    if settings["shuffled"]:
        measurements = permuted(measurements, seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loop = close_loop(measurements, None, "log-distance", seed, hold_out=settings["hold_out"])
        report = make_report(loop)
    error = report["error"]
    result = summary(report) | {
        "heldout": report["heldout"], "before_db": error["before"]["rmse_db"],
        "named_db": named_rmse_db(loop), "after_db": error["after"]["rmse_db"],
        "baselines_db": {name: scores["rmse_db"] for name, scores in report["baselines"].items()},
        "effects": [{"name": effect["name"], "parameters": effect["parameters"],
                     "heldout_nll_gain": effect["evidence"]["heldout_nll_gain"]}
                    for effect in report["effects"]]}
    if settings["set"] == "duke_cbrs" and not settings["shuffled"]:
        result |= {"azimuth_deg": _parameters(report, "antenna_pattern", "azimuth_deg"),
                   "azimuth_error_deg": azimuth_errors_deg(report),
                   "named_turned_by_180_db": turned_rmse_db(loop)}
    elif not settings["shuffled"]:
        off_db = floor_errors_db(report, folder)
        result |= {"by_day_db": {day: {when: scores[when]["rmse_db"] for when in WHEN}
                                 for day, scores in error["by_flight"].items()},
                   "floors": len(off_db), "floors_compared": int(np.isfinite(off_db).sum()),
                   "floor_median_abs_error_db": float(np.nanmedian(np.abs(off_db))),
                   "located": {when: _located(locate_held_out(loop, when == "after"))
                               for when in WHEN}}
    return result


def permuted(measurements: Measurements, seed: int) -> Measurements:
    """Return measurements whose levels have changed places within each device."""
    table, rng = measurements.table.copy(), np.random.default_rng(seed)
    column = measurements.level_column
    table[column] = table.groupby("device")[column].transform(
        lambda levels: rng.permutation(levels.to_numpy()))
    return Measurements(table, measurements.devices)


def _parameters(report: dict, effect: str, prefix: str) -> dict[str, float]:
    """Return an effect's parameters `prefix[END]` by end."""
    return {name[len(prefix) + 1:-1]: parameter["value"] for each in report["effects"]
            if each["name"] == effect for name, parameter in each["parameters"].items()
            if name.startswith(f"{prefix}[")}


def azimuth_errors_deg(report: dict) -> dict[str, float]:
    """Return how far each sector with an antenna of its own looks from the published azimuth."""
    found_deg = _parameters(report, "antenna_pattern", "azimuth_deg")
    return {name: (value - AZIMUTHS_DEG[name] + 180) % 360 - 180
            for name, value in found_deg.items()}


def floor_errors_db(report: dict, folder: Path) -> np.ndarray:
    """Return floors minus readings without a transmitter, which no fit has read [dB], or NaN."""
    noise_db = pd.read_csv(folder / "noise_only.csv").groupby("rx_id")["noise_db"].median()
    floors_db = _parameters(report, "noise_floor_censoring", "floor")
    return np.array([value - noise_db.get(name, np.nan) for name, value in floors_db.items()])


def _located(found: pd.DataFrame) -> dict:
    by_day = {day: rows for day, rows in found.groupby("flight", sort=False)} | {"all": found}
    return {day: {"devices": len(rows), "median_m": round(rows["error_m"].median()),
                  "ninety_m": round(rows["error_m"].quantile(0.9)),
                  "median_radius_m": round(rows["radius_m"].median()),
                  "within_radius": (rows["error_m"] <= rows["radius_m"]).mean()}
            for day, rows in by_day.items()}


def _text(found: dict) -> str:
    return f"{found['median_m']}, {100 * found['within_radius']:.0f} %"


def real_table(rows: pd.DataFrame) -> str:
    """Return errors, and days and how well transmitters are located of `powder_frs`."""
    by_name, lines = rows.set_index("name"), []
    for name in (each for each in real_cases(0) if each in by_name.index):
        row = by_name.loc[name]
        lines.append([f"`{name}`", row["heldout"]["by"], *(number(value, 2) for value in (
            row["before_db"], row["named_db"], row["after_db"],
            row["baselines_db"].get("regression_kriging"))), counted(row["named"])])
    parts = ["**Real measurements**\n\n" + markdown(
        ["set", "held out by", "log-distance [dB]", "named effects", "with interpolation",
         "kriging", "named"], lines)]
    if "powder_frs" in by_name.index:
        days, found = (by_name.loc["powder_frs", key] for key in ("by_day_db", "located"))
        parts.append("**`powder_frs`**: RMSE by day, before → after [dB]\n\n" + markdown(
            sorted(days), [[" → ".join(f"{days[day][when]:.1f}" for when in WHEN)
                            for day in sorted(days)]]))
        parts.append("**`powder_frs`**: median distance [m], and share within the 90 % radius\n\n"
                     + markdown(["day", "log-distance law", "corrected"], [
                         [day, *(_text(found[when][day]) for when in WHEN)]
                         for day in found["before"]]))
    return "\n\n".join(parts)


STUDIES = {"real": Study("What does close-loop find in real measurements?", find_in_real,
                         real_cases, real_table, seeds=1)}
