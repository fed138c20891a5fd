"""Table, file and plot of a loop's held-out residuals, before and after the effects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import xarray as xr

from radiotwin.closeloop.run import Loop
from radiotwin.display import (
    RESIDUAL_COLOURS,
    PlotFrame,
    Summarised,
    Summary,
    count,
    new_axes,
    plain,
    residual_range_db,
)
from radiotwin.errors import BadInput
from radiotwin.geo import read_frame
from radiotwin.io.cells import RESIDUALS, read_table, write_csv
from radiotwin.io.files import atomic_path
from radiotwin.io.forms import Origin
from radiotwin.links.view import links_dataset, links_table, of_device, plot_links
from radiotwin.scene import Scene

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from matplotlib.axes import Axes

WHEN = ("before", "after")


@dataclass(frozen=True, eq=False, repr=False)
class Residuals(Summarised):
    """Held-out residuals: measured minus predicted levels of links not used in the prediction.

    Attributes:
        table: one row for each link with the columns of `residual_table`: `before_db` by the base,
            `after_db` by base and effects; NaN if the link was not detected or never held out.
        origin: origin of the local frame; None if unknown.
    """

    table: pd.DataFrame
    origin: Origin | None = None

    @classmethod
    def load(cls, path: Path | str) -> Residuals:
        """Read a `residuals.csv.gz`.

        Args:
            path: `.csv` or `.csv.gz`; `frame.toml` in its folder has the frame's origin.

        Raises:
            BadInput: names file, row and column of the first value that cannot be used.
        """
        path = Path(path)
        kinds = {"time_s": "number or nothing", "measured_db": "number or nothing"}
        return cls(read_table(path, RESIDUALS, kinds), read_frame(path.parent))

    def save(self, path: Path | str) -> None:
        """Write `.csv` or `.csv.gz`, completely or not at all.

        Raises:
            BadInput: another format, or a file that cannot be written.
        """
        if not str(path).endswith((".csv", ".csv.gz")):
            raise BadInput(f"{path}: unknown format; allowed are .csv and .csv.gz")
        with atomic_path(path) as temporary:
            write_csv(self.table, temporary, "%.4f")

    def rmse_db(self, when: str = "after") -> float:
        """Return the root mean square of a residual [dB], `before` or `after`."""
        return rmse_db(self._values_db(self.table, when))

    def plot(self, when: str = "after", device: str | None = None, ax: Axes | None = None, *,
             scene: Scene | None = None, geographic: bool | None = None) -> Axes:
        """Draw the residual of each link at its moving end, red where less was measured.

        Args:
            when: `before` the effects were added, or `after`.
            device: draw the links of this device only; None: all, large residuals on top.
            ax: matplotlib axes to draw into; None: a new figure.
            scene: scene whose buildings are outlined; None: no outlines.
            geographic: whether axes are longitude and latitude; None: if the origin is known.

        Returns:
            The axes.

        Raises:
            BadInput: no such device, or longitude and latitude without an origin.
        """
        table = of_device(self.table, device)
        values_db = self._values_db(table, when)
        origin = self.origin
        if scene is not None and origin is None:
            origin = scene.config.origin
        frame, ax = PlotFrame.choose(origin, geographic), new_axes(ax)
        known, high_db = np.isfinite(values_db), residual_range_db(values_db)
        plot_links(table[known], values_db[known], ax, frame, scene, "measured − predicted [dB]",
                   False, cmap=RESIDUAL_COLOURS, vmin=-high_db, vmax=high_db)
        whose = "" if device is None else f" of device {plain(device)}"
        ax.set_title(f"held-out residual{whose}, {when}: RMSE {rmse_db(values_db):.2f} dB")
        return ax

    def to_xarray(self) -> xr.Dataset:
        """Return the columns as variables over the dimension `link`, with units."""
        return links_dataset(self.table, self.origin)

    def to_geodataframe(self) -> GeoDataFrame:
        """Return the table with a point for each link, at its moving end in the local frame [m].

        Raises:
            BadInput: GeoPandas is not installed.
        """
        return links_table(self.table, self.origin)

    def __len__(self) -> int:
        return len(self.table)

    @property
    def _summary(self) -> Summary:
        rmse = [f"{self.rmse_db(when):.2f} dB" for when in WHEN]
        known = int(np.isfinite(self.table["after_db"]).sum())
        return Summary("Residuals", f"{count(len(self), 'link')}, RMSE {rmse[0]} before, {rmse[1]} "
                       "after", (
            ("links", f"{len(self):,}"), ("with a residual", f"{known:,}"),
            ("devices", f"{self.table['device'].nunique():,}"),
            ("receivers", f"{self.table['receiver'].nunique():,}"),
            ("RMSE before", rmse[0]), ("RMSE after", rmse[1])))

    def _values_db(self, table: pd.DataFrame, when: str) -> np.ndarray:
        """Return the column (n,) `before` or `after` of a table [dB]."""
        if when not in WHEN:
            raise BadInput(f"when = {when!r}: allowed are {', '.join(WHEN)}")
        return table[f"{when}_db"].to_numpy(dtype=float)


def rmse_db(values_db: np.ndarray) -> float:
    """Return the root mean square of the known values (n,) [dB]; NaN without any."""
    known = values_db[np.isfinite(values_db)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")


def residual_table(loop: Loop) -> pd.DataFrame:
    """Return the held-out residuals (measured − predicted) of a loop, one row for each link.

    Args:
        loop: result of the loop.

    Returns:
        columns `time_s, flight, receiver, receiver_x_m, receiver_y_m, receiver_z_m, device,
        device_x_m, device_y_m, device_z_m` (as located; NaN if not located), `los` (1, 0),
        `measured_db` (dBm for power), `before_db` and `after_db`; NaN if the link was not detected
        or never held out.
    """
    links = loop.after.links
    device_m = np.where(loop.after.whole.usable[:, None], links.device_m[links.device], np.nan)
    before_db, after_db = (links.level_db - model.on_map[0]
                           for model in (loop.before, loop.after))
    return pd.DataFrame({
        "time_s": links.time_s, "flight": np.array(links.flight_names)[links.flight],
        "receiver": np.array(links.receiver_names)[links.receiver],
        **{f"receiver_{axis}_m": links.receiver_m[:, i] for i, axis in enumerate("xyz")},
        "device": np.array(links.device_names)[links.device],
        **{f"device_{axis}_m": device_m[:, i] for i, axis in enumerate("xyz")},
        "los": links.los.astype(int), "measured_db": links.level_db, "before_db": before_db,
        "after_db": after_db})


def residuals(loop: Loop) -> Residuals:
    """Return the held-out residuals of a close-loop, see `residual_table`."""
    return Residuals(residual_table(loop), loop.origin)
