"""Radio digital twins of cities, learnt from measurements.

`import radiotwin as rt` gives the objects and functions of `__all__`. Each is loaded when it is
first used, so that importing the package takes no time.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from radiotwin.closeloop.corrected_twin import corrected_twin
    from radiotwin.closeloop.criteria import SelectionCriteria
    from radiotwin.closeloop.result_file import make_report
    from radiotwin.closeloop.run import Loop, close_loop
    from radiotwin.compare import Comparison, compare_models, score_map, split_flights
    from radiotwin.coverage import CoverageSettings, predict_coverage
    from radiotwin.errors import BadInput, RunFailed
    from radiotwin.measurements import Measurements, read_measurements
    from radiotwin.paths.listing import list_paths
    from radiotwin.radiomap import RadioMap
    from radiotwin.report import read_run, write_report
    from radiotwin.scene import Scene
    from radiotwin.scene.build import BuildOptions, build_scene
    from radiotwin.scene.presets import build_preset
    from radiotwin.survey import fly_survey, segmented_truth
    from radiotwin.trace import SolverSettings, trace_map
    from radiotwin.twin import Twin, fit_twin

__version__: str  # found when it is asked for, as all names

_MODULES = {
    "closeloop.corrected_twin": ["corrected_twin"],
    "closeloop.criteria": ["SelectionCriteria"],
    "closeloop.result_file": ["make_report"],
    "closeloop.run": ["Loop", "close_loop"],
    "compare": ["Comparison", "compare_models", "score_map", "split_flights"],
    "coverage": ["CoverageSettings", "predict_coverage"],
    "errors": ["BadInput", "RunFailed"],
    "measurements": ["Measurements", "read_measurements"],
    "paths.listing": ["list_paths"],
    "radiomap": ["RadioMap"],
    "report": ["read_run", "write_report"],
    "scene": ["Scene"],
    "scene.build": ["BuildOptions", "build_scene"],
    "scene.presets": ["build_preset"],
    "survey": ["fly_survey", "segmented_truth"],
    "trace": ["SolverSettings", "trace_map"],
    "twin": ["Twin", "fit_twin"],
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [  # noqa: F822 - names that __getattr__ finds
    "BadInput", "BuildOptions", "Comparison", "CoverageSettings", "Loop", "Measurements",
    "RadioMap", "RunFailed", "Scene", "SelectionCriteria", "SolverSettings", "Twin", "__version__",
    "build_preset", "build_scene", "close_loop", "compare_models", "corrected_twin", "fit_twin",
    "fly_survey", "list_paths", "make_report", "predict_coverage", "read_measurements", "read_run",
    "score_map", "segmented_truth", "split_flights", "trace_map", "write_report"]


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
