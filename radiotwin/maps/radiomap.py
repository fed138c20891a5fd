"""The radio map: channel gain at every lattice position for every device; and a difference of two.

Both draw themselves into any axes, and give themselves to GIS programs as rows.
"""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import xarray as xr

from radiotwin.display import (
    DIFFERENCE_COLOURS,
    GAIN_COLOURS,
    PlotFrame,
    Summarised,
    Summary,
    add_colour_bar,
    add_legend,
    count,
    draw_cells,
    draw_points,
    geo_data_frame,
    level_range_db,
    new_axes,
    plain,
    residual_range_db,
    some,
    span,
)
from radiotwin.errors import BadInput
from radiotwin.geo import is_same_frame, origin_attributes, origin_text
from radiotwin.io.forms import Origin
from radiotwin.maps.file import (
    ATTRIBUTES,
    DIMS,
    GROUND,
    POWERS,
    VARIABLES,
    MapBlock,
    MapStream,
    header,
    load_dataset,
    open_dataset,
    parts_of,
    placed_attributes,
    write_parts,
)
from radiotwin.scene import Scene
from radiotwin.scene.lattice import Lattice
from radiotwin.scene.plot import draw_outlines

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from matplotlib.axes import Axes

DIFFERENCE = "difference_db"
SAME_M = 1e-3  # positions nearer than this are one [m]


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
    @abstractmethod
    def variables(self) -> tuple[str, ...]:
        """Names of the variables; the first one is drawn."""

    @abstractmethod
    def _look(self, values: np.ndarray) -> tuple[str, str, dict[str, Any]]:
        """Return the beginning of the title, the label of the colours, and their scale."""

    @property
    def devices(self) -> list[str]:
        """Names of the devices."""
        return [str(name) for name in self.dataset["device"].values]

    @property
    def tx_power_dbm(self) -> dict[str, float]:
        """Declared transmit powers by device [dBm]; empty: the map does not know them."""
        powers_dbm = json.loads(self.dataset.attrs.get(POWERS, "{}"))
        return {name: float(powers_dbm[name]) for name in self.devices if name in powers_dbm}

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

    def plot(self, device: str | None = None, altitude_m: float | None = None,
             ax: Axes | None = None, *, scene: Scene | None = None,
             geographic: bool | None = None) -> Axes:
        """Draw the values of one device at one altitude; white where there are none.

        Args:
            device: name; None: the first one.
            altitude_m: one of the map's [m]; None: the lowest.
            ax: axes of matplotlib to draw into; None: a new figure.
            scene: whose buildings are outlined and in which the device is marked; None: neither.
            geographic: whether axes are longitude and latitude; None: where the origin is known.

        Returns:
            The axes.

        Raises:
            BadInput: no such device or altitude, or longitude and latitude without an origin.
        """
        names, heights_m = self.devices, self.dataset["z"].values
        device = names[0] if device is None else device
        if device not in names:
            raise BadInput(f"device {device!r} is not in the map; it has {some(names)}")
        altitude_m = float(heights_m[0]) if altitude_m is None else altitude_m
        if altitude_m not in heights_m:
            raise BadInput(f"altitude {altitude_m:g} m is not in the map; it has "
                           f"{some(f'{z:g}' for z in heights_m)} m")
        part = self.dataset.isel(device=names.index(device)).sel(z=altitude_m)
        values = part[self.variables[0]].values
        title, label, colours = self._look(values)
        origin = scene.config.origin if scene is not None and self.origin is None else self.origin
        frame, ax = PlotFrame.choose(origin, geographic), new_axes(ax)
        drawn = draw_cells(ax, frame, part["x"].values, part["y"].values, values, **colours)
        add_colour_bar(ax, drawn, label, "both")
        if scene is not None:
            draw_outlines(ax, scene, frame)
            at = [(each.x_m, each.y_m) for each in scene.config.devices if each.device == device]
            if at:
                draw_points(ax, frame, *np.array(at).T, marker="^", s=80, color="white",
                            edgecolors="black", label=f"device {plain(device)}", zorder=4)
        frame.prepare(ax)
        add_legend(ax)
        ax.set_title(f"{title}device {plain(device)} at {altitude_m:g} m")
        return ax

    def to_geodataframe(self) -> GeoDataFrame:
        """Return a row with a point for each device and position, in metres of the local frame.

        Raises:
            BadInput: GeoPandas is not installed.
        """
        names, *axes_m = (self.dataset[axis].values for axis in ("device", "z", "y", "x"))
        name, z_m, y_m, x_m = (each.ravel() for each in np.meshgrid(names, *axes_m, indexing="ij"))
        columns = {"device": name, "x_m": x_m, "y_m": y_m, "z_m": z_m}
        if GROUND in self.dataset:
            ground_m = np.broadcast_to(self.dataset[GROUND].values,
                                       [len(names), *map(len, axes_m)]).ravel()
            columns |= {"z_m": z_m + ground_m, "above_ground_m": z_m}
        columns |= {each: self.dataset[each].values.ravel() for each in self.variables}
        position_m = np.column_stack([x_m, y_m]).astype(float)
        return geo_data_frame(pd.DataFrame(columns), self.origin, position_m=position_m)


