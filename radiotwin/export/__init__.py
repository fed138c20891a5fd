"""Radio maps as files that other programs read, by the name of the file."""

from collections.abc import Callable, Collection
from pathlib import Path

from radiotwin.errors import BadInput
from radiotwin.export.geotiff import write_geotiff
from radiotwin.export.kmz import write_kmz
from radiotwin.export.tables import write_csv, write_netcdf, write_numpy
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene

EXPORTERS: dict[str, Callable[[RadioMap, Scene, Path], None]] = {
    ".nc": write_netcdf, ".csv": write_csv, ".npz": write_numpy, ".tif": write_geotiff, ".kmz": write_kmz}
NEED_ORIGIN = (".kmz",)


def check_format(path: Path, scene: Scene | None = None, formats: Collection[str] = tuple(EXPORTERS)) -> None:
    """Check that a radio map of a scene can be written to a file.

    Args:
        path: file to write.
        scene: scene of the map.
        formats: suffixes that can be written.

    Raises:
        BadInput: another suffix, or a format that needs the origin of a scene that has none.
    """
    if path.suffix not in formats:
        raise BadInput(f"{path}: unknown format {path.suffix!r}; allowed are {', '.join(formats)}")
    if scene is not None and path.suffix in NEED_ORIGIN and scene.config.origin is None:
        raise BadInput(f"{path}: Google Earth needs to know where the scene is, and {scene.folder / 'scene.toml'} has "
                       "no [origin]; add one with latitude_deg and longitude_deg of x = y = 0")


def select(radio_map: RadioMap, devices: list[str] | None, altitudes_m: list[float] | None) -> RadioMap:
    """A part of a map.

    Args:
        radio_map: the whole.
        devices: names, in the order wanted; None: all.
        altitudes_m: of the lattice; None: all.

    Raises:
        BadInput: the map has no such device or altitude.
    """
    dataset = radio_map.dataset
    for name in devices or []:
        if name not in radio_map.devices:
            raise BadInput(f"device {name!r} is not in the map; it has {', '.join(radio_map.devices)}")
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
