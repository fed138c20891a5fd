"""Radio maps of strangers: checked, then in memory, or open to be read in parts."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import xarray as xr
from xarray.conventions import decode_cf_variable

from radiotwin.budgets import MAP_VALUES
from radiotwin.errors import BadInput
from radiotwin.hdf5 import check_hdf5
from radiotwin.inputs import open_input
from radiotwin.map_checks import axis_problem, form_problem, value_problem
from radiotwin.map_file import DIMS, GROUND, VARIABLES, is_zarr, without_cf
from radiotwin.map_zarr import open_zarr

MAKERS = "`radiotwin trace` or `radiotwin map`"


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
