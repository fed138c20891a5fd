"""Draw values of links at their moving end, and export links as a Dataset or GeoDataFrame."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr

from radiotwin.display import (
    PlotFrame,
    add_colour_bar,
    add_legend,
    draw_points,
    geo_data_frame,
    some,
)
from radiotwin.errors import BadInput
from radiotwin.geo import origin_attributes
from radiotwin.io.forms import Origin
from radiotwin.scene.plot import draw_outlines

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from matplotlib.axes import Axes

    from radiotwin.scene import Scene

ENDS = ("receiver", "device")
_UNITS = {"_m": "m", "_db": "dB", "_dbm": "dBm", "_s": "s", "_deg": "degree", "_hz": "Hz"}


def moving_end(table: pd.DataFrame) -> str:
    """Return `device` if devices are at more positions than receivers, else `receiver`."""
    receivers, devices = (len(table[[f"{end}_x_m", f"{end}_y_m"]].dropna().drop_duplicates())
                          for end in ENDS)
    return ENDS[int(devices > receivers)]


def of_device(table: pd.DataFrame, device: str | None) -> pd.DataFrame:
    """Select the links of a device (None: all links); BadInput if it has none."""
    if device is None:
        return table
    part = table[table["device"] == device]
    if part.empty:
        raise BadInput(f"no link is to device {device!r}; there are links to "
                       f"{some(table['device'].unique())}")
    return part


def plot_links(table: pd.DataFrame, values: np.ndarray, ax: Axes, frame: PlotFrame,
               scene: Scene | None, label: str, strongest_last: bool, **look: Any) -> None:
    """Draw values (n,) of links at their moving ends (NaN: not detected), and the fixed ends.

    `strongest_last` draws large values over small ones, else large magnitudes; `label` is of the
    colour bar, `look` goes to `Axes.scatter`.
    """
    end = moving_end(table)
    other = ENDS[1 - ENDS.index(end)]
    x_m, y_m = (table[f"{end}_{axis}_m"].to_numpy(dtype=float) for axis in "xy")
    if scene is not None:
        draw_outlines(ax, scene, frame)
    seen = np.isfinite(values)
    if not seen.all():
        draw_points(ax, frame, x_m[~seen], y_m[~seen], s=7, color="0.75", linewidths=0,
                    label="not detected", zorder=2)
    rows = np.flatnonzero(seen)
    rows = rows[np.argsort(values[rows] if strongest_last else np.abs(values[rows]))]
    drawn = draw_points(ax, frame, x_m[rows], y_m[rows], c=values[rows], s=14, linewidths=0,
                        zorder=3, **look)
    add_colour_bar(ax, drawn, label, "both")
    fixed = table[[f"{other}_x_m", f"{other}_y_m"]].dropna().drop_duplicates().to_numpy(float)
    if len(fixed):
        draw_points(ax, frame, *fixed.T, marker="^" if other == "device" else "s", s=70,
                    color="white", edgecolors="black", label=other, zorder=4)
    frame.prepare(ax)
    add_legend(ax)


def links_dataset(table: pd.DataFrame, origin: Origin | None) -> xr.Dataset:
    """Convert the columns of a table to variables over the dimension `link`, with units."""
    variables = {}
    for name in table:
        unit = next((unit for ending, unit in _UNITS.items() if str(name).endswith(ending)), None)
        values = table[name].to_numpy()
        variables[name] = ("link", values.astype(object) if values.dtype.kind not in "biuf"
                           else values, {} if unit is None else {"units": unit})
    return xr.Dataset(variables, {"link": np.arange(len(table))},
                      origin_attributes(origin))


def links_table(table: pd.DataFrame, origin: Origin | None) -> GeoDataFrame:
    """Return the links with a point at their moving end; BadInput without GeoPandas."""
    end = moving_end(table)
    position_m = table[[f"{end}_x_m", f"{end}_y_m"]].to_numpy(dtype=float)
    return geo_data_frame(table.reset_index(drop=True), origin, position_m=position_m)
