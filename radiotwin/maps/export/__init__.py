"""Write radio maps in file formats of other programs, chosen by the suffix."""

from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from radiotwin.display import some
from radiotwin.errors import BadInput
from radiotwin.io.budgets import MAP_VALUES
from radiotwin.maps.export.geotiff import require_origin, write_geotiff
from radiotwin.maps.export.kmz import write_kmz
from radiotwin.maps.export.tables import write_csv, write_dataset, write_numpy
from radiotwin.maps.file import MapStream
from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene import Scene

EXPORTERS: dict[str, Callable[[RadioMap, Scene, Path], None]] = {
    ".nc": write_dataset, ".zarr": write_dataset, ".csv": write_csv, ".npz": write_numpy,
    ".tif": write_geotiff, ".kmz": write_kmz}
STREAMED: dict[str, Callable[[RadioMap | MapStream, Scene, Path], None]] = {
    ".nc": write_dataset, ".zarr": write_dataset, ".csv": write_csv, ".tif": write_geotiff}
"""Formats to which a map can be written block by block while it is computed."""
_NAMED = 20  # at most so many devices or altitudes in a message


def write_map(radio_map: RadioMap | MapStream, scene: Scene, path: Path,
              exporters: dict[str, Callable[[RadioMap, Scene, Path], None]]) -> None:
    """Write a map in the format of the path's suffix, block by block if the format allows it.

    `exporters` are those by suffix. BadInput if the format requires the map in memory, and it is
    too large.
    """
    if path.suffix in STREAMED:
        STREAMED[path.suffix](radio_map, scene, path)
        return
    MAP_VALUES.check(len(radio_map.devices) * np.prod(radio_map.lattice.shape, dtype=float),
                     f"{path}: the map, which only {', '.join(STREAMED)} take in parts")
    if isinstance(radio_map, MapStream):
        radio_map = RadioMap.collect(radio_map)
    exporters[path.suffix](radio_map, scene, path)


def check_format(path: Path, scene: Scene,
                 formats: Collection[str] = tuple(EXPORTERS)) -> None:
    """Raise BadInput unless a map of a scene can be written in the format of a path's suffix."""
    if path.suffix not in formats:
        raise BadInput(f"{path}: unknown format {path.suffix!r}; allowed are "
                       f"{', '.join(formats)}")
    if path.suffix == ".kmz":
        require_origin(scene, f"{path}: Google Earth needs")


def select(radio_map: RadioMap | MapStream, devices: list[str] | None,
           altitudes_m: list[float] | None) -> RadioMap | MapStream:
    """Select devices and altitudes of a map.

    Args:
        radio_map: the whole map.
        devices: names, in the order wanted; None: all.
        altitudes_m: altitudes of the lattice [m]; None: all.

    Returns:
        The map of the selection.

    Raises:
        BadInput: the map has no such device or altitude.
    """
    if not devices and not altitudes_m:
        return radio_map
    names, lattice = radio_map.devices, radio_map.lattice
    known = set(names)
    for name in devices or []:
        if name not in known:
            raise BadInput(f"device {name!r} is not in the map; it has {some(names, _NAMED)}")
    for altitude_m in altitudes_m or []:
        if altitude_m not in lattice.z_m:
            heights = [f"{z:g}" for z in lattice.z_m]
            raise BadInput(f"altitude {altitude_m:g} m is not in the map; it has "
                           f"{some(heights, _NAMED)} m")
    if altitudes_m:
        lattice = replace(lattice, z_m=np.array(sorted(set(altitudes_m))))
    return radio_map.selected(list(dict.fromkeys(devices or names)), lattice)
