"""Maps: gains over the outlines of buildings, and residuals, levels and effects of a close-loop."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from matplotlib.patheffects import withStroke

from radiotwin.closeloop.output.residuals import rmse_db
from radiotwin.display import (
    DIFFERENCE_COLOURS,
    GAIN_COLOURS,
    RESIDUAL_COLOURS,
    level_range_db,
    plain,
    residual_range_db,
)
from radiotwin.maps.radiomap import RadioMap
from radiotwin.report.closeloop_data import DrawnLinks, EffectData, LoopData
from radiotwin.report.closeloop_words import found_causes, is_changed
from radiotwin.report.labels import (
    FOUND,
    MODELS,
    join_names,
    name_label,
    new_figure,
    save,
    source_label,
)
from radiotwin.scene import Scene
from radiotwin.scene.plot import draw_streets, draw_vegetation, height_grid
from radiotwin.twin import TwinDevice
from radiotwin.twin.compare import comparable_db

BUILDING_M = 2.0  # lowest height that is outlined
OUTLINE_CELLS = 400  # along the longer side
MAX_COLUMNS = 5
MAX_PANELS = 100
MAX_CELLS = 1_000  # along the longer side of a panel; of larger maps every n-th is drawn
MAX_RATIO = 5  # of the sides of a panel
TITLE_LETTERS_IN = 10  # that fit into an inch of a title
ERROR_RANGE_DB = 25.0
HeightGrid = tuple[np.ndarray, tuple[float, float, float, float]]
"""(ny, nx) heights [m], and x_min, x_max, y_min, y_max [m]."""
CELLS = 45  # along the longer side of the map
MIN_CELL_M = 10.0
MIN_LINKS = 3  # in a cell that is drawn
MAX_MARKS = 80  # more devices or receivers would hide the map
MAX_NAMES = 30  # beside the marks
PANEL_IN = 4.9  # width of a panel
MARGIN_M = 30.0  # around the links of an enlarged part
ROUND_STEPS = (1, 1.5, 2, 3, 4, 5, 7, 10)
HALO = [withStroke(linewidth=2.5, foreground="white")]
MAX_RAYS = 1500
MIN_CONTRIBUTION_DB = 0.5  # links that an effect changes by less are not drawn
RESIDUAL_LABEL = "measured − predicted [dB]"


def _lowest(radio_map: RadioMap) -> str:
    """Return the lowest altitude of a map as text: "40 m above the ground"."""
    lattice = radio_map.lattice
    return f"{lattice.z_m[0]:g} m" + (" above the ground" if lattice.above == "ground" else "")


def write_picture(radio_map: RadioMap, scene: Scene, path: Path | str,
                  devices: Sequence[TwinDevice] = ()) -> None:
    """Write the level of all devices at the lowest altitude as a PNG file.

    Levels are received powers [dBm] if the map has all transmit powers, else gains [dB].

    Args:
        radio_map: map to draw.
        scene: whose buildings are outlined.
        path: PNG file.
        devices: a twin's devices, whose estimates are marked beside the scene's positions.
    """
    save(_radio_map_figure(radio_map, scene, devices), path)


def _radio_map_figure(radio_map: RadioMap, scene: Scene, devices: Sequence[TwinDevice]) -> Figure:
    """Draw the lowest altitude of `MAX_PANELS` devices at most, thinned to `MAX_CELLS` a side."""
    names = radio_map.devices[:MAX_PANELS]
    radio_map = radio_map.thinned(max(-(-max(radio_map.lattice.shape[1:]) // MAX_CELLS), 1))
    level_db = radio_map.dataset["gain_db"].variable[:len(names), 0].values
    powers_dbm = tx_powers_dbm(radio_map)
    if powers_dbm is not None:
        level_db = level_db + powers_dbm[:len(names), None, None]
    rows = -(-len(names) // MAX_COLUMNS)
    columns = -(-len(names) // rows)
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    figure, axes = panels(rows, columns, 2.6,
                          0.6 + 2.3 * min((y_max - y_min) / (x_max - x_min), MAX_RATIO))
    colour_range = level_range_db(level_db)
    heights = height_grid(scene, OUTLINE_CELLS)
    position_m, found = true_positions_m(scene), {each.device: each for each in devices}
    for number, ax in enumerate(axes.flat):
        if number >= len(names):
            ax.set_axis_off()
            continue
        image = _draw_map(ax, level_db[number], radio_map, scene, heights, GAIN_COLOURS,
                          *colour_range)
        _mark_device(ax, position_m.get(names[number]), 8)
        if names[number] in found:
            _mark_twin_device(ax, found[names[number]])
        ax.set_title(plain(names[number]), fontsize=10)
        if number % columns:
            ax.set(ylabel="", yticklabels=[])
        if number + columns < len(names):
            ax.set(xlabel="", xticklabels=[])
    what, unit = ("channel gain", "dB") if powers_dbm is None else ("received power", "dBm")
    figure.colorbar(image, ax=axes, label=f"{what} [{unit}]", shrink=0.7)
    left_out = len(radio_map.devices) - len(names)
    more = f" ({left_out} more devices not shown)" if left_out else ""
    title = f"{what.capitalize()} at {_lowest(radio_map)}, {plain(source_label(radio_map))}{more}"
    letters = int(TITLE_LETTERS_IN * figure.get_figwidth())
    figure.suptitle(fill(title, letters, break_on_hyphens=False))
    handles = {label: handle for ax in axes.flat[:len(names)]
               for handle, label in zip(*ax.get_legend_handles_labels())}
    handles["building"] = Line2D([], [], color="black", linewidth=0.8)
    if np.isnan(level_db).any():
        handles["not detected"] = Patch(facecolor="white", edgecolor="black")
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", frameon=False,
                  ncols=min(len(handles), 1 + columns))
    return figure


def tx_powers_dbm(radio_map: RadioMap) -> np.ndarray | None:
    """Return the (k,) transmit powers of a map's devices [dBm]; None if one is not known."""
    common_dbm = radio_map.dataset.attrs.get("tx_power_dbm")
    powers_dbm = [radio_map.tx_power_dbm.get(name, common_dbm) for name in radio_map.devices]
    return None if None in powers_dbm else np.array(powers_dbm, dtype=float)


