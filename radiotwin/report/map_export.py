"""Write the radio map of a file or of a twin in the format of another program, or as a picture."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

from radiotwin.export import EXPORTERS, check_format, select, write_map
from radiotwin.export.place import check_map_place
from radiotwin.map_file import MapStream, is_zarr
from radiotwin.map_writing import check_target, size_of
from radiotwin.radiomap import RadioMap
from radiotwin.report.map_figures import write_picture
from radiotwin.scene import Scene
from radiotwin.twin import Twin

FORMATS: dict[str, Callable[[RadioMap, Scene, Path], None]] = EXPORTERS | {".png": write_picture}
TOLD_LINKS = 1_000_000


def check_map_target(path: Path | str, scene: Scene) -> None:
    """Check that a map of a scene can be written under a file name, before it is made.

    Args:
        path: file to write; its suffix chooses the format.
        scene: of the map.

    Raises:
        BadInput: an unknown format, one that needs an origin where the scene has none, or a file
            that cannot be written.
    """
    check_format(Path(path), scene, FORMATS)
    check_target(path)


def export_map(source: RadioMap | Twin, scene: Scene, path: Path | str, *,
               devices: Sequence[str] | None = None, altitudes_m: Sequence[float] | None = None,
               name: str = "the radio map",
               tell: Callable[[str], None] | None = None) -> RadioMap | MapStream:
    """Write a radio map as `.nc`, `.zarr`, `.csv`, `.npz`, `.tif`, `.kmz` or `.png`.

    The map of a twin is made block by block where the format allows it.

    Args:
        source: map, or twin whose map is written.
        scene: that it was made for.
        path: file to write; its suffix chooses the format.
        devices: names, in the order wanted; None: all.
        altitudes_m: altitudes of the lattice [m]; None: all.
        name: of the source in messages.
        tell: called with the size of a Zarr map of over `TOLD_LINKS` before it is written.

    Returns:
        What was written.

    Raises:
        BadInput: as `check_map_target`, a map of another place, or no such device or altitude.
    """
    path = Path(path)
    check_map_target(path, scene)
    if isinstance(source, RadioMap):
        check_map_place(name, source.attributes, scene)
        whole: RadioMap | MapStream = source
    else:
        whole = source.map_stream(scene)
    selected = select(whole, None if devices is None else list(devices),
                      None if altitudes_m is None else list(altitudes_m))
    shape = selected.lattice.shape
    if tell is not None and is_zarr(path) and len(selected.devices) * math.prod(shape) > TOLD_LINKS:
        tell(f"{path}: {size_of(shape, len(selected.devices))}")
    write_map(selected, scene, path, FORMATS)
    return selected
