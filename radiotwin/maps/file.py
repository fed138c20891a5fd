"""Radio maps in NetCDF and Zarr files: read, checked, and written block by block.

Radio maps of strangers: checked, then in memory, or open to be read in parts.

Write a radio map in the format of its file name, and say beforehand what that takes.

Radio maps as Zarr folders, which are written and read piece by piece.
"""

import math
import warnings
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.conventions import decode_cf_variable

from radiotwin.errors import BadInput
from radiotwin.io.budgets import MAP_STREAM_VALUES, MAP_VALUES
from radiotwin.io.files import atomic_folder, require_writable
from radiotwin.io.hdf5 import check_hdf5
from radiotwin.io.inputs import open_input
from radiotwin.io.zarr_check import METADATA, check_zarr
from radiotwin.maps.checks import axis_problem, form_problem, value_problem
from radiotwin.maps.form import (
    ATTRIBUTES,
    DIMS,
    GRID_MAPPING,
    GROUND,
    VARIABLES,
    MapBlock,
    is_zarr,
    parts_of,
    with_cf,
    without_cf,
    write_blocks,
)

_KNOWN = (*VARIABLES, *DIMS, GROUND, GRID_MAPPING)
_LEVEL = 3  # of Zstandard: its default
MAKERS = "`radiotwin trace` or `radiotwin map`"
_LINK_BYTES = 9  # gain and standard deviation in single precision, line of sight, not compressed


def require_zarr(path: Path) -> Any:
    """Return the package zarr.

    Args:
        path: of the map, for the message.

    Raises:
        BadInput: it is not installed.
    """
    try:
        import zarr
        import zarr.codecs
        import zarr.storage
    except ImportError:
        raise BadInput(f"{path}: Zarr needs the package zarr, which is not installed; install it "
                       "with `pip install 'radiotwin[zarr]'`, or take a .nc file") from None
    return zarr


def check_zarr_target(path: Path) -> None:
    """Check that a Zarr folder can be written under a name.

    Args:
        path: of the folder.

    Raises:
        BadInput: zarr is not installed, or `path` is a file, or a folder with something else.
    """
    require_zarr(path)
    if path.exists() and not path.is_dir():
        raise BadInput(f"{path} is a file; a radio map in Zarr is a folder: choose another name")
    if path.is_dir() and any(path.iterdir()) and not (path / METADATA).is_file():
        raise BadInput(f"{path} is a folder with other content than a radio map; choose another "
                       "name")
    with atomic_folder(path.with_name(f"{path.name}.radiotwin-try")) as folder:
        pass
    folder.with_name(f"{path.name}.radiotwin-try").rmdir()


def write_zarr(top: xr.Dataset, dtypes: dict[str, np.dtype], blocks: Iterable[MapBlock],
               path: Path | str) -> None:
    """Write a radio map as a Zarr folder by the CF conventions, atomically.

    Each block is a piece of its own, so that one block is in memory. The folder is written beside
    its place and renamed.

    Args:
        top: coordinates and attributes of the map.
        dtypes: of its variables, by name.
        blocks: of it, as `parts_of` cuts them.
        path: of the folder; an older map there is replaced.

    Raises:
        BadInput: zarr is not installed, or `path` cannot be written or is no map's.
        RunFailed: the disk is full or failed; an older map is unchanged.
    """
    path = Path(path)
    check_zarr_target(path)
    zarr = require_zarr(path)
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
def open_zarr(path: Path) -> Iterator[xr.Dataset]:
    """Open a Zarr folder after checking it; values stay in it until they are asked for.

    Args:
        path: of the folder.

    Raises:
        BadInput: as `check_zarr`, or zarr is not installed.
    """
    zarr = require_zarr(path)
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
    """Open a radio map whose values stay in its file until they are asked for.

    All of it has been read once, in parts, and checked.

    Args:
        path: of a NetCDF-4 file, or of a Zarr folder.

    Yields:
        the dataset, which can be read until the context ends.

    Raises:
        BadInput: no such file, damaged, or not a radio map.
    """
    with _opened(path) as opened:
        dataset = _prepared(path, opened)
        if dataset["los"].dtype != bool:
            dataset["los"] = _as_bool(dataset["los"].variable)
        yield dataset


def load_dataset(path: Path) -> xr.Dataset:
    """Read a radio map into memory.

    Args:
        path: of a NetCDF-4 file, or of a Zarr folder.

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
                opened = stack.enter_context(open_zarr(path))
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
            problem = axis_problem(dataset) or value_problem(dataset)
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

    Args:
        path: of the file; `NAME.zarr` of a Zarr folder.

    Raises:
        BadInput: it cannot be written, or something else is there.
        RunFailed: the disk is full.
    """
    if is_zarr(path):
        check_zarr_target(Path(path))
    else:
        require_writable(path)


def size_of(shape: tuple[int, ...], devices: int) -> str:
    """Return what a map takes that is written part by part, for people.

    Args:
        shape: numbers of positions along z, y and x.
        devices: number of devices.
    """
    parts = list(parts_of(shape))
    values = max(math.prod(each.stop - each.start for each in part) for part in parts)
    return (f"{devices * math.prod(shape):,} links in {devices * len(parts):,} parts, of which one "
            f"({values:,} links) is in memory at a time; at most "
            f"{devices * math.prod(shape) * _LINK_BYTES / 1e9:.2g} GB on the disk")


def write_parts(top: xr.Dataset, dtypes: dict[str, np.dtype], blocks: Iterable[MapBlock],
                path: Path | str) -> None:
    """Write a radio map block by block, atomically.

    Args:
        top: coordinates and attributes of the map.
        dtypes: of its variables, by name.
        blocks: of it, in the order of an array.
        path: `NAME.zarr` for a Zarr folder; any other name for NetCDF-4.

    Raises:
        BadInput: `path` cannot be written.
        RunFailed: the disk is full or failed; an older map is unchanged.
    """
    (write_zarr if is_zarr(path) else write_blocks)(top, dtypes, blocks, path)
