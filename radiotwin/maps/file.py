"""Check, read and write radio maps in NetCDF and Zarr files, block by block.

A file may come from a stranger. Its layout is checked before its values are read, and its values in
parts. Then it is loaded into memory, or stays open to be read in parts.
"""

import math
import warnings
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from xarray.conventions import decode_cf_variable

from radiotwin.errors import BadInput, optional_package
from radiotwin.geo import local_crs, origin_attributes
from radiotwin.io.array_stores import METADATA, check_hdf5, check_zarr
from radiotwin.io.budgets import DEVICES, MAP_AXIS, MAP_STREAM_VALUES, MAP_VALUES
from radiotwin.io.files import atomic_file, atomic_folder, require_folder, require_writable
from radiotwin.io.forms import MAX_NAME, MAX_POSITION_M, Origin
from radiotwin.io.inputs import open_input, parse_json
from radiotwin.links.plausible import MAX_LEVEL_DB
from radiotwin.runtime.console import progress
from radiotwin.scene.lattice import Lattice

DIMS = ("device", "z", "y", "x")
NETCDF, ZARR = ".nc", ".zarr"  # suffixes of radio maps
VARIABLES = ("gain_db", "los", "sigma_db")
SCHEMA = "radiotwin.radiomap/1"
CONVENTIONS = "CF-1.11"  # https://cfconventions.org
GRID_MAPPING = "crs"
GROUND = "ground_m"  # coordinate of a map whose altitudes are above the ground
GAIN_RANGE_DB = (-1_000.0, 200.0)  # far wider than of any link: gains outside are errors
MAX_SIGMA_DB = 1_000.0
BLOCK_VALUES = 200_000  # values of a variable in memory at once
_WHOLE_VALUES = 2**20  # up to so many values HDF5 chooses its chunks; larger variables get ours
_CHUNK_CELLS = 256  # cells of such a chunk along y and along x
_CACHE_BYTES = 2**26  # HDF5's cache of unfinished chunks of a variable
ATTRIBUTES: dict[str, dict[str, str]] = {
    "x": {"units": "m", "long_name": "east"},
    "y": {"units": "m", "long_name": "north"},
    "z": {"units": "m", "long_name": "height above the ground datum"},
    GROUND: {"units": "m", "long_name": "height of the ground above the datum; z is above it"},
    "gain_db": {"units": "dB", "long_name": "channel gain (NaN: not detected)"},
    "sigma_db": {"units": "dB", "long_name": "standard deviation of the gain"},
    "los": {"long_name": "line of sight by the 3D map"},
}
# CF attributes that are written to files and dropped on reading.
_CF_ATTRIBUTES: dict[str, dict[str, str | np.ndarray]] = {
    "x": {"axis": "X", "standard_name": "projection_x_coordinate"},
    "y": {"axis": "Y", "standard_name": "projection_y_coordinate"},
    "z": {"axis": "Z", "standard_name": "height", "positive": "up"},
    "los": {"flag_values": np.array([0, 1], dtype=np.int8),
            "flag_meanings": "no_line_of_sight line_of_sight"},
}
MIN_STEP_M = 1e-3
_NUMBERS = ("frequency_hz", "gain_limit_db", "origin_latitude_deg", "origin_longitude_deg",
            "origin_altitude_m", "shadowing_share", "shadowing_length_m")  # numeric attributes
_KNOWN = (*VARIABLES, *DIMS, GROUND, GRID_MAPPING)
_LEVEL = 3  # compression level of Zstandard, its default
MAKERS = "`radiotwin trace` or `radiotwin map`"
_LINK_BYTES = 9  # uncompressed: gain and sigma in single precision, line of sight in a byte


