"""Pictures of the report: the error from step to step, and what it depended on."""

from pathlib import Path

import numpy as np

from radiotwin.closeloop.drawing import (
    AFTER,
    BEFORE,
    FITTED,
    Means,
    bins,
    means,
    new_figure,
    on_axis,
    save,
    shorten,
    tidy,
)
from radiotwin.closeloop.effect_figures import draw_effects
from radiotwin.closeloop.folds import evidence_blocks
from radiotwin.closeloop.map_figures import Ground, draw_level_map, draw_residual_map
from radiotwin.closeloop.run import Loop, significant
from radiotwin.inference.residual_tests import variables
from radiotwin.closeloop.words import LAST_RESORTS, plainly
from radiotwin.scene import Scene

BINS = 20
MAX_PANELS = 6
MAX_MEMBERS = 24  # receivers, devices or flights in one panel
ADDED = "what the effects add"
PLACES = ("place_of_ray", "place_of_receiver")  # the map shows them


def draw_figures(loop: Loop, scene: Scene | None, report: dict, folder: Path) -> None:
    """Write all pictures of a report into its folder."""
    ground = Ground(loop.after.whole.links, scene)
    draw_waterfall(report, folder / "waterfall.png")
    draw_residual_map(loop, ground, folder / "residual_map.png")
    draw_level_map(loop, ground, folder / "level_map.png")
    draw_drivers(loop, folder / "drivers.png")
    draw_effects(loop, ground, folder)


def draw_waterfall(report: dict, path: Path) -> None:
    """Held-out RMSE: the base, what each kept effect takes off, and the end; other models as lines."""
    before, after = (report["error"][when]["rmse_db"] or 0.0 for when in ("before", "after"))
    kept = [(candidate["name"], candidate["heldout_rmse_db"]) for candidate in report["candidates"]
            if candidate["kept"] and candidate["heldout_rmse_db"] is not None]
    levels = [before, *(rmse_db for _, rmse_db in kept)]
    steps = [plainly(name) for name, _ in kept]
    if kept and abs(levels[-1] - after) > 0.005:
        levels.append(after)
        steps.append("all fitted again")
    figure = new_figure(max(1.15 * (len(steps) + 2) + 2.6, 6.5), 4.6)
    ax = figure.add_subplot()
    _bar(ax, 0, 0.0, before, BEFORE, f"{before:.2f} dB")
    for place, (high, low) in enumerate(zip(levels, levels[1:]), start=1):
        colour = AFTER if low <= high else BEFORE
        if steps[place - 1] in map(plainly, LAST_RESORTS):
            colour = "0.5"
        _bar(ax, place, high, low, colour, f"{low - high:+.2f}".replace("-", "−"), alpha=0.55)
        ax.plot([place - 0.65, place + 0.35], [high, high], color="0.5", linewidth=0.8)
    names = [f"before: {plainly(report['base'])} alone", *steps]
    if kept:
        end = len(steps) + 1
        ax.plot([end - 0.65, end + 0.35], [after, after], color="0.5", linewidth=0.8)
        _bar(ax, end, 0.0, after, AFTER, f"{after:.2f} dB")
        names.append("after")
    lines = [(value["rmse_db"], plainly(name), "--") for name, value in report["baselines"].items()
             if value["rmse_db"] is not None]
    if report["error"]["noise_floor_db"] is not None:
        lines.append((report["error"]["noise_floor_db"], "noise of one\nmeasurement", ":"))
    top = 1.12 * max(before, after, *levels, *(value for value, *_ in lines))
    ax.set(xlim=(-0.6, len(names) - 0.4), ylim=(0, max(top, 0.1)), ylabel="error on held-out links, RMSE [dB]",
           title=_change(before, after) if kept else "no effect of the catalogue lowers the error")
    ax.set_xticks(range(len(names)), [_wrapped(name) for name in names])
    _lines(ax, lines)
    ax.tick_params(axis="x", length=0)
    tidy(ax)
    save(figure, path)


