"""Radio maps as Zarr folders, which are written and read piece by piece."""

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from radiotwin.budgets import MAP_STREAM_VALUES
from radiotwin.errors import BadInput
from radiotwin.files import atomic_folder
from radiotwin.map_file import (
    ATTRIBUTES,
    DIMS,
    GRID_MAPPING,
    GROUND,
    VARIABLES,
    MapBlock,
    parts_of,
    with_cf,
)
from radiotwin.zarr_check import METADATA, check_zarr

_KNOWN = (*VARIABLES, *DIMS, GROUND, GRID_MAPPING)
_LEVEL = 3  # of Zstandard: its default


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