class MapBlock(NamedTuple):
    """A rectangular part of a radio map; blocks follow each other in C order.

    Attributes:
        where: slices of device, z, y and x.
        values: the block (device, z, y, x) of each variable, by name.
    """

    where: tuple[slice, slice, slice, slice]
    values: dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class MapStream:
    """A radio map computed block by block while it is written, so that it need not fit in memory.

    Attributes:
        devices: names.
        lattice: of the map.
        attributes: provenance.
        variables: `gain_db`, `los` and, of a learned map, `sigma_db`.
        make: computes the variables (z, y, x) of a device on a part of the lattice.
    """

    devices: list[str]
    lattice: Lattice
    attributes: dict[str, Any]
    variables: tuple[str, ...]
    make: Callable[[str, Lattice], dict[str, np.ndarray]]

    def blocks(self) -> Iterator[MapBlock]:
        """Compute all blocks, device by device in C order, and show a progress bar."""
        parts = list(parts_of(self.lattice.shape))
        with progress("mapping", total=len(self.devices) * len(parts)) as advance:
            for row, device in enumerate(self.devices):
                for z, y, x in parts:
                    values = self.make(device, self.lattice.part(z, y, x))
                    _check_values(device, values)
                    yield MapBlock((slice(row, row + 1), z, y, x),
                                   {name: values[name][None] for name in self.variables})
                    advance(1)

    def with_origin(self, origin: Origin | None) -> "MapStream":
        """Return the map with the origin of its local frame replaced; None removes it."""
        return replace(self, attributes=attributes_with_origin(self.attributes, origin))

    def selected(self, devices: list[str], lattice: Lattice) -> "MapStream":
        """Return the map of the given devices on the given levels of its lattice."""
        return replace(self, devices=devices, lattice=lattice)

    def thinned(self, step: int) -> "MapStream":
        """Return the map of every `step`-th position in x and in y."""
        every = slice(None, None, step)
        return replace(self, lattice=self.lattice.part(slice(None), every, every))

    @property
    def header(self) -> xr.Dataset:
        """Dataset of coordinates and attributes, without variables."""
        return header(self.devices, self.lattice, self.attributes)


def _check_values(device: str, values: dict[str, np.ndarray]) -> None:
    """Raise BadInput for gains or sigmas outside their range, before single precision overflows."""
    for name, (low, high) in (("gain_db", GAIN_RANGE_DB), ("sigma_db", (0.0, MAX_SIGMA_DB))):
        if name in values and not ((values[name] >= low) & (values[name] <= high)
                                   | np.isnan(values[name])).all():
            raise BadInput(f"the model's {name} for device {device!r} goes from "
                           f"{np.nanmin(values[name]):g} to {np.nanmax(values[name]):g}; allowed "
                           f"is {low:g} to {high:g}: fit it again")


POWERS = "device_tx_power_dbm"
"""Attribute with declared transmit powers by device [dBm], as JSON; gains do not include them."""


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


def attributes_with_origin(attributes: dict[Hashable, Any] | dict[str, Any],
                           origin: Origin | None) -> dict[str, Any]:
    """Replace the origin of the local frame in a map's attributes; None removes it."""
    return {str(name): value for name, value in attributes.items()
            if not str(name).startswith("origin_")} | origin_attributes(origin)


def parts_of(shape: tuple[int, ...]) -> Iterator[tuple[slice, slice, slice]]:
    """Cut a lattice (z, y, x) into slices of at most `BLOCK_VALUES` positions, in C order.

    A small lattice is one part. A larger one is cut into levels, rows and, if necessary, columns.
    """
    levels, rows, columns = shape
    if levels * rows * columns <= BLOCK_VALUES:
        yield slice(0, levels), slice(0, rows), slice(0, columns)
        return
    part_columns = min(columns, BLOCK_VALUES)
    part_rows = BLOCK_VALUES // part_columns if part_columns == columns else 1
    part_rows -= part_rows % _CHUNK_CELLS if part_rows > _CHUNK_CELLS else 0
    for level in range(levels):
        for row in range(0, rows, part_rows):
            for column in range(0, columns, part_columns):
                yield (slice(level, level + 1), slice(row, min(row + part_rows, rows)),
                       slice(column, min(column + part_columns, columns)))


def write_blocks(top: xr.Dataset, dtypes: dict[str, np.dtype], blocks: Iterable[MapBlock],
                 path: Path | str) -> None:
    """Write a radio map as compressed NetCDF-4 by the CF conventions; see `write_parts`."""
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
                    break  # the disk is full: computing the rest would be in vain
                for name, values in block.values.items():
                    opened[name][block.where] = values.astype(opened[name].dtype, copy=False)


def is_zarr(path: Path | str) -> bool:
    """Return whether a path has the suffix of a Zarr folder."""
    return Path(path).suffix.lower() == ZARR


def is_map(path: Path | str) -> bool:
    """Return whether a path has the suffix of a radio map."""
    return Path(path).suffix.lower() in (NETCDF, ZARR)


