"""Draw the figures of a close-loop: error step by step, dependence of the residual, maps."""

import textwrap
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from radiotwin.closeloop.run import Loop
from radiotwin.report.closeloop_data import BinMeans, LoopData, bin_index, bin_means, collect
from radiotwin.report.closeloop_maps import (
    contribution_map_figure,
    level_map_figure,
    residual_map_figure,
)
from radiotwin.report.effect_figures import effect_figure
from radiotwin.report.labels import INTERPOLATIONS, effect_picture, name_label
from radiotwin.report.map_figures import MapBackground
from radiotwin.report.style import AFTER, BEFORE, FITTED, hide_spines, new_figure, save, shorten
from radiotwin.scene import Scene

BINS = 20
MAX_PANELS = 6
MAX_MEMBERS = 24  # receivers, devices or flights in one panel
MAX_LINE = 1.5  # times the highest bar: other models up to there are lines
MIN_STEP_DB = 0.005  # smaller changes are not a bar of their own
CONTRIBUTION = "contribution of the effects"
ON_MAP = ("place_of_ray", "place_of_receiver")  # variables that the residual map shows


def write_closeloop_figures(loop: Loop, scene: Scene | None, report: dict,
                            folder: Path | str) -> None:
    """Write all figures of a close-loop as PNG files.

    Args:
        loop: result of the close-loop.
        scene: whose buildings are drawn; None: no 3D map.
        report: content of `closeloop.json`.
        folder: for `waterfall.png`, `residual_map.png`, `level_map.png`, `drivers.png`, and
            `effect_RANK_NAME.png` for each effect; those of an earlier run are removed.
    """
    folder, data = Path(folder), collect(loop)
    background = MapBackground(data.links, scene)
    for old in [*folder.glob("effect_*.png"), folder / "level_map.png"]:
        old.unlink(missing_ok=True)
    save(waterfall_figure(report), folder / "waterfall.png")
    save(residual_map_figure(data, background), folder / "residual_map.png")
    level_map = level_map_figure(data, background)
    if level_map is not None:
        save(level_map, folder / "level_map.png")
    save(dependence_figure(data), folder / "drivers.png")
    for rank, effect in enumerate(data.effects, start=1):
        save(effect_figure(effect, background), folder / effect_picture(rank, effect.name))
    if data.interpolated_db is not None:
        save(contribution_map_figure(data.interpolated_db, background),
             folder / effect_picture(len(data.effects) + 1, "correlated_shadowing"))


def waterfall_figure(report: dict) -> Figure:
    """Draw the held-out RMSE of the base, the change by each kept effect, and the final RMSE.

    Args:
        report: content of `closeloop.json`; its other models are horizontal lines, up to
            `MAX_LINE` times the highest bar.
    """
    before, after = (report["error"][when]["rmse_db"] or 0.0 for when in ("before", "after"))
    kept = [(candidate["name"], candidate["heldout_rmse_db"]) for candidate in report["candidates"]
            if candidate["kept"] and candidate["heldout_rmse_db"] is not None]
    declared = sum(effect.get("is_declared", False) for effect in report["effects"])
    kept = kept[declared:]  # what is declared comes first: it is part of the base
    levels = [before, *(rmse_db for _, rmse_db in kept)]
    steps = [(name_label(name), name in INTERPOLATIONS) for name, _ in kept]
    if kept and abs(levels[-1] - after) > MIN_STEP_DB:
        levels.append(after)
        steps.append(("joint refit", False))
    figure = new_figure(max(1.15 * (len(steps) + 2) + 2.6, 6.5), 4.6)
    ax = figure.add_subplot()
    _draw_bar(ax, 0, 0.0, before, BEFORE, f"{before:.2f} dB")
    for position, ((_, interpolated), high, low) in enumerate(zip(steps, levels, levels[1:]), 1):
        colour = "0.5" if interpolated else AFTER if low <= high else BEFORE
        change = f"{low - high:+.2f}".replace("-", "−")
        _draw_bar(ax, position, high, low, colour, change, alpha=0.55)
        _connect(ax, position, high)
    base = "with its own effects" if declared else "alone"
    names = [f"before: {name_label(report['base'])} {base}", *(name for name, _ in steps)]
    if kept:
        _connect(ax, len(names), after)
        _draw_bar(ax, len(names), 0.0, after, AFTER, f"{after:.2f} dB")
        names.append("after")
    highest = MAX_LINE * max(before, after, *levels)  # or the bars would be too low to be read
    lines = [(value["rmse_db"], name_label(name), "--") for name, value in
             report["baselines"].items() if (value["rmse_db"] or np.inf) <= highest]
    if report["error"]["noise_floor_db"] is not None:
        lines.append((report["error"]["noise_floor_db"], "noise of one\nmeasurement", ":"))
    top = 1.12 * max(before, after, *levels, *(value for value, *_ in lines))
    ax.set(xlim=(-0.6, len(names) - 0.4), ylim=(0, max(top, 0.1)),
           ylabel="RMSE on held-out links [dB]",
           title=_change(before, after) if kept else "no effect of the catalogue lowers the error")
    wrap = textwrap.TextWrapper(12, break_long_words=False, break_on_hyphens=False)
    ax.set_xticks(range(len(names)), [wrap.fill(name) for name in names])
    _draw_lines(ax, lines)
    ax.tick_params(axis="x", length=0)
    hide_spines(ax)
    return figure


