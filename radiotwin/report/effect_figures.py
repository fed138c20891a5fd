"""Draw each effect in its own terms: on the map, over the azimuth, over a variable, or as bars.

An effect chooses its figure by the attribute `figure`, a key of `FIGURES`. Without one its name
decides, then its stage. Any other effect is drawn over the variable that explains most of it.
"""

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from radiotwin.display import plain
from radiotwin.report.closeloop_data import BinMeans, EffectData, bin_index, bin_means
from radiotwin.report.closeloop_maps import (
    RESIDUAL_LABEL,
    affected_links_figure,
    contribution_map_figure,
)
from radiotwin.report.labels import parameter_label
from radiotwin.report.map_figures import MapBackground
from radiotwin.report.style import AFTER, BEFORE, FITTED, hide_spines, new_figure, shorten

BINS = 24
MAX_BARS = 40
MIN_SHARE = 0.3  # of the variance of a contribution that a variable explains, to be drawn over it
AZIMUTHS = {"device": "azimuth_deg", "receiver": "body_azimuth_deg"}


def effect_figure(effect: EffectData, background: MapBackground) -> Figure:
    """Draw an effect in the figure that suits it.

    Args:
        effect: the effect and its contribution.
        background: map of the same links.
    """
    kind = effect.figure or FIGURE_OF_STAGE.get(effect.stage, "")
    return FIGURES.get(kind, dependence_figure)(effect, background)


def dependence_figure(effect: EffectData, background: MapBackground) -> Figure:
    """Draw residual and contribution over the variable that explains the contribution best.

    Where no variable explains much, the contribution is drawn on the map.
    """
    name, share = _dominant_variable(effect)
    if share < MIN_SHARE:
        return contribution_map_figure(effect.contribution_db, background)
    value, label = effect.links.on_axis(name, effect.variables[name])
    figure, axes = _grid(len(effect.panels()))
    for number, (ax, (title, rows)) in enumerate(zip(axes, effect.panels())):
        measured = effect.residual_db
        _draw_means(ax, effect, rows, value, measured, effect.contribution_db,
                    "mean residual without the effect")
        ax.axhline(0, color="0.6", linewidth=0.8)
        ax.set(title=plain(title), xlabel=label, ylabel="residual [dB]" if number % 3 == 0 else "")
    return _with_legend(figure, axes, effect)


def response_figure(effect: EffectData, _: MapBackground) -> Figure:
    """Draw readings over the level predicted without the effect."""
    unit, predicted = effect.links.level_unit, effect.without_db
    figure, axes = _grid(len(effect.panels()))
    for number, (ax, (title, rows)) in enumerate(zip(axes, effect.panels())):
        fitted = _draw_means(ax, effect, rows, predicted, effect.links.level_db, effect.with_db,
                             "mean of the readings")
        ax.plot(fitted.at, fitted.at, color=FITTED, linewidth=1, linestyle=":",
                label="linear response")
        ax.set(title=plain(title), xlabel=f"predicted level [{unit}]",
               ylabel=f"reading [{unit}]" if number % 3 == 0 else "")
    return _with_legend(figure, axes, effect)


def pattern_figure(effect: EffectData, _: MapBackground) -> Figure:
    """Draw residual and fitted pattern over the azimuth."""
    azimuth_deg = effect.variables[AZIMUTHS[effect.member_kind or "device"]]
    figure, axes = _grid(len(effect.panels()), projection="polar")
    for ax, (title, rows) in zip(axes, effect.panels()):
        rows = rows[np.isfinite(azimuth_deg[rows])]
        index = np.floor(azimuth_deg[rows] / 360 * BINS).astype(int) % BINS
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
        both = np.concatenate([found.mean, fitted.mean])
        if len(both):
            span_db = max(np.ptp(both), 3.0)
            ax.set_ylim(both.min() - 0.35 * span_db, both.max() + 0.05 * span_db)
        ax.set_rlabel_position(22.5)  # type: ignore[attr-defined]
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.tick_params(axis="y", labelsize=7)
        ax.set_title(plain(title))
    zero = "the receiver's heading" if effect.member_kind == "receiver" else "north, at the device"
    figure.supxlabel(f"azimuth, clockwise from {zero}; radius: residual [dB]", fontsize=10)
    return _with_legend(figure, axes, effect)