def with_cf(dataset: xr.Dataset) -> xr.Dataset:
    """Return a copy with CF attributes, and with a grid mapping if the frame's origin is known."""
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
    """Return the map without the CF attributes that only files need; `dataset` loses some, too."""
    dataset = dataset.drop_vars(GRID_MAPPING, errors="ignore")
    dataset.attrs.pop("Conventions", None)
    for name in dataset.variables:
        for key in ("grid_mapping", *_CF_ATTRIBUTES.get(str(name), ())):
            dataset[name].attrs.pop(key, None)
            dataset[name].encoding.pop(key, None)
    return dataset


def form_problem(dataset: xr.Dataset) -> str | None:
    """Check variables, dims, dtypes and attributes; return the first fault, None for a radio map.

    Reads no values. BadInput if an axis is too long.
    """
    for name in VARIABLES:
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
    if not _are_powers(dataset.attrs.get(POWERS, "{}")):
        return (f"the attribute {POWERS} is {str(dataset.attrs[POWERS])[:60]!r}, not powers of "
                f"devices within {MAX_LEVEL_DB:g} dBm, such as {{\"d0\": 20.0}}")
    for name, most in (("latitude", 90), ("longitude", 180)):
        if abs(dataset.attrs.get(f"origin_{name}_deg", 0.0)) > most:
            return f"the attribute origin_{name}_deg is not within {most} degrees of 0"
    return None


def _are_powers(text: object) -> bool:
    """Return whether a text is JSON of powers [dBm] by device name."""
    try:
        powers_dbm = parse_json(str(text), POWERS)
    except BadInput:
        return False
    return isinstance(powers_dbm, dict) and all(
        type(each) in (int, float) and abs(each) <= MAX_LEVEL_DB for each in powers_dbm.values())


def axis_problem(dataset: xr.Dataset) -> str | None:
    """Check coordinates, ground heights and device names; return the first fault, or None."""
    for axis in "xyz":
        values = dataset[axis].values
        if (values.dtype.kind not in "iuf" or not np.isfinite(values).all()
                or not (np.diff(values) > 0).all()):
            return f"the coordinate {axis} must hold finite numbers in ascending order [m]"
        if max(-float(values[0]), float(values[-1])) > MAX_POSITION_M or (
                len(values) > 1 and np.diff(values).min() < MIN_STEP_M):
            return (f"the coordinate {axis} must lie within {MAX_POSITION_M:,.0f} m of 0, with "
                    f"steps of at least {MIN_STEP_M:g} m")
    if GROUND in dataset and not (np.abs(dataset[GROUND].values) <= MAX_POSITION_M).all():
        return f"{GROUND} must hold finite heights within {MAX_POSITION_M:,.0f} m of 0"
    names = dataset["device"].values.astype(str)
    unique, count = np.unique(names, return_counts=True)
    if len(unique) < len(names):
        return f"two devices have one name, {str(unique[count > 1][0])[:MAX_NAME]!r}"
    for name in names.tolist():
        if not name.isprintable() or not 0 < len(name) <= MAX_NAME:
            return (f"device name {name[:MAX_NAME]!r} is empty, longer than {MAX_NAME} "
                    "characters, or has some that cannot be printed")
    return None


def _values_problem(dataset: xr.Dataset) -> str | None:
    """Check gains, sigmas and lines of sight, chunk by chunk; return the first fault, or None."""
    names = [name for name in VARIABLES if name in dataset]
    regions = {name: list(_regions(dataset[name])) for name in names}
    with progress("checking the map", total=sum(map(len, regions.values()))) as advance:
        for name in names:
            for where in regions[name]:
                problem = _part_problem(name, dataset[name][where].values)
                if problem:
                    return problem
                advance()
    return None


def _part_problem(name: str, values: np.ndarray) -> str | None:
    """Check values of the variable `name`; return the first fault, or None."""
    if name == "los":
        is_right = values.dtype == bool or np.isin(values, (0, 1)).all()
        return None if is_right else "los holds other values than 0 and 1"
    low_db, high_db = np.fmin.reduce(values, axis=None), np.fmax.reduce(values, axis=None)
    if name == "sigma_db":
        if low_db < 0:
            return "sigma_db is negative somewhere"
        if high_db > MAX_SIGMA_DB:
            return f"sigma_db is above {MAX_SIGMA_DB:g} dB somewhere"
        return None
    if np.isinf(low_db) or np.isinf(high_db):
        return "gain_db is infinite somewhere; where nothing is detected it must be NaN"
    if low_db < GAIN_RANGE_DB[0] or high_db > GAIN_RANGE_DB[1]:
        return (f"gain_db goes from {low_db:g} to {high_db:g} dB; allowed is "
                f"{GAIN_RANGE_DB[0]:g} to {GAIN_RANGE_DB[1]:g}")
    return None