@dataclass(frozen=True, eq=False, repr=False)
class MapDifference(OverDevices):
    """Gain of one map minus that of another.

    Of a map of distributions (`sigma_db`) the mean counts, also where a link would not be detected;
    `score_map` compares with a truth as it is detected.

    Attributes:
        dataset: variable `difference_db` (float32, NaN where either map has no gain) with dims
            (device, z, y, x); attributes `minuend` and `subtrahend` are the sources of the maps.
    """

    dataset: xr.Dataset

    @classmethod
    def of(cls, first: xr.Dataset, second: xr.Dataset) -> MapDifference:
        """Subtract the gains of a map's dataset from those of another, over the same lattice.

        Raises:
            BadInput: other devices, other positions, other ground, or another frame.
        """
        names = [[str(name) for name in each["device"].values] for each in (first, second)]
        if set(names[0]) != set(names[1]):
            raise BadInput(f"the maps have different devices, {some(names[0])} and "
                           f"{some(names[1])}; take those of both with `selected` first")
        for axis in "xyz":
            ours_m, theirs_m = first[axis].values, second[axis].values
            if ours_m.shape != theirs_m.shape or not np.allclose(ours_m, theirs_m, rtol=0,
                                                                 atol=SAME_M):
                raise BadInput(f"the maps are over different positions: {axis} goes from "
                               f"{ours_m[0]:g} to {ours_m[-1]:g} m in {len(ours_m)} steps, and "
                               f"from {theirs_m[0]:g} to {theirs_m[-1]:g} m in {len(theirs_m)}; "
                               "make both for the same scene")
        ground_m, other_m = (each[GROUND].values if GROUND in each else 0.0
                             for each in (first, second))
        if not np.allclose(ground_m, other_m, rtol=0, atol=SAME_M):
            raise BadInput("the maps are over different ground, or one is of heights above the "
                           "ground and the other of heights above the datum; make both for the "
                           "same scene")
        origin, other = (origin_of({str(name): value for name, value in each.attrs.items()})
                         for each in (first, second))
        if origin is not None and other is not None and not is_same_frame(origin, other):
            raise BadInput(f"the maps are in different frames, about {origin_text(origin)} and "
                           f"about {origin_text(other)}; make both for the same scene")
        order = [names[1].index(name) for name in names[0]]
        difference = first["gain_db"].values - second["gain_db"].values[order]
        attributes = origin_attributes(origin or other) | {
            "minuend": str(first.attrs.get("source", "")),
            "subtrahend": str(second.attrs.get("source", ""))}
        variable = (first["gain_db"].dims, difference.astype(np.float32),
                    {"units": "dB", "long_name": "difference of the gains"})
        return cls(xr.Dataset({DIFFERENCE: variable}, first.coords, attributes))

    @property
    def difference_db(self) -> np.ndarray:
        """(device, z, y, x) difference [dB]; NaN where either map has no gain."""
        return self.dataset[DIFFERENCE].values

    @property
    def rmse_db(self) -> float:
        """Root of the mean square over all links that both maps have [dB]; NaN without one."""
        known = self.difference_db[np.isfinite(self.difference_db)].astype(float)
        return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")

    @property
    def mean_db(self) -> float:
        """Mean over all links that both maps have [dB]; NaN without one."""
        known = self.difference_db[np.isfinite(self.difference_db)].astype(float)
        return float(known.mean()) if len(known) else float("nan")

    @property
    def variables(self) -> tuple[str, ...]:
        """The one variable."""
        return (DIFFERENCE,)

    def _look(self, values: np.ndarray) -> tuple[str, str, dict[str, Any]]:
        """Red is where the first map has more."""
        high_db = residual_range_db(values)
        names = " − ".join(plain(self.dataset.attrs[each], 40) or "map"
                           for each in ("minuend", "subtrahend"))
        return (f"{names}\n", "difference of the gains [dB]",
                {"cmap": DIFFERENCE_COLOURS, "vmin": -high_db, "vmax": high_db})

    @property
    def _summary(self) -> Summary:
        known = int(np.isfinite(self.difference_db).sum())
        names = " − ".join(self.dataset.attrs[each] or "map" for each in ("minuend", "subtrahend"))
        return Summary(
            "MapDifference", f"{names}, {count(len(self), 'device')}, RMS {self.rmse_db:.2f} dB, "
            f"mean {self.mean_db:+.2f} dB", (
                ("maps", names), ("devices", some(self.devices)),
                ("links in both", f"{known:,} of {self.difference_db.size:,}"),
                ("RMS", f"{self.rmse_db:.2f} dB"), ("mean", f"{self.mean_db:+.2f} dB")))


