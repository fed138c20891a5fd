"""Radio maps block by block: their parts, and the NetCDF file that they are written to."""

from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from radiotwin.errors import BadInput
from radiotwin.geo import local_crs, origin_attributes
from radiotwin.io.files import atomic_file
from radiotwin.io.forms import Origin
from radiotwin.runtime.console import progress
from radiotwin.scene.lattice import Lattice

DIMS = ("device", "z", "y", "x")
NETCDF, ZARR = ".nc", ".zarr"  # suffixes of radio maps
VARIABLES = ("gain_db", "los", "sigma_db")
SCHEMA = "radiotwin.radiomap/1"
CONVENTIONS = "CF-1.11"  # https://cfconventions.org
GRID_MAPPING = "crs"
GROUND = "ground_m"  # coordinate of a map whose altitudes are above the ground
GAIN_RANGE_DB = (-1_000.0, 200.0)  # far beyond any link: what is outside is an error
MAX_SIGMA_DB = 1_000.0
BLOCK_VALUES = 200_000  # of a variable that are in memory at once
_WHOLE_VALUES = 2**20  # of a variable that HDF5 stores in pieces of its own choice
_CHUNK_CELLS = 256  # along y and x of a piece of a larger one
_CACHE_BYTES = 2**26  # of unfinished pieces of a variable
ATTRIBUTES: dict[str, dict[str, str]] = {
    "x": {"units": "m", "long_name": "east"},
    "y": {"units": "m", "long_name": "north"},
    "z": {"units": "m", "long_name": "height above the ground datum"},
    GROUND: {"units": "m", "long_name": "height of the ground above the datum; z is above it"},
    "gain_db": {"units": "dB", "long_name": "channel gain (NaN: not detected)"},
    "sigma_db": {"units": "dB", "long_name": "standard deviation of the gain"},
    "los": {"long_name": "line of sight by the 3D map"},
}
# Attributes of the file only, by the CF conventions; in memory they would be in the way.
_CF_ATTRIBUTES: dict[str, dict[str, str | np.ndarray]] = {
    "x": {"axis": "X", "standard_name": "projection_x_coordinate"},
    "y": {"axis": "Y", "standard_name": "projection_y_coordinate"},
    "z": {"axis": "Z", "standard_name": "height", "positive": "up"},
    "los": {"flag_values": np.array([0, 1], dtype=np.int8),
            "flag_meanings": "no_line_of_sight line_of_sight"},
}


class MapBlock(NamedTuple):
    """Part of a radio map; blocks come in the order of an array (device, z, y, x).

    Attributes:
        where: its slices of the four dims.
        values: (device, z, y, x) part of each variable, by name.
    """

    where: tuple[slice, slice, slice, slice]
    values: dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class MapStream:
    """A radio map that is made block by block, while it is written: it need not fit in memory.

    Attributes:
        devices: names.
        lattice: of the map.
        attributes: provenance.
        variables: `gain_db`, `los` and, of a learned map, `sigma_db`.
        make: returns the variables, each (z, y, x), of a device on a part of the lattice.
    """

    devices: list[str]
    lattice: Lattice
    attributes: dict[str, Any]
    variables: tuple[str, ...]
    make: Callable[[str, Lattice], dict[str, np.ndarray]]

    def blocks(self) -> Iterator[MapBlock]:
        """Make all blocks, with a progress bar."""
        parts = list(parts_of(self.lattice.shape))
        with progress("mapping", total=len(self.devices) * len(parts)) as advance:
            for row, device in enumerate(self.devices):
                for z, y, x in parts:
                    values = self.make(device, self.lattice.part(z, y, x))
                    _check_values(device, values)
                    yield MapBlock((slice(row, row + 1), z, y, x),
                                   {name: values[name][None] for name in self.variables})
                    advance(1)

    def placed(self, origin: Origin | None) -> "MapStream":
        """Return the same map with another origin of the local frame, or with none."""
        return replace(self, attributes=placed_attributes(self.attributes, origin))

    def selected(self, devices: list[str], lattice: Lattice) -> "MapStream":
        """Return the map of some of its devices on some levels of its lattice."""
        return replace(self, devices=devices, lattice=lattice)

    def thinned(self, step: int) -> "MapStream":
        """Return the map of every n-th position in x and in y."""
        every = slice(None, None, step)
        return replace(self, lattice=self.lattice.part(slice(None), every, every))

    @property
    def header(self) -> xr.Dataset:
        """Coordinates and attributes of the dataset that it would be."""
        return header(self.devices, self.lattice, self.attributes)


def _check_values(device: str, values: dict[str, np.ndarray]) -> None:
    """Refuse gains that no link has, before they become infinite in single precision."""
    for name, (low, high) in (("gain_db", GAIN_RANGE_DB), ("sigma_db", (0.0, MAX_SIGMA_DB))):
        if name in values and not ((values[name] >= low) & (values[name] <= high)
                                   | np.isnan(values[name])).all():
            raise BadInput(f"the model's {name} for device {device!r} goes from "
                           f"{np.nanmin(values[name]):g} to {np.nanmax(values[name]):g}; allowed "
                           f"is {low:g} to {high:g}: fit it again")


POWERS = "device_tx_power_dbm"
"""Attribute: declared transmit powers by device [dBm], as JSON; gains are without them."""


