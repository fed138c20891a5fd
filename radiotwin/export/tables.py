"""Radio maps as numbers: NetCDF, Zarr, CSV and NumPy."""

from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.cells import write_csv as write_table
from radiotwin.files import atomic_file
from radiotwin.map_file import MapBlock, MapStream
from radiotwin.map_writing import write_parts
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.scene.lattice import Lattice


def write_dataset(radio_map: RadioMap | MapStream, scene: Scene, path: Path) -> None:
    """Write NetCDF-4 or Zarr after the CF conventions, for xarray and `RadioMap.load`.

    Args:
        radio_map: map to write.
        scene: whose origin places the map on the globe.
        path: of the .nc file, or the .zarr folder.
    """
    placed = radio_map.placed(scene.config.origin)
    if isinstance(placed, RadioMap):
        placed.write(path)
        return
    dtypes = {name: np.dtype(bool if name == "los" else np.float32) for name in placed.variables}
    write_parts(placed.header, dtypes, placed.blocks(), path)


def write_csv(radio_map: RadioMap | MapStream, scene: Scene, path: Path) -> None:
    """Write CSV with one row a link.

    Columns: device, x_m, y_m, z_m, gain_db (empty: not detected), los, and sigma_db of a learned
    map. Nine digits restore single precision to the bit.

    Args:
        radio_map: map to write.
        scene: not used.
        path: of the .csv file.
    """
    devices, lattice, is_first = radio_map.devices, radio_map.lattice, True
    with atomic_file(path) as file:
        for block in radio_map.blocks():
            table = _rows(block, devices, lattice)
            write_table(table, file, "%.9g", header=is_first)
            is_first = False


def _rows(block: MapBlock, devices: list[str], lattice: Lattice) -> pd.DataFrame:
    """Return the links of a block, one a row."""
    row, z, y, x = block.where
    z_m, y_m, x_m = np.meshgrid(lattice.z_m[z], lattice.y_m[y], lattice.x_m[x], indexing="ij")
    names = np.repeat(np.array(devices[row], dtype=object), z_m.size)
    columns = {"device": names, "x_m": x_m.ravel(), "y_m": y_m.ravel(), "z_m": z_m.ravel()}
    if lattice.ground_m is not None:
        columns |= {"z_m": (z_m + lattice.ground_m[y, x]).ravel(), "above_ground_m": z_m.ravel()}
    return pd.DataFrame(columns | {name: values.astype(bool if name == "los" else np.float32,
                                                       copy=False).ravel()
                                   for name, values in block.values.items()})


def write_numpy(radio_map: RadioMap, scene: Scene, path: Path) -> None:
    """Write NumPy arrays, which `numpy.load` reads without pickling.

    Arrays: gain_db, los and sigma_db (device, z, y, x), device, z_m, y_m, x_m; and ground_m (y, x)
    where z_m is above the ground.

    Args:
        radio_map: map to write.
        scene: not used.
        path: of the .npz file.
    """
    lattice, dataset = radio_map.lattice, radio_map.dataset
    arrays = {"device": np.array(radio_map.devices), "z_m": lattice.z_m, "y_m": lattice.y_m,
              "x_m": lattice.x_m}
    if lattice.ground_m is not None:
        arrays |= {"ground_m": lattice.ground_m}
    arrays |= {name: dataset[name].values for name in radio_map.variables}
    with atomic_file(path) as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # no array is called allow_pickle
