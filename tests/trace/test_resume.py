"""The tracer on a small city: kill and resume, independence of a gain from the other links, materials below 1 GHz."""

import logging
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from radiotwin.scene import Scene
from radiotwin.scene.config import write_config
from radiotwin.trace import SolverSettings, trace_gains, trace_map

pytestmark = pytest.mark.llvm

SETTINGS = SolverSettings(samples_per_src=3_000, batch_receivers=40, max_num_paths_per_src=20_000)
# Notes each call of the solver, so that the test can tell how many were lost by the kill.
CHILD = """
import sys
from radiotwin.scene import Scene
from radiotwin.trace import SolverSettings, solver, trace_map

folder, log = sys.argv[1:]
solve = solver.PathGains.solve

def noted(self, device_m, points_m, antennas=(None, None)):
    with open(log, "a") as file:
        file.write("started\\n")
    return solve(self, device_m, points_m, antennas)

solver.PathGains.solve = noted
trace_map(Scene.load(folder), SolverSettings(samples_per_src=3_000, batch_receivers=40, max_num_paths_per_src=20_000),
          folder + "/truth.nc", ["d0", "d5"])
"""


def batch_files(folder):
    return sorted(folder.glob("cache/trace-*/device-*.npy"))


def test_killed_trace_loses_one_batch_and_ends_equal_to_the_bit(own_scene, tmp_path):
    whole = Scene(tmp_path / "whole", own_scene.config)
    own_scene.folder.rename(tmp_path / "killed")
    killed = tmp_path / "killed"
    subprocess.run(["cp", "-r", str(killed), str(whole.folder)], check=True)
    uninterrupted = trace_map(whole, SETTINGS, tmp_path / "whole.nc", ["d0", "d5"])
    total = len(batch_files(whole.folder))

    log = tmp_path / "calls"
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(killed), str(log)], start_new_session=True)
    deadline = time.monotonic() + 120
    while len(batch_files(killed)) < 5 and child.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(child.pid, signal.SIGKILL)
    assert child.wait() == -signal.SIGKILL
    finished = batch_files(killed)
    assert 5 <= len(finished) < total
    assert log.read_text().count("started") - len(finished) <= 1
    assert not (killed / "truth.nc").exists()

    times = {file: file.stat().st_mtime_ns for file in finished}
    resumed = trace_map(Scene.load(killed), SETTINGS, tmp_path / "killed.nc", ["d0", "d5"])
    assert {file: file.stat().st_mtime_ns for file in finished} == times
    assert len(batch_files(killed)) == total
    assert resumed.gain_db.tobytes() == uninterrupted.gain_db.tobytes()
    assert (tmp_path / "killed.nc").read_bytes() == (tmp_path / "whole.nc").read_bytes()


def test_two_solutions_are_equal_to_the_bit(small_scene):
    points_m = small_scene.lattice.positions_m[:100]
    first, second = (trace_gains(small_scene, small_scene.device_m[:2], points_m, SETTINGS) for _ in range(2))
    assert np.isfinite(first).mean() > 0.5
    assert first.tobytes() == second.tobytes()


def test_gain_does_not_depend_on_the_other_links(small_scene):
    """Not at all on the devices; on other points in a call in rare cases, as far as Sionna RT's hashing goes."""
    points_m = small_scene.lattice.positions_m[::4]
    together = trace_gains(small_scene, small_scene.device_m[:3], points_m, SETTINGS)
    alone = trace_gains(small_scene, small_scene.device_m[2:3], points_m, SETTINGS)
    assert alone[0].tobytes() == together[2].tobytes()
    order = np.random.default_rng(0).permutation(len(points_m))
    shuffled = trace_gains(small_scene, small_scene.device_m[2:3], points_m[order], SETTINGS)
    same = np.isclose(shuffled[0], alone[0, order], atol=1e-4, equal_nan=True)
    assert same.mean() > 0.95
    assert np.nanquantile(np.abs(shuffled[0] - alone[0, order]), 0.99) < 0.5


def test_link_is_the_same_both_ways(small_scene):
    """Rays start at one end only, so the two ways find the same paths but for what sampling misses."""
    settings = SolverSettings(samples_per_src=30_000, batch_receivers=20, max_num_paths_per_src=50_000)
    points_m = small_scene.lattice.positions_m[7::64][:8]
    there = trace_gains(small_scene, small_scene.device_m[:1], points_m, settings)[0]
    back = trace_gains(small_scene, points_m, small_scene.device_m[:1], settings)[:, 0]
    both = np.isfinite(there) & np.isfinite(back)
    assert both.sum() >= 6
    assert np.median(np.abs(there - back)[both]) < 0.5


def test_concrete_below_one_gigahertz_is_traced_with_a_warning(own_scene, caplog):
    radio = own_scene.config.radio.model_copy(update={"frequency_hz": 700e6})
    write_config(own_scene.config.model_copy(update={"radio": radio}), own_scene.folder / "scene.toml")
    scene = Scene.load(own_scene.folder)
    with caplog.at_level(logging.WARNING):
        gain_db = trace_gains(scene, scene.device_m[:1], scene.lattice.positions_m[:40], SETTINGS)
    assert "concrete for 1-100 GHz" in caplog.text and "0.7 GHz" in caplog.text
    assert np.isfinite(gain_db).any()


def test_cells_average_the_gains_of_points(small_scene, tmp_path):
    """Where a whole neighbourhood has LoS, the mean over its cells is that of its points."""
    cells = SolverSettings(solver="map", samples_per_src=300_000)
    averaged = trace_map(small_scene, cells, tmp_path / "cells.nc", devices=["d0"])
    assert averaged.dataset.attrs["solver"] == "map"
    los = averaged.los[0]
    clear = los.copy()
    for axis in (1, 2):
        clear &= np.roll(los, 1, axis) & np.roll(los, -1, axis)
    clear[:, [0, -1]] = clear[:, :, [0, -1]] = False
    assert clear.sum() > 20
    points_db = trace_gains(small_scene, small_scene.device_m[:1], small_scene.lattice.positions_m[clear.ravel()],
                            SETTINGS)[0]
    difference_db = averaged.gain_db[0][clear] - points_db
    assert abs(np.median(difference_db)) < 0.5
    assert np.quantile(np.abs(difference_db), 0.9) < 2.5
