"""Figures of a run: trajectories over the city, learning curves, and animations."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogFormatter
from PIL import Image

from marl.flights import Flights
from marl.mission import Known, Mission
from radiotwin.io.files import atomic_path
from radiotwin.scene import Scene
from radiotwin.scene.plot import height_grid

IDLE_COLOUR = "#555555"
COLOURS = ["#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9",  # Okabe and Ito
           "#6a3d9a", "#f0e442"]
MARKERS = "os^DvPX*"
MAX_IMAGES = 60  # of an animation
LEVEL_STYLES = ("--", ":", "-.", (0, (5, 1)))


def choose_flight(flights: Flights, mission: Mission) -> int:
    """Return the index of the flight whose collected share is nearest to the median."""
    ratio = flights.ratio(mission)
    return int(np.abs(ratio - np.median(ratio)).argmin())


def trajectories_figure(scene: Scene, mission: Mission, flights: Flights, flight: int,
                        known: Known | None) -> Figure:
    """Draw the trajectories of one flight over the city, with a panel for each UAV.

    `known` are device positions that the UAVs knew; None: the scene's.
    """
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    width_in = 5.6 * min(max((x_max - x_min) / (y_max - y_min), 0.6), 1.6)
    figure = Figure(figsize=(width_in * mission.uavs, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, mission.uavs, squeeze=False, sharey=True)[0]
    colours = _device_colours(mission.devices)
    height_m, bounds = height_grid(scene, 400)
    collected = _collected_by_device(flights, flight, mission)
    for u, axes in enumerate(panels):
        axes.imshow(np.ma.masked_less(height_m, 0.5), origin="lower", extent=bounds, cmap="Greys",
                    vmin=0, vmax=2.2 * max(float(height_m.max()), 1.0), interpolation="nearest")
        _draw_path(axes, scene, mission, flights, flight, u, colours)
        _draw_devices(axes, scene, known, colours, collected[u] / mission.data_units)
        share = collected[u].sum() / mission.data_units.sum()
        uav = scene.config.uavs[u]
        axes.set(xlim=(x_min, x_max), ylim=(y_min, y_max), aspect="equal", xlabel="x, east [m]",
                 title=f"{uav.uav}, {uav.altitude_m:g} m: {share:.0%} of all data")
    panels[0].set_ylabel("y, north [m]")
    figure.legend(handles=_legend(known is not None), loc="outside lower center", ncols=4,
                  frameon=False)
    figure.suptitle(
        f"{scene.config.name}: {flights.ratio(mission)[flight]:.1%} collected. Paths in the colour "
        "of the device that serves the UAV; percentages: what this UAV takes of a device's data")
    return figure


def draw_curve(curves: dict[str, list[dict]], levels: dict[str, float], path: Path | str) -> None:
    """Draw `curve_figure`, and write it as PNG."""
    save(curve_figure(curves, levels), path)


def curve_figure(curves: dict[str, list[dict]], levels: dict[str, float]) -> Figure:
    """Draw the collected share against the number of real episodes, with bands.

    Args:
        curves: rows with `real_episodes`, `truth_ratio`, and `truth_ratio_std` or `low` and `high`,
            by name; rows without a real episode are left out.
        levels: collected share of each baseline, drawn as a horizontal line.
    """
    figure = Figure(figsize=(8.5, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for number, (name, rows) in enumerate(curves.items()):
        rows = [row for row in rows if row["real_episodes"] > 0]
        x, ratio = (np.array([row[key] for row in rows]) for key in
                    ("real_episodes", "truth_ratio"))
        low, high = (np.array([row[edge] if edge in row else
                               row["truth_ratio"] + sign * row["truth_ratio_std"] for row in rows])
                     for edge, sign in (("low", -1), ("high", 1)))
        colour = COLOURS[number % len(COLOURS)]
        axes.plot(x, ratio, marker=MARKERS[number % len(MARKERS)], color=colour, label=name)
        axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)
    for style, (name, level) in zip(LEVEL_STYLES, levels.items(), strict=False):
        axes.axhline(level, color="black", linestyle=style, linewidth=1.1,
                     label=f"{name}: {level:.2f}")
    axes.set(ylim=(0, 1.02), xlabel="real episodes",
             ylabel="share of all data collected in the truth")
    if any(row["real_episodes"] > 0 for rows in curves.values() for row in rows):
        axes.set_xscale("log")  # it fails without data
        axes.xaxis.set_major_formatter(LogFormatter())  # plain numbers instead of powers of ten
        axes.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1, 0.4)))
    axes.grid(alpha=0.3, which="both")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    return figure


class FlightPicture:
    """Picture of a flight over the city from above, redrawn for each slot."""

    def __init__(self, scene: Scene, mission: Mission) -> None:
        x_min, x_max, y_min, y_max = scene.config.extent.bounds
        figure = Figure(figsize=(6.0, 6.0 * (y_max - y_min) / (x_max - x_min)), dpi=80)
        self._canvas, self._scene, self._mission = FigureCanvasAgg(figure), scene, mission
        self._axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        height_m, bounds = height_grid(scene, 300)
        self._axes.imshow(np.ma.masked_less(height_m, 0.5), origin="lower", extent=bounds,
                          cmap="Greys", vmin=0, vmax=2.2 * max(float(height_m.max()), 1.0))
        self._axes.set(xlim=(x_min, x_max), ylim=(y_min, y_max), xticks=[], yticks=[])
        self._colours = _device_colours(mission.devices)
        self._devices = [self._axes.plot(device.x_m, device.y_m, "o", color=colour, alpha=0.8,
                                         markeredgecolor="black")[0]
                         for device, colour in zip(scene.config.devices, self._colours)]
        self._trails = [self._axes.plot([], [], color=COLOURS[u % len(COLOURS)], linewidth=1.5)[0]
                        for u in range(mission.uavs)]
        self._uavs = [self._axes.plot([], [], "^", markersize=11, markeredgecolor="black")[0]
                      for _ in range(mission.uavs)]
        self._text = self._axes.text(0.01, 0.99, "", transform=self._axes.transAxes, va="top")

    def image(self, cells: np.ndarray, assigned: np.ndarray, data_units: np.ndarray) -> np.ndarray:
        """Draw a slot: devices scaled by their data, UAVs in the colour of the assigned device.

        `cells` (T, U, 2) are those of the slots so far; the image is (height, width, 3) uint8.
        """
        lattice, step_m = self._scene.lattice, self._mission.step_m
        for u, (trail, uav) in enumerate(zip(self._trails, self._uavs)):
            x_m = lattice.x_m[0] + cells[:, u, 1] * step_m
            y_m = lattice.y_m[0] + cells[:, u, 0] * step_m
            trail.set_data(x_m, y_m)
            uav.set_data(x_m[-1:], y_m[-1:])
            uav.set_color(IDLE_COLOUR if assigned[u] < 0 else self._colours[assigned[u]])
        share = data_units / self._mission.data_units
        for device, left in zip(self._devices, share):
            device.set_markersize(3 + 15 * np.sqrt(left))
        collected = 1 - data_units.sum() / self._mission.data_units.sum()
        self._text.set_text(f"slot {len(cells) - 1}: {collected:.0%} collected")
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


def save_animation(scene: Scene, mission: Mission, flights: Flights, flight: int,
                   path: Path) -> None:
    """Write one flight of a record as an animated GIF of at most `MAX_IMAGES` images."""
    picture, frames, length = FlightPicture(scene, mission), flights.frames, flights.length[flight]
    slots = range(0, length, -(-length // MAX_IMAGES))
    first, *others = [Image.fromarray(picture.image(
        frames.cell[flight, :slot + 1].astype(int), frames.assigned[flight, slot],
        frames.data_units[flight, slot])).quantize(64) for slot in slots]
    with atomic_path(path) as temporary:
        first.save(temporary, format="GIF", save_all=True, append_images=others, duration=120,
                   loop=0)


def _device_colours(count: int) -> list:
    """Return a colour for each of `count` devices."""
    if count <= 10:
        return [colormaps["tab10"](k) for k in range(count)]
    return [colormaps["gist_rainbow"](k / count) for k in range(count)]


def _collected_by_device(flights: Flights, flight: int, mission: Mission) -> np.ndarray:
    """Return the data units (U, K) that each UAV collected from each device in a flight."""
    collected = np.zeros((mission.uavs, mission.devices))
    served = flights.frames.assigned[flight]
    slot, u = np.nonzero(served >= 0)
    np.add.at(collected, (u, served[slot, u]), flights.collected[flight, slot, u])
    return collected


def _draw_path(axes: Axes, scene: Scene, mission: Mission, flights: Flights, flight: int, u: int,
               colours: list) -> None:
    """Draw one UAV's path, hovers, start and terminal."""
    slots = slice(0, flights.length[flight])
    flying = flights.frames.battery[flight, slots, u] > 0
    cells = flights.frames.cell[flight, slots, u][flying].astype(float)
    served = flights.frames.assigned[flight, slots, u][flying]
    x_m = scene.lattice.x_m[0] + cells[:, 1] * mission.step_m
    y_m = scene.lattice.y_m[0] + cells[:, 0] * mission.step_m
    # Shifted to the right of the direction of flight, so that the way back does not hide the way
    # out.
    points = np.stack([x_m, y_m], axis=1)
    steps = np.diff(points, axis=0)
    aside = 0.12 * np.stack([steps[:, 1], -steps[:, 0]], axis=1)
    paint = [IDLE_COLOUR if k < 0 else colours[k] for k in served]
    lines = np.stack([points[:-1] + aside, points[1:] + aside], axis=1)
    axes.add_collection(LineCollection(list(lines), colors=paint[:len(steps)], linewidths=2.4,
                                       capstyle="round"))
    stays = np.flatnonzero((steps == 0).all(axis=1))
    hovers: dict[tuple, list] = {}
    for slot in stays:
        hovers.setdefault((*points[slot], paint[slot]), []).append(slot)
    for (at_x_m, at_y_m, colour), hovering in hovers.items():
        axes.plot(at_x_m, at_y_m, "o", color=colour, alpha=0.75,
                  markersize=3 + 2.2 * np.sqrt(len(hovering)))
    config = scene.config.uavs[u]
    for x_m, y_m, marker, size in ((config.start_x_m, config.start_y_m, "s", 9),
                                   (config.terminal_x_m, config.terminal_y_m, "D", 13)):
        axes.plot(x_m, y_m, marker, color="black", markersize=size, markerfacecolor="none",
                  markeredgewidth=1.8)


