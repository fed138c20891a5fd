"""What a trace would cost: counts are exact, times are those of the batches, and nothing is wasted."""

import pytest

from radiotwin.trace import SolverSettings, trace_map
from radiotwin.trace.plan import CALIBRATED, TracePlan, plan_trace

PLAN = TracePlan(links=10_000, batches=100, finished=6, start_s=5.0, batch_s=2.0, batch_p90_s=3.0, busy=1.0,
                 peak_bytes=2**30, memory_bytes=2**31, workers=2)


def test_workers_share_what_is_left():
    """94 batches and a tenth more for the noise: 103.4, in rounds."""
    assert PLAN.seconds(1) == 5 + 2 * 104
    assert PLAN.seconds(2) == 5 + 2 * 52
    assert PLAN.seconds(64) == 5 + 2 * 2
    assert PLAN.seconds(10_000) == 5 + 2
    rows = PLAN.rows()
    assert [count for count, *_ in rows] == [1, 2, 4, 8, 16, 64, 256]
    assert rows[1] == (2, 109.0, 2 * 2.0**31)


@pytest.mark.llvm
def test_the_batches_of_a_plan_are_kept_for_the_map(own_scene, tmp_path, monkeypatch):
    settings = SolverSettings(samples_per_src=3_000, batch_receivers=40, max_num_paths_per_src=20_000)
    plan = plan_trace(own_scene, settings, ["d0", "d1"])
    assert plan.links == 2 * len(own_scene.lattice.positions_m)
    assert plan.batches == 2 * 13 and plan.finished == CALIBRATED
    assert 0 < plan.batch_s <= plan.batch_p90_s < 10 and plan.start_s > 0
    assert plan.peak_bytes > 2e8  # of this process, in which other tests have run
    assert plan.memory_bytes == settings.memory_bytes()
    files = {path: path.stat().st_mtime_ns for path in own_scene.folder.glob("cache/trace-*/device-*.npy")}
    assert len(files) == CALIBRATED
    trace_map(own_scene, settings, tmp_path / "map.nc", ["d0", "d1"])
    assert {path: path.stat().st_mtime_ns for path in files} == files
    assert plan_trace(own_scene, settings, ["d0", "d1"]).seconds(1) == 0
