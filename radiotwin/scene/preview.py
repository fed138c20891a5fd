"""A picture of a scene from above."""

import pathlib
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from radiotwin.files import atomic_path
from radiotwin.scene import Scene

Bounds = tuple[float, float, float, float]
_GROUND_COLOUR = "#eef0ee"
VEGETATION_COLOUR = "#7fb069"


def height_grid(scene: Scene, cells: int = 1000) -> tuple[np.ndarray, Bounds]:
    """Sample the heights over the scene's extent.

    Args:
        scene: Scene with its 3D map.
        cells: Number of cells along the longer side.

    Returns:
        (ny, nx) heights, south first [m], and (x_min, x_max, y_min, y_max) [m].
    """
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    cell_m = max(x_max - x_min, y_max - y_min) / cells
    x_m = np.arange(x_min + cell_m / 2, x_max, cell_m)
    y_m = np.arange(y_min + cell_m / 2, y_max, cell_m)
    return scene.city.height_at(*np.meshgrid(x_m, y_m)), scene.config.extent.bounds


def draw_preview(scene: Scene, path: pathlib.Path | str) -> None:
    """Write a picture of heights, devices and the UAVs' starts.

    Args:
        scene: Scene to draw.
        path: PNG file to write.
    """
    height_m, bounds = height_grid(scene)
    width = (bounds[1] - bounds[0]) / (bounds[3] - bounds[2])
    figure = Figure(figsize=(min(max(7.5 * width, 5.0), 13.0) + 1.6, 8.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    image = draw_heights(axes, height_m, bounds)
    draw_vegetation(axes, scene)
    clipped = height_m.max() > image.norm.vmax
    figure.colorbar(image, ax=axes, label="height [m]", shrink=0.85, pad=0.02,
                    extend="max" if clipped else "neither")
    draw_devices(axes, scene)
    if scene.config.devices or scene.config.uavs or scene.config.vegetation:
        figure.legend(loc="outside lower center", ncols=3, frameon=False)
    axes.set_title(f"{scene.config.name}   ({scene.config.radio.frequency_hz / 1e9:g} GHz)")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110, bbox_inches="tight", pad_inches=0.15)


def draw_heights(axes: Axes, height_m: np.ndarray, bounds: Bounds) -> AxesImage:
    """Draw heights with shaded relief.

    Args:
        axes: Axes in metres.
        height_m: (ny, nx) heights, south first [m].
        bounds: (x_min, x_max, y_min, y_max) [m].

    Returns:
        The image, for a colour bar.
    """
    colours = colormaps["YlGnBu"].with_extremes(bad=_GROUND_COLOUR)
    built = height_m[height_m > 0.5]
    top_m = max(float(np.percentile(built, 99.5)), 1.0) if len(built) else 1.0
    image = axes.imshow(np.ma.masked_less(height_m, 0.5), origin="lower", extent=bounds,
                        cmap=colours, vmin=0, vmax=top_m, interpolation="nearest")
    cell_m = (bounds[1] - bounds[0]) / height_m.shape[1]
    shade = LightSource(azdeg=315, altdeg=50).hillshade(np.flipud(height_m), vert_exag=0.25,
                                                        dx=cell_m, dy=cell_m)
    axes.imshow(np.flipud(shade), origin="lower", extent=bounds, cmap="gray", vmin=0, vmax=1,
                alpha=0.18)
    axes.set_facecolor(_GROUND_COLOUR)
    axes.set(xlabel="x, east [m]", ylabel="y, north [m]", aspect="equal")
    return image


def draw_vegetation(axes: Axes, scene: Scene) -> None:
    """Draw declared vegetation.

    Args:
        axes: Axes in metres.
        scene: Scene that declares it.
    """
    for number, each in enumerate(scene.config.vegetation):
        rings = [Path([*ring, ring[0]], closed=True) for ring in each.rings_m]
        axes.add_patch(PathPatch(Path.make_compound_path(*rings), facecolor=VEGETATION_COLOUR,
                                 edgecolor="none", alpha=0.45, zorder=1.5,
                                 label="" if number else "vegetation"))


def draw_devices(axes: Axes, scene: Scene) -> None:
    """Mark anchors, devices to be found and the UAVs' starts, labelled for a legend.

    Args:
        axes: Axes in metres.
        scene: Scene that declares them.
    """
    outline: dict[str, Any] = {"edgecolors": "white", "linewidths": 0.9, "zorder": 3,
                               "clip_on": False}
    for role, marker, size, colour, label in (
            ("anchor", "^", 110, "#d1495b", "anchor"),
            ("unknown", "*", 170, "#f08a00", "device to be found")):
        points = np.array([(device.x_m, device.y_m) for device in scene.config.devices
                           if device.role == role]).reshape(-1, 2)
        if len(points):
            axes.scatter(points[:, 0], points[:, 1], marker=marker, s=size, color=colour,
                         label=label, **outline)
    starts = np.array([(uav.start_x_m, uav.start_y_m) for uav in scene.config.uavs]).reshape(-1, 2)
    if len(starts):
        axes.scatter(starts[:, 0], starts[:, 1], marker="x", s=80, color="black", linewidths=2.2,
                     label="UAV start", zorder=3)
