"""Radio maps as numbers: NetCDF, CSV, NumPy."""

from pathlib import Path
from typing import Any

import numpy as np

from radiotwin.files import atomic_path
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene


def write_netcdf(radio_map: RadioMap, scene: Scene, path: Path) -> None:
    """The whole map after the CF conventions; `xarray.open_dataset` reads it, and so does `RadioMap.read`."""
    radio_map.placed(scene.config.origin).write(path)


def write_csv(radio_map: RadioMap, scene: Scene, path: Path) -> None:
    """One row a link: device, x_m, y_m, z_m, gain_db (empty: not detected), los, and sigma_db of a learned map.

    Nine digits bring single precision back to the bit.
    """
    table = radio_map.dataset.to_dataframe().reset_index()
    table = table.rename(columns={axis: f"{axis}_m" for axis in "xyz"})
    first = ["device", "x_m", "y_m", "z_m", "gain_db"]
    with atomic_path(path) as temporary:
        table[first + [name for name in table.columns if name not in first]].to_csv(
            temporary, index=False, float_format="%.9g")


def write_numpy(radio_map: RadioMap, scene: Scene, path: Path) -> None:
    """`numpy.load` reads it without pickling: gain_db, los and sigma_db (device, z, y, x), device, z_m, y_m, x_m."""
    dataset, lattice = radio_map.dataset, radio_map.lattice
    arrays: dict[str, Any] = {name: dataset[name].values for name in ("gain_db", "los", "sigma_db") if name in dataset}
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, device=np.array(radio_map.devices), z_m=lattice.z_m, y_m=lattice.y_m,
                            x_m=lattice.x_m, **arrays)
