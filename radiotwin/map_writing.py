"""Write a radio map in the format of its file name, and say beforehand what that takes."""

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import xarray as xr

from radiotwin.files import require_writable
from radiotwin.map_file import MapBlock, is_zarr, parts_of, write_blocks
from radiotwin.map_zarr import check_zarr_target, write_zarr

_LINK_BYTES = 9  # gain and standard deviation in single precision, line of sight, not compressed


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
