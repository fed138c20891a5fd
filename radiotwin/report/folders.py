"""Write the folder of a result: its tables, its figures and its page.

Write the radio map of a file or of a twin in the format of another program, or as a picture.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from radiotwin.closeloop.output.corrected_twin import corrected_twin
from radiotwin.closeloop.output.residuals import residuals
from radiotwin.closeloop.output.result_file import make_report, write_report
from radiotwin.closeloop.run import Loop
from radiotwin.io.files import require_writable
from radiotwin.maps.export import EXPORTERS, check_format, select, write_map
from radiotwin.maps.export.tables import check_map_place
from radiotwin.maps.file import check_target, size_of
from radiotwin.maps.form import MapStream, is_zarr
from radiotwin.maps.radiomap import RadioMap
from radiotwin.report.closeloop_figures import write_closeloop_figures
from radiotwin.report.closeloop_page import write_closeloop_page
from radiotwin.report.comparison import write_comparison, write_comparison_figures
from radiotwin.report.map_figures import write_picture
from radiotwin.scene import Scene
from radiotwin.twin import Twin, check_twin_target
from radiotwin.twin.compare import Comparison

FORMATS: dict[str, Callable[[RadioMap, Scene, Path], None]] = EXPORTERS | {".png": write_picture}
TOLD_LINKS = 1_000_000


def check_closeloop_folder(folder: Path | str) -> None:
    """Check that the result of a close-loop can be written to a folder, before it is made.

    Args:
        folder: to write.

    Raises:
        BadInput: it cannot be written, or its `twin` is not a twin's folder.
    """
    require_writable(Path(folder) / "closeloop.json")
    check_twin_target(Path(folder) / "twin")


def write_closeloop_folder(loop: Loop, scene: Scene | None, folder: Path | str, *,
                           title: str = "Close-loop report",
                           inputs: dict[str, Any] | None = None) -> dict[str, Any]:
    """Write all that `radiotwin close-loop` writes.

    The folder gets `closeloop.json`, `closeloop.html`, `residuals.csv.gz`, figures, and the
    corrected twin in the folder `twin`.

    Args:
        loop: result to write.
        scene: it was found in; None: there was none.
        folder: to write; other files in it are kept.
        title: of the page.
        inputs: names of measurements and scene, for `closeloop.json`.

    Returns:
        Content of `closeloop.json`.

    Raises:
        BadInput: as `check_closeloop_folder`.
    """
    folder = Path(folder)
    check_closeloop_folder(folder)
    report = make_report(loop) | ({} if inputs is None else {"inputs": inputs})
    write_closeloop_figures(loop, scene, report, folder)
    write_report(report, folder / "closeloop.json")
    residuals(loop).save(folder / "residuals.csv.gz")
    corrected_twin(loop, scene).save(folder / "twin")
    write_closeloop_page(report, folder, title)
    return report


def write_comparison_folder(comparison: Comparison, scene: Scene, folder: Path | str,
                            truth: RadioMap | None = None) -> None:
    """Write all that `radiotwin compare` writes: `compare.json`, tables and figures.

    Args:
        comparison: result to write.
        scene: of the measurements.
        folder: to write; other files in it are kept.
        truth: the map that was judged on; None: there was none.
    """
    write_comparison(comparison, scene, folder)
    write_comparison_figures(comparison, scene, truth, Path(folder))


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
