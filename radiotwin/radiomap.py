"""The radio map: channel gain at every lattice position for every device."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from radiotwin.budgets import DEVICES, MAP_AXIS
from radiotwin.display.style import GAIN_COLOURS, level_range_db, plain
from radiotwin.display.summary import Summary, count, some, span
from radiotwin.errors import BadInput
from radiotwin.hdf5 import check_hdf5
from radiotwin.inputs import open_input
from radiotwin.map_difference import MapDifference
from radiotwin.map_file import (
    ATTRIBUTES,
    DIMS,
    GAIN_RANGE_DB,
    GROUND,
    MAX_SIGMA_DB,
    MapBlock,
    MapStream,
    header,
    parts_of,
    placed_attributes,
    without_cf,
    write_blocks,
)
from radiotwin.map_view import OverDevices, map_table, pick, plot_values
from radiotwin.measurement_columns import MAX_COORDINATE_M
from radiotwin.scene import Scene
from radiotwin.scene.lattice import Lattice
from radiotwin.tables import MAX_NAME, Origin

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from matplotlib.axes import Axes

_VARIABLES = ("gain_db", "los", "sigma_db")
MIN_STEP_M = 1e-3
_NUMBERS = ("frequency_hz", "gain_limit_db", "origin_latitude_deg", "origin_longitude_deg",
            "origin_altitude_m", "shadowing_share", "shadowing_length_m")  # among the attributes


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
              attributes: dict[str, Any] | None = None) -> "RadioMap":
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
    def collect(cls, stream: MapStream) -> "RadioMap":
        """Make all blocks of a stream and keep them in memory."""
        shape = (len(stream.devices), *stream.lattice.shape)
        arrays = {name: np.empty(shape, bool if name == "los" else np.float32)
                  for name in stream.variables}
        for block in stream.blocks():
            for name, values in block.values.items():
                arrays[name][block.where] = values
        return cls(stream.header.assign({name: (DIMS, array, ATTRIBUTES[name])
                                         for name, array in arrays.items()}))

    @classmethod
    def load(cls, path: Path | str) -> "RadioMap":
        """Read a NetCDF-4 file.

        Args:
            path: of the file, as `save` makes it.

        Raises:
            BadInput: no such file, not NetCDF-4, or not a radio map.
        """
        path = Path(path)
        if not path.exists():
            raise BadInput(f"{path} does not exist; `radiotwin trace` or `radiotwin map` makes a "
                           "radio map")
        with open_input(path, "radio map (.nc)") as file:
            try:
                check_hdf5(file, path)
                with xr.open_dataset(file, engine="h5netcdf") as opened:
                    problem = _form_problem(opened)
                    names = [*(name for name in _VARIABLES if name in opened), *DIMS,
                             *([GROUND] if GROUND in opened.variables else [])]
                    dataset = opened if problem else opened[names].load().set_coords(
                        [name for name in names if name == GROUND])
            except BadInput:
                raise
            except Exception as error:  # h5py raises OSError, KeyError or ValueError, by the damage
                raise BadInput(f"{path} is not a readable NetCDF-4 file ({error}); make it again"
                               ) from None
        problem = problem or _value_problem(dataset)
        if problem:
            raise BadInput(f"{path} is not a radio map: {problem}; `radiotwin trace` or "
                           "`radiotwin map` makes one")
        dataset["los"] = dataset["los"].astype(bool)
        return cls(without_cf(dataset.drop_encoding()))

    read = load  # the name of version 0.1

    def save(self, path: Path | str) -> None:
        """Write compressed NetCDF-4 by the CF conventions, atomically.

        Args:
            path: of the file.

        Raises:
            BadInput: `path` cannot be written.
            RunFailed: the disk is full or failed; an older file is unchanged.
        """
        dtypes = {name: self.dataset[name].dtype for name in self.variables}
        write_blocks(self.header, dtypes, self.blocks(), path)

    write = save  # the name of version 0.1

    def plot(self, device: str | None = None, altitude_m: float | None = None,
             ax: "Axes | None" = None, *, scene: Scene | None = None,
             geographic: bool | None = None) -> "Axes":
        """Draw the gain of one device at one altitude; white where it is not detected.

        Args:
            device: name; None: the first one.
            altitude_m: one of the map's [m]; None: the lowest.
            ax: axes of matplotlib to draw into; None: a new figure.
            scene: whose buildings are outlined; None: none are.
            geographic: whether axes are longitude and latitude; None: where the origin is known.

        Returns:
            The axes.

        Raises:
            BadInput: no such device or altitude, or longitude and latitude without an origin.
        """
        device, altitude_m, part = pick(self.dataset, device, altitude_m)
        low_db, high_db = level_range_db(part["gain_db"].values)
        ax = plot_values(part["gain_db"], self.origin, ax, geographic, scene, device,
                         "channel gain [dB]", "both", cmap=GAIN_COLOURS, vmin=low_db,
                         vmax=high_db)
        source = plain(str(self.attributes.get("source", ""))) or "radio map"
        ax.set_title(f"{source}: device {plain(device)} at {altitude_m:g} m")
        return ax

    def to_geodataframe(self) -> "GeoDataFrame":
        """Return a row with a point for each device and position, in metres of the local frame.

        Raises:
            BadInput: GeoPandas is not installed.
        """
        return map_table(self.dataset, self.variables, self.origin)

    def __sub__(self, other: "RadioMap") -> MapDifference:
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
        seen = np.isfinite(self.gain_db)
        values_db = self.gain_db[seen]
        gains = span(float(values_db.min()), float(values_db.max()), "dB") if seen.any() else "–"
        origin = self.origin
        frequency_hz = self.attributes.get("frequency_hz")
        return Summary("RadioMap", f"{source}, {count(len(self), 'device')}, {size}, "
                       f"{self.lattice.step_m:g} m apart, gain {gains}", (
            ("source", source), ("devices", some(self.devices)), ("lattice", size),
            ("step", f"{self.lattice.step_m:g} m"),
            ("altitudes", some(f"{z:g}" for z in self.lattice.z_m) + " m"),
            ("frequency", "–" if frequency_hz is None else f"{frequency_hz / 1e9:g} GHz"),
            ("gain", gains), ("without a gain", f"{1 - seen.mean():.1%}"),
            ("standard deviation", "sigma_db" if "sigma_db" in self.variables else "none"),
            ("origin", "not known" if origin is None else
             f"latitude {origin.latitude_deg:g}°, longitude {origin.longitude_deg:g}°")))

    def blocks(self) -> Iterator[MapBlock]:
        """Return the map in parts, as `MapStream.blocks` makes them."""
        arrays = {name: self.dataset[name].values for name in self.variables}
        for row in range(self.dataset.sizes["device"]):
            for part in parts_of(self.lattice.shape):
                where = (slice(row, row + 1), *part)
                yield MapBlock(where, {name: array[where] for name, array in arrays.items()})

    def placed(self, origin: Origin | None) -> "RadioMap":
        """Return the same map with another origin of the local frame.

        Args:
            origin: the new origin; None removes it.
        """
        dataset = self.dataset.copy()
        dataset.attrs = placed_attributes(dataset.attrs, origin)
        return RadioMap(dataset)

    def selected(self, devices: list[str], lattice: Lattice) -> "RadioMap":
        """Return the map of some of its devices on some levels of its lattice."""
        return RadioMap(self.dataset.sel(device=devices, z=lattice.z_m))

    @property
    def header(self) -> xr.Dataset:
        """Coordinates and attributes."""
        return self.dataset.drop_vars(self.variables)

    @property
    def variables(self) -> tuple[str, ...]:
        """`gain_db`, `los` and, of a learned map, `sigma_db`."""
        return tuple(name for name in _VARIABLES if name in self.dataset)

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


def _form_problem(dataset: xr.Dataset) -> str | None:
    """Return the first reason why a dataset is not a radio map that is seen without its values."""
    for name in _VARIABLES:
        if name not in dataset.data_vars:
            if name == "sigma_db":
                continue
            return f"it lacks {name}; it has {list(dataset.data_vars)[:20]}"
        if dataset[name].dims != DIMS:
            return f"{name} has the dims {dataset[name].dims}, it needs {DIMS}"
        if dataset[name].dtype.kind not in ("biuf" if name == "los" else "iuf"):
            return f"{name} holds {dataset[name].dtype}, not numbers"
    for axis in DIMS:
        if (axis not in dataset.coords or dataset[axis].dims != (axis,)
                or dataset.sizes[axis] == 0):
            return f"the coordinate {axis} is missing or empty"
        budget = DEVICES if axis == "device" else MAP_AXIS
        budget.check(dataset.sizes[axis], f"axis {axis} of the radio map")
    if GROUND in dataset.variables and (
            dataset[GROUND].dims != ("y", "x") or dataset[GROUND].dtype.kind not in "iuf"):
        return f"{GROUND} is not numbers with the dims ('y', 'x')"
    for name in _NUMBERS:
        value = dataset.attrs.get(name, 0.0)
        if not isinstance(value, int | float | np.number) or not math.isfinite(value):
            return f"the attribute {name} is {str(value)[:60]!r}, not a finite number"
    for name, most in (("latitude", 90), ("longitude", 180)):
        if abs(dataset.attrs.get(f"origin_{name}_deg", 0.0)) > most:
            return f"the attribute origin_{name}_deg is not within {most} degrees of 0"
    return None


def _value_problem(dataset: xr.Dataset) -> str | None:
    """Return the first reason why the values of a dataset cannot be those of a radio map."""
    for axis in "xyz":
        values = dataset[axis].values
        if (values.dtype.kind not in "iuf" or not np.isfinite(values).all()
                or not (np.diff(values) > 0).all()):
            return f"the coordinate {axis} must hold finite numbers in ascending order [m]"
        if max(-float(values[0]), float(values[-1])) > MAX_COORDINATE_M or (
                len(values) > 1 and np.diff(values).min() < MIN_STEP_M):
            return (f"the coordinate {axis} must lie within {MAX_COORDINATE_M:,.0f} m of 0, with "
                    f"steps of at least {MIN_STEP_M:g} m")
    if GROUND in dataset and not (np.abs(dataset[GROUND].values) <= MAX_COORDINATE_M).all():
        return f"{GROUND} must hold finite heights within {MAX_COORDINATE_M:,.0f} m of 0"
    names = dataset["device"].values.astype(str)
    unique, count = np.unique(names, return_counts=True)
    if len(unique) < len(names):
        return f"two devices have one name, {str(unique[count > 1][0])[:MAX_NAME]!r}"
    for name in names.tolist():
        if not name.isprintable() or not 0 < len(name) <= MAX_NAME:
            return (f"device name {name[:MAX_NAME]!r} is empty, longer than {MAX_NAME} "
                    "characters, or has some that cannot be printed")
    gain_db = dataset["gain_db"].values
    low_db, high_db = np.fmin.reduce(gain_db, axis=None), np.fmax.reduce(gain_db, axis=None)
    if np.isinf(low_db) or np.isinf(high_db):
        return "gain_db is infinite somewhere; where nothing is detected it must be NaN"
    if low_db < GAIN_RANGE_DB[0] or high_db > GAIN_RANGE_DB[1]:
        return (f"gain_db goes from {low_db:g} to {high_db:g} dB; allowed is "
                f"{GAIN_RANGE_DB[0]:g} to {GAIN_RANGE_DB[1]:g}")
    if dataset["los"].dtype != bool and not np.isin(dataset["los"].values, (0, 1)).all():
        return "los holds other values than 0 and 1"
    if "sigma_db" in dataset:
        sigma_db = dataset["sigma_db"].values
        if np.fmin.reduce(sigma_db, axis=None) < 0:
            return "sigma_db is negative somewhere"
        if np.fmax.reduce(sigma_db, axis=None) > MAX_SIGMA_DB:
            return f"sigma_db is above {MAX_SIGMA_DB:g} dB somewhere"
    return None
