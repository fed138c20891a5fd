"""Plots of a scene from above: heights, vegetation, devices, UAV starts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from radiotwin.display import (
    METRES,
    PlotFrame,
    add_colour_bar,
    add_legend,
    draw_cells,
    draw_points,
    new_axes,
    plain,
)
from radiotwin.io.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.image import AxesImage

    from radiotwin.scene.scene import Scene

Bounds = tuple[float, float, float, float]
GROUND_COLOUR = "#eef0ee"
VEGETATION_COLOUR = "#7fb069"
STREET_COLOUR = "#9aa3ab"
BUILDING_M = 2.0  # lower surfaces are not outlined
MIN_HEIGHT_M = 0.5  # lower surfaces have the colour of the ground
PLOT_CELLS = 400  # along the longer side of a plot
MARKS = (("anchor", "^", 110, "#d1495b", "anchor"),
         ("unknown", "*", 170, "#f08a00", "device to be found"))
"""Role, marker, size, colour and label of devices."""


def height_grid(scene: Scene, cells: int = 1000,
                above_datum: bool = False) -> tuple[np.ndarray, Bounds]:
    """Sample the heights of the 3D map over the scene's extent.

    Args:
        scene: Scene to sample.
        cells: Number of cells along the longer side.
        above_datum: Whether heights are above the datum z = 0; else above the ground.

    Returns:
        (ny, nx) heights, south first [m], and (x_min, x_max, y_min, y_max) [m].
    """
    grid_m = np.meshgrid(*_centres(scene, cells))
    height_m = scene.city.height_at(*grid_m) if above_datum else _above_ground_m(scene, grid_m)
    return height_m, scene.config.extent.bounds


def _above_ground_m(scene: Scene, grid_m: Sequence[np.ndarray]) -> np.ndarray:
    """Return the height of the highest surface above the ground at x and y (ny, nx) [m]."""
    height_m = scene.city.height_at(*grid_m)
    return height_m if scene.city.terrain is None else \
        height_m - scene.city.ground_height_m(*grid_m)


def plot_scene(scene: Scene, ax: Axes | None, geographic: bool | None) -> Axes:
    """Draw heights, vegetation, devices and the UAVs' starts; see `Scene.plot`."""
    from matplotlib import colormaps

    frame, ax = PlotFrame.choose(scene.config.origin, geographic), new_axes(ax)
    x_m, y_m = _centres(scene, PLOT_CELLS)
    height_m = _above_ground_m(scene, np.meshgrid(x_m, y_m))
    top_m = _top_m(height_m)
    ax.set_facecolor(GROUND_COLOUR)
    drawn = draw_cells(ax, frame, x_m, y_m, np.ma.masked_less(height_m, MIN_HEIGHT_M),
                       cmap=colormaps["YlGnBu"], vmin=0, vmax=top_m)
    add_colour_bar(ax, drawn, "height [m]", "max" if height_m.max() > top_m else "neither")
    draw_streets(ax, scene, frame)
    draw_vegetation(ax, scene, frame)
    draw_devices(ax, scene, frame)
    frame.prepare(ax)
    add_legend(ax)
    ax.set_title(f"{plain(scene.config.name)} ({scene.config.radio.frequency_hz / 1e9:g} GHz)")
    return ax


def draw_outlines(ax: Axes, scene: Scene, frame: PlotFrame) -> None:
    """Draw the outlines of everything more than `BUILDING_M` above the ground."""
    grid_m = np.meshgrid(*_centres(scene, PLOT_CELLS))
    built = _above_ground_m(scene, grid_m) > BUILDING_M
    if built.any() and not built.all():
        ax.contour(*frame.at(*grid_m), built.astype(float), levels=[0.5], colors="black",
                   linewidths=0.5, alpha=0.6)


def draw_vegetation(axes: Axes, scene: Scene, frame: PlotFrame = METRES) -> None:
    """Draw the vegetation that a scene declares."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    for number, area in enumerate(scene.config.vegetation):
        rings = [Path(np.column_stack(frame.at(*np.array([*ring, ring[0]]).T)), closed=True)
                 for ring in area.rings_m]
        axes.add_patch(PathPatch(Path.make_compound_path(*rings), facecolor=VEGETATION_COLOUR,
                                 edgecolor="none", alpha=0.45, zorder=1.5,
                                 label="" if number else "vegetation"))


def draw_streets(axes: Axes, scene: Scene, frame: PlotFrame = METRES, zorder: float = 1.4) -> None:
    """Draw the streets as thin grey lines."""
    from matplotlib.collections import LineCollection

    axes.add_collection(
        LineCollection([np.column_stack(frame.at(*line_m.T)) for line_m in scene.streets_m],
                       colors=STREET_COLOUR, linewidths=0.7, zorder=zorder), autolim=False)


def draw_devices(axes: Axes, scene: Scene, frame: PlotFrame = METRES) -> None:
    """Mark anchors, devices to be found and the UAVs' starts, labelled for a legend."""
    outline: dict[str, Any] = {"edgecolors": "white", "linewidths": 0.9, "zorder": 3,
                               "clip_on": False}
    for role, marker, size, colour, label in MARKS:
        points = np.array([(device.x_m, device.y_m) for device in scene.config.devices
                           if device.role == role]).reshape(-1, 2)
        if len(points):
            draw_points(axes, frame, *points.T, marker=marker, s=size, color=colour, label=label,
                        **outline)
    starts = np.array([(uav.start_x_m, uav.start_y_m) for uav in scene.config.uavs]).reshape(-1, 2)
    if len(starts):
        draw_points(axes, frame, *starts.T, marker="x", s=80, color="black", linewidths=2.2,
                    label="UAV start", zorder=3)


