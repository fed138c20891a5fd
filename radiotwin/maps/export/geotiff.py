"""Write radio maps as GeoTIFF, with a band for each device and altitude, for GIS programs."""

import errno
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from radiotwin.errors import BadInput, optional_package
from radiotwin.geo import local_crs
from radiotwin.io.files import atomic_file, atomic_path
from radiotwin.io.forms import Origin
from radiotwin.maps.file import MapBlock, MapStream
from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene import Scene

MAX_BANDS = 65_535  # of the format
_WHOLE_VALUES = 2**24  # up to so many values a map is written whole, bands interleaved by pixel
GDAL_OPTIONS = {"GTIFF_WRITE_TOWGS84": "NO", "GDAL_CACHEMAX": 2**26}  # the cache in bytes


def write_geotiff(radio_map: RadioMap | MapStream, scene: Scene, path: Path) -> None:
    """Write gains [dB] in single precision, north up, with NaN (nodata) where not detected.

    A cell lies around its lattice position. Bands are named `DEVICE at Z m`, devices first. The
    coordinate reference system is the local frame of the scene's origin; without an origin there
    is none, and coordinates are local metres.

    Raises:
        BadInput: rasterio is not installed, or the lattice is not regular.
    """
    rasterio = require_rasterio(path)
    lattice, step_m = radio_map.lattice, cell_size_m(radio_map, scene)
    names = [(device, altitude_m) for device in radio_map.devices for altitude_m in lattice.z_m]
    if len(names) > MAX_BANDS:
        raise BadInput(f"{path}: GeoTIFF has at most {MAX_BANDS:,} bands, and the map has "
                       f"{len(names):,} devices and altitudes; choose some with --devices or "
                       "--altitudes, or write .nc or .csv")
    levels, height, width = lattice.shape
    place = georeference(lattice.x_m, lattice.y_m, step_m, scene.config.origin)
    above = "" if lattice.ground_m is None else " above the ground"
    attributes = {name: str(value) for name, value in radio_map.header.attrs.items()}
    profile = {"driver": "GTiff", "dtype": "float32", "count": len(names), "nodata": np.nan,
               "height": height, "width": width, "compress": "deflate", **place}

    def describe(file: Any) -> None:
        file.update_tags(**attributes)
        file.units = ["dB"] * len(names)
        for number, (device, altitude_m) in enumerate(names, start=1):
            file.set_band_description(number, f"{device} at {altitude_m:g} m{above}")
            file.update_tags(number, device=device, z_m=f"{altitude_m:g}")

    with rasterio.Env(**GDAL_OPTIONS):
        if len(names) * height * width > _WHOLE_VALUES:
            _write_parts(radio_map, path, profile, describe)
            return
        bands = np.empty((len(names), height, width), np.float32)
        for block in radio_map.blocks():
            bands[_bands(block, levels), *_window(block, height)] = _north_up(block)
        # GDAL hides errors of a full disk: it writes to memory, and we to the disk.
        with rasterio.MemoryFile(ext=".tif") as memory:
            with memory.open(**profile) as file:
                file.write(bands)
                describe(file)
            with atomic_file(path) as out:
                out.write(memory.getbuffer())


def _write_parts(radio_map: RadioMap | MapStream, path: Path, profile: dict[str, Any],
                 describe: Callable[[Any], None]) -> None:
    """Write a large map to the disk block by block.

    GDAL hides errors of a full disk, so every block is read again and its checksum compared.
    """
    import rasterio
    from rasterio.windows import Window

    levels, height, sums = len(radio_map.lattice.z_m), profile["height"], []
    with atomic_path(path) as temporary:
        with rasterio.open(temporary, "w", interleave="band", bigtiff="if_safer",
                           **profile) as file:
            for block in radio_map.blocks():
                values, bands, window = _north_up(block), _bands(block, levels), _window(block,
                                                                                         height)
                indexes = list(range(bands.start + 1, bands.stop + 1))
                file.write(values, indexes=indexes, window=Window.from_slices(*window))
                sums.append((indexes, window, zlib.crc32(values.data)))
            describe(file)
        try:
            with rasterio.open(temporary) as file:
                is_whole = all(zlib.crc32(file.read(indexes, window=Window.from_slices(*window)))
                               == expected for indexes, window, expected in sums)
        except rasterio.errors.RasterioIOError:
            is_whole = False
        if not is_whole:
            raise OSError(errno.ENOSPC, "the file could not be written as a whole")


def require_rasterio(path: Path) -> Any:
    """Import rasterio; raise BadInput that names the file to write if it is not installed."""
    return optional_package(
        "rasterio", f"{path} is written with the package rasterio, which is not installed; install "
                    "it with `pip install 'radiotwin[gis]'`, or write .nc or .csv")


def require_origin(scene: Scene, purpose: str) -> Origin:
    """Return a scene's origin; raise BadInput that begins with the purpose if it has none."""
    if scene.config.origin is None:
        raise BadInput(f"{purpose} the position of the scene, and {scene.folder / 'scene.toml'} "
                       "has no [origin]; add one with latitude_deg and longitude_deg of x = y = 0")
    return scene.config.origin


def georeference(x_m: np.ndarray, y_m: np.ndarray, step_m: float,
                 origin: Origin | None) -> dict[str, Any]:
    """Return rasterio's `crs` and `transform` of a raster with cells of `step_m`, north up.

    `x_m` and `y_m` are middles of the cells, ascending [m]. Without an origin there is no reference
    system, and coordinates are local metres.
    """
    import rasterio

    crs = None if origin is None else rasterio.crs.CRS.from_string(local_crs(origin))
    return {"crs": crs, "transform": rasterio.Affine(step_m, 0, x_m[0] - step_m / 2,
                                                     0, -step_m, y_m[-1] + step_m / 2)}


def _north_up(block: MapBlock) -> np.ndarray:
    """Return the gains (bands, rows, columns) of a block [dB], northern row first."""
    gain_db = block.values["gain_db"]
    values = gain_db.reshape(-1, *gain_db.shape[2:])[:, ::-1]
    return np.ascontiguousarray(values, dtype=np.float32)


def _bands(block: MapBlock, levels: int) -> slice:
    """Return the bands of a block as indices from 0; levels vary fastest."""
    row, z, _, _ = block.where
    first = row.start * levels + z.start
    return slice(first, first + z.stop - z.start)


def _window(block: MapBlock, height: int) -> tuple[slice, slice]:
    """Return the rows and columns of a block in a raster with `height` rows, north up."""
    _, _, y, x = block.where
    return slice(height - y.stop, height - y.start), x


def cell_size_m(radio_map: RadioMap | MapStream, scene: Scene) -> float:
    """Return the side of a map's cells [m]: its lattice's step, or the scene's for one position.

    BadInput if the positions are not evenly spaced.
    """
    step_m = radio_map.lattice.step_m or scene.config.lattice.step_m
    for axis_m in (radio_map.lattice.x_m, radio_map.lattice.y_m):
        if not np.allclose(np.diff(axis_m), step_m, rtol=0, atol=1e-6 * step_m):
            raise BadInput("the map's positions are not equally far apart, as a picture needs; "
                           "write .nc or .csv")
    return step_m
