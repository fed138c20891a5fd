"""Draw where a twin has its devices."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from radiotwin.display import PlotFrame, new_axes
from radiotwin.display.axes import add_legend, draw_points
from radiotwin.display.style import plain
from radiotwin.localize import TwinDevice
from radiotwin.scene import Scene
from radiotwin.scene.plot import MARKS
from radiotwin.tables import Origin

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAX_NAMES = 40  # more names would hide the map
_TURN = np.linspace(0.0, 2 * np.pi, 73)


def plot_positions(devices: list[TwinDevice], ax: Axes | None, origin: Origin | None,
                   scene: Scene | None, geographic: bool | None) -> Axes:
    """Draw devices with the circles of their 90 % radii; see `Twin.plot`."""
    frame, ax = PlotFrame.choose(origin, geographic), new_axes(ax)
    if scene is not None:
        scene.draw_outlines(ax, frame)
    placed = [each for each in devices if np.isfinite([each.x_m, each.y_m]).all()]
    for role, marker, size, colour, label in MARKS:
        for sure in (True, False):
            some = [each for each in placed if each.role == role and each.located == sure]
            if not some:
                continue
            name = label if role == "anchor" else "located" if sure else "best guess, not located"
            x_m, y_m = np.array([(each.x_m, each.y_m) for each in some]).T
            draw_points(ax, frame, x_m, y_m, marker=marker, s=size, label=name, zorder=4,
                        facecolors=colour if sure else "white", edgecolors="black" if sure
                        else colour, linewidths=0.7 if sure else 1.5)
    wide = [each for each in placed if each.located and 0 < each.credible_radius_m < np.inf]
    for number, each in enumerate(wide):
        ring = frame.at(each.x_m + each.credible_radius_m * np.cos(_TURN),
                        each.y_m + each.credible_radius_m * np.sin(_TURN))
        ax.plot(*ring, color="#f08a00", linewidth=1.2, zorder=3,
                label="" if number else "90 % radius")
    for each in placed[:MAX_NAMES]:
        x, y = frame.at(each.x_m, each.y_m)
        ax.annotate(plain(each.device, 24), (float(x), float(y)), xytext=(5, 5),
                    textcoords="offset points", fontsize=8, zorder=5)
    frame.prepare(ax)
    add_legend(ax)
    missing = len(devices) - len(placed)
    ax.set_title(f"{len(devices)} devices" + f", {missing} without a position" * bool(missing))
    return ax
