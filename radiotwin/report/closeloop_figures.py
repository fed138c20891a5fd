"""The figures of a close-loop: error step by step, dependence of the residual, and each effect.

An effect is drawn in its own terms: on the map, over the azimuth, over a variable, or as bars. It
chooses its figure by the attribute `figure`, a key of `FIGURES`; without one its stage decides. Any
other effect is drawn over the variable that explains most of it.
"""

import textwrap
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from radiotwin.closeloop.run import Loop
from radiotwin.display import plain
from radiotwin.report.closeloop_data import (
    BinMeans,
    EffectData,
    LoopData,
    bin_index,
    bin_means,
    collect,
)
from radiotwin.report.closeloop_words import rmse_after_db
from radiotwin.report.group_figures import groups_figure
from radiotwin.report.labels import (
    AFTER,
    BEFORE,
    FITTED,
    effect_picture,
    hide_spines,
    interpolations,
    name_label,
    new_figure,
    parameter_label,
    parameter_labels,
    save,
)
from radiotwin.report.map_figures import (
    RESIDUAL_LABEL,
    MapBackground,
    affected_links_figure,
    contribution_map_figure,
    level_map_figure,
    residual_map_figure,
)
from radiotwin.scene import Scene
from radiotwin.twin.model.correlated_shadowing import NAME as SHADOWING

EFFECT_BINS = 24
MAX_BARS = 40
MIN_SHARE = 0.3  # of the variance of a contribution that a variable explains, to be drawn over it
AZIMUTHS = {"device": "azimuth_deg", "receiver": "body_azimuth_deg"}
BINS = 20
MAX_PANELS = 6
MAX_LINE = 1.5  # times the highest bar: other models up to there are lines
MIN_STEP_DB = 0.005  # smaller changes are not a bar of their own
CONTRIBUTION = "contribution of the effects"
# Variables that the residual map and the figure of groups show.
ELSEWHERE = {"place_of_ray", "place_of_receiver", "device", "receiver", "flight", "los"}


def effect_figure(effect: EffectData, background: MapBackground) -> Figure:
    """Draw an effect in the figure that it names, else that of its stage, else over a variable."""
    kind = effect.found.figure or FIGURE_OF_STAGE.get(effect.found.stage, "")
    return FIGURES.get(kind, variable_figure)(effect, background)


def variable_figure(effect: EffectData, background: MapBackground) -> Figure:
    """Draw residual and contribution over the variable that best explains the contribution.

    The contribution is the effect's change of the predicted level [dB]. If no variable explains
    `MIN_SHARE` of its variance, it is drawn on the map instead.
    """
    name, share = _dominant_variable(effect)
    if share < MIN_SHARE:
        return contribution_map_figure(effect.contribution_db, background)
    value, label = effect.links.on_axis(name, effect.variables[name])
    return _means_figure(effect, value, effect.residual_db, effect.contribution_db,
                         ("mean residual without the effect", label, "residual [dB]"),
                         lambda ax, _: ax.axhline(0, color="0.6", linewidth=0.8))


def response_figure(effect: EffectData, _: MapBackground) -> Figure:
    """Draw readings over the level predicted without the effect, and a linear receiver's line."""
    unit, predicted = effect.links.level_unit, effect.without_db
    return _means_figure(effect, predicted, effect.links.level_db, effect.with_db,
                         ("mean of the readings", f"predicted level [{unit}]", f"reading [{unit}]"),
                         lambda ax, fitted: ax.plot(fitted.at, fitted.at, color=FITTED, linewidth=1,
                                                    linestyle=":", label="linear response"))


