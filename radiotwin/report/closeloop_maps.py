"""Draw residuals, levels and effects of a close-loop on the city map.

Mark on a map where an effect is.
"""

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection, QuadMesh
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from radiotwin.closeloop.output.residuals import rmse_db
from radiotwin.display import GAIN_COLOURS, RESIDUAL_COLOURS, plain, residual_range_db
from radiotwin.effects.boxes import buildings
from radiotwin.report.closeloop_data import EffectData, LoopData
from radiotwin.report.labels import join_names, name_label
from radiotwin.report.map_figures import MapBackground
from radiotwin.report.style import FOUND, draw_legend_below, new_figure

HALO = [withStroke(linewidth=2.5, foreground="white")]
Label = tuple[str, np.ndarray]
"""Text beside a marker, and its position (2,) [m]."""
MAX_RAYS = 1500
MIN_CONTRIBUTION_DB = 0.5  # links that an effect changes by less are not drawn
RESIDUAL_LABEL = "measured − predicted [dB]"


def mark(ax: Axes, effect: EffectData) -> None:
    """Draw an effect that has a position, with its name; others are left out."""
    for field, draw in MARKERS.items():
        label = draw(ax, effect) if field in effect.params else None
        if label is not None:
            _draw_label(ax, *label)
            return


def _mark_box(ax: Axes, effect: EffectData) -> Label:
    """Outline a box: centre x, y, length, width, height [m] and counter-clockwise turn [deg]."""
    x_m, y_m, length_m, width_m, height_m, turn_deg = effect.params["box"]
    turn = np.radians(turn_deg)
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]) * 0.5 * (length_m, width_m)
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    outline_m = corners @ rotation + (x_m, y_m)
    ax.plot(outline_m[:, 0], outline_m[:, 1], color=FOUND, linewidth=2, zorder=5)
    return f"{name_label(effect.name)}\n{height_m:.0f} m high", np.array((x_m, y_m))


def _mark_building(ax: Axes, effect: EffectData) -> Label | None:
    """Fill a building that is gone."""
    city = effect.links.city
    if city is None:
        return None
    faces = city.faces[buildings(city)[0] == effect.params["building"]]
    ax.add_collection(PolyCollection(city.vertices[faces][..., :2], facecolors=FOUND,
                                     edgecolors="none", alpha=0.6, zorder=5), autolim=False)
    return "removed building", effect.params["centre_m"][:2]


def _mark_move(ax: Axes, effect: EffectData) -> Label | None:
    """Draw an arrow from the given to the estimated position of a device."""
    if "device" not in effect.params:
        return None
    device, move_m = effect.params["device"], effect.params["move_m"][:2]
    given_m = effect.links.device_m[device, :2]
    estimate_m = given_m + move_m
    ax.annotate("", tuple(estimate_m), tuple(given_m), zorder=6, arrowprops={
        "arrowstyle": "->", "color": FOUND, "linewidth": 2, "shrinkA": 0, "shrinkB": 4})
    ax.plot(*estimate_m, "*", color=FOUND, markersize=13, markeredgecolor="white", zorder=7)
    name = plain(effect.links.names["device"][device])
    return f"{name} is\n{np.hypot(*move_m):.0f} m away", estimate_m


def _mark_point(ax: Axes, effect: EffectData) -> Label:
    """Draw a cross."""
    position_m = effect.params["place_m"][:2]
    ax.plot(*position_m, "X", color=FOUND, markersize=11, markeredgecolor="white", zorder=6)
    return name_label(effect.name), position_m


MARKERS: dict[str, Callable[[Axes, EffectData], Label | None]] = {
    "box": _mark_box, "building": _mark_building, "move_m": _mark_move, "place_m": _mark_point}
"""By the parameter that holds the position."""


def _draw_label(ax: Axes, text: str, position_m: np.ndarray) -> None:
    """Write beside a marker, on the side of the middle of the map."""
    right = position_m[0] < np.mean(ax.get_xlim())
    ax.annotate(text, tuple(position_m), xytext=(14 if right else -14, 12),
                textcoords="offset points", color=FOUND, fontsize=9, fontweight="bold",
                ha="left" if right else "right", zorder=7, path_effects=HALO)


def residual_map_figure(data: LoopData, background: MapBackground) -> Figure:
    """Draw the mean held-out residual over the positions of the moving end, before and after."""
    panels = [(f"before: {name_label(data.base)}", data.before_db)]
    if data.changed:
        names = [name_label(name) for name in data.kept]
        added = join_names(names) if len(names) < 3 else f"{len(names)} effects"
        panels.append((f"after: with {added}", data.after_db))
    residuals_db = [data.links.level_db - predicted_db for _, predicted_db in panels]
    cells = [background.cell_means(residual_db) for residual_db in residuals_db]
    figure = new_figure(5.4 * len(panels) + 0.9, background.panel_height(4.9) + 1.3)
    range_db = residual_range_db(cells[0][2])
    for number, ((title, _), residual_db, grid) in enumerate(zip(panels, residuals_db, cells)):
        ax = figure.add_subplot(1, len(panels), number + 1)
        background.draw(ax, labelled=number == 0)
        image = _draw_cells(ax, grid, RESIDUAL_COLOURS, -range_db, range_db)
        for effect in data.effects:
            mark(ax, effect)
        ax.set_title(f"{title}\nRMSE {rmse_db(residual_db):.2f} dB", fontsize=11)
    figure.colorbar(image, ax=figure.axes, shrink=0.85, extend="both", label=RESIDUAL_LABEL)
    end = "receiver" if background.receivers_move else "device"
    draw_legend_below(
        figure, f"mean over all links with the {end} in a cell of {background.cell_m:g} m")
    return figure


