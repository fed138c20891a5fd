"""`--target-db` of trace and gains: rays by an error target, with the cost told before the work."""

import shutil

import numpy as np
import pytest

from radiotwin.maps.radiomap import RadioMap
from radiotwin.trace import SolverSettings
from radiotwin.trace.plan import Rung


@pytest.fixture
def folder(small_scene, tmp_path):
    shutil.copytree(small_scene.folder, tmp_path / "scene", ignore=shutil.ignore_patterns("cache"))
    (tmp_path / "points.csv").write_text("x_m,y_m,z_m\n140,40,55\n60,40,55\n")
    return tmp_path


@pytest.fixture
def asked(monkeypatch):
    """Two qualities that were tried; notes the question."""
    questions = []

    def choose(scene, points_m, target_db, devices, **others):
        questions.append((len(points_m), target_db, devices, others))
        return [Rung(name, SolverSettings.of_quality(name, **others), 99, rms_db, 2.5, -0.25, seconds)
                for name, rms_db, seconds in (("fast", 2.0, 0.1), ("default", 0.75, 0.3))]

    monkeypatch.setattr("radiotwin.trace.choose_quality", choose)
    return questions


def test_gains(run, folder, asked, monkeypatch):
    used = []

    def traced(scene, device_m, points_m, settings, *_):
        used.append(settings)
        return np.full((len(device_m), len(points_m)), -80.0)

    monkeypatch.setattr("radiotwin.trace.run.trace_gains", traced)
    done = run("gains scene --points points.csv --devices d0,d1 --sum coherent --seed 3 --target-db 1 -o g.csv", folder)
    assert done.returncode == 0, done.stderr
    [(*what, others)] = asked
    assert what == [2, 1.0, ["d0", "d1"]] and others.items() >= {"combining": "coherent", "seed": 3}.items()
    assert used == [SolverSettings.of_quality("default", combining="coherent", seed=3)]
    assert "99 links" in done.stdout and "minutes for 4 links" in done.stdout and "--target-db 1: quality default" in done.stdout


def test_trace(run, folder, asked, monkeypatch):
    monkeypatch.setattr("radiotwin.trace.run.solve_lattice",
                        lambda scene, settings, store, index, *_: np.full((len(index), scene.blocked.size), -80.0))
    monkeypatch.setattr("radiotwin.trace.run.solve_finer", lambda *_: (
        np.zeros((1, 1), int), np.arange(1), np.full((1, 1), -80.0)))
    monkeypatch.setattr("radiotwin.trace.run.check_gains", lambda *_: {"links": 1})
    done = run("trace scene --devices d0 --target-db 1 -o map.nc", folder)
    assert done.returncode == 0, done.stderr
    assert RadioMap.load(folder / "map.nc").dataset.attrs["samples_per_src"] == 100_000
    assert asked[0][1:3] == (1.0, ["d0"])
    assert asked[0][3].items() >= {"solver": "paths", "combining": "power", "seed": 1}.items()


@pytest.mark.parametrize(("options", "message"), [
    ("--quality fast --target-db 1", "--quality and --target-db both say how many rays there are; give one"),
    ("--target-db 99", "target_db = 99: allowed is 0.05 to 20 dB")])
@pytest.mark.parametrize("command", ["gains scene --points points.csv", "trace scene"])
def test_what_cannot_be_asked(run, folder, command, options, message):
    done = run(f"{command} {options}", folder)
    assert done.returncode == 2 and message in done.stderr
    assert not list(folder.glob("*.nc")) and not (folder / "gains.csv").exists()


def test_a_map_over_cells_has_no_target(run, folder):
    done = run("trace scene --solver map --target-db 1", folder)
    assert done.returncode == 2 and "needs the solver 'paths'" in done.stderr