def pattern_figure(effect: EffectData, _: MapBackground) -> Figure:
    """Draw mean residuals and the fitted antenna pattern over the azimuth, on polar axes."""
    azimuth_deg = effect.variables[AZIMUTHS[effect.member_kind or "device"]]
    figure, axes = _grid(len(effect.panels()), projection="polar")
    for ax, (title, rows) in zip(axes, effect.panels()):
        rows = rows[np.isfinite(azimuth_deg[rows])]
        index = np.floor(azimuth_deg[rows] / 360 * EFFECT_BINS).astype(int) % EFFECT_BINS
        found, fitted = (bin_means(index, azimuth_deg[rows], each_db[rows],
                                   effect.links.block[rows])
                         for each_db in (effect.residual_db, effect.contribution_db))
        azimuth = np.radians(found.at)
        ax.set_theta_zero_location("N")  # type: ignore[attr-defined]
        ax.set_theta_direction(-1)  # type: ignore[attr-defined]
        ax.plot(azimuth, found.mean, "o", color=BEFORE, markersize=4,
                label="mean residual without the effect")
        ax.errorbar(azimuth, found.mean, yerr=found.error, fmt="none", color=BEFORE, elinewidth=1)
        ax.plot(*_closed_curve(fitted), color=AFTER, linewidth=2, label="fitted")
        means_db = np.concatenate([found.mean, fitted.mean])
        if len(means_db):
            span_db = max(np.ptp(means_db), 3.0)
            ax.set_ylim(means_db.min() - 0.35 * span_db, means_db.max() + 0.05 * span_db)
        ax.set_rlabel_position(22.5)  # type: ignore[attr-defined]
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.tick_params(axis="y", labelsize=7)
        ax.set_title(plain(title))
    zero = "the receiver's heading" if effect.member_kind == "receiver" else "north, at the device"
    figure.supxlabel(f"azimuth, clockwise from {zero}; radius: residual [dB]", fontsize=10)
    return _with_legend(figure, axes, effect)


def histogram_figure(effect: EffectData, _: MapBackground) -> Figure:
    """Draw histograms of the residual [dB] without and with the effect.

    Of an effect on NLoS links only, NLoS links are counted; of all others, all detected links.
    """
    rows, los = np.isfinite(effect.residual_db), effect.links.los
    nlos = effect.found.nlos_only and (rows & ~los).any()
    rows = rows & ~los if nlos else rows
    without_db = effect.residual_db[rows]
    with_db = without_db - effect.contribution_db[rows]
    range_db = float(np.quantile(np.abs(without_db), 0.995)) + 1.0
    figure = new_figure(7.0, 3.8)
    ax = figure.add_subplot()
    for residual_db, colour, label in ((without_db, BEFORE, "without the effect"),
                                       (with_db, AFTER, "with the effect")):
        ax.hist(residual_db, np.linspace(-range_db, range_db, 61).tolist(), color=colour,
                alpha=0.55, label=f"{label}: {np.sqrt(np.mean(residual_db**2)):.2f} dB (RMSE)")
    ax.axvline(0, color="0.3", linewidth=0.8)
    ax.set(xlabel=RESIDUAL_LABEL, ylabel="links",
           title=f"{rows.sum():,} links{' without line of sight' if nlos else ''}")
    ax.legend(frameon=False)
    hide_spines(ax)
    return figure


def interval_figure(effect: EffectData, background: MapBackground) -> Figure:
    """Draw an effect's parameter for each device or receiver as a bar with its 90 % interval.

    The `MAX_BARS` largest that the data determine are drawn; `variable_figure` if there are none.
    """
    known = {name: each for name, each in effect.parameters.items() if each.determined}
    if not known:
        return variable_figure(effect, background)
    chosen = sorted(known.items(), key=lambda item: -abs(item[1].value))[:MAX_BARS]
    chosen.sort(key=lambda item: item[1].value)
    value = np.array([p.value for _, p in chosen])
    errors = np.abs(np.array([(p.value - p.low, p.high - p.value) for _, p in chosen]).T)
    figure = new_figure(7.0, 0.28 * len(chosen) + 1.1)
    ax = figure.add_subplot()
    ax.barh(range(len(chosen)), value, xerr=errors, color=AFTER, alpha=0.75, ecolor=FITTED,
            capsize=2)
    members = [name.partition("[")[2].removesuffix("]") for name, _ in chosen]
    ax.set_yticks(range(len(chosen)), [plain(member, 24) for member in members])
    ax.axvline(0, color="0.4", linewidth=0.8)
    label = parameter_label(chosen[0][0].partition("[")[0], parameter_labels(effect.found.name))
    ax.set(xlabel=f"{label}, with 90 % interval [{chosen[0][1].unit}]",
           ylim=(-0.7, len(chosen) - 0.3))
    hide_spines(ax)
    return figure


FIGURES: dict[str, Callable[[EffectData, MapBackground], Figure]] = {
    "dependence": variable_figure, "histogram": histogram_figure, "intervals": interval_figure,
    "links": affected_links_figure, "pattern": pattern_figure, "response": response_figure}
