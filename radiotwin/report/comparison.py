"""Compare channel models on held-out flights: tables, figures, and their part of a page."""

import json
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from pydantic import field_validator

from radiotwin.closeloop.output.result_file import for_json
from radiotwin.display import plain
from radiotwin.errors import BadInput
from radiotwin.io.cells import write_csv
from radiotwin.io.files import atomic_path
from radiotwin.io.forms import Real, Record, Whole, read_record, validated
from radiotwin.links.alignment import as_measurements
from radiotwin.links.measurements import Measurements
from radiotwin.maps.file import is_zarr
from radiotwin.maps.radiomap import RadioMap
from radiotwin.report.html import Table, read_picture
from radiotwin.report.labels import LOS_COLOUR, MODELS, NLOS_COLOUR, save
from radiotwin.report.map_figures import model_maps_figure, panels, true_positions_m
from radiotwin.runtime.execution import Executor
from radiotwin.scene import Scene
from radiotwin.scene.plot import draw_heights, height_grid
from radiotwin.twin import Twin
from radiotwin.twin.compare import (
    CLASSES,
    DEFAULT_MODELS,
    Comparison,
    compare_models,
    published_models,
    split_flights,
)
from radiotwin.twin.fit import usable_models

SCHEMA = "radiotwin.comparison/1"  # of compare.json
MAX_COLUMNS = 5  # panels in a row
SHOWN = ("log_distance", "segmented_nn")  # models with maps and located devices
FIGURES = (
    ("maps.png", "One device: truth, twin and log-distance model",
     "Gain of the truth, of the learned twin and of the log-distance model, and the differences."),
    ("scatter.png", "Held-out flights",
     "Predicted over measured gain of every detected link of flights that no model was fitted to."),
    ("estimates.png", "Positions of the unknown devices",
     "Estimates by the log-distance model and by the twin; a circle contains 90 % of the "
     "posterior."),
)


class ScoreRecord(Record):
    """Errors of a model on a class of links."""

    model: str
    against: str
    positions: Literal["estimated", "true"]
    links: Literal["all", "LoS", "NLoS"]
    n: Whole
    rmse_db: Real | None
    mae_db: Real | None
    bias_db: Real | None


class LocationRecord(Record):
    """Where a model located a device."""

    model: str
    device: str
    x_m: Real | None = None
    y_m: Real | None = None
    error_m: Real | None
    credible_radius_m: Real | None = None
    located: bool = False


class ComparisonRecord(Record):
    """Content of `compare.json`."""

    scores: list[ScoreRecord]
    locations: list[LocationRecord]

    @field_validator("scores")
    @classmethod
    def _complete(cls, scores: list[ScoreRecord]) -> list[ScoreRecord]:
        """Refuse scores unless each model has one row for all links, one for LoS, one for NLoS."""
        classes = Counter((each.model, each.against, each.positions) for each in scores)
        rows = {(each.model, each.against, each.positions, each.links) for each in scores}
        if len(rows) < len(scores) or any(count != len(CLASSES) for count in classes.values()):
            raise ValueError(f"not one row for each of {', '.join(CLASSES)} of a model")
        return scores


def compare_held_out(measurements: Measurements | pd.DataFrame | Path | str,
                     scene: Scene | Path | str, truth: RadioMap | None = None, *,
                     held_out: int = 1, paths: bool = False, also: Sequence[Path | str] = (),
                     seed: int = 0, executor: Executor | None = None) -> Comparison:
    """Fit all channel models to the first flights, and compare them on the last ones.

    Published laws that are valid at the scene's frequency are compared as well, without a fit.
    Without torch the model `segmented_nn` is left out, with a warning.

    Args:
        measurements: of several flights, also as a file or a data frame.
        scene: where they were flown, or its folder.
        truth: radio map on which errors over all positions are computed, too; None: there is none.
        held_out: number of flights, the last ones, that nothing is fitted to.
        paths: compare the model `paths`, too; takes minutes.
        also: folders of twins and, with a truth, files of radio maps, to compare with the models.
        seed: of all fits.
        executor: where the models are fitted; None: in this process.

    Raises:
        BadInput: too few flights, neither a twin's folder nor a radio map, a map without a truth,
            or what `compare_models` refuses.
    """
    scene = Scene.of(scene)
    train, test = split_flights(as_measurements(measurements, scene), held_out)
    twins, maps = _judge_also([Path(path) for path in also], truth, test.flights)
    models = (*usable_models(DEFAULT_MODELS), *published_models(scene.config.radio.frequency_hz),
              *["paths"] * paths)
    return compare_models(train, test, scene, truth, seed=seed, models=models, twins=twins,
                          maps=maps, executor=executor)


