"""Radio maps as numbers: NetCDF, CSV and NumPy."""

from pathlib import Path

import numpy as np

from radiotwin.cells import write_csv as write_table
from radiotwin.files import atomic_path
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene


def write_netcdf(radio_map: RadioMap, scene: Scene, path: Path) -> None:
    """Write NetCDF-4 after the CF conventions, for `xarray.open_dataset` and `RadioMap.read`.

    Args:
        radio_map: map to write.
        scene: whose origin places the map on the globe.
        path: of the .nc file.
    """
    radio_map.placed(scene.config.origin).write(path)


def write_csv(radio_map: RadioMap, scene: Scene, path: Path) -> None:
    """Write CSV with one row a link.

    Columns: device, x_m, y_m, z_m, gain_db (empty: not detected), los, and sigma_db of a learned
    map. Nine digits restore single precision to the bit.

    Args:
        radio_map: map to write.
        scene: not used.
        path: of the .csv file.
    """
    table = radio_map.dataset.to_dataframe().reset_index()
    table = table.rename(columns={axis: f"{axis}_m" for axis in "xyz"})
    first = ["device", "x_m", "y_m", "z_m", "gain_db"]
    rest = [name for name in table.columns if name not in first]
    with atomic_path(path) as temporary:
        write_table(table[first + rest], temporary, "%.9g")


def write_numpy(radio_map: RadioMap, scene: Scene, path: Path) -> None:
    """Write NumPy arrays, which `numpy.load` reads without pickling.

    Arrays: gain_db, los and sigma_db (device, z, y, x), device, z_m, y_m, x_m.

    Args:
        radio_map: map to write.
        scene: not used.
        path: of the .npz file.
    """
    lattice, dataset = radio_map.lattice, radio_map.dataset
    arrays = {"device": np.array(radio_map.devices), "z_m": lattice.z_m, "y_m": lattice.y_m,
              "x_m": lattice.x_m}
    arrays |= {name: dataset[name].values for name in ("gain_db", "los", "sigma_db")
               if name in dataset}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # no array is called allow_pickle
