"""What the loop makes of real measurements, against what is known of them.

    python benchmarks/real_data.py DATA -o docs/results/real_data.json [--only NAME …]

DATA has the folders `duke_cbrs` and `powder_frs` (docs/real-data.md says where they come from), each with
`measurements.csv.gz` and `devices.csv`, and `powder_frs/noise_only.csv`. An entry that is in the file already is left
out, so that a run that was stopped goes on. Five to fifteen minutes an entry.
"""

import argparse
import json
import resource
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.closeloop.locate import Corrected, calibrated_temper, locate, whole_area
from radiotwin.closeloop.report import make_report
from radiotwin.closeloop.run import Loop, close_loop
from radiotwin.closeloop.search import Model, rmse_db
from radiotwin.effects.sector_antenna import SectorAntenna
from radiotwin.files import atomic_path
from radiotwin.measurements import Measurements, read_measurements

AZIMUTHS_DEG = {"A": 212, "B": 212, "C": 30, "D": 30, "E": 216, "F": 216}  # clockwise from north
DEVICES_A_DAY = 150


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=list(STUDIES), choices=list(STUDIES))
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    results = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    for name in arguments.only:
        if name in results:
            continue
        started = time.process_time()
        results[name] = STUDIES[name](arguments.data)
        results[name] |= {"cpu_s": round(time.process_time() - started),
                          "peak_gib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2)}
        print(name, json.dumps(results[name]), flush=True)
        with atomic_path(arguments.out) as temporary:
            temporary.write_text(json.dumps(results, indent=1), encoding="utf-8")


def duke_cbrs(data: Path) -> dict:
    """LTE on a campus, held out in blocks of 60 m: which way do the sectors look?"""
    loop, summary = _close(read_measurements(data / "duke_cbrs" / "measurements.csv.gz"), "block")
    found_deg, off_deg = azimuths_deg(loop)
    return summary | {
        "azimuth_deg": {name: round(value, 1) for name, value in sorted(found_deg.items())},
        "azimuth_error_deg": {name: round(value, 1) for name, value in sorted(off_deg.items())},
        "named_turned_by_180_db": round(turned_rmse_db(loop.search.explained), 2)}


def powder_frs(data: Path) -> dict:
    """Hand-held transmitters heard by many receivers, held out by day: floors, and where transmitters are."""
    folder = data / "powder_frs"
    loop, summary = _close(read_measurements(folder / "measurements.csv.gz"), "flight")
    off_db = floor_errors_db(loop, folder)
    return summary | {
        "by_day_db": {name: {when: round(rmse_db(model, loop.records.flight == day), 2) for when, model in
                             (("before", loop.before), ("after", loop.after))}
                      for day, name in enumerate(loop.records.flight_names)},
        "floors": len(off_db), "floors_compared": int(np.isfinite(off_db).sum()),
        "floor_median_abs_error_db": round(float(np.nanmedian(np.abs(off_db))), 2) if len(off_db) else None,
        "located": {"before": _located(loop, loop.before), "after": _located(loop, loop.after)}}


def _shuffled(name: str, hold_out: str) -> Callable[[Path], dict]:
    def study(data: Path) -> dict:
        """Levels permuted within each device: nothing is there to be found."""
        return _close(permuted(read_measurements(data / name / "measurements.csv.gz"), 0), hold_out)[1]
    return study


STUDIES = {"duke_cbrs": duke_cbrs, "powder_frs": powder_frs, "duke_cbrs_shuffled": _shuffled("duke_cbrs", "block"),
           "powder_frs_shuffled": _shuffled("powder_frs", "flight")}


def azimuths_deg(loop: Loop) -> tuple[dict[str, float], dict[str, float]]:
    """Where each sector with an antenna of its own looks, and how far that is from the published azimuth."""
    found = {loop.records.device_names[int(device)]: pattern[0] % 360 for part in loop.after.whole.parts
             if isinstance(part.effect, SectorAntenna) for device, pattern in part.setting["devices"].items()}
    return found, {name: (value - AZIMUTHS_DEG[name] + 180) % 360 - 180 for name, value in found.items()}


def turned_rmse_db(model: Model) -> float:
    """Held-out error with every boresight turned round, everything else fitted again."""
    sides, fits = [], []
    for side in model.sides:
        parts = [side.part(part.effect, {"devices": {device: [pattern[0] + 180.0, *pattern[1:]] for device, pattern in
                                                     part.setting["devices"].items()}})
                 if isinstance(part.effect, SectorAntenna) else part for part in side.parts]
        sides.append(side.with_parts(parts))
        fits.append(sides[-1].fit())
    return rmse_db(Model(sides[0], sides[1:], fits, model.index), np.ones(len(model.index), dtype=bool))


def floor_errors_db(loop: Loop, folder: Path) -> np.ndarray:
    """How far the floors that were found are from readings without a transmitter, which no fit has read; NaN for
    receivers without such readings."""
    noise_db = pd.read_csv(folder / "noise_only.csv").groupby("rx_id")["noise_db"].median()
    floors_db = next((part.setting["receivers"] for part in loop.after.whole.parts
                      if part.effect.name == "noise_floor_censoring"), {})
    return np.array([floor_db - noise_db.get(loop.records.receiver_names[int(receiver)], np.nan)
                     for receiver, floor_db in floors_db.items()])


def permuted(measurements: Measurements, seed: int) -> Measurements:
    """Measurements whose levels have changed places within each device."""
    table, rng = measurements.table.copy(), np.random.default_rng(seed)
    column = measurements.level_column
    table[column] = table.groupby("device")[column].transform(lambda levels: rng.permutation(levels.to_numpy()))
    return Measurements(table, measurements.devices)


def _close(measurements: Measurements, hold_out: str) -> tuple[Loop, dict]:
    """The loop, and what it took."""
    started = time.process_time()
    loop = close_loop(measurements, None, "log-distance", 0, lambda text: None, hold_out)
    return loop, _summary(loop) | {"loop_cpu_s": round(time.process_time() - started)}


def _summary(loop: Loop) -> dict:
    report = make_report(loop)
    everything = np.ones(len(loop.records), dtype=bool)
    return {"verdict": report["verdict"], "named": [effect["name"] for effect in report["effects"]],
            "heldout": report["heldout"], "before_db": round(rmse_db(loop.before, everything), 2),
            "named_db": round(rmse_db(loop.search.explained, everything), 2),
            "after_db": round(rmse_db(loop.after, everything), 2),
            "baselines_db": {name: round(scores["rmse_db"], 2) for name, scores in report["baselines"].items()},
            "effects": [{"name": effect["name"], "parameters": effect["parameters"],
                         "heldout_nll_gain": effect["evidence"]["heldout_nll_gain"]} for effect in report["effects"]],
            "drivers": [driver["variable"] for driver in report["remaining"]["drivers"]]}


def _located(loop: Loop, model: Model) -> dict:
    """Held-out devices found by models of the other days, and the regions calibrated on those."""
    records = loop.records
    device_m = records.device_m[:, :2]
    models = [Corrected.of(side, fit) for side, fit in zip(model.folds, model.fits[1:])]
    days = [records.select(model.index == number) for number in range(len(models))]
    area_m = whole_area(models[0], records)
    rng, result, every = np.random.default_rng(0), {}, []
    for number, (corrected, day) in enumerate(zip(models, days)):
        others = [i for i in range(len(models)) if i != number]
        temper = calibrated_temper([models[i] for i in others], [days[i] for i in others], area_m, 0)
        devices = np.unique(day.device)
        chosen = rng.permutation(devices)[:DEVICES_A_DAY]
        places = list(locate(replace(corrected, temper=temper), day.select(np.isin(day.device, chosen)), area_m))
        off_m = np.array([[np.hypot(*(device_m[p.device] - (p.x_m, p.y_m))), p.radius_m] for p in places])
        every.append(off_m)
        result[day.flight_names[day.flight[0]]] = _errors(off_m) | {"temper": temper}
    return result | {"all": _errors(np.vstack(every))}


def _errors(off_m: np.ndarray) -> dict:
    return {"devices": len(off_m), "median_m": round(float(np.median(off_m[:, 0]))),
            "ninety_m": round(float(np.quantile(off_m[:, 0], 0.9))),
            "median_radius_m": round(float(np.median(off_m[:, 1]))),
            "within_radius": round(float((off_m[:, 0] <= off_m[:, 1]).mean()), 3)}


if __name__ == "__main__":
    main()