def draw_drivers(loop: Loop, path: Path) -> None:
    """Mean held-out residual against the strongest variables before and after, and what the effects add there."""
    links = loop.after.whole.links
    values = variables(links, loop.before.held_out_mean_db)
    names = _strongest(loop, values)
    residual_db = [links.level_db - model.held_out_mean_db for model in (loop.before, loop.after)]
    seen = np.isfinite(residual_db[0]) & np.isfinite(residual_db[1])
    block = evidence_blocks(links)
    columns = {1: 1, 2: 2, 4: 2}.get(len(names), 3)
    rows = max(-(-len(names) // columns), 1)
    figure = new_figure(4.1 * columns, 3.2 * rows + 0.4)
    for number, name in enumerate(names):
        ax = figure.add_subplot(rows, columns, number + 1)
        value, axis_label = on_axis(links, name, values[name])
        used = seen & np.isfinite(value)
        labels = _labels(links, name)
        level = bins(value[used], BINS) if labels is None else value[used]
        before, after = (means(level, value[used].astype(float), each[used], block[used]) for each in residual_db)
        if labels is None:
            _curves(ax, before, after, loop.after is not loop.before)
        else:
            _categories(ax, before, after, labels, loop.after is not loop.before)
        ax.set(xlabel=axis_label, ylabel="mean residual [dB]" if number % columns == 0 else "")
        ax.axhline(0, color="0.6", linewidth=0.8, zorder=0)
        tidy(ax)
    if names:
        found = dict(zip(*figure.axes[0].get_legend_handles_labels()[::-1]))
        labels = [label for label in ("before", "after", ADDED) if label in found]
        figure.legend([found[label] for label in labels], labels, loc="outside upper center", ncols=3, frameon=False)
    else:
        figure.text(0.5, 0.5, "no variable could be tested", ha="center", va="center", fontsize=12)
    save(figure, path)


def _strongest(loop: Loop, values: dict[str, np.ndarray]) -> list[str]:
    """Variables that matter before, then those that matter after; where none does, the likeliest three."""
    found = [driver.variable for driver in (*significant(loop.dependences_before), *significant(loop.dependences_after))]
    found = found or [driver.variable for driver in loop.dependences_before][:3]
    return [name for name in dict.fromkeys(found) if name in values and name not in PLACES][:MAX_PANELS]


def _labels(links, name: str) -> list[str] | None:
    """Names of the values of a variable that is no number."""
    return {"receiver": links.receiver_names, "device": links.device_names, "flight": links.flight_names,
            "los": ["without", "with"]}.get(name)


def _curves(ax, before: Means, after: Means, changed: bool) -> None:
    styles = [(before, BEFORE, "before"), (after, AFTER, "after")]
    for curve, colour, label in styles if changed else styles[:1]:
        ax.fill_between(curve.at, curve.mean - curve.error, curve.mean + curve.error, color=colour, alpha=0.2,
                        linewidth=0)
        ax.plot(curve.at, curve.mean, "o-", color=colour, markersize=3, linewidth=1.3, label=label)
    if changed:
        ax.plot(before.at, before.mean - after.mean, color=FITTED, linewidth=1.3, linestyle="--",
                label=ADDED)


def _categories(ax, before: Means, after: Means, labels: list[str], changed: bool) -> None:
    shown = np.sort(np.argsort(-np.abs(before.mean))[:MAX_MEMBERS])
    place = np.arange(len(shown))
    shift = 0.16 if changed else 0.0
    ax.errorbar(place - shift, before.mean[shown], before.error[shown], fmt="o", color=BEFORE, markersize=5,
                elinewidth=1.5, label="before")
    if changed:
        ax.errorbar(place + shift, after.mean[shown], after.error[shown], fmt="o", color=AFTER, markersize=5,
                    elinewidth=1.5, label="after")
        ax.plot(place, (before.mean - after.mean)[shown], "_", color=FITTED, markersize=12, markeredgewidth=1.5,
                label=ADDED)
    names = [shorten(labels[int(before.at[each])]) for each in shown]
    crowded = sum(map(len, names)) > 36
    ax.set_xticks(place, names, rotation=90 if crowded else 0, fontsize=8 if crowded else 10)
    ax.set_xlim(-0.6, len(shown) - 0.4)


def _bar(ax, place: int, start: float, end: float, colour: str, text: str, **style) -> None:
    low, high = sorted((start, end))
    ax.bar(place, high - low, bottom=low, width=0.7, color=colour, zorder=2, **style)
    ax.annotate(text, (place, high), xytext=(0, 3), textcoords="offset points", ha="center", va="bottom",
                fontweight="bold", zorder=5)


def _lines(ax, lines: list[tuple[float, str, str]]) -> None:
    """Thin lines across, each with its name and value at the right, moved apart where they would overlap."""
    top, last = ax.get_ylim()[1], -np.inf
    for value, name, style in sorted(lines):
        ax.axhline(value, color="0.45", linewidth=0.9, linestyle=style, zorder=1)
        last = max(value, last + 0.085 * top)
        ax.annotate(f"{name} {value:.2f}", (1.0, last), xycoords=("axes fraction", "data"), xytext=(4, 0),
                    textcoords="offset points", va="center", fontsize=9, color="0.3", annotation_clip=False)


def _change(before: float, after: float) -> str:
    return f"{before:.2f} → {after:.2f} dB on links that took no part" + (
        f": {abs(1 - after / before):.0%} {'less' if after <= before else 'more'}" if before else "")


def _wrapped(name: str) -> str:
    """On lines of a word or two."""
    lines = [""]
    for word in name.split():
        if lines[-1] and len(lines[-1]) + len(word) > 11:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)