def _judge_also(paths: list[Path], truth: RadioMap | None, held_out: list[str],
               ) -> tuple[dict[str, Twin], dict[str, RadioMap]]:
    """Read further twins and radio maps to compare with the models, each named by its path.

    Warns if a twin was fitted to a flight in `held_out`, which makes its error look too small.
    BadInput for a radio map without a truth map.
    """
    twins, maps = {}, {}
    for path in paths:
        if path.is_dir() and not is_zarr(path):
            twins[str(path)] = Twin.load(path)
            fitted_to = set(twins[str(path)].provenance.get("flights", []))
            seen = sorted(fitted_to & set(held_out))
            if seen:
                warnings.warn(
                    f"{path} was fitted to {', '.join(seen[:4])}, which is held out here: its "
                    "error on held-out flights is too good", stacklevel=2)
        elif truth is None:
            raise BadInput(f"{path}: a radio map can only be judged on a whole map; give --truth, "
                           "too")
        else:
            maps[str(path)] = RadioMap.load(path)
    return twins, maps


def write_comparison(comparison: Comparison, scene: Scene, folder: Path | str) -> None:
    """Write the tables of a comparison as files, and the name of its scene.

    `compare.json`, `scores.csv`, `locations.csv` and `predictions.csv.gz`; the folder is made if
    needed, files of these names are replaced.
    """
    folder = Path(folder)
    record = for_json({"schema": SCHEMA, "scene": scene.config.name,
                       "scores": comparison.scores.to_dict("records"),
                       "locations": comparison.locations.to_dict("records"),
                       "location_summary": comparison.location_summary().to_dict("records")})
    with atomic_path(folder / "compare.json") as temporary:
        temporary.write_text(json.dumps(record, indent=1, allow_nan=False), encoding="utf-8")
    for name, table in (("scores.csv", comparison.scores), ("locations.csv", comparison.locations),
                        ("predictions.csv.gz", comparison.predictions)):
        with atomic_path(folder / name) as temporary:
            write_csv(table, temporary, "%.4f")


def read_comparison(path: Path) -> Comparison:
    """Read the scores and locations of a `compare.json`; twins and predictions are empty.

    Raises:
        BadInput: it cannot be read, it is of another version, or it is damaged.
    """
    record = read_record(path, "comparison (compare.json)")
    if record.get("schema") != SCHEMA:
        raise BadInput(f"{path}: schema is {repr(record.get('schema'))[:60]}, this version reads "
                       f"{SCHEMA!r}; make the run again")
    record = validated(ComparisonRecord, record, path, "run `radiotwin compare` again")
    scores = pd.DataFrame(record["scores"], columns=list(ScoreRecord.model_fields))
    locations = pd.DataFrame(record["locations"], columns=list(LocationRecord.model_fields))
    for table in (scores, locations):
        numbers = [name for name in table if name.endswith(("_db", "_m"))]
        table[numbers] = table[numbers].astype(float)
    return Comparison(scores, locations, {}, pd.DataFrame())


