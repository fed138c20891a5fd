"""A trace by workers: the same bytes as in one process, whatever happens to them, or to the command."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from radiotwin.runtime.execution import open_executor
from radiotwin.scene import Scene
from radiotwin.trace import SolverSettings, trace_gains, trace_map
from tests.runtime.execution.jobs import needs_ray, processes_with, two_workers, wait_until

pytestmark = pytest.mark.llvm

ROOT = Path(__file__).parents[2]
SETTINGS = SolverSettings(samples_per_src=3_000, batch_receivers=40, max_num_paths_per_src=20_000)
TRACE = ["-m", "radiotwin", "trace", "--quality", "fast", "--devices", "d0,d1", "-o"]


def points_of(scene):
    """Some 250 positions all over the lattice."""
    positions_m = scene.lattice.positions_m[~scene.blocked.ravel()]
    return positions_m[::len(positions_m) // 240]


@pytest.fixture(scope="module")
def rbm():
    scene = Scene.load(ROOT / "scenes" / "rbm")
    points_m = points_of(scene)
    return scene, points_m, trace_gains(scene, scene.device_m[:2], points_m, SETTINGS)


@pytest.mark.parametrize("place", ["local", pytest.param("ray", marks=[pytest.mark.slow, needs_ray])])
def test_gains_are_equal_to_the_bit_also_after_a_worker_was_killed(rbm, place):
    scene, points_m, expected = rbm
    with two_workers(place) as (executor, killed):
        found = trace_gains(scene, scene.device_m[:2], points_m, SETTINGS, executor=executor)
    assert np.isfinite(found).mean() > 0.5
    assert found.tobytes() == expected.tobytes()
    assert killed


def batches(folder):
    return sorted(folder.glob("cache/trace-*/device-*.npy"))


def trace(folder, *options, **popen):
    return subprocess.Popen([sys.executable, *TRACE, str(folder / "map.nc"), str(folder), *options], cwd=ROOT,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True, **popen)


@pytest.mark.slow
def test_a_command_that_was_killed_goes_on_with_other_workers_to_the_same_bytes(own_scene, tmp_path):
    """One process, and two of which the driver is killed: the map is the same file."""
    alone, many = tmp_path / "alone", tmp_path / "many"
    shutil.copytree(own_scene.folder, alone)
    shutil.copytree(own_scene.folder, many)
    uninterrupted = trace(alone, "--workers", "1")
    assert uninterrupted.wait(200) == 0, uninterrupted.stderr.read()

    mark = f"mark-{tmp_path}"
    driver = trace(many, "--workers", "2", env=os.environ | {"MARK_OF_TEST": mark})
    wait_until(lambda: len(batches(many)) >= 3 or driver.poll() is not None, 200)
    os.kill(driver.pid, signal.SIGKILL)
    driver.wait()
    finished = {path: path.stat().st_mtime_ns for path in batches(many)}
    assert 3 <= len(finished) < len(batches(alone)) and not (many / "map.nc").exists()
    wait_until(lambda: not processes_with(mark), 20)

    again = trace(many, "--workers", "2")
    assert again.wait(200) == 0, again.stderr.read()
    assert {path: path.stat().st_mtime_ns for path in finished} == finished
    assert (many / "map.nc").read_bytes() == (alone / "map.nc").read_bytes()
    assert "2 workers on this machine, 1 core, at most 1.4 GiB of memory each" in again.stderr.read()


def test_a_batch_in_halves_differs_little_from_the_whole(small_scene):
    """What is done where memory is short: a gain depends on the points beside it in rare cases only."""
    from radiotwin.trace.link_job import LinkBatch, SolveBatch

    piece = LinkBatch("a", small_scene.device_m[0], points_of(small_scene)[:40], (None, None), 40)
    solve = SolveBatch(small_scene, SETTINGS)
    whole = solve(piece)
    halves = np.concatenate([solve(half) for half in piece.halves()])
    assert [half.batch_receivers for half in piece.halves()] == [20, 20]
    same = np.isclose(whole, halves, atol=1e-4, equal_nan=True)
    assert same.mean() > 0.9 and np.isfinite(whole).sum() > 20


@pytest.mark.slow
def test_the_map_of_cells_by_workers(own_scene, tmp_path):
    cells = SolverSettings(solver="map", samples_per_src=100_000)
    alone = trace_map(own_scene, cells, tmp_path / "alone.nc", ["d0"])
    shutil.rmtree(own_scene.folder / "cache")
    with open_executor("2") as executor:
        together = trace_map(own_scene, cells, tmp_path / "together.nc", ["d0"], executor)
    assert together.gain_db.tobytes() == alone.gain_db.tobytes()
