"""Radio digital twins of cities, learnt from measurements.

`import radiotwin as rt` gives the objects and functions of `__all__`. Each is loaded when it is
first used, so that importing the package takes no time.
"""

import sys
from importlib import import_module, util
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from radiotwin.alignment import in_scene_frame
    from radiotwin.build import build_scene
    from radiotwin.closeloop.corrected_scene import write_corrected_scene
    from radiotwin.closeloop.corrected_twin import corrected_twin
    from radiotwin.closeloop.criteria import SelectionCriteria
    from radiotwin.closeloop.residual_table import residuals
    from radiotwin.closeloop.residuals import Residuals
    from radiotwin.closeloop.result_file import make_report
    from radiotwin.closeloop.run import Loop, close_loop
    from radiotwin.compare import Comparison, compare_models, score_map, split_flights
    from radiotwin.comparison_output import compare_held_out
    from radiotwin.coverage import CoverageSettings, predict_coverage
    from radiotwin.demo import run_demo
    from radiotwin.doctor import diagnose
    from radiotwin.errors import BadInput, RunFailed
    from radiotwin.importing import import_measurements
    from radiotwin.map_difference import MapDifference
    from radiotwin.measurements import Measurements, read_measurements
    from radiotwin.paths.listing import list_paths
    from radiotwin.pieces import cache_content, clear_cache, keep_pieces
    from radiotwin.point_gains import export_ns3
    from radiotwin.radiomap import RadioMap
    from radiotwin.report import (
        export_map,
        read_run,
        write_closeloop_folder,
        write_comparison_folder,
        write_report,
    )
    from radiotwin.scene import Scene
    from radiotwin.scene.export import export_scene
    from radiotwin.scene.presets import build_preset
    from radiotwin.survey import fly_survey, read_truth, segmented_truth
    from radiotwin.trace import SolverSettings, choose_quality, read_points, trace_map, trace_points
    from radiotwin.twin import Twin, fit_twin
    from radiotwin.twin.locate import locate_devices, position_errors

__version__: str  # found when it is asked for, as all names

_MODULES = {
    "alignment": ["in_scene_frame"],
    "build": ["build_scene"],
    "closeloop.corrected_scene": ["write_corrected_scene"],
    "closeloop.corrected_twin": ["corrected_twin"],
    "closeloop.criteria": ["SelectionCriteria"],
    "closeloop.residual_table": ["residuals"],
    "closeloop.residuals": ["Residuals"],
    "closeloop.result_file": ["make_report"],
    "closeloop.run": ["Loop", "close_loop"],
    "compare": ["Comparison", "compare_models", "score_map", "split_flights"],
    "comparison_output": ["compare_held_out"],
    "coverage": ["CoverageSettings", "predict_coverage"],
    "demo": ["run_demo"],
    "doctor": ["diagnose"],
    "errors": ["BadInput", "RunFailed"],
    "importing": ["import_measurements"],
    "map_difference": ["MapDifference"],
    "measurements": ["Measurements", "read_measurements"],
    "paths.listing": ["list_paths"],
    "pieces": ["cache_content", "clear_cache", "keep_pieces"],
    "point_gains": ["export_ns3"],
    "radiomap": ["RadioMap"],
    "report": ["export_map", "read_run", "write_closeloop_folder", "write_comparison_folder",
               "write_report"],
    "scene": ["Scene"],
    "scene.export": ["export_scene"],
    "scene.presets": ["build_preset"],
    "survey": ["fly_survey", "read_truth", "segmented_truth"],
    "trace": ["SolverSettings", "choose_quality", "read_points", "trace_map", "trace_points"],
    "twin": ["Twin", "fit_twin"],
    "twin.locate": ["locate_devices", "position_errors"],
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [  # noqa: F822 - names that __getattr__ finds
    "BadInput", "Comparison", "CoverageSettings", "Loop", "MapDifference", "Measurements",
    "RadioMap", "Residuals", "RunFailed", "Scene", "SelectionCriteria", "SolverSettings", "Twin",
    "__version__", "build_preset", "build_scene", "cache_content", "choose_quality", "clear_cache",
    "close_loop", "compare_held_out", "compare_models", "corrected_twin", "diagnose", "export_map",
    "export_ns3", "export_scene", "fit_twin", "fly_survey", "import_measurements", "in_scene_frame",
    "keep_pieces", "list_paths", "locate_devices", "make_report", "position_errors",
    "predict_coverage", "read_measurements", "read_points", "read_run", "read_truth", "residuals",
    "run_demo", "score_map", "segmented_truth", "split_flights", "trace_map", "trace_points",
    "write_closeloop_folder", "write_comparison_folder", "write_corrected_scene", "write_report"]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return _version()
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'radiotwin' has no attribute {name!r}")
    return getattr(import_module(f"radiotwin.{_MODULE_OF[name]}"), name)


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version  # half the time of this import

    try:
        return version("radiotwin")
    except PackageNotFoundError:  # run from a source tree that was never installed
        return "0+source"


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def _hide_folder_coverage() -> None:
    """Hide a folder `coverage` in the working directory from `import coverage`.

    numba imports that package where there is one, and would take our output folder for it.
    """
    found = util.find_spec("coverage") if "coverage" not in sys.modules else None
    if found is not None and found.origin is None:  # a folder without a module
        sys.modules["coverage"] = None  # type: ignore[assignment]


_hide_folder_coverage()