def header(devices: list[str], lattice: Lattice, attributes: dict[str, Any] | None) -> xr.Dataset:
    """Return the coordinates and attributes of a radio map."""
    dataset = xr.Dataset(coords={"device": np.array(devices, dtype=object),
                                 "z": lattice.z_m, "y": lattice.y_m, "x": lattice.x_m},
                         attrs={"schema": SCHEMA, **(attributes or {})})
    for axis in "zyx":
        dataset[axis].attrs.update(ATTRIBUTES[axis])
    if lattice.ground_m is not None:
        dataset["z"].attrs["long_name"] = "height above the ground"
        dataset = dataset.assign_coords({GROUND: (("y", "x"), lattice.ground_m,
                                                  ATTRIBUTES[GROUND])})
    return dataset


def placed_attributes(attributes: dict[Hashable, Any] | dict[str, Any],
                      origin: Origin | None) -> dict[str, Any]:
    """Return the attributes of a map with another origin of the local frame, or with none."""
    return {str(name): value for name, value in attributes.items()
            if not str(name).startswith("origin_")} | origin_attributes(origin)


def parts_of(shape: tuple[int, ...]) -> Iterator[tuple[slice, slice, slice]]:
    """Return slices of (z, y, x), in the order of an array, of at most `BLOCK_VALUES` each.

    A small lattice is one part; others are cut into levels, rows and, if need be, columns.
    """
    levels, rows, columns = shape
    if levels * rows * columns <= BLOCK_VALUES:
        yield slice(0, levels), slice(0, rows), slice(0, columns)
        return
    wide = min(columns, BLOCK_VALUES)
    high = BLOCK_VALUES // wide if wide == columns else 1
    high -= high % _CHUNK_CELLS if high > _CHUNK_CELLS else 0
    for level in range(levels):
        for row in range(0, rows, high):
            for column in range(0, columns, wide):
                yield (slice(level, level + 1), slice(row, min(row + high, rows)),
                       slice(column, min(column + wide, columns)))


def write_blocks(top: xr.Dataset, dtypes: dict[str, np.dtype], blocks: Iterable[MapBlock],
                 path: Path | str) -> None:
    """Write a radio map as compressed NetCDF-4 by the CF conventions; see `write_parts`.

    HDF5 crashes where a write fails: it writes to a file that keeps the error until the end.
    """
    import h5netcdf  # type: ignore[import-untyped]

    shape = tuple(top.sizes[name] for name in DIMS)
    options = {"compression": "gzip", "compression_opts": 4}
    if np.prod(shape, dtype=float) > _WHOLE_VALUES:
        cells = [min(size, _CHUNK_CELLS) for size in shape[2:]]
        options["chunks"] = (1, 1, *cells)
    start = BytesIO()
    with_cf(top).to_netcdf(start, engine="h5netcdf",
                           encoding={axis: {"_FillValue": None} for axis in ("x", "y", "z", GROUND)
                                     if axis in top})
    with atomic_file(path, hide_errors=True) as file:
        file.write(start.getbuffer())
        with h5netcdf.File(file, "r+", rdcc_nbytes=_CACHE_BYTES) as opened:
            for name, dtype in dtypes.items():
                is_bool = dtype.kind == "b"
                variable = opened.create_variable(
                    name, DIMS, np.int8 if is_bool else dtype,
                    fillvalue=dtype.type(np.nan) if dtype.kind == "f" else None, **options)
                attributes = ATTRIBUTES.get(name, {}) | _CF_ATTRIBUTES.get(name, {})
                attributes |= {"grid_mapping": GRID_MAPPING} if GRID_MAPPING in opened else {}
                variable.attrs.update(attributes | ({"dtype": "bool"} if is_bool else {}))
            for block in blocks:
                if getattr(file, "error", None) is not None:
                    break  # the disk is full: the rest would be made for nothing
                for name, values in block.values.items():
                    opened[name][block.where] = values.astype(opened[name].dtype, copy=False)


def is_zarr(path: Path | str) -> bool:
    """Return whether the name of a radio map is that of a Zarr folder."""
    return Path(path).suffix.lower() == ZARR


def is_map(path: Path | str) -> bool:
    """Return whether a path has the suffix of a radio map."""
    return Path(path).suffix.lower() in (NETCDF, ZARR)


def with_cf(dataset: xr.Dataset) -> xr.Dataset:
    """Add the CF attributes, and the grid mapping where the origin is known."""
    dataset = dataset.copy().assign_attrs(Conventions=CONVENTIONS)
    for name in ("x", "y", "z"):
        dataset[name] = dataset[name].assign_attrs(_CF_ATTRIBUTES[name])
    latitude, longitude = (dataset.attrs.get(f"origin_{name}_deg")
                           for name in ("latitude", "longitude"))
    if latitude is None or longitude is None:
        return dataset
    from pyproj import CRS

    origin = Origin(latitude_deg=float(latitude), longitude_deg=float(longitude))
    dataset[GRID_MAPPING] = xr.Variable((), np.int32(0), CRS(local_crs(origin)).to_cf())
    return dataset


def without_cf(dataset: xr.Dataset) -> xr.Dataset:
    """Remove the attributes that a file has beside those in memory."""
    dataset = dataset.drop_vars(GRID_MAPPING, errors="ignore")
    dataset.attrs.pop("Conventions", None)
    for name in dataset.variables:
        for key in ("grid_mapping", *_CF_ATTRIBUTES.get(str(name), ())):
            dataset[name].attrs.pop(key, None)
            dataset[name].encoding.pop(key, None)
    return dataset
