"""Radio digital twins of cities, learnt from measurements.

`import radiotwin as rt` gives the objects and functions of `__all__`. Each is loaded when it is
first used, so that importing the package takes no time.
"""

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from radiotwin.cli.demo import run_demo
    from radiotwin.cli.doctor import diagnose
    from radiotwin.closeloop.output.corrected_scene import write_corrected_scene
    from radiotwin.closeloop.output.corrected_twin import corrected_twin
    from radiotwin.closeloop.output.residuals import Residuals, residuals
    from radiotwin.closeloop.output.result_file import make_report
    from radiotwin.closeloop.run import Loop, close_loop
    from radiotwin.closeloop.verdict.criteria import SelectionCriteria
    from radiotwin.coverage import CoverageSettings, predict_coverage
    from radiotwin.errors import BadInput, RunFailed
    from radiotwin.importing import import_measurements
    from radiotwin.links.alignment import in_scene_frame
    from radiotwin.links.measurements import Measurements, read_measurements
    from radiotwin.maps.radiomap import MapDifference, RadioMap
    from radiotwin.maps.survey import fly_survey, read_truth, segmented_truth
    from radiotwin.propagation.paths.listing import list_paths
    from radiotwin.report import (
        export_map,
        read_run,
        write_closeloop_folder,
        write_comparison_folder,
        write_report,
    )
    from radiotwin.report.comparison import compare_held_out
    from radiotwin.runtime.pieces import cache_content, clear_cache, keep_pieces
    from radiotwin.scene import Scene
    from radiotwin.scene.export import export_scene
    from radiotwin.scene.presets import build_preset
    from radiotwin.scene.readers import build_scene
    from radiotwin.trace import SolverSettings, choose_quality, read_points, trace_map, trace_points
    from radiotwin.twin import Twin, fit_twin
    from radiotwin.twin.compare import Comparison, compare_models, score_map, split_flights
    from radiotwin.twin.locate import locate_devices, position_errors
    from radiotwin.twin.point_gains import export_ns3
    from radiotwin.twin.regressor import TwinRegressor

__version__: str  # found when it is asked for, as all names

__all__ = [  # noqa: F822 - names that __getattr__ finds
    "BadInput", "Comparison", "CoverageSettings", "Loop", "MapDifference", "Measurements",
    "RadioMap", "Residuals", "RunFailed", "Scene", "SelectionCriteria", "SolverSettings", "Twin",
    "TwinRegressor", "__version__", "build_preset", "build_scene", "cache_content",
    "choose_quality", "clear_cache", "close_loop", "compare_held_out", "compare_models",
    "corrected_twin", "diagnose", "export_map", "export_ns3", "export_scene", "fit_twin",
    "fly_survey", "import_measurements", "in_scene_frame", "keep_pieces", "list_paths",
    "locate_devices", "make_report", "position_errors", "predict_coverage", "read_measurements",
    "read_points", "read_run", "read_truth", "residuals", "run_demo", "score_map",
    "segmented_truth", "split_flights", "trace_map", "trace_points", "write_closeloop_folder",
    "write_comparison_folder", "write_corrected_scene", "write_report"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return _version()
    if name not in __all__:
        raise AttributeError(f"module 'radiotwin' has no attribute {name!r}")
    return getattr(import_module(_modules()[name]), name)


@cache
def _modules() -> dict[str, str]:
    """Return the module of each name, as the imports for type checkers above have it."""
    import ast  # when the first name is loaded, which takes longer
    import inspect
    import sys

    tree = ast.parse(inspect.getsource(sys.modules[__name__]))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    return {each.name: str(node.module) for node in block.body
            if isinstance(node, ast.ImportFrom) for each in node.names}


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version  # half the time of this import

    try:
        return version("radiotwin")
    except PackageNotFoundError:  # run from a source tree that was never installed
        return "0+source"


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