def model_maps_figure(truth: RadioMap, models: dict[str, RadioMap], scene: Scene,
                      device: str) -> Figure:
    """Draw a device's gains in the truth and in models, and the errors, at the lowest altitude.

    `models` are radio maps by name, over the truth's lattice.
    """
    figure, axes = panels(2, 1 + len(models), 4.0, 4.3)
    heights = height_grid(scene, OUTLINE_CELLS)
    true_db = truth.gain_db[truth.devices.index(device), 0]
    colour_range = level_range_db(true_db)
    gain_image = _draw_map(axes[0, 0], true_db, truth, scene, heights, GAIN_COLOURS, *colour_range)
    axes[0, 0].set_title("truth")
    axes[1, 0].set_axis_off()
    axes[1, 0].text(
        0.02, 0.5, f"device {plain(device)}\nat {_lowest(truth)} altitude\n\n"
        "top: channel gain\nbottom: model − truth\ntriangle: device\nblank: not detected\n\n"
        "models: mean of\nthe detected levels", transform=axes[1, 0].transAxes, fontsize=11)
    for column, (name, radio_map) in enumerate(models.items(), start=1):
        model_db = comparable_db(radio_map, truth)[radio_map.devices.index(device), 0]
        error_db = model_db - true_db
        _draw_map(axes[0, column], model_db, radio_map, scene, heights, GAIN_COLOURS,
                  *colour_range)
        axes[0, column].set_title(plain(MODELS.get(name, name)))
        error_image = _draw_map(axes[1, column], error_db, truth, scene, heights,
                                DIFFERENCE_COLOURS, -ERROR_RANGE_DB, ERROR_RANGE_DB)
        axes[1, column].set_title(f"difference, RMSE {np.sqrt(np.nanmean(error_db**2)):.1f} dB",
                                  fontsize=10)
    for ax in (*axes[0], *axes[1, 1:]):
        _mark_device(ax, true_positions_m(scene).get(device), 9)
    figure.colorbar(gain_image, ax=axes[0], label="channel gain [dB]", shrink=0.85)
    figure.colorbar(error_image, ax=axes[1], label="model − truth [dB]", shrink=0.85,
                    extend="both")
    return figure


def panels(rows: int, columns: int, width_in: float, height_in: float) -> tuple[Figure, np.ndarray]:
    """Return a figure and its (rows, columns) axes, each of a size in inches."""
    figure = new_figure(width_in * columns + 1.2, height_in * rows)
    figure.set_layout_engine("compressed")  # in all of them both axes have one scale
    return figure, figure.subplots(rows, columns, squeeze=False)


