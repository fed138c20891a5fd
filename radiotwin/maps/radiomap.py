"""`RadioMap`: channel gain at every lattice position for every device; and `MapDifference`."""

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
    attributes_with_origin,
    header,
    load_dataset,
    open_dataset,
    parts_of,
    write_parts,
)
from radiotwin.scene import Scene
from radiotwin.scene.lattice import Lattice
from radiotwin.scene.plot import draw_outlines

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from matplotlib.axes import Axes

DIFFERENCE = "difference_db"
SAME_M = 1e-3  # two maps' positions may differ by this [m]


def origin_of(attributes: dict[str, Any]) -> Origin | None:
    """Return the origin of a map's local frame from its attributes; None if they lack it."""
    found = {name: float(attributes[f"origin_{name}"]) for name in Origin.model_fields
             if f"origin_{name}" in attributes}
    return Origin(**found) if {"latitude_deg", "longitude_deg"} <= found.keys() else None


class LatticeData(Summarised):
    """Base class of datasets with a value for each device and lattice position.

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
        """Names of the variables; `plot` draws the first."""

    @abstractmethod
    def _look(self, values: np.ndarray) -> tuple[str, str, dict[str, Any]]:
        """Return the title's first part, the colour bar's label, and options of the colours."""

    @property
    def devices(self) -> list[str]:
        """Names of the devices."""
        return [str(name) for name in self.dataset["device"].values]

    @property
    def tx_power_dbm(self) -> dict[str, float]:
        """Declared transmit powers by device [dBm]; empty if the map has none."""
        powers_dbm = json.loads(self.dataset.attrs.get(POWERS, "{}"))
        return {name: float(powers_dbm[name]) for name in self.devices if name in powers_dbm}

    @property
    def attributes(self) -> dict[str, Any]:
        """Provenance, such as source, frequency, solver settings, seed and origin."""
        return {str(name): value for name, value in self.dataset.attrs.items()}

    @property
    def origin(self) -> Origin | None:
        """Origin of the local frame; None if unknown."""
        return origin_of(self.attributes)

    def to_xarray(self) -> xr.Dataset:
        """Return a copy of the dataset."""
        return self.dataset.copy(deep=True)

    def plot(self, device: str | None = None, altitude_m: float | None = None,
             ax: Axes | None = None, *, scene: Scene | None = None,
             geographic: bool | None = None) -> Axes:
        """Draw the values of one device at one altitude; missing ones are white.

        Args:
            device: name; None: the first device.
            altitude_m: one of the map's altitudes [m]; None: the lowest.
            ax: axes of matplotlib to draw into; None: a new figure.
            scene: draw outlines of its buildings and mark the device; None: neither.
            geographic: whether axes are longitude and latitude; None: if the origin is known.

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
            xy_m = [(each.x_m, each.y_m) for each in scene.config.devices if each.device == device]
            if xy_m:
                draw_points(ax, frame, *np.array(xy_m).T, marker="^", s=80, color="white",
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
class MapDifference(LatticeData):
    """Gain of one map minus the gain of another.

    If a map has `sigma_db`, its mean gain is subtracted, even below the limit of detection.
    `score_map` compares detected levels instead.

    Attributes:
        dataset: variable `difference_db` (float32, NaN where either map has no gain) with dims
            (device, z, y, x); attributes `minuend` and `subtrahend` name the maps' sources.
    """

    dataset: xr.Dataset

    @classmethod
    def of(cls, first: xr.Dataset, second: xr.Dataset) -> MapDifference:
        """Subtract the gains of the second map's dataset from those of the first.

        Raises:
            BadInput: the maps differ in devices, positions, ground or frame.
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
        """Difference of the gains (device, z, y, x) [dB]; NaN where either map has no gain."""
        return self.dataset[DIFFERENCE].values

    @property
    def rmse_db(self) -> float:
        """Root mean square difference over all links in both maps [dB]; NaN if there is none."""
        known = self.difference_db[np.isfinite(self.difference_db)].astype(float)
        return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")

    @property
    def mean_db(self) -> float:
        """Mean difference over all links in both maps [dB]; NaN if there is none."""
        known = self.difference_db[np.isfinite(self.difference_db)].astype(float)
        return float(known.mean()) if len(known) else float("nan")

    @property
    def variables(self) -> tuple[str, ...]:
        """`difference_db`."""
        return (DIFFERENCE,)

    def _look(self, values: np.ndarray) -> tuple[str, str, dict[str, Any]]:
        """Return a plot's title, bar label and colours; red where the first map has more gain."""
        high_db = residual_range_db(values)
        names = " − ".join(plain(self.dataset.attrs[each], 40) or "map"
                           for each in ("minuend", "subtrahend"))
        return (f"{names}\n", "difference of the gains [dB]",
                {"cmap": DIFFERENCE_COLOURS, "vmin": -high_db, "vmax": high_db})

    @property
    def _summary(self) -> Summary:
        """Describe the difference in one line and a table: maps, devices, links, RMS, mean [dB]."""
        known = int(np.isfinite(self.difference_db).sum())
        names = " − ".join(self.dataset.attrs[each] or "map" for each in ("minuend", "subtrahend"))
        return Summary(
            "MapDifference", f"{names}, {count(len(self), 'device')}, RMS {self.rmse_db:.2f} dB, "
            f"mean {self.mean_db:+.2f} dB", (
                ("maps", names), ("devices", some(self.devices)),
                ("links in both", f"{known:,} of {self.difference_db.size:,}"),
                ("RMS", f"{self.rmse_db:.2f} dB"), ("mean", f"{self.mean_db:+.2f} dB")))


@dataclass(frozen=True, eq=False, repr=False)
class RadioMap(LatticeData):
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
            devices: (n,) names.
            lattice: of the map.
            gain_db: channel gain [dB], (n, z, y, x) or (n, z * y * x); NaN where not detected.
            los: line of sight by the 3D map, of the same shape.
            sigma_db: standard deviation of the gain [dB], of the same shape.
            attributes: provenance, such as source, frequency and seed.
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
        """Compute all blocks of a stream, or read all values of an opened map, into memory."""
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
        """Open a NetCDF-4 file, or a Zarr folder; values are read on access.

        All values are read once, in parts, to check them. `save`, `blocks` and `selected` hold one
        part in memory, `dataset.isel` the selection; `gain_db` and `los` read everything.

        Args:
            path: as `save` makes it.

        Yields:
            The map, open until the context ends.

        Raises:
            BadInput: see `load`.
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

    def require_made_for(self, scene: Scene) -> None:
        """Raise BadInput unless the map was made for this version of a scene, with all devices."""
        known = set(self.devices)
        missing = [device.device for device in scene.config.devices if device.device not in known]
        if missing or not self.is_over_lattice_of(scene) \
                or self.dataset.attrs.get("scene_hash") != scene.content_hash():
            what = (f"it lacks device {missing[0]!r}" if missing else
                    "geometry, radio, devices or lattice differ")
            raise BadInput(f"the radio map was not made for the scene as it is now in "
                           f"{scene.folder} ({what}); run `radiotwin trace` again")

    def is_over_lattice_of(self, scene: Scene) -> bool:
        """Return whether the map's positions are those of a scene's lattice."""
        return self.lattice.equals(scene.lattice)

    def _look(self, values: np.ndarray) -> tuple[str, str, dict[str, Any]]:
        low_db, high_db = level_range_db(values)
        source = plain(str(self.attributes.get("source", ""))) or "radio map"
        return (f"{source}: ", "channel gain [dB]",
                {"cmap": GAIN_COLOURS, "vmin": low_db, "vmax": high_db})

    def __sub__(self, other: RadioMap) -> MapDifference:
        """Subtract another map's gains; see `MapDifference.of`."""
        if not isinstance(other, RadioMap):
            return NotImplemented
        return MapDifference.of(self.dataset, other.dataset)

    @property
    def _summary(self) -> Summary:
        """Describe the map in one line and a table; its values are read block by block."""
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
        """Read the map block by block, as `MapStream.blocks` computes one."""
        arrays = {name: self.dataset[name].variable for name in self.variables}
        for row in range(self.dataset.sizes["device"]):
            for part in parts_of(self.lattice.shape):
                where = (slice(row, row + 1), *part)
                yield MapBlock(where, {name: array[where].values
                                       for name, array in arrays.items()})

    def with_origin(self, origin: Origin | None) -> RadioMap:
        """Return the map with the origin of its local frame replaced; None removes it."""
        dataset = self.dataset.copy()
        dataset.attrs = attributes_with_origin(dataset.attrs, origin)
        return RadioMap(dataset)

    def selected(self, devices: list[str], lattice: Lattice) -> RadioMap:
        """Return the map of the given devices at a lattice's altitudes; all x and y are kept."""
        return RadioMap(self.dataset.sel(device=devices, z=lattice.z_m))

    def thinned(self, step: int) -> RadioMap:
        """Return the map of every `step`-th position in x and in y."""
        every = slice(None, None, step)
        return RadioMap(self.dataset.isel(y=every, x=every))

    @property
    def header(self) -> xr.Dataset:
        """Dataset of coordinates and attributes, without the variables."""
        return self.dataset.drop_vars(self.variables)

    @property
    def variables(self) -> tuple[str, ...]:
        """`gain_db`, `los` and, of a learned map, `sigma_db`."""
        return tuple(name for name in VARIABLES if name in self.dataset)

    @property
    def lattice(self) -> Lattice:
        """Positions at which the map has values."""
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