def _regions(values: xr.DataArray) -> Iterator[tuple[slice, ...]]:
    """Cut an array into slices of whole chunks of its file, joined up to `BLOCK_VALUES` values."""
    encoding: dict[Any, Any] = values.encoding
    stored = encoding.get("chunks") or encoding.get("chunksizes") or (1,) * values.ndim
    step = [min(part, size) for part, size in zip(stored, values.shape)]
    for axis in reversed(range(values.ndim)):
        fits = max(BLOCK_VALUES // math.prod(step), 1)
        step[axis] = min(step[axis] * fits, values.shape[axis])
    return (tuple(slice(start, start + length) for start, length in zip(starts, step))
            for starts in product(*(range(0, size, length)
                                    for size, length in zip(values.shape, step))))


def _require_zarr(path: Path) -> Any:
    """Import zarr; raise BadInput if it is not installed."""
    return optional_package(
        "zarr", f"{path}: Zarr needs the package zarr, which is not installed; install it with "
                "`pip install 'radiotwin[zarr]'`, or take a .nc file")


def _write_zarr(top: xr.Dataset, dtypes: dict[str, np.dtype], blocks: Iterable[MapBlock],
               path: Path | str) -> None:
    """Write a radio map as a Zarr folder by the CF conventions; see `write_parts`.

    Each block is a chunk, so one block is in memory at a time.
    """
    path = Path(path)
    check_target(path)
    zarr = _require_zarr(path)
    shape = tuple(top.sizes[name] for name in DIMS)
    first = next(parts_of(shape[1:]))
    placed = with_cf(top)
    placed["device"] = placed["device"].astype(str)
    with (atomic_folder(path) as folder, warnings.catch_warnings(),
          zarr.config.set({"array.write_empty_chunks": True})):
        warnings.simplefilter("ignore", zarr.errors.UnstableSpecificationWarning)  # of names
        store = zarr.storage.LocalStore(folder)
        placed.to_zarr(store, mode="w-", zarr_format=3, consolidated=False,
                       encoding={name: {"_FillValue": None} for name in ("x", "y", "z", GROUND)
                                 if name in placed.variables})
        group = zarr.open_group(store, mode="r+", use_consolidated=False)
        grid = {"grid_mapping": GRID_MAPPING} if GRID_MAPPING in placed else {}
        arrays = {name: group.create_array(
            name, shape=shape, chunks=(1, *(part.stop for part in first)), dtype=dtype,
            fill_value=dtype.type("nan") if dtype.kind == "f" else dtype.type(0),
            compressors=zarr.codecs.ZstdCodec(level=_LEVEL), dimension_names=DIMS,
            attributes=ATTRIBUTES.get(name, {}) | grid)
            for name, dtype in dtypes.items()}
        for block in blocks:
            for name, values in block.values.items():
                arrays[name][block.where] = values.astype(dtypes[name], copy=False)


@contextmanager
def _open_zarr(path: Path) -> Iterator[xr.Dataset]:
    """Check and open a Zarr folder, values read on access; warns if pieces of it are missing."""
    zarr = _require_zarr(path)
    missing = check_zarr(path, _KNOWN, MAP_STREAM_VALUES)
    if any(missing.values()):
        warnings.warn(f"{path} lacks {sum(missing.values()):,} pieces of its arrays "
                      f"({', '.join(name for name, count in missing.items() if count)}), which "
                      "stand for not detected: if it is a copy, see whether it is whole",
                      stacklevel=5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", zarr.errors.UnstableSpecificationWarning)
        opened = xr.open_zarr(zarr.storage.LocalStore(path, read_only=True), chunks=None,
                              consolidated=False, zarr_format=3)
    names = opened["device"].values.tolist() if "device" in opened.coords else []
    opened = opened.assign_coords(device=("device", np.array(names, dtype=object)))
    opened.attrs = {name: np.array(value) if isinstance(value, list) else value
                    for name, value in opened.attrs.items()}
    yield opened


@contextmanager
def open_dataset(path: Path) -> Iterator[xr.Dataset]:
    """Open a radio map, NetCDF-4 or Zarr, of which values are read on access.

    All values are read once, in parts, to check them. BadInput if there is no such file, or it is
    damaged, or no radio map.
    """
    with _open_unchecked(path) as opened:
        dataset = _checked_map(path, opened)
        if dataset["los"].dtype != bool:
            dataset["los"] = _as_bool(dataset["los"].variable)
        yield dataset


def load_dataset(path: Path) -> xr.Dataset:
    """Read a radio map, NetCDF-4 or Zarr, into memory; BadInput also if it is too large."""
    with _open_unchecked(path) as opened:
        dataset = _checked_map(path, opened, is_loaded=True)
    dataset["los"] = dataset["los"].astype(bool)
    return dataset


@contextmanager
def _open_unchecked(path: Path) -> Iterator[xr.Dataset]:
    """Open a NetCDF or Zarr file that cannot crash its library; the content is not checked yet."""
    if not path.exists():
        raise BadInput(f"{path} does not exist; {MAKERS} makes a radio map")
    with ExitStack() as stack:
        with _errors_as_bad_input(path):
            if is_zarr(path):
                opened = stack.enter_context(_open_zarr(path))
            else:
                file = stack.enter_context(open_input(path, "radio map (.nc, .zarr)"))
                check_hdf5(file, path)
                opened = stack.enter_context(xr.open_dataset(file, engine="h5netcdf"))
        yield opened


def _checked_map(path: Path, opened: xr.Dataset, is_loaded: bool = False) -> xr.Dataset:
    """Check an opened dataset with its values; return the radio map without CF attributes."""
    with _errors_as_bad_input(path):
        problem, dataset = form_problem(opened), opened
        if problem is None:
            names = [name for name in (*VARIABLES, *DIMS, GROUND) if name in opened.variables]
            dataset = opened[names].set_coords([name for name in names if name == GROUND])
            if is_loaded:
                MAP_VALUES.check(dataset["gain_db"].size, path)
                dataset = dataset.load()
            problem = axis_problem(dataset) or _values_problem(dataset)
    if problem:
        raise BadInput(f"{path} is not a radio map: {problem}; {MAKERS} makes one")
    return without_cf(dataset.drop_encoding())


@contextmanager
def _errors_as_bad_input(path: Path) -> Iterator[None]:
    """Turn any exception of the reading libraries into BadInput."""
    try:
        yield
    except BadInput:
        raise
    except Exception as error:  # OSError, KeyError or ValueError, by the library and the damage
        kind = "Zarr folder" if is_zarr(path) else "NetCDF-4 file"
        raise BadInput(f"{path} is not a readable {kind} ({error}); make it again") from None


def _as_bool(stored: xr.Variable) -> xr.Variable:
    """Return a variable of 0 and 1 as booleans, converted on access."""
    marked = stored.copy(deep=False)
    marked.attrs["dtype"] = "bool"  # as xarray marks booleans in files
    return decode_cf_variable("los", marked)


def check_target(path: Path | str) -> None:
    """Raise BadInput unless a radio map can be written to a path; call it before long work."""
    if is_zarr(path):
        _require_zarr(Path(path))
        require_folder(path, ("*",), mark=METADATA)
    else:
        require_writable(path)


def size_of(shape: tuple[int, ...], devices: int) -> str:
    """Say how many links, parts and gigabytes on disk a map (z, y, x) of `devices` devices has."""
    parts = list(parts_of(shape))
    values = max(math.prod(each.stop - each.start for each in part) for part in parts)
    return (f"{devices * math.prod(shape):,} links in {devices * len(parts):,} parts, of which one "
            f"({values:,} links) is in memory at a time; at most "
            f"{devices * math.prod(shape) * _LINK_BYTES / 1e9:.2g} GB on the disk")


def write_parts(top: xr.Dataset, dtypes: dict[str, np.dtype], blocks: Iterable[MapBlock],
                path: Path | str) -> None:
    """Write a radio map block by block, atomically: `NAME.zarr` as a Zarr folder, else NetCDF-4.

    `top` has coordinates and attributes, `dtypes` are of the variables, by name; all blocks follow
    in C order. BadInput if `path` cannot be written, RunFailed if the disk is full or failed; an
    older map is then unchanged.
    """
    (_write_zarr if is_zarr(path) else write_blocks)(top, dtypes, blocks, path)
