"""Learning curves on a real campus: number of readings, and areas left out: `readings`, `away`.

Each row is a user who has these readings and no others: base, effects and combination are learnt
from them alone, with blocks of them held out, and so are the other models.
"""

from dataclasses import replace
from itertools import product

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from radiotwin import Measurements, Scene, close_loop, make_report
from radiotwin.closeloop.output.corrected_twin import corrected_twin
from radiotwin.closeloop.predict.baselines import (
    BOOSTING,
    EXTRA_TREES,
    Part,
    fitted_law,
    law_db,
    trees_db,
)
from radiotwin.links import Links, prepare_links
from radiotwin.propagation.laws.kriging import RegressionKriging
from radiotwin.propagation.laws.log_distance import LogDistance, SegmentedLogDistance
from studies.campus import campus, share_within, with_azimuths
from studies.closeloop import counted, summary
from studies.closeloop_real import AZIMUTHS_DEG, azimuth_errors_deg
from studies.runner import Study
from studies.tables import markdown, number

READINGS = (250, 500, 1000, 2000, 4000)
WAYS = {"scattered": "scattered over the campus", "drives": "of some squares of 60 m"}
SQUARE_M = 60.0  # side of the squares that few drives are drawn by
QUADRANTS = ("south-west", "north-west", "south-east", "north-east")
TWIN, NAMED = "twin", "named effects alone"


def learn_from(measured: Measurements, scene: Scene, learnt: np.ndarray, seed: int) -> dict:
    """Fit twins to a mask (n,) of readings, and score their prediction of all others.

    Returns:
        what was named, `rmse_db` of the others by model, and the `coverage` of the twin's 90 %
        intervals of their readings.
    """
    links = prepare_links(measured, scene)
    rows = _rows_of(links, measured, np.flatnonzero(learnt))
    test = np.setdiff1d(np.arange(len(links)), rows)
    loop = close_loop(measured.select(learnt), scene, "twin", seed, hold_out="block")
    twin = corrected_twin(loop, scene)
    named = replace(twin, fitted=replace(twin.fitted, shadowing=None, blend=None))
    others = links.select(test)
    by_twin, dof = twin.predict(others), twin.fitted.dof
    scale_db = by_twin.sd_db * np.sqrt((dof - 2) / dof)
    predicted = {TWIN: by_twin.mean_db, NAMED: named.predict(others).mean_db}
    unlimited = links.with_columns(limit_db=np.full(len(links), -np.inf))
    for kind in (LogDistance, SegmentedLogDistance, RegressionKriging):
        predicted[kind.name] = law_db(fitted_law(kind, unlimited, rows), unlimited, test)
    for name in (EXTRA_TREES, BOOSTING):
        predicted[name] = trees_db(name, Part(unlimited), rows, test, seed)
    report = make_report(loop)
    return summary(report) | {
        "learnt": len(rows), "others": len(test),
        "coverage": share_within(others.level_db - by_twin.mean_db, scale_db, dof),
        "azimuth_error_deg": azimuth_errors_deg(report),
        "rmse_db": {name: float(np.sqrt(np.nanmean((others.level_db - mean_db) ** 2)))
                    for name, mean_db in predicted.items()}}


def _rows_of(links: Links, measured: Measurements, chosen: np.ndarray) -> np.ndarray:
    """Return the rows of prepared links that belong to chosen measurements."""
    def keys(receiver_m: np.ndarray, device: np.ndarray, level_db: np.ndarray) -> list[tuple]:
        return list(zip(*np.round(receiver_m[:, :2].T, 3), device, level_db))

    names = np.array(links.device_names)
    wanted = set(keys(measured.receiver_m[chosen],
                      measured.table["device"].to_numpy()[chosen], measured.level_db[chosen]))
    return np.flatnonzero([key in wanted for key in keys(
        links.receiver_m, names[links.device], links.level_db)])


def away_cases(seed: int) -> dict[str, dict]:
    """Return the cases: a quadrant of the area, or a sector, is left out of the training.

    Sectors with their azimuths declared, too: what a planner knows of one that is not built.
    """
    return {f"quadrant-{each}": {"left_out": each} for each in QUADRANTS} | {
        f"sector-{each}": {"left_out": each} for each in AZIMUTHS_DEG} | {
        f"told-sector-{each}": {"left_out": each, "told": True} for each in AZIMUTHS_DEG}


def learn_elsewhere(seed: int, settings: dict) -> dict:
    """Fit to all readings but those of a quadrant or a sector, and predict these."""
    left_out = settings["left_out"]
    with campus() as (measured, scene):
        if settings.get("told"):
            measured = with_azimuths(measured)
        if left_out in QUADRANTS:
            end_m = measured.receiver_m[:, :2]
            east, north = (end_m > np.median(end_m, axis=0)).T
            out = 2 * east + north == QUADRANTS.index(left_out)
        else:
            out = measured.table["device"].to_numpy() == left_out
        return learn_from(measured, scene, ~out, seed)


