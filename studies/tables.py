"""Numbers, Markdown and panels of the studies' tables and figures."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from marl.figures import COLOURS, MARKERS
from radiotwin import RadioMap, Scene
from radiotwin.maps.survey import read_truth

RATIO = "share of all data collected in the truth"


def scene_folder(name: str) -> Path:
    """Return the folder of a scene: a name is of `scenes/`, all else is a path."""
    return Path("scenes") / name if name == Path(name).name else Path(name)


def load_world(settings: dict) -> tuple[Scene, RadioMap]:
    """Return the scene `scene` of a row's settings, and its radio map `truth`."""
    scene = Scene.load(scene_folder(settings["scene"]))
    return scene, read_truth(scene, settings["truth"])


def read_frame(rows: list[dict]) -> pd.DataFrame:
    """Return rows as a table, by name and seed, with a column for each result."""
    keys = ("name", "seed", "settings", "cpu_s")
    frame = pd.DataFrame([{key: row[key] for key in keys} | row["results"] for row in rows])
    return frame.sort_values(["name", "seed"], ignore_index=True)


def provenance(rows: list[dict]) -> str:
    """Return how many rows there are and what made them."""
    own = [row for row in rows if "copied_from" not in row]
    copied = sorted({f"`{row['copied_from']}`" for row in rows if "copied_from" in row})
    versions, machines = ({row[key] for row in rows if row[key]} for key in ("version", "machine"))
    hours = sum(row["cpu_s"] or 0 for row in own) / 3600
    return (f"{len(rows)} rows of {len({row['name'] for row in rows})} kinds"
            + (f", {hours:.1f} CPU hours" if hours else "") + "; version (commit, or hash of the "
            f"sources): {'; '.join([', '.join(sorted(versions)), *sorted(machines)])}."
            + (f" Equal rows are copied from {', '.join(copied)}." if copied else ""))


def markdown(heads: Sequence[str], rows: list[list[str]], title: str = "", note: str = "") -> str:
    """Return a table below its title."""
    return "\n".join([f"**{title}**{note}\n"] * bool(title) + [
        "| " + " | ".join(heads) + " |", "|" + "---|" * len(heads),
        *("| " + " | ".join(row) + " |" for row in rows)])


def number(value: float | None, digits: int = 3) -> str:
    """Return a number for a table, a dash where there is none."""
    return "–" if value is None or value != value else f"{value:,.{digits}f}"


def sd(values: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the sample standard deviation over the first axis; 0 of one value."""
    return np.std(values, axis=0, ddof=min(len(values) - 1, 1))


def with_sd(values: Sequence[float] | np.ndarray, digits: int = 3) -> str:
    """Return mean ± standard deviation; of one value the value."""
    if not len(values):
        return "–"
    mean = f"{np.mean(values):.{digits}f}"
    return f"{mean} ± {sd(values):.{digits}f}" if len(values) > 1 else mean


class Curve(NamedTuple):
    """Mean and standard deviation over seeds at `(n,)` real episodes, or over another abscissa."""

    x: np.ndarray
    mean: np.ndarray
    sd: np.ndarray

    def needed(self, ratio: float) -> float:
        """Return the first x at which the mean is at least `ratio`; NaN where it never is."""
        enough = np.flatnonzero(self.mean >= ratio)
        return float(self.x[enough[0]]) if len(enough) else np.nan


def over_seeds(curves: pd.Series, x: str = "real_episodes", y: str = "truth_ratio") -> Curve:
    """Return the curve of a row's seeds, as long as the shortest."""
    length = min(len(curve[x]) for curve in curves)
    xs, ys = (np.array([curve[key][:length] for curve in curves], dtype=float) for key in (x, y))
    return Curve(xs.mean(axis=0), ys.mean(axis=0), sd(ys))


def last(curves: pd.Series, column: str = "truth_ratio") -> list[float]:
    """Return the last value of each curve."""
    return [curve[column][-1] for curve in curves]


def worlds(rows: pd.DataFrame) -> Iterator[tuple[str, dict[str, pd.DataFrame]]]:
    """Yield title of a world, and its rows by name without the world; ray-traced truths first."""
    truth = rows["settings"].str["truth"]
    scene = rows["settings"].str["scene"].str.split("/").str[-1]
    for (_, of, where), group in rows.groupby([truth != "traced", truth, scene]):
        kind = "ray-traced" if of == "traced" else "statistical"
        yield f"{where.replace('paper_', 'the paper’s ')}, {kind} truth", {
            name.removeprefix(f"{where}-").removeprefix(f"{of}-"): seeds
            for name, seeds in group.groupby("name")}


def make_panels(count: int, columns: int, height_in: float) -> tuple[Figure, list[Axes]]:
    """Return a figure of `count` panels."""
    columns = min(columns, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(10.0, height_in * rows + 0.9), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for unused in axes[count:]:
        unused.remove()
    return figure, list(axes[:count])


def draw_line(axes: Axes, curve: Curve, label: str, index: int) -> None:
    """Draw a mean with a band of its standard deviation; a single point gets a large marker."""
    colour, alone = COLOURS[index % len(COLOURS)], len(curve.x) == 1
    axes.plot(curve.x, curve.mean, marker=MARKERS[index % len(MARKERS)], color=colour, label=label,
              markersize=9 if alone else 4, markeredgecolor="black" if alone else colour)
    axes.fill_between(curve.x, curve.mean - curve.sd, curve.mean + curve.sd, color=colour,
                      alpha=0.18, linewidth=0)
    axes.grid(True, alpha=0.3)


def with_legend(figure: Figure, panels: list[Axes], columns: int) -> Figure:
    """Return the figure with one legend for all panels below them."""
    entries = {label: handle for axes in panels
               for handle, label in zip(*axes.get_legend_handles_labels())}
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns,
                  frameon=False)
    return figure
