"""Each kept effect in its own terms: on the map, round the compass, over what it depends on, or as bars."""

from pathlib import Path

import numpy as np
from matplotlib.ticker import MaxNLocator

from radiotwin.closeloop.partial_effects import BINS, Acting, acting_alone, acts_through
from radiotwin.closeloop.drawing import (
    AFTER,
    BEFORE,
    FITTED,
    Means,
    bins,
    means,
    new_figure,
    on_axis,
    plain,
    save,
    shorten,
    tidy,
)
from radiotwin.closeloop.folds import evidence_blocks
from radiotwin.closeloop.map_figures import Ground, draw_added, draw_links
from radiotwin.closeloop.run import Loop
from radiotwin.effects.correlated_shadowing import NAME as LAST_RESORT
from radiotwin.inference.residual_tests import variables
from radiotwin.closeloop.words import parameter

MAX_BARS = 40
EXPLAINED = 0.3  # share of what an effect does that a variable must stand for, to be drawn over it
PLACED = ("box", "building", "move_m", "place_m")
DIRECTIONS = {"device": "azimuth_deg", "receiver": "body_azimuth_deg"}


def draw_effects(loop: Loop, ground: Ground, folder: Path) -> None:
    """Write `effect_RANK_NAME.png` for each kept effect; those of an earlier run go."""
    for old in folder.glob("effect_*.png"):
        old.unlink()
    for number, (part, parameters) in enumerate(zip(loop.after.whole.parts, loop.parameters)):
        acting = acting_alone(loop, number, part, parameters)
        _draw(acting, ground, folder / f"effect_{number + 1}_{part.effect.name}.png")
    if loop.after.shadowing:
        added_db = loop.after.held_out_shadowing[0] * loop.after.held_out(lambda side, fit: side.expect(fit).scale_db)
        draw_added(added_db, ground, folder / f"effect_{len(loop.after.whole.parts) + 1}_{LAST_RESORT}.png")


def _draw(acting: Acting, ground: Ground, path: Path) -> None:
    """The picture that suits the effect."""
    effect, params = acting.part.effect, acting.part.params
    if any(key in params for key in PLACED):
        draw_links(acting.part, acting.without_db, acting.with_db, ground, path)
    elif effect.stage == "paths":
        _draw_histogram(acting, path)
    elif effect.name.endswith("_gain_offset") or effect.stage in ("detection", "limit"):
        _draw_bars(acting, path)
    elif effect.stage == "receiver":
        unit = "dB" if acting.links.is_gain else "dBm"
        _draw_over(acting, acting.without_db, f"expected level [{unit}]", path, reading=True)
    elif effect.name in ("antenna_pattern", "body_shadowing"):
        _draw_compass(acting, path)
    else:
        name, share = acts_through(acting)
        if share < EXPLAINED:
            draw_added(acting.added_db, ground, path)
        else:
            value = variables(acting.links, acting.without_db)[name]
            _draw_over(acting, *on_axis(acting.links, name, value), path)


def _draw_over(acting: Acting, value: np.ndarray, label: str, path: Path, reading: bool = False) -> None:
    """Residual without the effect against a variable, and what was fitted; or readings against what is expected."""
    links = acting.links
    figure, axes = _grid(len(acting.panels()))
    block = evidence_blocks(links)
    for number, (ax, (name, rows)) in enumerate(zip(axes, acting.panels())):
        rows = rows[np.isfinite(value[rows])]
        level = bins(value[rows], BINS)
        offset_db = value if reading else np.zeros(len(links))
        found, fitted = (means(level, value[rows], (offset_db + part_db)[rows], block[rows])
                         for part_db in (acting.residual_db, acting.added_db))
        ax.plot(value[rows], (offset_db + acting.residual_db)[rows], ".", color="0.8", markersize=2, zorder=0,
                rasterized=True)
        ax.plot(found.at, found.mean, "o", color=BEFORE, markersize=4,
                label="measured, mean" if reading else "residual without it, mean")
        ax.errorbar(found.at, found.mean, found.error, fmt="none", color=BEFORE)
        ax.plot(fitted.at, fitted.mean, color=AFTER, linewidth=2, label="fitted")
        if reading:
            ax.plot(fitted.at, fitted.at, color=FITTED, linewidth=1, linestyle=":", label="reads what is expected")
        else:
            ax.axhline(0, color="0.6", linewidth=0.8)
        everything_db = (offset_db + acting.residual_db)[rows]
        ax.set(title=plain(name), xlabel=label,
               ylim=_limits(everything_db, np.concatenate([found.mean, fitted.mean])))
        if number % 3 == 0:
            ax.set_ylabel(label.replace("expected level", "reading") if reading else "residual [dB]")
        tidy(ax)
    _finish(figure, axes, acting, path)


