"""The residual on the city map, and what was found there drawn in."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.patheffects import withStroke

from radiotwin.closeloop.drawing import FOUND, RESIDUAL_COLOURS, new_figure, plain, save
from radiotwin.effects.fold_model import AppliedEffect
from radiotwin.links.link_data import LinkData
from radiotwin.closeloop.run import Loop
from radiotwin.closeloop.selection import rmse_db
from radiotwin.closeloop.words import listed, plainly
from radiotwin.effects.removed_obstacle import buildings
from radiotwin.scene import Scene
from radiotwin.scene.preview import height_grid

CELLS = 45  # along the longer side of the map
MIN_CELL_M = 10.0
MIN_LINKS = 3  # of a cell
MAX_MARKS = 80
MIN_RANGE_DB, MAX_RANGE_DB = 2.0, 30.0
MAX_RAYS = 1500
EDGE_M = 30.0
ACTS_DB = 0.5  # links on which an effect does less are not drawn
HALO = [withStroke(linewidth=2.5, foreground="white")]


class Ground:
    """What lies under every panel: buildings, the ends that do not move, and a frame.

    Args:
        links: links, with the devices where the model has them.
        scene: whose buildings are drawn; None: there is no map.
    """

    def __init__(self, links: LinkData, scene: Scene | None):
        self.links, self.scene = links, scene
        self.receivers_move = len(np.unique(links.receiver_m[:, :2].round(), axis=0)) >= len(links.device_names)
        device_m = links.device_m[links.device]
        self.moving_m: np.ndarray
        self.moving_m, still_m = ((links.receiver_m, device_m) if self.receivers_move
                                  else (device_m, links.receiver_m))
        if scene is not None:
            self._height_m, self.bounds = height_grid(scene, 500)
        else:
            places_m = np.vstack([self.moving_m, still_m])[:, :2]
            (x_min, y_min), (x_max, y_max) = np.nanquantile(places_m, [0.002, 0.998], axis=0)
            edge_m = 0.04 * max(x_max - x_min, y_max - y_min, 50.0)
            self.bounds = x_min - edge_m, x_max + edge_m, y_min - edge_m, y_max + edge_m

    @property
    def cell_m(self) -> float:
        """A round side of a cell [m]."""
        x_min, x_max, y_min, y_max = self.bounds
        wanted = max(max(x_max - x_min, y_max - y_min) / CELLS, MIN_CELL_M)
        power = 10.0 ** np.floor(np.log10(wanted))
        return float(next(step * power for step in (1, 1.5, 2, 3, 4, 5, 7, 10) if step * power >= 0.95 * wanted))

    def height_in(self, width_in: float) -> float:
        """Of a panel of that width."""
        x_min, x_max, y_min, y_max = self.bounds
        return width_in * min(max((y_max - y_min) / max(x_max - x_min, 1.0), 0.4), 1.3)

    def frame(self, places_m: np.ndarray) -> tuple[float, float, float, float]:
        """x_min, x_max, y_min, y_max [m] of a part of the map that holds (n, 2) places, of the map's proportions."""
        x_min, x_max, y_min, y_max = self.bounds
        if not len(places_m):
            return self.bounds
        low, high = places_m.min(axis=0) - EDGE_M, places_m.max(axis=0) + EDGE_M
        middle, size = 0.5 * (low + high), np.array([x_max - x_min, y_max - y_min])
        half = 0.5 * size * min(max(*((high - low) / size), 0.3), 1.0)
        middle = np.clip(middle, np.array([x_min, y_min]) + half, np.array([x_max, y_max]) - half)
        return middle[0] - half[0], middle[0] + half[0], middle[1] - half[1], middle[1] + half[1]

    def draw(self, ax, labelled: bool = True) -> None:
        """Buildings, devices that stand still (or receivers, where devices move), and axes in metres."""
        x_min, x_max, y_min, y_max = self.bounds
        if self.scene is not None:
            ax.imshow(np.where(self._height_m > 2, 0.82, np.nan), origin="lower", extent=self.bounds, cmap="gray",
                      vmin=0, vmax=1, interpolation="nearest")
            ax.contour(self._height_m > 2, levels=[0.5], origin="lower", extent=self.bounds, colors="0.35",
                       linewidths=0.5, zorder=3)
        ax.set(xlim=(x_min, x_max), ylim=(y_min, y_max), aspect="equal", xlabel="x, east [m]",
               ylabel="y, north [m]" if labelled else "")
        ax.tick_params(labelleft=labelled)
        links = self.links
        if self.receivers_move:
            members = np.unique(links.device)
            anchor = np.isin(members, list(links.anchors))
            kinds = [("^", "black", "device, declared", links.device_m[members[anchor]]),
                     ("o", "white", "device, located", links.device_m[members[~anchor]])]
        else:
            kinds = [("s", "black", "receiver", np.unique(links.receiver_m.round(), axis=0))]
        for marker, colour, label, place_m in kinds:
            if 0 < len(place_m) <= MAX_MARKS:
                ax.scatter(place_m[:, 0], place_m[:, 1], marker=marker, s=38, color=colour, edgecolors="black",
                           linewidths=0.8, zorder=4, label=label)

    def cells(self, residual_db: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean residual of the links whose moving end is in each cell; NaN where they are few.

        Returns:
            edges in x and in y [m], and (ny, nx) means [dB]
        """
        seen = np.isfinite(residual_db)
        x_min, x_max, y_min, y_max = self.bounds
        edges = [np.arange(low, high + self.cell_m, self.cell_m) for low, high in ((x_min, x_max), (y_min, y_max))]
        places_m = self.moving_m[seen, :2]
        total, count = (np.histogram2d(places_m[:, 0], places_m[:, 1], edges, weights=weights)[0]  # type: ignore[call-overload]
                        for weights in (residual_db[seen], np.ones(seen.sum())))
        return edges[0], edges[1], np.where(count >= MIN_LINKS, total / np.maximum(count, 1), np.nan).T


def draw_residual_map(loop: Loop, ground: Ground, path: Path) -> None:
    """Mean held-out residual at the places of the end that moves, before and after."""
    links = loop.after.whole.links
    everything = np.ones(len(links), dtype=bool)
    panels = [(f"before: {plainly(loop.base)} alone", loop.before)]
    if loop.after is not loop.before:
        names = [plainly(entry.name) for entry in loop.search.log if entry.kept]
        panels.append((f"after: with {listed(names) if len(names) < 3 else f'{len(names)} effects'}", loop.after))
    grids = [ground.cells(links.level_db - model.held_out_mean_db) for _, model in panels]
    figure = new_figure(5.4 * len(panels) + 0.9, ground.height_in(4.9) + 1.3)
    most_db = range_db(grids[0][2])
    for number, ((title, model), grid) in enumerate(zip(panels, grids)):
        ax = figure.add_subplot(1, len(panels), number + 1)
        ground.draw(ax, labelled=number == 0)
        image = ax.pcolormesh(*grid, cmap=RESIDUAL_COLOURS, vmin=-most_db, vmax=most_db, zorder=2, alpha=0.9,
                              linewidth=0, rasterized=True)
        for part in loop.after.whole.parts:
            mark(ax, part, links)
        ax.set_title(f"{title}\nerror of a link {rmse_db(model, everything):.2f} dB", fontsize=11)
    figure.colorbar(image, ax=figure.axes, shrink=0.85, extend="both", label="measured − predicted [dB]")
    what = "the receiver" if ground.receivers_move else "the device"
    _legend(figure, f"mean of all links with {what} in a cell of {ground.cell_m:g} m")
    save(figure, path)


def draw_level_map(loop: Loop, ground: Ground, path: Path) -> None:
    """Mean level at the places of the end that moves: measured, as expected of held-out links, and the difference."""
    links, mean_db = loop.after.whole.links, loop.after.held_out_mean_db
    seen = np.isfinite(links.level_db) & np.isfinite(mean_db)
    if not seen.any():
        return
    levels_db = [np.where(seen, values, np.nan) for values in (links.level_db, mean_db)]
    grids = [ground.cells(values) for values in (*levels_db, levels_db[0] - levels_db[1])]
    known_db = grids[0][2][np.isfinite(grids[0][2])]
    low_db, high_db = np.quantile(known_db, [0.02, 0.98]) if len(known_db) else (-1.0, 0.0)
    most_db, unit = range_db(grids[2][2]), "gain [dB]" if links.is_gain else "received power [dBm]"
    titles = ("measured", "predicted, held out", "measured − predicted")
    figure = new_figure(15.6, ground.height_in(4.3) + 1.2)
    for number, (grid, title) in enumerate(zip(grids, titles)):
        ax = figure.add_subplot(1, 3, number + 1)
        ground.draw(ax, labelled=number == 0)
        colours = {"cmap": RESIDUAL_COLOURS, "vmin": -most_db, "vmax": most_db} if number == 2 else {
            "cmap": "viridis", "vmin": low_db, "vmax": high_db}
        image = ax.pcolormesh(*grid, zorder=2, alpha=0.9, linewidth=0, rasterized=True, **colours)
        ax.set_title(title, fontsize=11)
        figure.colorbar(image, ax=ax, shrink=0.85, extend="both", location="bottom",
                        label="difference [dB]" if number == 2 else unit)
    _legend(figure, f"mean of the links in a cell of {ground.cell_m:g} m")
    save(figure, path)


def draw_added(added_db: np.ndarray, ground: Ground, path: Path) -> None:
    """What an effect adds, on the map.

    Args:
        added_db: (n,) to each link.
        ground: of the same links.
    """
    figure = new_figure(6.6, ground.height_in(4.9) + 0.9)
    ax = figure.add_subplot()
    ground.draw(ax)
    grid = ground.cells(added_db)
    most_db = range_db(grid[2])
    image = ax.pcolormesh(*grid, cmap=RESIDUAL_COLOURS, vmin=-most_db, vmax=most_db, zorder=2, alpha=0.9, linewidth=0,
                          rasterized=True)
    figure.colorbar(image, ax=ax, shrink=0.85, extend="both", label="what it adds [dB]")
    _legend(figure, f"mean of cells of {ground.cell_m:g} m")
    save(figure, path)


def draw_links(part: AppliedEffect, without_db: np.ndarray, with_db: np.ndarray, ground: Ground, path: Path) -> None:
    """The links that an effect with a place acts on, coloured by their residual without and with it.

    Args:
        part: the effect.
        without_db, with_db: (n,) expected level of all links.
        ground: of the same links.
    """
    links = ground.links
    acts = (np.abs(with_db - without_db) > ACTS_DB) & np.isfinite(links.level_db)
    rows = np.flatnonzero(acts)
    drawn = np.random.default_rng(0).permutation(rows)[:MAX_RAYS]
    figure = new_figure(11.7, ground.height_in(4.9) + 1.1)
    residuals_db = [links.level_db - mean_db for mean_db in (without_db, with_db)]
    most_db = range_db(residuals_db[0][rows])
    ends_m = np.stack([links.device_m[links.device], links.receiver_m], axis=1)[..., :2]
    frame = ground.frame(ends_m[drawn].reshape(-1, 2))
    for number, (residual_db, title) in enumerate(zip(residuals_db, ("without it", "with it"))):
        ax = figure.add_subplot(1, 2, number + 1)
        ground.draw(ax, labelled=number == 0)
        order = drawn[np.argsort(np.abs(residual_db[drawn]))]
        rays = LineCollection(ends_m[order], array=residual_db[order], cmap=RESIDUAL_COLOURS, linewidths=0.8, alpha=0.6,
                              zorder=2)
        rays.set_clim(-most_db, most_db)
        ax.add_collection(rays, autolim=False)
        dots = ax.scatter(ground.moving_m[order, 0], ground.moving_m[order, 1], c=residual_db[order], s=12,
                          cmap=RESIDUAL_COLOURS, vmin=-most_db, vmax=most_db, linewidths=0.2, edgecolors="0.3",
                          zorder=3)
        ax.set(xlim=frame[:2], ylim=frame[2:])
        mark(ax, part, links)
        error = f"{np.sqrt(np.mean(residual_db[rows] ** 2)):.2f} dB" if len(rows) else "none was detected"
        ax.set_title(f"{title}\nerror of the {len(rows):,} links that it acts on: {error}", fontsize=11)
    figure.colorbar(dots, ax=figure.axes, shrink=0.85, extend="both", label="measured − predicted [dB]")
    _legend(figure)
    save(figure, path)


def mark(ax, part: AppliedEffect, links: LinkData) -> None:
    """Draw where an effect is, if it has a place: a box, a building that is gone, an end that stands elsewhere."""
    params, name = part.params, plainly(part.effect.name)
    place_m: Any
    if "box" in params:
        x_m, y_m, length_m, width_m, height_m, turn_deg = params["box"]
        turn = np.radians(turn_deg)
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]) * 0.5 * (length_m, width_m)
        corners = corners @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + (x_m, y_m)
        ax.plot(corners[:, 0], corners[:, 1], color=FOUND, linewidth=2, zorder=5)
        text, place_m = f"{name}\n{height_m:.0f} m high", (x_m, y_m)
    elif "building" in params and links.city is not None:
        city = links.city
        faces = city.faces[buildings(city)[0] == params["building"]]
        ax.add_collection(PolyCollection(city.vertices[faces][..., :2], facecolors=FOUND, edgecolors="none",
                                         alpha=0.6, zorder=5),
                          autolim=False)
        text, place_m = "this building is gone", params["centre_m"][:2]
    elif "move_m" in params and "device" in params:
        place_m = links.device_m[params["device"], :2]
        moved_m = place_m + params["move_m"][:2]
        ax.annotate("", moved_m, place_m, zorder=6, arrowprops={"arrowstyle": "->", "color": FOUND, "linewidth": 2,
                                                               "shrinkA": 0, "shrinkB": 4})
        ax.plot(*moved_m, "*", color=FOUND, markersize=13, markeredgecolor="white", zorder=7)
        text = f"{plain(links.device_names[params['device']])} stands\n{np.hypot(*params['move_m'][:2]):.0f} m away"
        place_m = moved_m
    elif "place_m" in params:
        place_m, text = params["place_m"][:2], name
        ax.plot(*place_m, "X", color=FOUND, markersize=11, markeredgecolor="white", zorder=6)
    else:
        return
    right = place_m[0] < np.mean(ax.get_xlim())
    ax.annotate(text, place_m, xytext=(14 if right else -14, 12), textcoords="offset points", color=FOUND,
                fontsize=9, fontweight="bold", ha="left" if right else "right", zorder=7, path_effects=HALO)


def range_db(residual_db: np.ndarray) -> float:
    """End of a scale of colours: nearly all values are within it."""
    seen = np.abs(residual_db[np.isfinite(residual_db)])
    most_db = float(np.quantile(seen, 0.95)) if len(seen) else MIN_RANGE_DB
    return float(np.clip(np.ceil(most_db), MIN_RANGE_DB, MAX_RANGE_DB))


def _legend(figure, title: str = "") -> None:
    handles, labels = figure.axes[0].get_legend_handles_labels()
    if handles or title:
        figure.legend(handles, labels, title=title, loc="outside lower center", ncols=3, frameon=False)