def write_comparison_figures(comparison: Comparison, scene: Scene, truth: RadioMap | None,
                             folder: Path | str) -> None:
    """Write the figures of a comparison as PNG files.

    Args:
        comparison: result of `compare_models`.
        scene: whose buildings are drawn.
        truth: map of reference gains; None: no maps are drawn.
        folder: for `scatter.png`, `estimates.png` where all true positions are known, and
            `maps.png`.
    """
    folder = Path(folder)
    save(_scatter_figure(comparison, list(comparison.twins)), folder / "scatter.png")
    shown = [name for name in SHOWN if name in comparison.twins] or list(comparison.twins)[:2]
    if len(comparison.locations) and comparison.locations["error_m"].notna().all():
        save(_estimates_figure(comparison, shown, scene), folder / "estimates.png")
    if truth is not None:
        maps = {name: comparison.twins[name].radio_map(scene) for name in reversed(shown)}
        figure = model_maps_figure(truth, maps, scene, _typical_device(truth, maps))
        save(figure, folder / "maps.png")


def _typical_device(truth: RadioMap, maps: dict[str, RadioMap]) -> str:
    """Return the device whose share of LoS positions is nearest the mean, of those in all maps."""
    devices = [name for name in truth.devices
               if all(name in radio_map.devices for radio_map in maps.values())]
    los = np.array([truth.los[truth.devices.index(name)].mean() for name in devices])
    return devices[int(np.abs(los - los.mean()).argmin())]


