"""Write the folder of a result: its tables, its figures and its page."""

from pathlib import Path
from typing import Any

from radiotwin.closeloop.corrected_twin import corrected_twin
from radiotwin.closeloop.residual_table import residuals
from radiotwin.closeloop.result_file import make_report, write_report
from radiotwin.closeloop.run import Loop
from radiotwin.compare import Comparison
from radiotwin.comparison_output import write_comparison
from radiotwin.files import require_writable
from radiotwin.radiomap import RadioMap
from radiotwin.report.closeloop_figures import write_closeloop_figures
from radiotwin.report.closeloop_page import write_closeloop_page
from radiotwin.report.comparison_figures import write_comparison_figures
from radiotwin.scene import Scene
from radiotwin.twin import check_twin_target


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
