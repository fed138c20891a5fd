"""Pictures of coverage: classes with a legend, buildings, transmitters, a scale bar and sources."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from radiotwin.coverage import Coverage
from radiotwin.coverage.output import Legend, drawn_rasters, file_stem, legend_of
from radiotwin.display import plain
from radiotwin.report.labels import attribution, new_figure, save
from radiotwin.report.map_figures import HeightGrid
from radiotwin.scene import Scene
from radiotwin.scene.plot import draw_streets, height_grid

BUILDING_M = 2.0  # lowest height that is drawn
OUTLINE_CELLS = 800  # along the longer side
LONGER_SIDE_IN = 7.5
LEGEND_IN = 3.6
MAX_RATIO = 3.0  # of the sides of a picture
MAX_LABELS = 30  # transmitters with a name beside them
MAX_LEGEND_ROWS = 24
BUILDING_COLOUR, OUTLINE_COLOUR = "#8f8f8f", "#4a4a4a"
ROUND_LENGTHS = (1, 2, 5, 10)


def write_coverage_pictures(coverage: Coverage, scene: Scene, folder: Path) -> None:
    """Write a PNG of each raster over the scene's buildings: `received_power.png`, …."""
    heights = height_grid(scene, OUTLINE_CELLS)
    for name in drawn_rasters(coverage):
        save(_coverage_figure(coverage, scene, name, heights), folder / f"{file_stem(name)}.png")


def _coverage_figure(coverage: Coverage, scene: Scene, name: str, heights: HeightGrid) -> Figure:
    """Draw a raster of a coverage map in classes, with buildings, transmitters and polygons."""
    legend, bounds_m = legend_of(name, coverage), coverage.grid.bounds_m
    x_min, x_max, y_min, y_max = bounds_m
    width, height = x_max - x_min, y_max - y_min
    scale = LONGER_SIDE_IN / max(width, height)
    figure = new_figure(max(width, height / MAX_RATIO) * scale + LEGEND_IN,
                        max(height, width / MAX_RATIO) * scale + 1.1)
    ax = figure.add_subplot()
    classes = legend.classes(coverage.dataset[name].values)
    ax.imshow(np.ma.masked_less(classes, 0), origin="lower", extent=bounds_m,
              cmap=ListedColormap(legend.colours), vmin=-0.5, vmax=len(legend.colours) - 0.5,
              interpolation="nearest")
    draw_streets(ax, scene)
    height_m, grid_m = heights
    building = height_m > BUILDING_M
    has_indoor_levels = coverage.settings.indoor_loss_db is not None
    if not has_indoor_levels:
        # Cells whose middle is inside, and the outlines in full detail.
        ax.imshow(np.where(coverage.dataset["indoor"].values, 1.0, np.nan), origin="lower",
                  extent=bounds_m, cmap=ListedColormap([BUILDING_COLOUR]),
                  interpolation="nearest")
        ax.imshow(np.where(building, 1.0, np.nan), origin="lower", extent=grid_m,
                  cmap=ListedColormap([BUILDING_COLOUR]), interpolation="nearest")
    if building.any():
        ax.contour(building, levels=[0.5], origin="lower", extent=grid_m, colors=OUTLINE_COLOUR,
                   linewidths=0.4)
    _draw_transmitters(ax, coverage)
    for area in coverage.areas:
        for part in getattr(area.outline, "geoms", [area.outline]):
            if part.geom_type == "Polygon":
                ax.plot(*np.asarray(part.exterior.coords).T, color="black", linewidth=1.4,
                        linestyle="--")
    ax.set(xlim=(x_min, x_max), ylim=(y_min, y_max), aspect="equal", xlabel="x, east [m]",
           ylabel="y, north [m]")
    ax.set_title(legend.title, loc="left", fontweight="bold")
    _draw_scale_bar(ax, bounds_m)
    handles = _handles(legend, classes, coverage, bool(building.any()) and not has_indoor_levels)
    figure.legend(handles=handles, loc="outside right upper", frameon=False,
                  alignment="left", title="share of the area", title_fontsize="small")
    figure.supxlabel(_caption(coverage, scene), fontsize=7, color="#444444")
    return figure


