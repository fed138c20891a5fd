"""Radio maps in the file formats of other programs, chosen by the file name."""

from collections.abc import Callable, Collection
from pathlib import Path

from radiotwin.errors import BadInput
from radiotwin.export.geotiff import write_geotiff
from radiotwin.export.kmz import write_kmz
from radiotwin.export.tables import write_csv, write_netcdf, write_numpy
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene

EXPORTERS: dict[str, Callable[[RadioMap, Scene, Path], None]] = {
    ".nc": write_netcdf, ".csv": write_csv, ".npz": write_numpy, ".tif": write_geotiff,
    ".kmz": write_kmz}


def check_format(path: Path, scene: Scene,
                 formats: Collection[str] = tuple(EXPORTERS)) -> None:
    """Check that a radio map of a scene can be written under a file name.

    Args:
        path: of the output; its suffix chooses the format.
        scene: of the map.
        formats: suffixes that can be written.

    Raises:
        BadInput: no exporter writes the suffix, or it needs an origin and the scene has none.
    """
    if path.suffix not in formats:
        raise BadInput(f"{path}: unknown format {path.suffix!r}; allowed are "
                       f"{', '.join(formats)}")
    if path.suffix == ".kmz" and scene.config.origin is None:
        raise BadInput(f"{path}: Google Earth needs the position of the scene, and "
                       f"{scene.folder / 'scene.toml'} has no [origin]; add one with latitude_deg "
                       "and longitude_deg of x = y = 0")


def select(
    radio_map: RadioMap, devices: list[str] | None, altitudes_m: list[float] | None
) -> RadioMap:
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
    dataset = radio_map.dataset
    for name in devices or []:
        if name not in radio_map.devices:
            raise BadInput(f"device {name!r} is not in the map; it has "
                           f"{', '.join(radio_map.devices)}")
    known_m = radio_map.lattice.z_m
    for altitude_m in altitudes_m or []:
        if altitude_m not in known_m:
            raise BadInput(f"altitude {altitude_m:g} m is not in the map; it has "
                           f"{', '.join(f'{z:g}' for z in known_m)} m")
    if devices:
        dataset = dataset.sel(device=list(dict.fromkeys(devices)))
    if altitudes_m:
        dataset = dataset.sel(z=sorted(set(altitudes_m)))
    return RadioMap(dataset)