def away_table(rows: pd.DataFrame) -> str:
    """Return the table of errors by the part that was left out, and over all parts."""
    models = list(rows.iloc[0]["rmse_db"])
    by_name = rows.set_index("name")
    names = [name for name in away_cases(0) if name in by_name.index]
    lines = [[_left_out(name), f"{by_name.loc[name]['others']:,}",
              *(number(by_name.loc[name]["rmse_db"][model], 2) for model in models),
              _percent(by_name.loc[name].get("coverage", np.nan)),
              counted(by_name.loc[name]["named"])] for name in names]
    for kind in ("quadrant", "sector", "told-sector"):
        own = by_name.loc[[name for name in names if name.startswith(kind)]]
        if len(own) == sum(name.startswith(kind) for name in away_cases(0)):
            squares = [np.average([each[model] ** 2 for each in own["rmse_db"]],
                                  weights=own["others"]) for model in models]
            lines.append([f"**all {_left_out(kind)}s**", f"{own['others'].sum():,}",
                          *(number(np.sqrt(each), 2) for each in squares), "", ""])
    head = ["left out", "readings", *(f"`{name}`" for name in models), "in 90 %", "named"]
    return markdown(head, lines, "Where nothing was measured", ": RMSE [dB]")


def _left_out(name: str) -> str:
    told, name = name.startswith("told-"), name.removeprefix("told-")
    return "declared " * told + name.replace("-", " ", 1)


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if np.isfinite(share) else "–"


def readings_cases(seed: int) -> dict[str, dict]:
    """Return the cases: numbers of training readings, scattered or from few squares of ground.

    Of undeclared antennas, and with their azimuths declared.
    """
    undeclared = {f"{way}-{count}": {"way": way, "count": count}
                  for count in READINGS for way in WAYS}
    return undeclared | {f"told-{name}": settings | {"told": True}
                         for name, settings in undeclared.items()}


def learn_from_few(seed: int, settings: dict) -> dict:
    """Fit to some readings, and predict all others."""
    with campus() as (measured, scene):
        if settings.get("told"):
            measured = with_azimuths(measured)
        chosen = _drawn(measured, settings["way"], settings["count"], np.random.default_rng(seed))
        return learn_from(measured, scene, np.isin(np.arange(len(measured.table)), chosen), seed)


def _drawn(measured: Measurements, way: str, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw the rows of training readings: scattered, or all of some squares of ground."""
    order = rng.permutation(len(measured.table))
    if way == "scattered":
        return np.sort(order[:count])
    cell = np.floor(measured.receiver_m[:, :2] / SQUARE_M).astype(int)
    square = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    rank = rng.permutation(square.max() + 1)[square]
    return np.sort(np.lexsort((order, rank))[:count])


def readings_table(rows: pd.DataFrame) -> str:
    """Return errors by number of readings."""
    models = list(rows.iloc[0]["rmse_db"])
    parts = []
    for told, way in product(("", "told-"), WAYS):
        own = rows[rows["name"].str.startswith(told + way)]
        if own.empty:
            continue
        grouped = own.groupby(own["name"].str.rpartition("-")[2].astype(int))
        parts.append(markdown(
            ["readings", *(f"`{name}`" for name in models), "twin's in 90 %"],
            [[f"{count:,}", *(number(np.mean([each[name] for each in group["rmse_db"]]), 2)
                              for name in models),
              _percent(group["coverage"].mean() if "coverage" in group else np.nan)]
             for count, group in grouped],
            f"Readings {WAYS[way]}" + ", azimuths declared" * bool(told),
            ": RMSE of all others [dB]"))
    return "\n\n".join(parts)


def readings_figure(rows: pd.DataFrame) -> dict[str, Figure]:
    """Return the learning curves."""
    figure = Figure(figsize=(10.5, 6.4), layout="constrained")
    kinds = product(("", "told-"), WAYS)
    for axes, (told, way) in zip(figure.subplots(2, 2, sharex=True, sharey=True).flat, kinds):
        own = rows[rows["name"].str.startswith(told + way)]
        if own.empty:
            continue
        for name in rows.iloc[0]["rmse_db"]:
            error_db = own.groupby(own["name"].str.rpartition("-")[2].astype(int))["rmse_db"].apply(
                lambda group, name=name: np.mean([each[name] for each in group]))
            axes.plot(error_db.index, error_db, marker="o", label=name.replace("_", " "),
                      linewidth=2.5 if name == "twin" else 1.2)
        axes.set_title(WAYS[way] + ", azimuths declared" * bool(told), fontsize=10)
        axes.set(xscale="log")
        axes.set_xticks(READINGS, [f"{count:,}" for count in READINGS])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right upper",
                  fontsize=8)
    figure.supxlabel("readings learnt from")
    figure.supylabel("RMSE of all other readings [dB]")
    return {"readings": figure}


STUDIES = {
    "readings": Study("How many readings does a twin of a real campus need?", learn_from_few,
                      readings_cases, readings_table, readings_figure, seeds=2),
    "away": Study("What does a twin say where nothing was measured?", learn_elsewhere, away_cases,
                  away_table, seeds=1)}
