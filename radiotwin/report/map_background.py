"""Draw what lies under every map of a close-loop: buildings and the ends that do not move."""

import numpy as np
from matplotlib.axes import Axes

from radiotwin.report.closeloop_data import LinkArrays
from radiotwin.scene import Scene
from radiotwin.scene.preview import draw_vegetation, height_grid

CELLS = 45  # along the longer side of the map
MIN_CELL_M = 10.0
MIN_LINKS = 3  # of a cell
MAX_MARKS = 80  # more devices or receivers would hide the map
MARGIN_M = 30.0  # around the links of an enlarged part
ROUND_STEPS = (1, 1.5, 2, 3, 4, 5, 7, 10)


class MapBackground:
    """The ground that the panels of a map share.

    Args:
        links: measured links.
        scene: whose buildings are drawn; None: no 3D map.
    """

    def __init__(self, links: LinkArrays, scene: Scene | None) -> None:
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
        """Return a round side of a map cell [m]."""
        x_min, x_max, y_min, y_max = self.bounds
        wanted = max(max(x_max - x_min, y_max - y_min) / CELLS, MIN_CELL_M)
        power = 10.0 ** np.floor(np.log10(wanted))
        return float(next(step * power for step in ROUND_STEPS if step * power >= 0.95 * wanted))

    def panel_height(self, width_in: float) -> float:
        """Return the height of a panel of a width, both in inches."""
        x_min, x_max, y_min, y_max = self.bounds
        return width_in * min(max((y_max - y_min) / max(x_max - x_min, 1.0), 0.4), 1.3)

    def frame(self, positions_m: np.ndarray) -> tuple[float, float, float, float]:
        """Enlarge a part of the map, in the map's proportions.

        Args:
            positions_m: (n, 2) positions that are to be seen [m].

        Returns:
            x_min, x_max, y_min, y_max [m]
        """
        x_min, x_max, y_min, y_max = self.bounds
        if not len(positions_m):
            return self.bounds
        low, high = positions_m.min(axis=0) - MARGIN_M, positions_m.max(axis=0) + MARGIN_M
        middle, size = 0.5 * (low + high), np.array([x_max - x_min, y_max - y_min])
        half = 0.5 * size * min(max(*((high - low) / size), 0.3), 1.0)
        middle = np.clip(middle, np.array([x_min, y_min]) + half, np.array([x_max, y_max]) - half)
        return middle[0] - half[0], middle[0] + half[0], middle[1] - half[1], middle[1] + half[1]

    def draw(self, ax: Axes, labelled: bool = True) -> None:
        """Draw buildings, the ends that do not move, and axes in metres.

        Args:
            ax: axes to draw into.
            labelled: whether the y axis has labels.
        """
        x_min, x_max, y_min, y_max = self.bounds
        if self._scene is not None:
            draw_vegetation(ax, self._scene)
        if self._height_m is not None:
            building = self._height_m > BUILDING_M
            ax.imshow(np.where(building, 0.82, np.nan), origin="lower", extent=self.bounds,
                      cmap="gray", vmin=0, vmax=1, interpolation="nearest")
            ax.contour(building, levels=[0.5], origin="lower", extent=self.bounds, colors="0.35",
                       linewidths=0.5, zorder=3)
        ax.set(xlim=(x_min, x_max), ylim=(y_min, y_max), aspect="equal", xlabel="x, east [m]",
               ylabel="y, north [m]" if labelled else "")
        ax.tick_params(labelleft=labelled)
        for marker, colour, label, position_m in self._fixed_ends():
            if 0 < len(position_m) <= MAX_MARKS:
                ax.scatter(position_m[:, 0], position_m[:, 1], marker=marker, s=38, color=colour,
                           edgecolors="black", linewidths=0.8, zorder=4, label=label)

    def cell_means(self, value_db: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Average a value over the links whose moving end is in a cell.

        Args:
            value_db: (n,) value of each link [dB]; NaN is left out.

        Returns:
            edges of the cells in x and in y [m], and (ny, nx) means [dB]; NaN where a cell has
            fewer than `MIN_LINKS` links
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

    def _fixed_ends(self) -> list[tuple[str, str, str, np.ndarray]]:
        """Return marker, colour, label and positions of each kind of end that does not move."""
        links = self.links
        if not self.receivers_move:
            return [("s", "black", "receiver", np.unique(links.receiver_m.round(), axis=0))]
        members = np.unique(links.variables["device"])
        anchor = links.anchor[members]
        return [("^", "black", "device, declared", links.device_m[members[anchor]]),
                ("o", "white", "device, located", links.device_m[members[~anchor]])]