def histogram_figure(effect: EffectData, _: MapBackground) -> Figure:
    """Draw the distribution of the residuals that the effect changes, without and with it."""
    rows, los = np.isfinite(effect.residual_db), effect.links.los
    nlos = effect.nlos_only and (rows & ~los).any()
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
    """Draw the value of each member that the data determine, with its 90 % interval."""
    known = {name: each for name, each in effect.parameters.items() if each.determined}
    if not known:
        return dependence_figure(effect, background)
    chosen = sorted(known.items(), key=lambda item: -abs(item[1].value))[:MAX_BARS]
    chosen.sort(key=lambda item: item[1].value)
    value = np.array([p.value for _, p in chosen])
    errors = np.abs(np.array([(p.value - p.low, p.high - p.value) for _, p in chosen]).T)
    figure = new_figure(7.0, 0.28 * len(chosen) + 1.1)
    ax = figure.add_subplot()
    ax.barh(range(len(chosen)), value, xerr=errors, color=AFTER, alpha=0.75, ecolor=FITTED,
            capsize=2)
    members = [name.partition("[")[2].removesuffix("]") for name, _ in chosen]
    ax.set_yticks(range(len(chosen)), [shorten(member, 24) for member in members])
    ax.axvline(0, color="0.4", linewidth=0.8)
    label = parameter_label(chosen[0][0].partition("[")[0])
    ax.set(xlabel=f"{label}, with 90 % interval [{chosen[0][1].unit}]",
           ylim=(-0.7, len(chosen) - 0.3))
    hide_spines(ax)
    return figure


FIGURES: dict[str, Callable[[EffectData, MapBackground], Figure]] = {
    "dependence": dependence_figure, "histogram": histogram_figure, "intervals": interval_figure,
    "links": affected_links_figure, "pattern": pattern_figure, "response": response_figure}
FIGURE_OF_STAGE = {"paths": "histogram", "detection": "intervals", "limit": "intervals",
                   "receiver": "response"}


def _draw_means(ax: Axes, effect: EffectData, rows: np.ndarray, value: np.ndarray,
                measured_db: np.ndarray, fitted_db: np.ndarray, label: str) -> BinMeans:
    """Draw links as dots, their means over a variable, and the mean of what is fitted.

    Args:
        ax: axes to draw into.
        effect: the effect.
        rows: (r,) indices of the links.
        value: (n,) variable.
        measured_db: (n,) level or residual [dB].
        fitted_db: (n,) the same as fitted [dB].
        label: of the means in the legend.

    Returns:
        the means of what is fitted
    """
    rows = rows[np.isfinite(value[rows])]
    index = bin_index(value[rows], BINS)
    found, fitted = (bin_means(index, value[rows], each_db[rows], effect.links.block[rows])
                     for each_db in (measured_db, fitted_db))
    ax.plot(value[rows], measured_db[rows], ".", color="0.8", markersize=2, zorder=0,
            rasterized=True)
    ax.plot(found.at, found.mean, "o", color=BEFORE, markersize=4, label=label)
    ax.errorbar(found.at, found.mean, found.error, fmt="none", color=BEFORE)
    ax.plot(fitted.at, fitted.mean, color=AFTER, linewidth=2, label="fitted")
    ax.set_ylim(_limits(measured_db[rows], np.concatenate([found.mean, fitted.mean])))
    hide_spines(ax)
    return fitted


def _closed_curve(fitted: BinMeans) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuths [rad] and radii of a closed curve, broken where there are no links."""
    azimuth_deg = np.r_[fitted.at, fitted.at[:1] + 360]
    radius = np.r_[fitted.mean, fitted.mean[:1]]
    gaps = np.flatnonzero(np.diff(azimuth_deg) > 2 * 360 / BINS) + 1
    return np.radians(np.insert(azimuth_deg, gaps, np.nan)), np.insert(radius, gaps, np.nan)


def _dominant_variable(effect: EffectData) -> tuple[str, float]:
    """Return the variable that explains the contribution best, and the share of its variance."""
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
    """Return the share of the variance of a contribution that lies between bins of a variable."""
    known = np.isfinite(value)
    if not known.any() or np.var(contribution_db[known]) < 1e-12:
        return 0.0
    index = bin_index(value[known], BINS)
    total_db = np.bincount(index, weights=contribution_db[known])
    mean_db = total_db / np.maximum(np.bincount(index), 1)
    return float(np.var(mean_db[index]) / np.var(contribution_db[known]))


def _grid(count: int, projection: str | None = None) -> tuple[Figure, list[Axes]]:
    columns = min(max(count, 1), 3)
    rows = max(-(-count // columns), 1)
    figure = new_figure(max(3.7 * columns, 5.5), 3.4 * rows + 0.6)
    axes = [figure.add_subplot(rows, columns, number + 1, projection=projection)
            for number in range(count)]
    return figure, axes


def _limits(links_db: np.ndarray, means_db: np.ndarray) -> tuple[float, float]:
    """Return the ends of an axis that shows nearly all links and all means."""
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
