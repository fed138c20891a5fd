"""Radio maps in NetCDF and Zarr files: checked, read, and written block by block.

A file may be a stranger's: its form is checked before its values are read, and its values in parts.
Then it is in memory, or stays open to be read in parts.
"""

import math
import warnings
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.conventions import decode_cf_variable

from radiotwin.errors import BadInput, optional_package
from radiotwin.io.array_stores import METADATA, check_hdf5, check_zarr
from radiotwin.io.budgets import DEVICES, MAP_AXIS, MAP_STREAM_VALUES, MAP_VALUES
from radiotwin.io.files import atomic_folder, require_folder, require_writable
from radiotwin.io.forms import MAX_NAME, MAX_POSITION_M
from radiotwin.io.inputs import open_input, parse_json
from radiotwin.links.cell_limits import MAX_LEVEL_DB
from radiotwin.maps.form import (
    ATTRIBUTES,
    BLOCK_VALUES,
    DIMS,
    GAIN_RANGE_DB,
    GRID_MAPPING,
    GROUND,
    MAX_SIGMA_DB,
    POWERS,
    VARIABLES,
    MapBlock,
    is_zarr,
    parts_of,
    with_cf,
    without_cf,
    write_blocks,
)
from radiotwin.runtime.console import progress

MIN_STEP_M = 1e-3
_NUMBERS = ("frequency_hz", "gain_limit_db", "origin_latitude_deg", "origin_longitude_deg",
            "origin_altitude_m", "shadowing_share", "shadowing_length_m")  # among the attributes
_KNOWN = (*VARIABLES, *DIMS, GROUND, GRID_MAPPING)
_LEVEL = 3  # of Zstandard: its default
MAKERS = "`radiotwin trace` or `radiotwin map`"
_LINK_BYTES = 9  # gain and standard deviation in single precision, line of sight, not compressed


def form_problem(dataset: xr.Dataset) -> str | None:
    """Return the first reason why a dataset is not a radio map that is seen without its values."""
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
    """Return whether an attribute holds powers [dBm] by name, as JSON."""
    try:
        powers_dbm = parse_json(str(text), POWERS)
    except BadInput:
        return False
    return isinstance(powers_dbm, dict) and all(
        type(each) in (int, float) and abs(each) <= MAX_LEVEL_DB for each in powers_dbm.values())


def axis_problem(dataset: xr.Dataset) -> str | None:
    """Return the first reason why the axes of a dataset cannot be those of a radio map."""
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


def _value_problem(dataset: xr.Dataset) -> str | None:
    """Return the first reason why the values of a dataset cannot be those of a radio map.

    They are read in parts, each of whole pieces as the file stores them.
    """
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
    """Return slices that cover an array, of whole pieces of its file; small pieces are joined."""
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
    """Return the package zarr, which writes or reads a map."""
    return optional_package(
        "zarr", f"{path}: Zarr needs the package zarr, which is not installed; install it with "
                "`pip install 'radiotwin[zarr]'`, or take a .nc file")


def _check_zarr_target(path: Path) -> None:
    """Raise BadInput unless a Zarr folder can be written under a name."""
    _require_zarr(path)
    require_folder(path, ("*",), mark=METADATA)


def _write_zarr(top: xr.Dataset, dtypes: dict[str, np.dtype], blocks: Iterable[MapBlock],
               path: Path | str) -> None:
    """Write a radio map as a Zarr folder by the CF conventions; arguments as of `write_parts`.

    Each block is a piece of its own, so that one block is in memory. The folder is written beside
    its place and renamed.
    """
    path = Path(path)
    _check_zarr_target(path)
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
    """Open a Zarr folder after checking it; values stay in it until they are asked for."""
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
    """Open a radio map, NetCDF-4 or Zarr, whose values stay in its file until they are asked for.

    All of it has been read once, in parts, and checked. The dataset can be read until the context
    ends.

    Raises:
        BadInput: no such file, damaged, or not a radio map.
    """
    with _opened(path) as opened:
        dataset = _prepared(path, opened)
        if dataset["los"].dtype != bool:
            dataset["los"] = _as_bool(dataset["los"].variable)
        yield dataset


