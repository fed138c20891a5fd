"""Results of `close-loop` on real measurements, against what is known of them: `real`.

The folder `RADIOTWIN_DATA` (default: `shared/data` beside the checkout) holds `duke_cbrs` and
`powder_frs`, each with `measurements.csv.gz` and `devices.csv`, and `powder_frs/noise_only.csv`;
docs/real-data.md says where they come from. Five to fifteen minutes a row.
"""

import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin import BadInput, Loop, Measurements, close_loop, make_report, read_measurements
from radiotwin.closeloop.crossfit import CrossFit
from radiotwin.effects.antennas import SectorEffect
from radiotwin.twin.localize import calibrate_radii, locate, whole_area
from radiotwin.twin.model.model import Fit
from studies.closeloop import counted, summary
from studies.runner import Study
from studies.tables import markdown, number

DATA = Path(os.environ.get("RADIOTWIN_DATA", Path(__file__).parents[2] / "shared" / "data"))
AZIMUTHS_DEG = {"A": 212, "B": 212, "C": 30, "D": 30, "E": 216, "F": 216}  # published; from north
WHEN = ("before", "after")
DEVICES_A_FOLD = 150  # that are located


def real_cases(seed: int) -> dict[str, dict]:
    """Return both sets, and both with levels permuted within each device: a control."""
    return {name + "_shuffled" * shuffled: {"set": name, "hold_out": hold_out, "shuffled": shuffled}
            for shuffled in (False, True)
            for name, hold_out in (("duke_cbrs", "block"), ("powder_frs", "flight"))}


def real_campaign(name: str) -> Measurements:
    """Return the measurements of a folder of real ones.

    Raises:
        BadInput: it is not there.
    """
    folder = DATA / name
    if not folder.is_dir():
        raise BadInput(f"{folder} is not there: docs/real-data.md says where to get it; name its "
                       "folder in RADIOTWIN_DATA")
    return read_measurements(folder / "measurements.csv.gz")


def one_in_each_cell(table: pd.DataFrame, cell_m: float, labels: tuple[str, ...],
                     seed: int) -> pd.DataFrame:
    """Return one row, drawn at random, of each square on the ground and each of some labels."""
    cell = np.floor(table[["receiver_x_m", "receiver_y_m"]] / cell_m)
    cell = cell.assign(**{label: table[label] for label in labels})
    kept = ~cell.sample(frac=1.0, random_state=seed).duplicated().sort_index()
    return table[kept].reset_index(drop=True)