def dependence_figure(data: LoopData) -> Figure:
    """Draw the mean held-out residual against the variables that it depends on most."""
    residual_db = [data.links.level_db - predicted for predicted in (data.before_db, data.after_db)]
    known = np.isfinite(residual_db[0]) & np.isfinite(residual_db[1])
    variables = [name for name in dict.fromkeys(data.drivers)
                 if name in data.links.variables and name not in ON_MAP][:MAX_PANELS]
    columns = {1: 1, 2: 2, 4: 2}.get(len(variables), 3)
    rows = max(-(-len(variables) // columns), 1)
    figure = new_figure(4.1 * columns, 3.2 * rows + 0.4)
    for number, variable in enumerate(variables):
        ax = figure.add_subplot(rows, columns, number + 1)
        value, axis_label = data.links.on_axis(variable, data.links.variables[variable])
        used = known & np.isfinite(value)
        labels = data.links.names.get(variable)
        index = bin_index(value[used], BINS) if labels is None else value[used]
        before, after = (bin_means(index, value[used].astype(float), each[used],
                                   data.links.block[used]) for each in residual_db)
        if labels is None:
            _draw_curves(ax, before, after, data.changed)
        else:
            _draw_members(ax, before, after, labels, data.changed)
        ax.set(xlabel=axis_label, ylabel="mean residual [dB]" if number % columns == 0 else "")
        ax.axhline(0, color="0.6", linewidth=0.8, zorder=0)
        hide_spines(ax)
    if variables:
        handles = dict(zip(*figure.axes[0].get_legend_handles_labels()[::-1]))
        shown = [label for label in ("before", "after", CONTRIBUTION) if label in handles]
        figure.legend([handles[label] for label in shown], shown, loc="outside upper center",
                      ncols=min(columns + 1, 3), frameon=False)  # one panel has room for two
    else:
        figure.text(0.5, 0.5, "no variable could be tested", ha="center", va="center", fontsize=12)
    return figure


def _draw_curves(ax: Axes, before: BinMeans, after: BinMeans, changed: bool) -> None:
    """Draw means with their standard errors over a continuous variable."""
    curves = [(before, BEFORE, "before"), (after, AFTER, "after")]
    for curve, colour, label in curves if changed else curves[:1]:
        ax.fill_between(curve.at, curve.mean - curve.error, curve.mean + curve.error, color=colour,
                        alpha=0.2, linewidth=0)
        ax.plot(curve.at, curve.mean, "o-", color=colour, markersize=3, linewidth=1.3, label=label)
    if changed:
        ax.plot(before.at, before.mean - after.mean, color=FITTED, linewidth=1.3, linestyle="--",
                label=CONTRIBUTION)


def _draw_members(ax: Axes, before: BinMeans, after: BinMeans, labels: list[str],
                  changed: bool) -> None:
    """Draw means with their standard errors for the members with the largest residuals."""
    shown = np.sort(np.argsort(-np.abs(before.mean))[:MAX_MEMBERS])
    position = np.arange(len(shown))
    shift = 0.16 if changed else 0.0
    ax.errorbar(position - shift, before.mean[shown], before.error[shown], fmt="o", color=BEFORE,
                markersize=5, elinewidth=1.5, label="before")
    if changed:
        ax.errorbar(position + shift, after.mean[shown], after.error[shown], fmt="o", color=AFTER,
                    markersize=5, elinewidth=1.5, label="after")
        ax.plot(position, (before.mean - after.mean)[shown], "_", color=FITTED, markersize=12,
                markeredgewidth=1.5, label=CONTRIBUTION)
    names = [shorten(labels[int(before.at[each])]) for each in shown]
    crowded = sum(map(len, names)) > 36
    ax.set_xticks(position, names, rotation=90 if crowded else 0, fontsize=8 if crowded else 10)
    ax.set_xlim(-0.6, len(shown) - 0.4)


def _draw_bar(ax: Axes, position: int, start: float, end: float, colour: str, text: str,
              alpha: float = 1.0) -> None:
    low, high = sorted((start, end))
    ax.bar(position, high - low, bottom=low, width=0.7, color=colour, alpha=alpha, zorder=2)
    ax.annotate(text, (position, high), xytext=(0, 3), textcoords="offset points", ha="center",
                va="bottom", fontweight="bold", zorder=5)


def _connect(ax: Axes, position: int, level: float) -> None:
    """Draw a thin line from the bar before to the bar at a position."""
    ax.plot([position - 0.65, position + 0.35], [level, level], color="0.5", linewidth=0.8)


def _draw_lines(ax: Axes, lines: list[tuple[float, str, str]]) -> None:
    """Draw horizontal lines (value, name, style) with labels at the right that do not overlap."""
    top, last = ax.get_ylim()[1], -np.inf
    for value, name, style in sorted(lines):
        ax.axhline(value, color="0.45", linewidth=0.9, linestyle=style, zorder=1)
        last = max(value, last + 0.085 * top)
        ax.annotate(f"{name} {value:.2f}", (1.0, last), xycoords=("axes fraction", "data"),
                    xytext=(4, 0), textcoords="offset points", va="center", fontsize=9, color="0.3",
                    annotation_clip=False)


def _change(before: float, after: float) -> str:
    text = f"{before:.2f} → {after:.2f} dB on held-out links"
    if not before:
        return text
    return f"{text}: {abs(1 - after / before):.0%} {'less' if after <= before else 'more'}"
