"""Channel gains from devices of a twin or radio map to any points, and their export to ns-3."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from radiotwin.errors import BadInput
from radiotwin.io.budgets import ROWS
from radiotwin.maps.export.tables import check_map_place, write_ns3
from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.twin import Twin


def export_ns3(source: Twin | RadioMap, scene: Scene, points_m: np.ndarray, folder: Path | str, *,
               devices: Sequence[str] | None = None) -> int:
    """Write the path losses between devices and points for ns-3; return the number of pairs.

    Args:
        source: twin, or radio map with the points on its lattice.
        scene: scene of the twin or map.
        points_m: (n, 3) positions of the other ends [m].
        folder: output folder; other files in it stay.
        devices: names of devices; None: all that have a position.

    Raises:
        BadInput: an unknown device, points off the lattice of a map, or no gain at all.
    """
    points_m = np.asarray(points_m, dtype=float).reshape(-1, 3)
    placed = _placed(source, scene)
    if placed.empty and isinstance(source, RadioMap):
        raise BadInput(f"{scene.folder / 'scene.toml'} declares none of the map's devices "
                       f"({', '.join(source.devices[:20])}), and a node needs a position: declare "
                       "them there as [[devices]], or give the twin that the map is of")
    names = list(placed["device"]) if devices is None else list(dict.fromkeys(devices))
    for name in names:
        if name not in set(placed["device"]):
            raise BadInput(f"device {name!r} has no position here; there are "
                           f"{', '.join(placed['device'][:20])}")
    ROWS.check(len(names) * len(points_m), "points times devices")
    chosen = placed.set_index("device").loc[names].reset_index()
    return write_ns3(chosen, points_m, gains_at(source, scene, points_m, names), folder)


def gains_at(source: Twin | RadioMap, scene: Scene, points_m: np.ndarray,
             devices: Sequence[str]) -> np.ndarray:
    """Return channel gains (k, n) [dB] from devices to points (n, 3) [m].

    A twin predicts the mean even below sensitivity. NaN inside buildings, and in gaps of a map.
    BadInput if points are off the lattice of a map, or it is in another frame than the scene.
    """
    points_m = np.asarray(points_m, dtype=float).reshape(-1, 3)
    inside = scene.city.inside(points_m)
    if isinstance(source, RadioMap):
        check_map_place("the radio map", source.attributes, scene)
        places = np.unravel_index(source.lattice.index_of(points_m), source.lattice.shape)
        z, y, x = (xr.DataArray(place, dims="point") for place in places)
        gain_db = source.dataset["gain_db"].sel(device=list(devices)).isel(
            z=z, y=y, x=x).transpose("device", "point").values.astype(float)
    else:
        source.require_map(scene)
        source.warn_of_another_scene(scene, scene.content_hash())
        row_of = {device.device: row for row, device in enumerate(source.devices)}
        index = np.repeat([row_of[name] for name in devices], len(points_m))
        links = source.links(np.tile(points_m, (len(devices), 1)), index, scene)
        level_db = source.predict(links).mean_db - source.power_dbm(scene)[index]
        gain_db = level_db.reshape(len(devices), len(points_m))
    return np.where(inside, np.nan, gain_db)


def _placed(source: Twin | RadioMap, scene: Scene) -> pd.DataFrame:
    """Return device, x_m, y_m, z_m of the devices that have a position."""
    if isinstance(source, Twin):
        rows = [(device.device, *device.position_m) for device in source.devices]
    else:
        rows = [(device.device, device.x_m, device.y_m, device.z_m)
                for device in scene.config.devices if device.device in set(source.devices)]
    return pd.DataFrame(rows, columns=["device", "x_m", "y_m", "z_m"]).dropna(ignore_index=True)
