"""Pictures of the residual: where it is, what drives it, and what each step took of it."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from radiotwin.closeloop.run import Loop
from radiotwin.closeloop.search import rmse_db
from radiotwin.closeloop.structure import variables
from radiotwin.files import atomic_path
from radiotwin.scene import Scene

MOST_POINTS = 20_000
BEFORE, AFTER = "#c2571a", "#1f6f8b"
BINS = 24
RANGE_DB = 15.0


def draw_residual_map(loop: Loop, scene: Scene | None, path: Path) -> None:
    """Held-out residual at the receivers' places, before and after."""
    figure = _figure(11, 5.2)
    records = loop.after.whole.records
    rows = _some(np.flatnonzero(np.isfinite(records.level_db)))
    moving = len(np.unique(records.receiver_m[:, :2].round(), axis=0)) >= len(records.device_names)
    place_m = (records.receiver_m if moving else records.device_m[records.device])[rows]
    for column, (name, model) in enumerate((("before", loop.before), ("after", loop.after))):
        ax = figure.add_subplot(1, 2, column + 1)
        if scene is not None:
            _outline(ax, scene)
        residual_db = (records.level_db - model.held_out_mean_db())[rows]
        dots = ax.scatter(place_m[:, 0], place_m[:, 1], c=residual_db, s=4, cmap="RdBu", vmin=-RANGE_DB, vmax=RANGE_DB,
                          linewidths=0, rasterized=True)
        if moving:
            known = records.device_m[np.unique(records.device)]
            ax.plot(known[:, 0], known[:, 1], "k^", markersize=5, label="devices")
        _boxes(ax, loop)
        ax.set(title=f"{name}: {rmse_db(model, np.ones(len(records), bool)):.2f} dB", xlabel="x, east [m]",
               ylabel="y, north [m]", aspect="equal")
    figure.colorbar(dots, ax=figure.axes, label="measured − predicted [dB]", shrink=0.8)
    _save(figure, path)


def draw_drivers(loop: Loop, path: Path) -> None:
    """Mean held-out residual against the variables that it depended on most, before and after."""
    records = loop.after.whole.records
    names = [driver.variable for driver in loop.drivers_before][:6]
    means = [records.level_db - model.held_out_mean_db() for model in (loop.before, loop.after)]
    values = variables(records, loop.before.held_out_mean_db())
    figure = _figure(11, 3.1 * ((len(names) + 2) // 3))
    for number, name in enumerate(names):
        ax = figure.add_subplot((len(names) + 2) // 3, 3, number + 1)
        value = values[name].astype(float)
        for residual_db, colour, label in zip(means, (BEFORE, AFTER), ("before", "after")):
            seen = np.isfinite(value) & np.isfinite(residual_db)
            edges = np.unique(np.quantile(value[seen], np.linspace(0, 1, BINS + 1)))
            place = np.clip(np.searchsorted(edges, value[seen], side="right") - 1, 0, max(len(edges) - 2, 0))
            count = np.maximum(np.bincount(place), 1)
            centre = np.bincount(place, weights=value[seen]) / count
            mean = np.bincount(place, weights=residual_db[seen]) / count
            used = np.bincount(place) > 5
            ax.plot(centre[used], mean[used], "o-", color=colour, markersize=3, linewidth=1.2, label=label)
        ax.axhline(0, color="0.6", linewidth=0.8)
        ax.set(xlabel=name, ylabel="mean residual [dB]" if number % 3 == 0 else "")
    if names:
        figure.axes[0].legend(frameon=False)
    _save(figure, path)


def draw_waterfall(loop: Loop, path: Path) -> None:
    """Held-out RMSE from the base over each kept effect to the end, beside other models."""
    everything = np.ones(len(loop.records), dtype=bool)
    names = [f"base: {loop.base}", *(f"+ {entry.name}" for entry in loop.search.log if entry.kept)]
    values = [rmse_db(loop.before, everything), *(entry.rmse_db for entry in loop.search.log if entry.kept)]
    figure = _figure(8, 0.55 * (len(names) + len(loop.baselines)) + 1.0)
    ax = figure.add_subplot()
    colours = [BEFORE, *[AFTER] * (len(values) - 1), *["0.7"] * len(loop.baselines)]
    names += [name.replace("_", " ") for name in loop.baselines]
    values += list(loop.baselines.values())
    ax.barh(names[::-1], values[::-1], color=colours[::-1])
    for row, value in enumerate(values[::-1]):
        ax.text(value, row, f" {value:.2f}", va="center")
    ax.set(xlabel="error on held-out links, RMSE [dB]", xlim=(0, 1.12 * max(values)))
    ax.spines[["top", "right"]].set_visible(False)
    _save(figure, path)


def _outline(ax, scene: Scene) -> None:
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    x_m, y_m = np.linspace(x_min, x_max, 300), np.linspace(y_min, y_max, 300)
    height_m = scene.city.height_at(*np.meshgrid(x_m, y_m))
    ax.contourf(x_m, y_m, height_m, levels=[2.0, 1e4], colors=["0.85"])


def _boxes(ax, loop: Loop) -> None:
    """Traced boxes, drawn."""
    for part in loop.after.whole.parts:
        if "box" in part.setting:
            x_m, y_m, length_m, width_m, _, turn_deg = part.setting["box"]
            turn = np.radians(turn_deg)
            corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]) * 0.5 * (length_m, width_m)
            corners = corners @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + (x_m, y_m)
            ax.plot(corners[:, 0], corners[:, 1], color="#7a0177", linewidth=2)


def _some(rows: np.ndarray) -> np.ndarray:
    return rows[:: max(len(rows) // MOST_POINTS, 1)]


def _figure(width_in: float, height_in: float) -> Figure:
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, path: Path) -> None:
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110, format="png")
