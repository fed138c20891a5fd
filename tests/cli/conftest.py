"""The command line, and files that it has made."""

import shutil

import numpy as np
import pytest

from tests.command_line import run, run_installed
from tests.worlds import quick_report

__all__ = ["quick_report", "run", "run_installed"]
SURVEY = "survey scene --truth segmented --flights 1 -o out.csv"
FIT = "fit m.csv --scene scene --model log_distance -o out"
MAP = "map twin --scene scene -o out.nc"


@pytest.fixture(scope="session")
def scene_to_map(run, tmp_path_factory):
    """A folder with a scene, a survey of it (m.csv), a twin, and a map."""
    folder = tmp_path_factory.mktemp("scene-to-map")
    for command in ("build-scene preset:small -o scene", SURVEY.replace("out", "m"), FIT.replace("out", "twin"),
                    MAP.replace("out", "map")):
        assert run(command, folder).returncode == 0
    return folder


@pytest.fixture
def strangers_folder(scene_to_map, tmp_path):
    """A copy of them, beside what a command has no business with."""
    (tmp_path / "outside").mkdir()
    return shutil.copytree(scene_to_map, tmp_path / "work", ignore=shutil.ignore_patterns("cache"))


@pytest.fixture
def traced(monkeypatch):
    """A tracer that takes no time; the settings of each call at points."""
    used = []

    def trace_gains(scene, device_m, points_m, settings, *_):
        used.append(settings)
        return np.full((len(device_m), len(points_m)), -80.0)

    monkeypatch.setattr("radiotwin.trace.run.trace_gains", trace_gains)
    monkeypatch.setattr("radiotwin.trace.run.solve_lattice",
                        lambda scene, settings, store, index, *_: np.full((len(index), scene.blocked.size), -80.0))
    monkeypatch.setattr("radiotwin.trace.run.solve_finer", lambda *_: (
        np.zeros((1, 1), int), np.arange(1), np.full((1, 1), -80.0)))
    monkeypatch.setattr("radiotwin.trace.run.check_gains", lambda *_: {"links": 1})
    return used