@dataclass(frozen=True, eq=False, repr=False)
class RadioMap(OverDevices):
    """Channel gain over a lattice.

    Attributes:
        dataset: variables `gain_db` (float32, NaN where not detected), `los` (bool) and optionally
            `sigma_db` (float32), each with dims (device, z, y, x); coordinates x, y, z [m];
            attributes hold the provenance (source, solver settings, seed, origin).
    """

    dataset: xr.Dataset

    @classmethod
    def build(cls, devices: list[str], lattice: Lattice, gain_db: np.ndarray, los: np.ndarray,
              sigma_db: np.ndarray | None = None,
              attributes: dict[str, Any] | None = None) -> RadioMap:
        """Build a map from arrays.

        Args:
            devices: names of the devices, (n,).
            lattice: of the map.
            gain_db: channel gain [dB], (n, z, y, x) or (n, z * y * x); NaN where not detected.
            los: line of sight by the 3D map, of the same shape.
            sigma_db: standard deviation of the gain [dB], of the same shape.
            attributes: provenance.
        """
        shape = (len(devices), *lattice.shape)
        variables = {"gain_db": gain_db.astype(np.float32), "los": los.astype(bool)}
        if sigma_db is not None:
            variables["sigma_db"] = sigma_db.astype(np.float32)
        dataset = header(devices, lattice, attributes).assign(
            {name: (DIMS, values.reshape(shape), ATTRIBUTES[name])
             for name, values in variables.items()})
        return cls(dataset)

    @classmethod
    def collect(cls, stream: MapStream | RadioMap) -> RadioMap:
        """Return a map in memory: all blocks of a stream, or all values of an opened map."""
        if isinstance(stream, RadioMap):
            return cls(stream.dataset.load())
        shape = (len(stream.devices), *stream.lattice.shape)
        arrays = {name: np.empty(shape, bool if name == "los" else np.float32)
                  for name in stream.variables}
        for block in stream.blocks():
            for name, values in block.values.items():
                arrays[name][block.where] = values
        return cls(stream.header.assign({name: (DIMS, array, ATTRIBUTES[name])
                                         for name, array in arrays.items()}))

    @classmethod
    def load(cls, path: Path | str) -> RadioMap:
        """Read a NetCDF-4 file, or a Zarr folder, into memory.

        Args:
            path: as `save` makes it; `NAME.zarr` is a Zarr folder.

        Raises:
            BadInput: no such file, damaged, not a radio map, or too large for the memory.
        """
        return cls(load_dataset(Path(path)))

    @classmethod
    @contextmanager
    def open(cls, path: Path | str) -> Iterator[RadioMap]:
        """Open a NetCDF-4 file, or a Zarr folder, whose values stay there until they are used.

        It has been read once, in parts, and checked. `save`, `blocks` and `selected` keep one part
        in memory, `dataset.isel` what it selects; `gain_db` and `los` read everything.

        Args:
            path: as `save` makes it.

        Yields:
            The map; its values can be read until the context ends.

        Raises:
            BadInput: as `load`.
        """
        with open_dataset(Path(path)) as dataset:
            yield cls(dataset)

    def save(self, path: Path | str) -> None:
        """Write the map by the CF conventions, atomically and part by part.

        Args:
            path: `NAME.zarr` for a Zarr folder; any other name for compressed NetCDF-4.

        Raises:
            BadInput: `path` cannot be written.
            RunFailed: the disk is full or failed; an older map is unchanged.
        """
        write_parts(self.header, {name: self.dataset[name].dtype for name in self.variables},
                    self.blocks(), path)

    def require_of(self, scene: Scene) -> None:
        """Raise BadInput unless the map was made for a scene as it is now, with all its devices."""
        known = set(self.devices)
        missing = [device.device for device in scene.config.devices if device.device not in known]
        if missing or not self.is_over_lattice_of(scene) \
                or self.dataset.attrs.get("scene_hash") != scene.content_hash():
            what = (f"it lacks device {missing[0]!r}" if missing else
                    "geometry, radio, devices or lattice differ")
            raise BadInput(f"the radio map was not made for the scene as it is now in "
                           f"{scene.folder} ({what}); run `radiotwin trace` again")

    def is_over_lattice_of(self, scene: Scene) -> bool:
        """Return whether the map is over a scene's lattice."""
        return self.lattice.equals(scene.lattice)

    def _look(self, values: np.ndarray) -> tuple[str, str, dict[str, Any]]:
        low_db, high_db = level_range_db(values)
        source = plain(str(self.attributes.get("source", ""))) or "radio map"
        return (f"{source}: ", "channel gain [dB]",
                {"cmap": GAIN_COLOURS, "vmin": low_db, "vmax": high_db})

    def __sub__(self, other: RadioMap) -> MapDifference:
        """Return the difference of the gains, see `MapDifference`.

        Raises:
            BadInput: other devices, other positions, or another frame.
        """
        if not isinstance(other, RadioMap):
            return NotImplemented
        return MapDifference.of(self.dataset, other.dataset)

    @property
    def _summary(self) -> Summary:
        levels, rows, columns = self.lattice.shape
        source = str(self.attributes.get("source", "")) or "unknown source"
        size = f"{columns} × {rows} × {levels} positions (x, y, z)"
        seen, low_db, high_db = 0, np.inf, -np.inf
        for block in self.blocks():  # of an opened map: it may be larger than the memory
            values_db = block.values["gain_db"]
            seen += int(np.isfinite(values_db).sum())
            low_db = min(low_db, float(np.fmin.reduce(values_db, axis=None, initial=np.inf)))
            high_db = max(high_db, float(np.fmax.reduce(values_db, axis=None, initial=-np.inf)))
        gains = span(low_db, high_db, "dB") if seen else "–"
        missing = 1 - seen / self.dataset["gain_db"].size
        origin = self.origin
        frequency_hz = self.attributes.get("frequency_hz")
        return Summary("RadioMap", f"{source}, {count(len(self), 'device')}, {size}, "
                       f"{self.lattice.step_m:g} m apart, gain {gains}", (
            ("source", source), ("devices", some(self.devices)), ("lattice", size),
            ("step", f"{self.lattice.step_m:g} m"),
            ("altitudes", some(f"{z:g}" for z in self.lattice.z_m) + " m"),
            ("frequency", "–" if frequency_hz is None else f"{frequency_hz / 1e9:g} GHz"),
            ("gain", gains), ("without a gain", f"{missing:.1%}"),
            ("standard deviation", "sigma_db" if "sigma_db" in self.variables else "none"),
            ("origin", "not known" if origin is None else
             f"latitude {origin.latitude_deg:g}°, longitude {origin.longitude_deg:g}°")))

    def blocks(self) -> Iterator[MapBlock]:
        """Return the map in parts, as `MapStream.blocks` makes them."""
        arrays = {name: self.dataset[name].variable for name in self.variables}
        for row in range(self.dataset.sizes["device"]):
            for part in parts_of(self.lattice.shape):
                where = (slice(row, row + 1), *part)
                yield MapBlock(where, {name: array[where].values
                                       for name, array in arrays.items()})

    def placed(self, origin: Origin | None) -> RadioMap:
        """Return the same map with another origin of the local frame, or with none."""
        dataset = self.dataset.copy()
        dataset.attrs = placed_attributes(dataset.attrs, origin)
        return RadioMap(dataset)

    def selected(self, devices: list[str], lattice: Lattice) -> RadioMap:
        """Return the map of some of its devices on some levels of its lattice."""
        return RadioMap(self.dataset.sel(device=devices, z=lattice.z_m))

    def thinned(self, step: int) -> RadioMap:
        """Return the map of every n-th position in x and in y."""
        every = slice(None, None, step)
        return RadioMap(self.dataset.isel(y=every, x=every))

    @property
    def header(self) -> xr.Dataset:
        """Coordinates and attributes."""
        return self.dataset.drop_vars(self.variables)

    @property
    def variables(self) -> tuple[str, ...]:
        """`gain_db`, `los` and, of a learned map, `sigma_db`."""
        return tuple(name for name in VARIABLES if name in self.dataset)

    @property
    def lattice(self) -> Lattice:
        """Positions of the map."""
        x_m, y_m, z_m = (self.dataset[axis].values.astype(float) for axis in "xyz")
        ground_m = self.dataset[GROUND].values.astype(float) if GROUND in self.dataset else None
        return Lattice(x_m, y_m, z_m, ground_m)

    @property
    def gain_db(self) -> np.ndarray:
        """Channel gain [dB], (device, z, y, x) float32; NaN where not detected."""
        return self.dataset["gain_db"].values

    @property
    def los(self) -> np.ndarray:
        """Line of sight by the 3D map, (device, z, y, x) bool."""
        return self.dataset["los"].values
