"""The radio map: channel gain at every lattice position for every device."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from radiotwin.display.axes import GAIN_COLOURS, level_range_db, plain
from radiotwin.display.summary import Summary, count, some, span
from radiotwin.errors import BadInput
from radiotwin.io.forms import Origin
from radiotwin.maps.difference import MapDifference
from radiotwin.maps.file import load_dataset, open_dataset, write_parts
from radiotwin.maps.form import (
    ATTRIBUTES,
    DIMS,
    GROUND,
    VARIABLES,
    MapBlock,
    MapStream,
    header,
    parts_of,
    placed_attributes,
)
from radiotwin.maps.view import OverDevices, map_table, pick, plot_values
from radiotwin.scene import Scene
from radiotwin.scene.lattice import Lattice

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from matplotlib.axes import Axes


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
    def collect(cls, stream: "MapStream | RadioMap") -> "RadioMap":
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
    def load(cls, path: Path | str) -> "RadioMap":
        """Read a NetCDF-4 file, or a Zarr folder, into memory.

        Args:
            path: as `save` makes it; `NAME.zarr` is a Zarr folder.

        Raises:
            BadInput: no such file, damaged, not a radio map, or too large for the memory.
        """
        return cls(load_dataset(Path(path)))

    read = load  # the name of version 0.1

    @classmethod
    @contextmanager
    def open(cls, path: Path | str) -> Iterator["RadioMap"]:
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

    write = save  # the name of version 0.1

    def require_of(self, scene: Scene) -> None:
        """Raise BadInput unless the map was made for a scene as it is now, with all its devices.

        Args:
            scene: whose hash is held against the map's attribute `scene_hash`.
        """
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

    def thinned(self, step: int) -> "RadioMap":
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