def load_dataset(path: Path) -> xr.Dataset:
    """Read a radio map, NetCDF-4 or Zarr, into memory.

    Raises:
        BadInput: as `open_dataset`, or it is too large to be in memory.
    """
    with _opened(path) as opened:
        dataset = _prepared(path, opened, is_loaded=True)
    dataset["los"] = dataset["los"].astype(bool)
    return dataset


@contextmanager
def _opened(path: Path) -> Iterator[xr.Dataset]:
    """Open a file as it is, after the checks that its library needs."""
    if not path.exists():
        raise BadInput(f"{path} does not exist; {MAKERS} makes a radio map")
    with ExitStack() as stack:
        with _reported(path):
            if is_zarr(path):
                opened = stack.enter_context(_open_zarr(path))
            else:
                file = stack.enter_context(open_input(path, "radio map (.nc, .zarr)"))
                check_hdf5(file, path)
                opened = stack.enter_context(xr.open_dataset(file, engine="h5netcdf"))
        yield opened


def _prepared(path: Path, opened: xr.Dataset, is_loaded: bool = False) -> xr.Dataset:
    """Return the map in a dataset, as it is in memory, once all of it has been checked."""
    with _reported(path):
        problem, dataset = form_problem(opened), opened
        if problem is None:
            names = [name for name in (*VARIABLES, *DIMS, GROUND) if name in opened.variables]
            dataset = opened[names].set_coords([name for name in names if name == GROUND])
            if is_loaded:
                MAP_VALUES.check(dataset["gain_db"].size, path)
                dataset = dataset.load()
            problem = axis_problem(dataset) or _value_problem(dataset)
    if problem:
        raise BadInput(f"{path} is not a radio map: {problem}; {MAKERS} makes one")
    return without_cf(dataset.drop_encoding())


@contextmanager
def _reported(path: Path) -> Iterator[None]:
    """Turn what the libraries raise for a damaged file into a message."""
    try:
        yield
    except BadInput:
        raise
    except Exception as error:  # OSError, KeyError or ValueError, by the library and the damage
        kind = "Zarr folder" if is_zarr(path) else "NetCDF-4 file"
        raise BadInput(f"{path} is not a readable {kind} ({error}); make it again") from None


def _as_bool(stored: xr.Variable) -> xr.Variable:
    """Return 0 and 1 as booleans, each when it is read."""
    marked = stored.copy(deep=False)
    marked.attrs["dtype"] = "bool"  # as xarray marks booleans in files
    return decode_cf_variable("los", marked)


def check_target(path: Path | str) -> None:
    """Check that a radio map can be written under a name; call it before long work.

    Raises:
        BadInput: it cannot be written, or something else is there.
        RunFailed: the disk is full.
    """
    if is_zarr(path):
        _check_zarr_target(Path(path))
    else:
        require_writable(path)


def size_of(shape: tuple[int, ...], devices: int) -> str:
    """Return, for people, the size of a map of shape (z, y, x) that is written part by part."""
    parts = list(parts_of(shape))
    values = max(math.prod(each.stop - each.start for each in part) for part in parts)
    return (f"{devices * math.prod(shape):,} links in {devices * len(parts):,} parts, of which one "
            f"({values:,} links) is in memory at a time; at most "
            f"{devices * math.prod(shape) * _LINK_BYTES / 1e9:.2g} GB on the disk")


def write_parts(top: xr.Dataset, dtypes: dict[str, np.dtype], blocks: Iterable[MapBlock],
                path: Path | str) -> None:
    """Write a radio map block by block, atomically: `NAME.zarr` as a Zarr folder, else NetCDF-4.

    Args:
        top: coordinates and attributes of the map.
        dtypes: of its variables, by name.
        blocks: of it, in the order of an array.
        path: of the file or folder.

    Raises:
        BadInput: `path` cannot be written.
        RunFailed: the disk is full or failed; an older map is unchanged.
    """
    (_write_zarr if is_zarr(path) else write_blocks)(top, dtypes, blocks, path)