def true_positions_m(scene: Scene) -> dict[str, np.ndarray]:
    """Return the position (3,) of each device of a scene [m]."""
    return dict(zip([device.device for device in scene.config.devices], scene.device_m))


def _draw_map(ax: Axes, level_db: np.ndarray, radio_map: RadioMap, scene: Scene,
              heights: HeightGrid, colours: str, low_db: float, high_db: float) -> AxesImage:
    """Draw (ny, nx) levels over the lattice of a map, with streets and outlines of buildings."""
    lattice = radio_map.lattice
    half_m = lattice.step_m / 2
    extent = (lattice.x_m[0] - half_m, lattice.x_m[-1] + half_m,
              lattice.y_m[0] - half_m, lattice.y_m[-1] + half_m)
    image = ax.imshow(level_db, origin="lower", extent=extent, cmap=colours, vmin=low_db,
                      vmax=high_db, interpolation="nearest")
    height_m, bounds = heights
    ax.contour(height_m > BUILDING_M, levels=[0.5], origin="lower", extent=bounds, colors="black",
               linewidths=0.4, alpha=0.5)
    draw_streets(ax, scene)
    ax.set(xlabel="x, east [m]", ylabel="y, north [m]", aspect="equal")
    ax.autoscale(False)  # a mark outside must not make the map smaller
    return image


def _mark_device(ax: Axes, position_m: np.ndarray | None, size: float) -> None:
    """Mark the declared position of a device (x, y, …) [m]; None: nothing is drawn."""
    if position_m is not None:
        ax.plot(*position_m[:2], "^", color="white", markeredgecolor="black", markersize=size,
                label="device, declared")


def _mark_twin_device(ax: Axes, device: TwinDevice) -> None:
    """Mark a twin's device: an anchor, or an estimate with the circle that holds it with 90 %."""
    position_m = np.array([device.x_m, device.y_m])
    if device.role == "anchor":
        _mark_device(ax, position_m, 8)
        return
    ax.plot(*position_m, "X", color=FOUND, markeredgecolor="white", markersize=9,
            label="device, located" if device.located else "device, best guess")
    if np.isfinite(device.credible_radius_m):
        ax.add_artist(Circle((device.x_m, device.y_m), device.credible_radius_m,
                             fill=False, color=FOUND))
        ax.plot([], [], "o", markerfacecolor="none", color=FOUND, label="holds it with 90 %")