def find_in_real(seed: int, settings: dict) -> dict:
    """Close the loop on the real `set`, with links held out by `hold_out`."""
    measurements = real_campaign(settings["set"])
    if settings["shuffled"]:
        measurements = permuted(measurements, seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loop = close_loop(measurements, None, "log-distance", seed, hold_out=settings["hold_out"])
        report = make_report(loop)
    error = report["error"]
    result = summary(report) | {
        "heldout": report["heldout"], "before_db": error["before"]["rmse_db"],
        "named_db": explained(loop).rmse_db(), "after_db": error["after"]["rmse_db"],
        "combined_db": error["combined"]["rmse_db"],
        "baselines_db": {name: scores["rmse_db"] for name, scores in report["baselines"].items()},
        "posterior": report["posterior"],
        "effects": [{"name": effect["name"], "parameters": effect["parameters"],
                     "probability": effect["probability"],
                     "heldout_nll_gain": effect["evidence"]["heldout_nll_gain"]}
                    for effect in report["effects"]]}
    if settings["set"] == "duke_cbrs" and not settings["shuffled"]:
        result |= {"azimuth_deg": _parameters(report, "antenna_pattern", "azimuth_deg"),
                   "azimuth_error_deg": azimuth_errors_deg(report),
                   "named_turned_by_180_db": turned_rmse_db(loop)}
    elif not settings["shuffled"]:
        off_db = floor_errors_db(report, DATA / settings["set"])
        result |= {"by_day_db": {day: {when: scores[when]["rmse_db"] for when in WHEN}
                                 for day, scores in error["by_flight"].items()},
                   "floors": len(off_db), "floors_compared": int(np.isfinite(off_db).sum()),
                   "floor_median_abs_error_db": float(np.nanmedian(np.abs(off_db))),
                   "located": {when: locate_held_out(loop, getattr(loop, when)) for when in WHEN}}
    return result


def permuted(measurements: Measurements, seed: int) -> Measurements:
    """Return measurements whose levels have changed places within each device."""
    table, rng = measurements.table.copy(), np.random.default_rng(seed)
    column = measurements.level_column
    table[column] = table.groupby("device")[column].transform(
        lambda levels: rng.permutation(levels.to_numpy()))
    return Measurements(table, measurements.devices)


def explained(loop: Loop) -> CrossFit:
    """Return the model with the named effects, without interpolation of the rest."""
    return loop.explained


def turned_rmse_db(loop: Loop) -> float:
    """Return its held-out error with all sector antennas turned by 180°, the rest refitted [dB]."""
    def turned(fit: Fit) -> Fit:
        effects = []
        for each in fit.effects:
            if isinstance(each, SectorEffect):
                each = each.changed(devices={
                    device: pattern.model_copy(update={"azimuth_deg": pattern.azimuth_deg + 180.0})
                    for device, pattern in each.params.devices.items()})
            effects.append(each)
        return fit.model.with_effects(effects).fit()

    return explained(loop).map(turned).rmse_db()


def locate_held_out(loop: Loop, model: CrossFit) -> dict[str, dict]:
    """Locate devices of each fold by what was learnt from the others, with calibrated 90 % radii.

    Returns:
        By flight (a fold each), of at most 150 devices, and of all.
    """
    models = [fold.learnt for fold in model.folds]
    folds = [loop.links.select(model.index == index) for index in range(len(models))]
    area_m, rng, rows = whole_area(models[0], loop.links), np.random.default_rng(0), []
    for index, (learnt, fold) in enumerate(zip(models, folds)):
        others, elsewhere = ([*each[:index], *each[index + 1:]] for each in (models, folds))
        known = calibrate_radii(others, elsewhere, area_m, 0)  # type: ignore[arg-type]
        chosen = rng.permutation(np.unique(fold.device))[:DEVICES_A_FOLD]
        asked = fold.select(np.isin(fold.device, chosen))
        for found in locate(replace(learnt, **vars(known)), asked, area_m):
            row = loop.links.device_names.index(found.device)
            away_m = loop.links.device_m[row, :2] - (found.x_m, found.y_m)
            rows.append((fold.flight_names[fold.flight[0]], np.hypot(*away_m),
                         found.credible_radius_m))
    located = pd.DataFrame(rows, columns=["flight", "error_m", "radius_m"])
    by_day = {day: own for day, own in located.groupby("flight", sort=False)} | {"all": located}
    return {day: {"devices": len(own), "median_m": round(own["error_m"].median()),
                  "ninety_m": round(own["error_m"].quantile(0.9)),
                  "median_radius_m": round(own["radius_m"].median()),
                  "within_radius": (own["error_m"] <= own["radius_m"]).mean()}
            for day, own in by_day.items()}


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


def real_table(rows: pd.DataFrame) -> str:
    """Return errors, and days and how well transmitters are located of `powder_frs`."""
    by_name = rows.set_index("name")
    parts = [markdown(
        ["set", "held out by", "log-distance [dB]", "named effects", "with interpolation",
         "combined", "best baseline", "named"],
        [[f"`{name}`", row["heldout"]["by"], *(number(value, 2) for value in (
            row["before_db"], row["named_db"], row["after_db"], row["combined_db"])),
          _best(row["baselines_db"]), counted(row["named"])]
         for name, row in by_name.reindex(real_cases(0)).dropna(how="all").iterrows()],
        "Real measurements")]
    if "powder_frs" in by_name.index:
        days, found = (by_name.loc["powder_frs", key] for key in ("by_day_db", "located"))
        parts.append(markdown(
            sorted(days), [[" → ".join(f"{days[day][when]:.1f}" for when in WHEN)
                            for day in sorted(days)]],
            "`powder_frs`", ": RMSE by day, before → after [dB]"))
        parts.append(markdown(["day", "log-distance law", "corrected"], [
            [day, *(f"{each['median_m']}, {100 * each['within_radius']:.0f} %"
                    for each in (found[when][day] for when in WHEN))] for day in found["before"]],
            "`powder_frs`", ": median distance [m], and share within the 90 % radius"))
    return "\n\n".join(parts)


def _best(baselines_db: dict[str, float]) -> str:
    name = min(baselines_db, key=baselines_db.__getitem__)
    return f"{number(baselines_db[name], 2)} (`{name}`)"


STUDIES = {"real": Study("What does close-loop find in real measurements?", find_in_real,
                         real_cases, real_table, seeds=1)}
