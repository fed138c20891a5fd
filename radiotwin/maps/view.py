"""Draw radio maps and their differences into any axes, and give them to GIS programs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr

from radiotwin.display import PlotFrame, geo_data_frame, new_axes
from radiotwin.display.axes import add_colour_bar, add_legend, draw_cells, draw_points, plain
from radiotwin.display.summary import Summarised, some
from radiotwin.errors import BadInput
from radiotwin.io.forms import Origin
from radiotwin.maps.form import GROUND
from radiotwin.scene import Scene

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from matplotlib.axes import Axes


def origin_of(attributes: dict[str, Any]) -> Origin | None:
    """Return the origin of a map's frame by its attributes; None where they do not have it."""
    found = {name: float(attributes[f"origin_{name}"]) for name in Origin.model_fields
             if f"origin_{name}" in attributes}
    return Origin(**found) if {"latitude_deg", "longitude_deg"} <= found.keys() else None


class OverDevices(Summarised):
    """Base of what has values for each device over a lattice.

    Attributes:
        dataset: variables with dims (device, z, y, x), coordinates x, y, z [m], provenance.
    """

    dataset: xr.Dataset

    def __len__(self) -> int:
        """Return the number of devices."""
        return self.dataset.sizes["device"]

    @property
    def devices(self) -> list[str]:
        """Names of the devices."""
        return [str(name) for name in self.dataset["device"].values]

    @property
    def attributes(self) -> dict[str, Any]:
        """Provenance."""
        return {str(name): value for name, value in self.dataset.attrs.items()}

    @property
    def origin(self) -> Origin | None:
        """Of the local frame; None where it is not known."""
        return origin_of(self.attributes)

    def to_xarray(self) -> xr.Dataset:
        """Return a copy of the dataset."""
        return self.dataset.copy(deep=True)


def pick(dataset: xr.Dataset, device: str | None, altitude_m: float | None
         ) -> tuple[str, float, xr.Dataset]:
    """Return a device, an altitude, and the part of a map for them, with dims (y, x).

    Args:
        dataset: with dims (device, z, y, x).
        device: its name; None: the first one.
        altitude_m: one of the map's [m]; None: the lowest.

    Raises:
        BadInput: the map has no such device or altitude.
    """
    names, heights_m = [str(name) for name in dataset["device"].values], dataset["z"].values
    device = names[0] if device is None else device
    if device not in names:
        raise BadInput(f"device {device!r} is not in the map; it has {some(names)}")
    altitude_m = float(heights_m[0]) if altitude_m is None else altitude_m
    if altitude_m not in heights_m:
        raise BadInput(f"altitude {altitude_m:g} m is not in the map; it has "
                       f"{some(f'{z:g}' for z in heights_m)} m")
    return device, altitude_m, dataset.isel(device=names.index(device)).sel(z=altitude_m)


def plot_values(values: xr.DataArray, origin: Origin | None, ax: Axes | None,
                geographic: bool | None, scene: Scene | None, device: str, label: str,
                extend: str, **look: Any) -> Axes:
    """Draw values over the positions of a lattice.

    Args:
        values: (y, x); NaN stays empty.
        origin: of the frame.
        ax: to draw into; None: a new figure.
        geographic: whether axes are longitude and latitude; None: where the origin is known.
        scene: whose buildings are outlined and in which the device is marked; None: neither.
        device: of the values.
        label: of the colour bar.
        extend: ends of the colour scale that values lie beyond, of `Figure.colorbar`.
        look: of `Axes.pcolormesh`.
    """
    if scene is not None and origin is None:
        origin = scene.config.origin
    frame, ax = PlotFrame.choose(origin, geographic), new_axes(ax)
    drawn = draw_cells(ax, frame, values["x"].values, values["y"].values, values.values, **look)
    add_colour_bar(ax, drawn, label, extend)
    if scene is not None:
        scene.draw_outlines(ax, frame)
        at = [(each.x_m, each.y_m) for each in scene.config.devices if each.device == device]
        if at:
            draw_points(ax, frame, *np.array(at).T, marker="^", s=80, color="white",
                        edgecolors="black", label=f"device {plain(device)}", zorder=4)
    frame.prepare(ax)
    add_legend(ax)
    return ax


def map_table(dataset: xr.Dataset, variables: Sequence[str], origin: Origin | None
              ) -> GeoDataFrame:
    """Return a row with a point for each device and position of a map.

    Args:
        dataset: with dims (device, z, y, x).
        variables: columns beside `device, x_m, y_m, z_m`, and `above_ground_m` where the map's
            altitudes are that.
        origin: of the frame.

    Raises:
        BadInput: GeoPandas is not installed.
    """
    names, *axes_m = (dataset[axis].values for axis in ("device", "z", "y", "x"))
    name, z_m, y_m, x_m = (each.ravel() for each in np.meshgrid(names, *axes_m, indexing="ij"))
    columns = {"device": name, "x_m": x_m, "y_m": y_m, "z_m": z_m}
    if GROUND in dataset:
        ground_m = np.broadcast_to(dataset[GROUND].values, [len(names), *map(len, axes_m)]).ravel()
        columns |= {"z_m": z_m + ground_m, "above_ground_m": z_m}
    columns |= {each: dataset[each].values.ravel() for each in variables}
    position_m = np.column_stack([x_m, y_m]).astype(float)
    return geo_data_frame(pd.DataFrame(columns), origin, position_m=position_m)
