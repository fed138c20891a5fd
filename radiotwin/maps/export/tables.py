"""Write radio maps as NetCDF, Zarr, CSV and NumPy, and losses between nodes for ns-3.

The MatrixPropagationLossModel of ns-3 has one constant loss for each pair of nodes [1].

[1] ns-3 manual, "Propagation": MatrixPropagationLossModel::SetLoss, SetDefaultLoss.
"""

import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.io.budgets import ROWS
from radiotwin.io.cells import write_csv as write_table
from radiotwin.io.files import atomic_file, atomic_path
from radiotwin.maps.file import MapBlock, MapStream, write_parts
from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.scene.lattice import Lattice

MAX_ORIGIN_DIFFERENCE = 1e-6  # by rounding, between origins of one place [degrees, or m altitude]
NODES, LOSSES = "nodes.csv", "losses.csv"
_POSITION = ["x_m", "y_m", "z_m"]


def write_dataset(radio_map: RadioMap | MapStream, scene: Scene, path: Path) -> None:
    """Write NetCDF-4 or Zarr by the CF conventions, with the scene's origin."""
    placed = radio_map.with_origin(scene.config.origin)
    if isinstance(placed, RadioMap):
        placed.save(path)
        return
    dtypes = {name: np.dtype(bool if name == "los" else np.float32) for name in placed.variables}
    write_parts(placed.header, dtypes, placed.blocks(), path)


def write_csv(radio_map: RadioMap | MapStream, scene: Scene, path: Path) -> None:
    """Write CSV with a row for each link; the scene is not used.

    Columns: device, x_m, y_m, z_m, gain_db (empty: not detected), los, and sigma_db of a learned
    map. Nine digits restore single precision to the bit.
    """
    devices, lattice, is_first = radio_map.devices, radio_map.lattice, True
    with atomic_file(path) as file:
        for block in radio_map.blocks():
            table = _rows(block, devices, lattice)
            write_table(table, file, "%.9g", header=is_first)
            is_first = False


def _rows(block: MapBlock, devices: list[str], lattice: Lattice) -> pd.DataFrame:
    """Return a row for each link of a block."""
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
    """Write NumPy arrays that `numpy.load` reads without pickle; the scene is not used.

    Arrays: gain_db, los and sigma_db (device, z, y, x), device, z_m, y_m, x_m; and ground_m (y, x)
    if z_m are heights above the ground.
    """
    lattice, dataset = radio_map.lattice, radio_map.dataset
    arrays = {"device": np.array(radio_map.devices), "z_m": lattice.z_m, "y_m": lattice.y_m,
              "x_m": lattice.x_m}
    if lattice.ground_m is not None:
        arrays |= {"ground_m": lattice.ground_m}
    arrays |= {name: dataset[name].values for name in radio_map.variables}
    with atomic_file(path) as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]  # no array is called allow_pickle
        with zipfile.ZipFile(file, "a") as archive:
            archive.comment = b"radiotwin"


def check_map_place(name: str, attributes: dict[str, Any], scene: Scene) -> None:
    """Raise BadInput unless a radio map has the origin of a scene, whose outlines it will be given.

    A warning says if it was made for another version of the scene.
    """
    origin = scene.config.origin
    for key, value in ({} if origin is None else origin.model_dump()).items():
        of_map = attributes.get(f"origin_{key}", value)
        if abs(of_map - value) > MAX_ORIGIN_DIFFERENCE:
            raise BadInput(f"{name} is a map of another place: its origin's {key} is {of_map:g}, "
                           f"that of {scene.folder} is {value:g}; give the scene that it was made "
                           "for, or trace again")
    if attributes.get("scene_hash") not in (None, scene.content_hash()):
        warnings.warn(f"{name} was made for another scene than {scene.folder}, or that has changed "
                      "since: outlines, devices and the origin are those of the scene",
                      stacklevel=3)


def write_ns3(devices: pd.DataFrame, points_m: np.ndarray, gain_db: np.ndarray,
              folder: Path | str) -> int:
    """Write nodes and the path losses between them for ns-3: `nodes.csv` and `losses.csv`.

    `nodes.csv` has a row for each node: `node` (its number, devices first), `x_m, y_m, z_m`, and
    `name` (`point0`, … of points). `losses.csv` has a row for each pair with a gain: `device_node`,
    `point_node`, `loss_db`, positive.

    Args:
        devices: k rows `device, x_m, y_m, z_m`.
        points_m: (n, 3) positions of the other ends [m].
        gain_db: (k, n) channel gain [dB]; NaN: no link.
        folder: to write to; other files in it are kept.

    Returns:
        number of pairs.

    Raises:
        BadInput: no gain at all, a device without a position, or with the name of a point.
    """
    names = [f"point{number}" for number in range(len(points_m))]
    unplaced = ~np.isfinite(devices[_POSITION].to_numpy(dtype=float)).all(axis=1)
    if unplaced.any():
        raise BadInput(f"device {devices['device'].iloc[int(np.argmax(unplaced))]!r} has no "
                       "position, which a node needs; leave it out with --devices")
    same = set(devices["device"]) & set(names)
    if same:
        raise BadInput(f"device {sorted(same)[0]!r} has the name of a point; rename it")
    seen = np.isfinite(gain_db)
    if not seen.any():
        raise BadInput("no pair of a device and a point has a gain; are the points outdoors and in "
                       "reach?")
    ROWS.check(gain_db.size, "points times devices")
    device, point = np.nonzero(seen)
    nodes = pd.DataFrame(np.vstack([devices[_POSITION].to_numpy(dtype=float), points_m]),
                         columns=_POSITION)
    nodes.insert(0, "node", np.arange(len(nodes)))
    nodes["name"] = [*devices["device"], *names]  # last: a name may have a comma
    losses = pd.DataFrame({"device_node": device, "point_node": len(devices) + point,
                           "loss_db": -gain_db[seen]})
    folder = Path(folder)
    with atomic_path(folder / NODES) as first, atomic_path(folder / LOSSES) as second:
        write_table(nodes, first, "%.3f")
        write_table(losses, second, "%.3f")
    return len(losses)