def _top_m(height_m: np.ndarray) -> float:
    """Return the upper end of the colour scale [m]: the 99.5th percentile of building heights."""
    built = height_m[height_m > MIN_HEIGHT_M]
    return max(float(np.percentile(built, 99.5)), 1.0) if len(built) else 1.0


def _centres(scene: Scene, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Return x (nx,) and y (ny,) of the centres of a scene's cells [m]."""
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    cell_m = max(x_max - x_min, y_max - y_min) / cells
    # At least two each way, which contours and shades need
    nx, ny = (max(round(side_m / cell_m), 2) for side_m in (x_max - x_min, y_max - y_min))
    return (x_min + (np.arange(nx) + 0.5) * (x_max - x_min) / nx,
            y_min + (np.arange(ny) + 0.5) * (y_max - y_min) / ny)


def draw_preview(scene: Scene, path: Path | str) -> None:
    """Write a PNG picture of heights, devices and the UAVs' starts."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    height_m, bounds = height_grid(scene)
    width = (bounds[1] - bounds[0]) / (bounds[3] - bounds[2])
    figure = Figure(figsize=(min(max(7.5 * width, 5.0), 13.0) + 1.6, 8.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    image = draw_heights(axes, height_m, bounds)
    draw_streets(axes, scene)
    draw_vegetation(axes, scene)
    on_terrain = scene.city.terrain is not None
    if on_terrain:
        _draw_contours(axes, scene)
    clipped = height_m.max() > image.norm.vmax
    figure.colorbar(image, ax=axes, shrink=0.85, pad=0.02,
                    label="height above the ground [m]" if on_terrain else "height [m]",
                    extend="max" if clipped else "neither")
    draw_devices(axes, scene)
    if scene.config.devices or scene.config.uavs or scene.config.vegetation:
        figure.legend(loc="outside lower center", ncols=3, frameon=False)
    axes.set_title(f"{scene.config.name}   ({scene.config.radio.frequency_hz / 1e9:g} GHz)")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110, bbox_inches="tight", pad_inches=0.15)


def _draw_contours(axes: Axes, scene: Scene) -> None:
    """Draw labelled contour lines of a terrain's height above the datum [m]."""
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    x_m, y_m = np.meshgrid(np.linspace(x_min, x_max, 200), np.linspace(y_min, y_max, 200))
    lines = axes.contour(x_m, y_m, scene.city.ground_height_m(x_m, y_m), levels=10,
                         colors="#8a6d4b", linewidths=0.7, alpha=0.7, zorder=1.2)
    axes.clabel(lines, fmt="%g m", fontsize=8)


def draw_heights(axes: Axes, height_m: np.ndarray, bounds: Bounds) -> AxesImage:
    """Draw heights (ny, nx) [m], south first, over `bounds` [m] with shaded relief."""
    from matplotlib import colormaps
    from matplotlib.colors import LightSource

    colours = colormaps["YlGnBu"].with_extremes(bad=GROUND_COLOUR)
    top_m = _top_m(height_m)
    image = axes.imshow(np.ma.masked_less(height_m, MIN_HEIGHT_M), origin="lower", extent=bounds,
                        cmap=colours, vmin=0, vmax=top_m, interpolation="nearest")
    cell_m = (bounds[1] - bounds[0]) / height_m.shape[1]
    shade = LightSource(azdeg=315, altdeg=50).hillshade(np.flipud(height_m), vert_exag=0.25,
                                                        dx=cell_m, dy=cell_m)
    axes.imshow(np.flipud(shade), origin="lower", extent=bounds, cmap="gray", vmin=0, vmax=1,
                alpha=0.18)
    axes.set_facecolor(GROUND_COLOUR)
    axes.set(xlabel="x, east [m]", ylabel="y, north [m]", aspect="equal")
    return image
