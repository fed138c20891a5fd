"""Radio maps as GeoTIFF: one band for each device and altitude, for GIS programs."""

from pathlib import Path

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.files import atomic_path
from radiotwin.geodesy import local_crs
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene


def write_geotiff(radio_map: RadioMap, scene: Scene, path: Path) -> None:
    """Write gains [dB] in single precision, north up, with NaN (nodata) where not detected.

    A cell lies around its lattice position. Bands are named `DEVICE at Z m`, devices first. The
    coordinate reference system is the local frame of the scene's origin; without an origin there
    is none, and coordinates are local metres.

    Args:
        radio_map: map to write.
        scene: of the map.
        path: of the .tif file.

    Raises:
        BadInput: rasterio is not installed, or the lattice is not regular.
    """
    try:
        import rasterio
    except ImportError:
        raise BadInput(
            f"{path}: GeoTIFF is written with the package rasterio, which is not installed; "
            "install it with `pip install 'radiotwin[gis]'`, or write .nc or .csv") from None
    lattice, gain_db = radio_map.lattice, radio_map.gain_db
    step_m = cell_size_m(radio_map, scene)
    names = [(device, altitude_m) for device in radio_map.devices for altitude_m in lattice.z_m]
    bands = gain_db.reshape(len(names), *gain_db.shape[2:])[:, ::-1]
    origin = scene.config.origin
    crs = None if origin is None else rasterio.crs.CRS.from_string(local_crs(origin))
    transform = rasterio.Affine(step_m, 0, lattice.x_m[0] - step_m / 2,
                                0, -step_m, lattice.y_m[-1] + step_m / 2)
    attributes = {name: str(value) for name, value in radio_map.dataset.attrs.items()}
    with atomic_path(path) as temporary, rasterio.Env(GTIFF_WRITE_TOWGS84="NO"):
        with rasterio.open(
                temporary, "w", driver="GTiff", dtype="float32", count=len(names), nodata=np.nan,
                height=bands.shape[1], width=bands.shape[2], compress="deflate", crs=crs,
                transform=transform) as file:
            file.write(bands)
            file.update_tags(**attributes)
            file.units = ["dB"] * len(names)
            for number, (device, altitude_m) in enumerate(names, start=1):
                file.set_band_description(number, f"{device} at {altitude_m:g} m")
                file.update_tags(number, device=device, z_m=f"{altitude_m:g}")


def cell_size_m(radio_map: RadioMap, scene: Scene) -> float:
    """Return the side of a cell: the lattice's step, or the scene's for a map of one position.

    Args:
        radio_map: map to be drawn in cells.
        scene: of the map.

    Returns:
        The side [m].

    Raises:
        BadInput: the positions are not equally far apart.
    """
    step_m = radio_map.lattice.step_m or scene.config.lattice.step_m
    for axis_m in (radio_map.lattice.x_m, radio_map.lattice.y_m):
        if not np.allclose(np.diff(axis_m), step_m, rtol=0, atol=1e-6 * step_m):
            raise BadInput("the map's positions are not equally far apart, as a picture needs; "
                           "write .nc or .csv")
    return step_m
