"""Mark on a map where an effect is."""

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.patheffects import withStroke

from radiotwin.display.style import plain
from radiotwin.effects.mapped_buildings import buildings
from radiotwin.report.closeloop_data import EffectData
from radiotwin.report.labels import name_label
from radiotwin.report.style import FOUND

HALO = [withStroke(linewidth=2.5, foreground="white")]
Label = tuple[str, np.ndarray]
"""Text beside a marker, and its position (2,) [m]."""


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