FIGURE_OF_STAGE = {"paths": "histogram", "detection": "intervals", "limit": "intervals",
                   "receiver": "response"}


def _means_figure(effect: EffectData, value: np.ndarray, measured_db: np.ndarray,
                  fitted_db: np.ndarray, labels: tuple[str, str, str],
                  draw_line: Callable[[Axes, BinMeans], object]) -> Figure:
    """Draw levels or residuals (n,) [dB] of links over a variable: dots, means, and fitted means.

    `labels` are those of the measured means, of x and of y. `draw_line` adds a line of reference to
    the axes, given the fitted means.
    """
    figure, axes = _grid(len(effect.panels()))
    for number, (ax, (title, rows)) in enumerate(zip(axes, effect.panels())):
        rows = rows[np.isfinite(value[rows])]
        index = bin_index(value[rows], EFFECT_BINS)
        found, fitted = (bin_means(index, value[rows], each_db[rows], effect.links.block[rows])
                         for each_db in (measured_db, fitted_db))
        ax.plot(value[rows], measured_db[rows], ".", color="0.8", markersize=2, zorder=0,
                rasterized=True)
        ax.plot(found.at, found.mean, "o", color=BEFORE, markersize=4, label=labels[0])
        ax.errorbar(found.at, found.mean, found.error, fmt="none", color=BEFORE)
        ax.plot(fitted.at, fitted.mean, color=AFTER, linewidth=2, label="fitted")
        ax.set_ylim(_limits(measured_db[rows], np.concatenate([found.mean, fitted.mean])))
        hide_spines(ax)
        draw_line(ax, fitted)
        ax.set(title=plain(title), xlabel=labels[1], ylabel=labels[2] if number % 3 == 0 else "")
    return _with_legend(figure, axes, effect)