def _scatter_figure(comparison: Comparison, models: list[str]) -> Figure:
    """Draw predicted over measured levels of the held-out links, a panel for each model."""
    columns = min(len(models), MAX_COLUMNS)
    figure, axes = panels(-(-len(models) // columns), columns, 4.2, 4.6)
    for unused in axes.flat[len(models):]:
        unused.set_visible(False)
    links = comparison.predictions.dropna(subset=["measured_db"])
    levels_db = [links["measured_db"], *(links[model].dropna() for model in models)]
    both_db = np.concatenate(levels_db)
    ends_db = np.floor(both_db.min() / 5) * 5, np.ceil(both_db.max() / 5) * 5
    for ax, model in zip(axes.flat, models):
        for los, colour, label in ((False, NLOS_COLOUR, "NLoS"), (True, LOS_COLOUR, "LoS")):
            part = links[links["los"] == los]
            ax.plot(part["measured_db"], part[model], ".", color=colour, markersize=3, alpha=0.5,
                    label=label)
        ax.plot(ends_db, ends_db, color="black", linewidth=0.8)
        error_db = (links[model] - links["measured_db"]).dropna()
        rmse_db = np.sqrt(np.mean(error_db**2))
        ax.set(title=f"{plain(MODELS.get(model, model))}, RMSE {rmse_db:.1f} dB", aspect="equal",
               xlabel="measured [dB]", ylabel="predicted [dB]", xlim=ends_db, ylim=ends_db)
        ax.grid(alpha=0.25)
        ax.legend(markerscale=4, loc="upper left")
    return figure


def _estimates_figure(comparison: Comparison, models: list[str], scene: Scene) -> Figure:
    """Draw true and estimated device positions by model; 90 % radii up to twice the map's width."""
    extent = scene.config.extent
    ratio = (extent.x_max_m - extent.x_min_m) / (extent.y_max_m - extent.y_min_m)
    figure, axes = panels(1, len(models), 6.4 * min(max(ratio, 0.7), 1.4), 6.4)
    height_m, bounds = height_grid(scene, 500)
    true_m = true_positions_m(scene)
    max_radius_m = 2 * (bounds[1] - bounds[0])
    for ax, model in zip(axes.flat, models):
        image = draw_heights(ax, height_m, bounds)
        for device in comparison.twins[model].devices:
            if device.role == "anchor":
                ax.plot(device.x_m, device.y_m, "^", color="black", markersize=8, label="anchor")
                continue
            x_m, y_m, _ = true_m[device.device]
            ax.plot(x_m, y_m, "*", color="#f08a00", markersize=14, markeredgecolor="white",
                    label="true position")
            if np.isfinite([device.x_m, device.y_m]).all():
                ax.plot([x_m, device.x_m], [y_m, device.y_m], color=NLOS_COLOUR, linewidth=1)
                ax.plot(device.x_m, device.y_m, "x", color=NLOS_COLOUR, markersize=8,
                        markeredgewidth=2, label="estimate")
                radius_m = min(device.credible_radius_m, max_radius_m)
                ax.add_artist(Circle((device.x_m, device.y_m), radius_m, fill=False,
                                     color=NLOS_COLOUR, linewidth=1, alpha=0.8))
        errors_m = comparison.locations.query("model == @model")["error_m"]
        ax.set_title(f"{plain(MODELS.get(model, model))}: median error {errors_m.median():.1f} m")
        ax.set(xlim=bounds[:2], ylim=bounds[2:])
    handles = dict(zip(*reversed(axes[0, 0].get_legend_handles_labels())))
    figure.colorbar(image, ax=axes, label="height [m]", shrink=0.8)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3,
                  frameon=False)
    return figure


def comparison_context(comparison: Comparison, folder: Path) -> dict[str, Any]:
    """Collect the summary, tables and figures of a comparison for a run's page."""
    pictures = [read_picture(folder, name, title, text) for name, title, text in FIGURES]
    return {"lead": _summary(comparison), "tables": _tables(comparison),
            "figures": [picture for picture in pictures if picture]}


def _tables(comparison: Comparison) -> list[tuple[str, Table]]:
    """Return titled tables of level errors [dB] and position errors [m], a row for each model."""
    columns = ("model", "RMSE", "RMSE LoS", "RMSE NLoS", "MAE", "bias")
    tables = []
    estimated = comparison.scores.query("positions == 'estimated'")
    for against, part in estimated.groupby("against", sort=False):
        by_model = part.set_index(["model", "links"])
        rmse_db = by_model["rmse_db"].unstack()[list(CLASSES)]
        of_all = by_model.xs("all", level="links")
        rows = [[MODELS.get(name, name), *rmse_db.loc[name], of_all.mae_db[name],
                 of_all.bias_db[name]] for name in of_all.index]
        best = [list(of_all.index).index(of_all["rmse_db"].idxmin())] \
            if of_all["rmse_db"].notna().any() else []
        tables.append((f"Error on {against} [dB], {of_all['n'].max():,} links",
                       Table(columns, rows, strong=best)))
    located = [[MODELS.get(row.model, row.model), int(row.devices), row.median_m, row.p90_m,
                row.worst_m] for row in comparison.location_summary().itertuples()]
    if located:
        tables.append(("Error of the unknown devices' positions [m]", Table(
            ("model", "located devices", "median", "90 %", "worst"), located)))
    return tables


def _judged(comparison: Comparison) -> pd.DataFrame:
    """Return a table of each model's RMSE over the truth map [dB] and median position error [m]."""
    scores = comparison.scores.query(
        "against == 'whole map' and positions == 'estimated' and links == 'all'")
    located = comparison.location_summary().set_index("model")
    return scores.set_index("model")[["rmse_db"]].join(located[["median_m"]], how="inner")


def _summary(comparison: Comparison) -> str:
    """Compare the twin with the log-distance model and the best one; empty without a truth map."""
    judged = _judged(comparison)
    if not set(SHOWN) <= set(judged.index):
        return ""
    line, twin = judged.loc["log_distance"], judged.loc["segmented_nn"]
    text = ("Fitted to a few flights, the twin predicts the gain over the whole map with an RMSE "
            f"of {twin.rmse_db:.1f} dB (log-distance model: {line.rmse_db:.1f} dB) and locates the "
            f"unknown devices with a median error of {twin.median_m:.1f} m (log-distance model: "
            f"{line.median_m:.1f} m).")
    best = judged["rmse_db"].idxmin()
    return text if best == "segmented_nn" else (
        f"{text} The least error over the whole map has {MODELS.get(best, best)}: "
        f"{judged.rmse_db[best]:.1f} dB.")