def _draw_devices(axes: Axes, scene: Scene, known: Known | None, colours: list,
                  share: np.ndarray) -> None:
    """Draw the devices with the share (K,) of their data that the UAV collected."""
    for k, device in enumerate(scene.config.devices):
        marker, size = ("^", 11) if device.role == "anchor" else ("*", 15)
        axes.plot(device.x_m, device.y_m, marker, color=colours[k], markersize=size,
                  markeredgecolor="black", markeredgewidth=0.8)
        if device.role != "anchor" and known is not None and device.device in known.position_m:
            axes.plot(*known.position_m[device.device], "x", color="black", markersize=7,
                      markeredgewidth=1.6)
        label = device.device if share[k] < 0.005 else f"{device.device}: {share[k]:.0%}"
        right = device.x_m > np.mean(scene.config.extent.bounds[:2])
        axes.annotate(label, (device.x_m, device.y_m), (-9 if right else 9, 6),
                      textcoords="offset points", fontsize=9, ha="right" if right else "left",
                      weight="bold" if share[k] >= 0.005 else "normal",
                      path_effects=[withStroke(linewidth=2.5, foreground="white")])


def _legend(has_estimates: bool) -> list[Line2D]:
    """Return the legend of the trajectories, with or without marks of estimated positions."""
    def mark(marker: str, label: str, size: float, **style: Any) -> Line2D:
        return Line2D([], [], linestyle="", marker=marker, label=label, markersize=size,
                      color="black", **style)

    unknown = [mark("*", "unknown device, true position", 12),
               mark("x", "its estimate", 7, markeredgewidth=1.6)] if has_estimates else [
        mark("*", "unknown device, where it is thought to be", 12)]
    return [mark("^", "anchor", 9), *unknown,
            mark("s", "start", 9, markerfacecolor="none"),
            mark("D", "terminal", 9, markerfacecolor="none"),
            mark("o", "hover, larger for longer", 8),
            Line2D([], [], color=IDLE_COLOUR, linewidth=2.4, label="no device serves the UAV")]


def save(figure: Figure, path: Path | str, dpi: int = 130) -> None:
    """Write a figure as PNG atomically."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