def _handles(legend: Legend, classes: np.ndarray, coverage: Coverage,
             with_buildings: bool) -> list[Patch]:
    """Return legend patches: each class with its share of the cells, "not detected", buildings.

    Of more than `MAX_LEGEND_ROWS` classes only the most frequent are named.
    """
    counts = np.bincount(classes[classes >= 0].astype(int), minlength=len(legend.labels))
    cells = classes.size - coverage.summary["cells_left_out_indoors"]
    shares = counts / max(cells, 1)
    rows = list(range(len(legend.labels)))
    if len(rows) > MAX_LEGEND_ROWS:
        rows = sorted(np.argsort(-shares, kind="stable")[:MAX_LEGEND_ROWS].tolist())
    handles = [Patch(facecolor=legend.colours[row], edgecolor="#666666", linewidth=0.4,
                     label=f"{plain(legend.labels[row], 30)}   {shares[row]:.1%}") for row in rows]
    if len(rows) < len(legend.labels):
        handles.append(Patch(alpha=0, label=f"… {len(legend.labels) - len(rows)} more"))
    if counts.sum() < cells:
        handles.append(Patch(facecolor="white", edgecolor="#666666", linewidth=0.4,
                             label=f"not detected   {1 - counts.sum() / cells:.1%}"))
    if with_buildings:
        handles.append(Patch(facecolor=BUILDING_COLOUR, edgecolor=OUTLINE_COLOUR, linewidth=0.4,
                             label="building, left out"))
    return handles


def _draw_transmitters(ax: Axes, coverage: Coverage) -> None:
    """Mark transmitters with their names, and the boresight of directional antennas."""
    x_min, x_max, y_min, y_max = coverage.grid.bounds_m
    length_m = 0.03 * max(x_max - x_min, y_max - y_min)
    for each in coverage.transmitters:
        x_m, y_m = map(float, each.position_m[:2])
        if np.isnan(x_m):
            continue
        if each.antenna is not None and np.ptp(each.antenna.pattern.gain_dbi, axis=1).max() > 0.5:
            azimuth = np.radians(each.antenna.azimuth_deg)
            ax.plot([x_m, x_m + length_m * np.sin(azimuth)],
                    [y_m, y_m + length_m * np.cos(azimuth)], color="black", linewidth=1.6,
                    zorder=4)
        ax.plot(x_m, y_m, "^", color="white", markeredgecolor="black", markersize=9, zorder=5)
        if len(coverage.transmitters) <= MAX_LABELS:
            ax.annotate(plain(each.name, 20), (x_m, y_m), (5, 5), textcoords="offset points",
                        fontsize=8, zorder=6, annotation_clip=True,
                        bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "alpha": 0.75,
                              "edgecolor": "none"})


def _draw_scale_bar(ax: Axes, bounds_m: tuple[float, float, float, float]) -> None:
    """Draw a bar of a round length, about a fifth of the width, in the lower left corner."""
    x_min, x_max, y_min, y_max = bounds_m
    wanted_m = (x_max - x_min) / 5
    decade_m = 10.0 ** np.floor(np.log10(wanted_m))
    # log10 of a length just below a power of ten may be rounded up to that of the power.
    length_m = max((each * decade_m for each in ROUND_LENGTHS if each * decade_m <= wanted_m),
                   default=wanted_m)
    margin_m, thick_m = 0.02 * (x_max - x_min), 0.006 * (y_max - y_min)
    text = f"{length_m / 1000:g} km" if length_m >= 1000 else f"{length_m:g} m"
    ax.add_patch(Rectangle((x_min + margin_m, y_min + margin_m), length_m, thick_m,
                           facecolor="black", edgecolor="white", linewidth=0.8, zorder=7))
    ax.annotate(text, (x_min + margin_m + length_m / 2, y_min + margin_m + 1.5 * thick_m), (0, 2),
                textcoords="offset points", ha="center", va="bottom", fontsize=8, zorder=7,
                bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "alpha": 0.75,
                      "edgecolor": "none"})


def _caption(coverage: Coverage, scene: Scene) -> str:
    """Return the caption in two lines: model, receivers, noise, credit of the map."""
    facts = coverage.dataset.attrs
    above = "above ground" if coverage.grid.above_ground else "above the datum"
    lines = [f"{plain(facts['model'], 90)}; receivers {facts['height_m']:g} m {above}, cells of "
             f"{facts['step_m']:g} m",
             f"bandwidth {facts['bandwidth_hz'] / 1e6:g} MHz, noise {facts['noise_dbm']:.1f} dBm "
             f"(noise figure {facts['noise_figure_db']:.1f} dB)"]
    credit = attribution(scene)
    return "\n".join([lines[0], lines[1] + (f"; map {credit}" if credit else "")])
