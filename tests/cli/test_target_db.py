"""`--target-db` of trace and gains: rays by an error target, with the cost told before the work."""

import shutil

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


def test_gains(run, folder, asked, traced):
    done = run("gains scene --points points.csv --devices d0,d1 --sum coherent --seed 3 --target-db 1 -o g.csv", folder)
    assert done.returncode == 0, done.stderr
    [(*what, others)] = asked
    assert what == [2, 1.0, ["d0", "d1"]] and others.items() >= {"combining": "coherent", "seed": 3}.items()
    assert traced == [SolverSettings.of_quality("default", combining="coherent", seed=3)]
    assert "99 links" in done.stdout and "minutes for 4 links" in done.stdout and "--target-db 1: quality default" in done.stdout


def test_trace(run, folder, asked, traced):
    done = run("trace scene --devices d0 --target-db 1 -o map.nc", folder)
    assert done.returncode == 0, done.stderr
    assert RadioMap.load(folder / "map.nc").dataset.attrs["samples_per_src"] == 100_000
    assert asked[0][1:3] == (1.0, ["d0"])
    assert asked[0][3].items() >= {"solver": "paths", "combining": "power", "seed": 1}.items()