class MapBackground:
    """Map under the panels of a figure: buildings, streets, and the ends that do not move.

    Args:
        links: measured links.
        scene: whose buildings are drawn; None: no 3D map.
    """

    def __init__(self, links: DrawnLinks, scene: Scene | None) -> None:
        self.links = links
        device_m, receiver_m = links.ends_m[:, 0], links.receiver_m
        positions = np.unique(receiver_m[:, :2].round(), axis=0)
        self.receivers_move = len(positions) >= len(links.device_m)
        self.moving_m = receiver_m if self.receivers_move else device_m
        self._height_m: np.ndarray | None = None
        self._scene = scene
        if scene is not None:
            self._height_m, self.bounds = height_grid(scene, 500)
        else:
            ends_m = np.vstack([receiver_m, device_m])[:, :2]
            (x_min, y_min), (x_max, y_max) = np.nanquantile(ends_m, [0.002, 0.998], axis=0)
            margin_m = 0.04 * max(x_max - x_min, y_max - y_min, 50.0)
            self.bounds = x_min - margin_m, x_max + margin_m, y_min - margin_m, y_max + margin_m

    @property
    def cell_m(self) -> float:
        """Return the side of a map cell [m]: a round number, about 1/`CELLS` of the longer side."""
        x_min, x_max, y_min, y_max = self.bounds
        wanted = max(max(x_max - x_min, y_max - y_min) / CELLS, MIN_CELL_M)
        power = 10.0 ** np.floor(np.log10(wanted))
        return float(next(step * power for step in ROUND_STEPS if step * power >= 0.95 * wanted))

    def panel_height(self, width_in: float) -> float:
        """Return a panel's height in the map's proportions, 0.4 to 1.3 of its width [inches]."""
        x_min, x_max, y_min, y_max = self.bounds
        return width_in * min(max((y_max - y_min) / max(x_max - x_min, 1.0), 0.4), 1.3)

    def frame(self, positions_m: np.ndarray) -> tuple[float, float, float, float]:
        """Return x_min, x_max, y_min, y_max [m] of the part of the map around positions (n, 2) [m].

        It has the map's proportions and 0.3 of its size or more; all of it without positions.
        """
        x_min, x_max, y_min, y_max = self.bounds
        if not len(positions_m):
            return self.bounds
        low, high = positions_m.min(axis=0) - MARGIN_M, positions_m.max(axis=0) + MARGIN_M
        middle, span_m = 0.5 * (low + high), np.array([x_max - x_min, y_max - y_min])
        half = 0.5 * span_m * min(max(*((high - low) / span_m), 0.3), 1.0)
        middle = np.clip(middle, np.array([x_min, y_min]) + half, np.array([x_max, y_max]) - half)
        return middle[0] - half[0], middle[0] + half[0], middle[1] - half[1], middle[1] + half[1]

    def draw(self, ax: Axes) -> None:
        """Draw buildings, streets, and the links' fixed ends if up to `MAX_MARKS`; axes [m]."""
        x_min, x_max, y_min, y_max = self.bounds
        if self._scene is not None:
            draw_streets(ax, self._scene)
            draw_vegetation(ax, self._scene)
        if self._height_m is not None:
            building = self._height_m > BUILDING_M
            ax.imshow(np.where(building, 0.82, np.nan), origin="lower", extent=self.bounds,
                      cmap="gray", vmin=0, vmax=1, interpolation="nearest")
            ax.contour(building, levels=[0.5], origin="lower", extent=self.bounds, colors="0.35",
                       linewidths=0.5, zorder=3)
        ax.set(xlim=(x_min, x_max), ylim=(y_min, y_max), aspect="equal", xlabel="x, east [m]",
               ylabel="y, north [m]")
        for marker, colour, label, names, position_m in self._fixed_ends():
            if 0 < len(position_m) <= MAX_MARKS:
                ax.scatter(position_m[:, 0], position_m[:, 1], marker=marker, s=38, color=colour,
                           edgecolors="black", linewidths=0.8, zorder=4, label=label)
            for name, (x_m, y_m, _) in zip(names, position_m) if len(names) <= MAX_NAMES else ():
                if x_min < x_m < x_max and y_min < y_m < y_max:
                    ax.annotate(plain(name, 14), (x_m, y_m), (0, 6), textcoords="offset points",
                                ha="center", fontsize=8, zorder=5, path_effects=HALO)

    def panels(self, count: int) -> list[Axes]:
        """Make a figure of equally wide panels with the map, and return their axes."""
        figure = new_figure(PANEL_IN * count, self.panel_height(PANEL_IN - 0.7) + 1.7)
        parts = figure.subfigures(1, count, squeeze=False)[0]
        axes = [part.add_subplot() for part in parts]
        for ax in axes:
            self.draw(ax)
        return axes

    def cell_means(self, value_db: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Average the known values of links (n,) [dB] over the map cell of their moving end.

        Returns:
            edges (nx + 1,) and (ny + 1,) of the cells in x and in y [m], and (ny, nx) means [dB];
            NaN where a cell has fewer than `MIN_LINKS` links
        """
        known = np.isfinite(value_db)
        x_min, x_max, y_min, y_max = self.bounds
        edges = [np.arange(low, high + self.cell_m, self.cell_m)
                 for low, high in ((x_min, x_max), (y_min, y_max))]
        x_m, y_m = self.moving_m[known, :2].T
        total = np.histogram2d(x_m, y_m, edges, weights=value_db[known])[0]  # type: ignore[call-overload]
        count = np.histogram2d(x_m, y_m, edges)[0]  # type: ignore[call-overload]
        mean_db = np.where(count >= MIN_LINKS, total / np.maximum(count, 1), np.nan)
        return edges[0], edges[1], mean_db.T

    def _fixed_ends(self) -> list[tuple[str, str, str, list[str], np.ndarray]]:
        """Return marker, colour, label, names and positions [m] of the links' fixed ends, by kind.

        Kinds: receivers if devices move; else devices of declared, and of located position.
        """
        links = self.links
        if not self.receivers_move:
            return [("s", "black", "receiver", [], np.unique(links.receiver_m.round(), axis=0))]
        members = np.unique(links.variables["device"])
        anchor = np.isin(members, sorted(links.anchors))
        return [(marker, colour, label, [links.device_names[each] for each in chosen],
                 links.device_m[chosen])
                for marker, colour, label, chosen in (
                    ("^", "black", "device, declared", members[anchor]),
                    ("o", "white", "device, located", members[~anchor]))]


def mark(ax: Axes, effect: EffectData) -> None:
    """Draw the place of an effect with its name; nothing for an effect without a place."""
    found = effect.mark
    if found is None:
        return
    if found.outline_m is not None:
        ax.plot(found.outline_m[:, 0], found.outline_m[:, 1], color=FOUND, linewidth=2, zorder=5)
    elif found.faces_m is not None:
        ax.add_collection(PolyCollection([*found.faces_m], facecolors=FOUND, edgecolors="none",
                                         alpha=0.6, zorder=5), autolim=False)
    elif found.from_m is not None:
        ax.annotate("", tuple(found.at_m), tuple(found.from_m), zorder=6, arrowprops={
            "arrowstyle": "->", "color": FOUND, "linewidth": 2, "shrinkA": 0, "shrinkB": 4})
        ax.plot(*found.at_m, "*", color=FOUND, markersize=13, markeredgecolor="white", zorder=7)
    else:
        ax.plot(*found.at_m, "X", color=FOUND, markersize=11, markeredgecolor="white", zorder=6)
    _draw_label(ax, "\n".join(plain(line) for line in found.text.split("\n")), found.at_m)


def _draw_label(ax: Axes, text: str, position_m: np.ndarray) -> None:
    """Write a text beside a marker, towards the middle of the map, where it hides fewer markers."""
    side = 1 if position_m[0] < np.mean(ax.get_xlim()) else -1
    point_m = np.ptp(ax.get_xlim()) / (72 * (PANEL_IN - 0.7))
    lines = text.split("\n")
    width_m, height_m = 6 * point_m * max(map(len, lines)), 12 * point_m * len(lines)
    ends_m = np.concatenate([np.zeros((0, 2)), *(
        each.get_offsets() for each in ax.collections
        if isinstance(each, PathCollection) and not str(each.get_label()).startswith("_"))])
    across_m, up_m = (ends_m - position_m[:2]).T
    level = (side * across_m > 0) & (side * across_m < width_m + 20 * point_m)
    above, below = ((level & (sign * up_m > 0) & (sign * up_m < height_m + 20 * point_m)).sum()
                    for sign in (1, -1))
    ax.annotate(text, tuple(position_m), xytext=(14 * side, 12 if above <= below else -12),
                textcoords="offset points", color=FOUND, fontsize=9, fontweight="bold",
                ha="left" if side > 0 else "right", va="bottom" if above <= below else "top",
                zorder=7, path_effects=HALO)


def residual_map_figure(data: LoopData, background: MapBackground, report: dict) -> Figure:
    """Draw maps of the mean held-out residual in cells, before and after the effects.

    Places, devices and causes are marked that `report` (`closeloop.json`) names. Both RMSEs are of
    the links that the base predicts.
    """
    panels = [(f"before: {name_label(data.base)}", data.before_db)]
    if data.changed:
        names = [name_label(name) for name in data.added]
        added = join_names(names) if len(names) < 3 else f"{len(names)} effects"
        panels.append((f"after: with {added}", data.after_db))
    residuals_db = [data.links.level_db - predicted_db for _, predicted_db in panels]
    has_before = np.isfinite(residuals_db[0])
    cells = [background.cell_means(residual_db) for residual_db in residuals_db]
    axes = background.panels(len(panels))
    range_db = residual_range_db(cells[0][2])
    for ax, (title, _), residual_db, grid in zip(axes, panels, residuals_db, cells):
        _frame_places(ax, report.get("anomalies", []))
        _ring_devices(ax, data.links, report)
        for effect in data.effects:
            mark(ax, effect)
        ax.set_title(f"{title}\nRMSE {rmse_db(residual_db[has_before]):.2f} dB", fontsize=11)
        _draw_cells(ax, grid, RESIDUAL_COLOURS, -range_db, range_db, f"{RESIDUAL_LABEL}, mean over "
                    f"cells of {background.cell_m:g} m")
    return axes[0].figure.figure  # type: ignore[return-value]


def _frame_places(ax: Axes, anomalies: Sequence[dict]) -> None:
    """Draw a dashed frame around each place whose links deviate (anomalies of family `place`)."""
    label: str | None = "links at or through it stand out"
    for each in anomalies:
        if each["family"] == "place":
            (west_m, east_m), (south_m, north_m) = each["ranges"]["x_m"], each["ranges"]["y_m"]
            ax.plot([west_m, east_m, east_m, west_m, west_m],
                    [south_m, south_m, north_m, north_m, south_m], color="black", linestyle="--",
                    linewidth=1.5, zorder=6, label=label)
            label = None


def _ring_devices(ax: Axes, links: DrawnLinks, report: dict) -> None:
    """Draw a ring around each device that an anomaly or a found cause is about."""
    named = {name for each in report.get("anomalies", [])
             for name in each["members"].get("device", ())}
    named |= {place["device"] for effect in found_causes(report)
              for place in effect.get("places", [])
              if place.get("device") and is_changed(effect, place["device"])}
    ringed_m = links.device_m[[name in named for name in links.device_names]]
    if len(ringed_m):
        ax.scatter(ringed_m[:, 0], ringed_m[:, 1], marker="o", s=160, facecolors="none",
                   edgecolors=FOUND, linewidths=2, zorder=6, label="device that it is about")


def level_map_figure(data: LoopData, background: MapBackground) -> Figure | None:
    """Draw maps of measured level, held-out prediction and their difference, averaged in cells.

    None if no detected link has a held-out prediction.
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
    axes = background.panels(3)
    for ax, grid, (colours, low, high, title, label) in zip(axes, cells, looks):
        ax.set_title(title, fontsize=11)
        _draw_cells(ax, grid, colours, low, high,
                    f"{label}, mean over cells of {background.cell_m:g} m")
    return axes[0].figure.figure  # type: ignore[return-value]


def contribution_map_figure(contribution_db: np.ndarray, background: MapBackground) -> Figure:
    """Draw a map of an effect's change of the levels (n,) [dB], averaged in cells."""
    (ax,) = background.panels(1)
    grid = background.cell_means(contribution_db)
    range_db = residual_range_db(grid[2])
    _draw_cells(ax, grid, RESIDUAL_COLOURS, -range_db, range_db,
                f"contribution [dB], mean over cells of {background.cell_m:g} m")
    return ax.figure.figure  # type: ignore[return-value]


def affected_links_figure(effect: EffectData, background: MapBackground) -> Figure:
    """Draw the links that an effect changes as lines in the colour of their residual.

    Left without the effect, right with it. Changes up to `MIN_CONTRIBUTION_DB` do not count. Of
    many links `MAX_RAYS` are drawn, at random with a fixed seed, so that a figure can be repeated.
    """
    links = effect.links
    changed = np.abs(effect.contribution_db) > MIN_CONTRIBUTION_DB
    rows = np.flatnonzero(changed & np.isfinite(links.level_db))
    drawn = np.random.default_rng(0).permutation(rows)[:MAX_RAYS]
    range_db = residual_range_db(effect.residual_db[rows])
    ends_m = links.ends_m[..., :2]
    frame = background.frame(ends_m[drawn].reshape(-1, 2))
    axes = background.panels(2)
    for ax, (title, predicted_db) in zip(axes, (("without the effect", effect.without_db),
                                                ("with the effect", effect.with_db))):
        residual_db = links.level_db - predicted_db
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
        _draw_legends(ax, dots, RESIDUAL_LABEL)
    return axes[0].figure.figure  # type: ignore[return-value]


def _draw_cells(ax: Axes, grid: tuple[np.ndarray, np.ndarray, np.ndarray], colours: str,
                low: float, high: float, label: str) -> None:
    """Draw cells in colour (`grid`: edges in x and in y [m], values (ny, nx)), with the legends."""
    image = ax.pcolormesh(*grid, cmap=colours, vmin=low, vmax=high, zorder=2, alpha=0.9,
                          linewidth=0, rasterized=True)
    _draw_legends(ax, image, label)


def _draw_legends(ax: Axes, coloured: ScalarMappable, label: str) -> None:
    """Draw colour bar and legend of marks below a panel."""
    part = ax.figure
    part.colorbar(coloured, ax=ax, location="bottom", shrink=0.85, extend="both", label=label)
    part.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2,
                frameon=False, fontsize=9)