def _closed_curve(fitted: BinMeans) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuth [rad] and radius [dB] of a closed polar curve; NaN in gaps over two bins."""
    azimuth_deg = np.r_[fitted.at, fitted.at[:1] + 360]
    radius = np.r_[fitted.mean, fitted.mean[:1]]
    gaps = np.flatnonzero(np.diff(azimuth_deg) > 2 * 360 / EFFECT_BINS) + 1
    return np.radians(np.insert(azimuth_deg, gaps, np.nan)), np.insert(radius, gaps, np.nan)


def _dominant_variable(effect: EffectData) -> tuple[str, float]:
    """Return the continuous variable that explains an effect's contribution best, and how well.

    The second value is the share of the contribution's variance, averaged over the panels.
    """
    shares = {}
    for name, value in effect.variables.items():
        if value.dtype.kind != "f" or not np.isfinite(value).any():
            continue
        by_panel = [_explained_share(value[rows], effect.contribution_db[rows])
                    for _, rows in effect.panels()]
        shares[name] = float(np.mean(by_panel)) if by_panel else 0.0
    best = max(shares, key=lambda name: shares[name])
    return best, shares[best]


def _explained_share(value: np.ndarray, contribution_db: np.ndarray) -> float:
    """Return the share (0 to 1) of a contribution's variance that bins of a variable explain.

    It is the variance of the bins' means over that of the contribution.
    """
    known = np.isfinite(value)
    if not known.any() or np.var(contribution_db[known]) < 1e-12:
        return 0.0
    index = bin_index(value[known], EFFECT_BINS)
    total_db = np.bincount(index, weights=contribution_db[known])
    mean_db = total_db / np.maximum(np.bincount(index), 1)
    return float(np.var(mean_db[index]) / np.var(contribution_db[known]))


def _grid(count: int, projection: str | None = None) -> tuple[Figure, list[Axes]]:
    """Return a new figure with `count` axes, up to three in a row."""
    columns = min(max(count, 1), 3)
    rows = max(-(-count // columns), 1)
    figure = new_figure(max(3.7 * columns, 5.5), 3.4 * rows + 0.6)
    axes = [figure.add_subplot(rows, columns, number + 1, projection=projection)
            for number in range(count)]
    return figure, axes


def _limits(links_db: np.ndarray, means_db: np.ndarray) -> tuple[float, float]:
    """Return the ends of an axis [dB] that shows the links but 2 % at each end, and all means."""
    low, high = np.quantile(links_db, [0.02, 0.98]) if len(links_db) else (-1.0, 1.0)
    low, high = min(low, *means_db, high), max(high, *means_db, low)
    margin = 0.05 * (high - low) + 0.1
    return low - margin, high + margin


def _with_legend(figure: Figure, axes: list[Axes], effect: EffectData) -> Figure:
    """Add the legend above the panels, with a note where only LoS links are shown."""
    if axes:
        los = effect.links.los
        los_only = los[effect.shown].all() and not los.all()
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3,
                      frameon=False, title="links with line of sight" if los_only else None)
    return figure


def write_closeloop_figures(loop: Loop, scene: Scene | None, report: dict,
                            folder: Path | str) -> None:
    """Write all figures of a close-loop as PNG files.

    Args:
        loop: result of the close-loop.
        scene: whose buildings are drawn; None: no 3D map.
        report: content of `closeloop.json`.
        folder: for `groups.png`, `waterfall.png`, `residual_map.png`, `effect_RANK_NAME.png` for
            each effect and, if there is something to draw, `level_map.png` and `drivers.png`.
    """
    folder, data = Path(folder), collect(loop)
    background = MapBackground(data.links, scene)
    save(groups_figure(data, report), folder / "groups.png")
    save(waterfall_figure(report), folder / "waterfall.png")
    save(residual_map_figure(data, background, report), folder / "residual_map.png")
    for name, figure in (("level_map", level_map_figure(data, background)),
                         ("drivers", dependence_figure(data))):
        if figure is not None:
            save(figure, folder / f"{name}.png")
    for rank, effect in enumerate(data.effects, start=1):
        save(effect_figure(effect, background), folder / effect_picture(rank, effect.found.name))
    if data.interpolated_db is not None:
        save(contribution_map_figure(data.interpolated_db, background),
             folder / effect_picture(len(data.effects) + 1, SHADOWING))


def waterfall_figure(report: dict) -> Figure:
    """Draw how the held-out RMSE falls: the base model, the change by each effect, the result.

    Effects are what the base lacks and was added to it. Other models of `closeloop.json` are
    horizontal lines; above `MAX_LINE` times the highest bar they are left out.
    """
    error = report["error"]
    before, after = error["before"]["rmse_db"] or 0.0, rmse_after_db(error) or 0.0
    kept = [(candidate["name"], candidate["heldout_rmse_db"]) for candidate in report["candidates"]
            if candidate["kept"] and candidate["heldout_rmse_db"] is not None]
    declared = sum(effect.get("is_declared", False) for effect in report["effects"])
    kept = kept[declared:]  # declared effects come first: they are part of the base
    rmses = [before, *(rmse_db for _, rmse_db in kept)]
    without_cause = interpolations()
    steps = [(name_label(name), name in without_cause) for name, _ in kept]
    if kept and abs(rmses[-1] - after) > MIN_STEP_DB:
        rmses.append(after)
        known = error.get("after_with_quality")
        steps.append(("on a map: quality not known" if known else "joint refit", False))
    figure = new_figure(max(1.15 * (len(steps) + 2) + 2.6, 6.5), 4.6)
    ax = figure.add_subplot()
    _draw_bar(ax, 0, 0.0, before, BEFORE, f"{before:.2f} dB")
    for position, ((_, interpolated), high, low) in enumerate(zip(steps, rmses, rmses[1:]), 1):
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
    highest = MAX_LINE * max(before, after, *rmses)  # or the bars would be too low to be read
    lines = [(value["rmse_db"], name_label(name), "--") for name, value in
             report["baselines"].items() if (value["rmse_db"] or np.inf) <= highest]
    if error["noise_floor_db"] is not None:
        lines.append((error["noise_floor_db"], "noise of one\nmeasurement", ":"))
    top = 1.12 * max(before, after, *rmses, *(value for value, *_ in lines))
    ax.set(xlim=(-0.6, len(names) - 0.4), ylim=(0, max(top, 0.1)),
           ylabel="RMSE on held-out links [dB]",
           title=_change(before, after) if kept else "no effect of the catalogue lowers the error")
    wrap = textwrap.TextWrapper(12, break_long_words=False, break_on_hyphens=False)
    ax.set_xticks(range(len(names)), [wrap.fill(name) for name in names])
    _draw_lines(ax, lines)
    ax.tick_params(axis="x", length=0)
    hide_spines(ax)
    return figure


def dependence_figure(data: LoopData) -> Figure | None:
    """Draw the mean held-out residual over the continuous variables that it depends on most.

    None if there is no such variable. At most `MAX_PANELS` are drawn.
    """
    residual_db = [data.links.level_db - predicted for predicted in (data.before_db, data.after_db)]
    known = np.isfinite(residual_db[0]) & np.isfinite(residual_db[1])
    variables = [name for name in dict.fromkeys(data.drivers)
                 if name in data.links.variables and name not in ELSEWHERE][:MAX_PANELS]
    if not variables:
        return None
    columns = {1: 1, 2: 2, 4: 2}.get(len(variables), 3)
    rows = max(-(-len(variables) // columns), 1)
    figure = new_figure(4.1 * columns, 3.2 * rows + 0.4)
    for number, variable in enumerate(variables):
        ax = figure.add_subplot(rows, columns, number + 1)
        value, axis_label = data.links.on_axis(variable, data.links.variables[variable])
        used = known & np.isfinite(value)
        index = bin_index(value[used], BINS)
        before, after = (bin_means(index, value[used].astype(float), each[used],
                                   data.links.block[used]) for each in residual_db)
        _draw_curves(ax, before, after, data.changed)
        ax.set(xlabel=axis_label, ylabel="mean residual [dB]" if number % columns == 0 else "")
        ax.axhline(0, color="0.6", linewidth=0.8, zorder=0)
        hide_spines(ax)
    handles = dict(zip(*figure.axes[0].get_legend_handles_labels()[::-1]))
    shown = [label for label in ("before", "after", CONTRIBUTION) if label in handles]
    figure.legend([handles[label] for label in shown], shown, loc="outside upper center",
                  ncols=min(columns + 1, 3), frameon=False)  # one panel has room for two
    return figure


def _draw_curves(ax: Axes, before: BinMeans, after: BinMeans, changed: bool) -> None:
    """Draw mean residuals before and after the effects over a variable, with standard errors.

    Without effects (`changed` is false), only the mean residuals before are drawn.
    """
    curves = [(before, BEFORE, "before"), (after, AFTER, "after")]
    for curve, colour, label in curves if changed else curves[:1]:
        ax.fill_between(curve.at, curve.mean - curve.error, curve.mean + curve.error, color=colour,
                        alpha=0.2, linewidth=0)
        ax.plot(curve.at, curve.mean, "o-", color=colour, markersize=3, linewidth=1.3, label=label)
    if changed:
        ax.plot(before.at, before.mean - after.mean, color=FITTED, linewidth=1.3, linestyle="--",
                label=CONTRIBUTION)


def _draw_bar(ax: Axes, position: int, start: float, end: float, colour: str, text: str,
              alpha: float = 1.0) -> None:
    """Draw a bar from `start` to `end`, in either order, with a text above."""
    low, high = sorted((start, end))
    ax.bar(position, high - low, bottom=low, width=0.7, color=colour, alpha=alpha, zorder=2)
    ax.annotate(text, (position, high), xytext=(0, 3), textcoords="offset points", ha="center",
                va="bottom", fontweight="bold", zorder=5)


def _connect(ax: Axes, position: int, level: float) -> None:
    """Draw a thin line at a level [dB] from the previous bar to the bar at a position."""
    ax.plot([position - 0.65, position + 0.35], [level, level], color="0.5", linewidth=0.8)


def _draw_lines(ax: Axes, lines: list[tuple[float, str, str]]) -> None:
    """Draw horizontal lines (value, name, style) with labels at the right that do not overlap."""
    top, last = ax.get_ylim()[1], -np.inf
    spacing = min(0.085, 1 / max(len(lines), 1)) * top
    for above, (value, name, style) in zip(range(len(lines) - 1, -1, -1), sorted(lines)):
        ax.axhline(value, color="0.45", linewidth=0.9, linestyle=style, zorder=1)
        last = min(max(value, last + spacing), top - above * spacing)  # room for labels above
        ax.annotate(f"{name} {value:.2f}", (1.0, last), xycoords=("axes fraction", "data"),
                    xytext=(4, 0), textcoords="offset points", va="center", fontsize=9, color="0.3",
                    annotation_clip=False)


def _change(before: float, after: float) -> str:
    """Return the change of the RMSE [dB] as a title: "4.25 → 2.46 dB on held-out links …"."""
    text = f"{before:.2f} → {after:.2f} dB on held-out links"
    if not before:
        return text
    return f"{text}: {abs(1 - after / before):.0%} {'less' if after <= before else 'more'}"