def _draw_compass(acting: Acting, path: Path) -> None:
    """Residual without the effect round the compass, and the fitted pattern."""
    links, block = acting.links, evidence_blocks(acting.links)
    angle_deg = variables(links, acting.without_db)[DIRECTIONS[acting.members or "device"]]
    figure, axes = _grid(len(acting.panels()), projection="polar")
    for ax, (name, rows) in zip(axes, acting.panels()):
        rows = rows[np.isfinite(angle_deg[rows])]
        level = np.floor(angle_deg[rows] / 360 * BINS).astype(int) % BINS
        found, fitted = (means(level, angle_deg[rows], part_db[rows], block[rows])
                         for part_db in (acting.residual_db, acting.added_db))
        turn = np.radians(found.at)
        ax.set_theta_zero_location("N")
        ax.set_theta_direction(-1)
        ax.plot(turn, found.mean, "o", color=BEFORE, markersize=4, label="residual without it, mean")
        ax.errorbar(turn, found.mean, yerr=found.error, fmt="none", color=BEFORE, elinewidth=1)
        ax.plot(*_round(fitted), color=AFTER, linewidth=2, label="fitted")
        both = np.concatenate([found.mean, fitted.mean])
        if len(both):
            ax.set_ylim(both.min() - 0.35 * max(np.ptp(both), 3.0), both.max() + 0.05 * max(np.ptp(both), 3.0))
        ax.set_rlabel_position(22.5)
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.tick_params(axis="y", labelsize=7)
        ax.set_title(plain(name))
    what = "from north, seen from the device" if acting.members != "receiver" else "from the receiver's heading"
    figure.supxlabel(f"direction, clockwise {what}; radius: residual [dB]", fontsize=10)
    _finish(figure, axes, acting, path)


def _round(fitted: Means) -> tuple[np.ndarray, np.ndarray]:
    """Angles [rad] and radii of a line round the compass, broken where there are no links."""
    turn_deg, radius = np.r_[fitted.at, fitted.at[:1] + 360], np.r_[fitted.mean, fitted.mean[:1]]
    gaps = np.flatnonzero(np.diff(turn_deg) > 2 * 360 / BINS) + 1
    return np.radians(np.insert(turn_deg, gaps, np.nan)), np.insert(radius, gaps, np.nan)


def _draw_histogram(acting: Acting, path: Path) -> None:
    """Residuals of the links that it acts on, without and with it."""
    rows = np.isfinite(acting.residual_db)
    nlos = acting.part.effect.nlos_only and (rows & ~acting.links.los).any()
    rows = rows & ~acting.links.los if nlos else rows
    residuals_db = acting.residual_db[rows], acting.residual_db[rows] - acting.added_db[rows]
    most_db = float(np.quantile(np.abs(residuals_db[0]), 0.995)) + 1.0
    figure = new_figure(7.0, 3.8)
    ax = figure.add_subplot()
    for residual_db, colour, label in zip(residuals_db, (BEFORE, AFTER), ("without it", "with it")):
        ax.hist(residual_db, np.linspace(-most_db, most_db, 61).tolist(), color=colour, alpha=0.55,
                label=f"{label}: {np.sqrt(np.mean(residual_db**2)):.2f} dB (RMSE)")
    ax.axvline(0, color="0.3", linewidth=0.8)
    ax.set(xlabel="measured − predicted [dB]", ylabel="links",
           title=f"{rows.sum():,} links{' without line of sight' if nlos else ''}")
    ax.legend(frameon=False)
    tidy(ax)
    save(figure, path)


def _draw_bars(acting: Acting, path: Path) -> None:
    """A value with its 90 % interval for each member."""
    chosen = sorted(acting.parameters.items(), key=lambda item: -abs(item[1].value))[:MAX_BARS]
    chosen.sort(key=lambda item: item[1].value)
    value = np.array([p.value for _, p in chosen])
    spread = np.abs(np.array([(p.value - p.low, p.high - p.value) for _, p in chosen]).T)
    figure = new_figure(7.0, 0.28 * len(chosen) + 1.1)
    ax = figure.add_subplot()
    ax.barh(range(len(chosen)), value, xerr=spread, color=AFTER, alpha=0.75, ecolor=FITTED, capsize=2)
    ax.set_yticks(range(len(chosen)), [shorten(name.partition("[")[2].removesuffix("]"), 24) for name, _ in chosen])
    ax.axvline(0, color="0.4", linewidth=0.8)
    words = f"{parameter(chosen[0][0].partition('[')[0])}, with 90 % interval [{chosen[0][1].unit}]"
    ax.set(xlabel=words, ylim=(-0.7, len(chosen) - 0.3))
    tidy(ax)
    save(figure, path)


def _grid(count: int, projection: str | None = None):
    columns = min(max(count, 1), 3)
    rows = max(-(-count // columns), 1)
    figure = new_figure(max(3.7 * columns, 5.5), 3.4 * rows + 0.6)
    return figure, [figure.add_subplot(rows, columns, number + 1, projection=projection) for number in range(count)]


def _limits(everything_db: np.ndarray, drawn_db: np.ndarray) -> tuple[float, float]:
    """Of an axis: nearly all links, and all that is fitted."""
    low, high = np.quantile(everything_db, [0.02, 0.98]) if len(everything_db) else (-1.0, 1.0)
    low, high = min(low, *drawn_db, high), max(high, *drawn_db, low)
    return low - 0.05 * (high - low) - 0.1, high + 0.05 * (high - low) + 0.1


def _finish(figure, axes: list, acting: Acting, path: Path) -> None:
    if axes:
        only = acting.links.los[acting.shown].all() and not acting.links.los.all()
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False,
                      title="links with line of sight" if only else None)
    save(figure, path)