def level_map_figure(data: LoopData, background: MapBackground) -> Figure | None:
    """Draw measured and predicted held-out levels and their difference over the moving end.

    Returns:
        the figure; None where no detected link has a held-out prediction
    """
    links, predicted_db = data.links, data.after_db
    known = np.isfinite(links.level_db) & np.isfinite(predicted_db)
    if not known.any():
        return None
    measured_db, predicted_db = (np.where(known, values, np.nan)
                                 for values in (links.level_db, predicted_db))
    cells = [background.cell_means(values)
             for values in (measured_db, predicted_db, measured_db - predicted_db)]
    finite_db = cells[0][2][np.isfinite(cells[0][2])]
    low_db, high_db = np.quantile(finite_db, [0.02, 0.98]) if len(finite_db) else (-1.0, 0.0)
    range_db = residual_range_db(cells[2][2])
    level = "gain [dB]" if links.is_gain else "received power [dBm]"
    looks = ((GAIN_COLOURS, low_db, high_db, "measured", level),
             (GAIN_COLOURS, low_db, high_db, "predicted, held out", level),
             (RESIDUAL_COLOURS, -range_db, range_db, "measured − predicted", "difference [dB]"))
    figure = new_figure(15.6, background.panel_height(4.3) + 1.2)
    for number, (grid, (colours, low, high, title, label)) in enumerate(zip(cells, looks)):
        ax = figure.add_subplot(1, 3, number + 1)
        background.draw(ax, labelled=number == 0)
        image = _draw_cells(ax, grid, colours, low, high)
        ax.set_title(title, fontsize=11)
        figure.colorbar(image, ax=ax, shrink=0.85, extend="both", location="bottom", label=label)
    draw_legend_below(figure, f"mean over the links in a cell of {background.cell_m:g} m")
    return figure


def contribution_map_figure(contribution_db: np.ndarray, background: MapBackground) -> Figure:
    """Draw the mean contribution of an effect over the positions of the moving end.

    Args:
        contribution_db: (n,) change of the predicted level of each link [dB].
        background: of the same links.
    """
    figure = new_figure(6.6, background.panel_height(4.9) + 0.9)
    ax = figure.add_subplot()
    background.draw(ax)
    grid = background.cell_means(contribution_db)
    range_db = residual_range_db(grid[2])
    image = _draw_cells(ax, grid, RESIDUAL_COLOURS, -range_db, range_db)
    figure.colorbar(image, ax=ax, shrink=0.85, extend="both", label="contribution [dB]")
    draw_legend_below(figure, f"mean over cells of {background.cell_m:g} m")
    return figure


def affected_links_figure(effect: EffectData, background: MapBackground) -> Figure:
    """Draw the links that an effect changes, coloured by their residual without and with it."""
    links = effect.links
    changed = np.abs(effect.contribution_db) > MIN_CONTRIBUTION_DB
    rows = np.flatnonzero(changed & np.isfinite(links.level_db))
    drawn = np.random.default_rng(0).permutation(rows)[:MAX_RAYS]
    range_db = residual_range_db(effect.residual_db[rows])
    ends_m = links.ends_m[..., :2]
    frame = background.frame(ends_m[drawn].reshape(-1, 2))
    figure = new_figure(11.7, background.panel_height(4.9) + 1.1)
    for number, (title, predicted_db) in enumerate((("without the effect", effect.without_db),
                                                    ("with the effect", effect.with_db))):
        residual_db = links.level_db - predicted_db
        ax = figure.add_subplot(1, 2, number + 1)
        background.draw(ax, labelled=number == 0)
        order = drawn[np.argsort(np.abs(residual_db[drawn]))]
        rays = LineCollection(ends_m[order], array=residual_db[order], cmap=RESIDUAL_COLOURS,
                              linewidths=0.8, alpha=0.6, zorder=2)
        rays.set_clim(-range_db, range_db)
        ax.add_collection(rays, autolim=False)
        x_m, y_m = background.moving_m[order, :2].T
        dots = ax.scatter(x_m, y_m, c=residual_db[order], s=12, cmap=RESIDUAL_COLOURS,
                          vmin=-range_db, vmax=range_db, linewidths=0.2, edgecolors="0.3", zorder=3)
        ax.set(xlim=frame[:2], ylim=frame[2:])
        mark(ax, effect)
        error = f"{rmse_db(residual_db[rows]):.2f} dB" if len(rows) else "none was detected"
        ax.set_title(f"{title}\nRMSE of the {len(rows):,} links that it changes: {error}",
                     fontsize=11)
    figure.colorbar(dots, ax=figure.axes, shrink=0.85, extend="both", label=RESIDUAL_LABEL)
    draw_legend_below(figure)
    return figure


def _draw_cells(ax: Axes, grid: tuple[np.ndarray, np.ndarray, np.ndarray], colours: str,
                low: float, high: float) -> QuadMesh:
    """Draw means over cells, as `MapBackground.cell_means` returns them."""
    return ax.pcolormesh(*grid, cmap=colours, vmin=low, vmax=high, zorder=2, alpha=0.9,
                         linewidth=0, rasterized=True)
