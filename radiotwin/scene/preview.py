"""A picture of a scene from above."""

from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from radiotwin.io.files import atomic_path
from radiotwin.scene import Scene
from radiotwin.scene.plot import GROUND_COLOUR, Bounds, draw_devices, draw_vegetation, height_grid


def draw_preview(scene: Scene, path: Path | str) -> None:
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
    on_terrain = scene.city.terrain is not None
    if on_terrain:
        draw_contours(axes, scene)
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


def draw_contours(axes: Axes, scene: Scene) -> None:
    """Draw lines of equal height of a terrain above the datum, with their heights [m].

    Args:
        axes: Axes in metres.
        scene: Scene with a terrain.
    """
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    x_m, y_m = np.meshgrid(np.linspace(x_min, x_max, 200), np.linspace(y_min, y_max, 200))
    lines = axes.contour(x_m, y_m, scene.city.ground_height_m(x_m, y_m), levels=10,
                         colors="#8a6d4b", linewidths=0.7, alpha=0.7, zorder=1.2)
    axes.clabel(lines, fmt="%g m", fontsize=8)


def draw_heights(axes: Axes, height_m: np.ndarray, bounds: Bounds) -> AxesImage:
    """Draw heights with shaded relief.

    Args:
        axes: Axes in metres.
        height_m: (ny, nx) heights, south first [m].
        bounds: (x_min, x_max, y_min, y_max) [m].

    Returns:
        The image, for a colour bar.
    """
    colours = colormaps["YlGnBu"].with_extremes(bad=GROUND_COLOUR)
    built = height_m[height_m > 0.5]
    top_m = max(float(np.percentile(built, 99.5)), 1.0) if len(built) else 1.0
    image = axes.imshow(np.ma.masked_less(height_m, 0.5), origin="lower", extent=bounds,
                        cmap=colours, vmin=0, vmax=top_m, interpolation="nearest")
    cell_m = (bounds[1] - bounds[0]) / height_m.shape[1]
    shade = LightSource(azdeg=315, altdeg=50).hillshade(np.flipud(height_m), vert_exag=0.25,
                                                        dx=cell_m, dy=cell_m)
    axes.imshow(np.flipud(shade), origin="lower", extent=bounds, cmap="gray", vmin=0, vmax=1,
                alpha=0.18)
    axes.set_facecolor(GROUND_COLOUR)
    axes.set(xlabel="x, east [m]", ylabel="y, north [m]", aspect="equal")
    return image
