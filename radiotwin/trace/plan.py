"""Estimated cost of a trace, from a few of its batches."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import loky
import numpy as np

from radiotwin.execution import Executor, Job
from radiotwin.execution.local import LocalPool
from radiotwin.execution.worker import peak_bytes
from radiotwin.scene import Scene
from radiotwin.trace.lattice_gains import lattice_pieces
from radiotwin.trace.link_job import KeptBatches, Links, link_job
from radiotwin.trace.run import device_indices, open_store
from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.tiles import with_radius

CALIBRATED = 6  # batches; the first one compiles kernels
NOISE_SHARE = 0.1  # of the time: 1 % of the links again with ten times the rays
WORKERS = (1, 2, 4, 8, 16, 64, 256)


@dataclass(frozen=True)
class TracePlan:
    """Cost of a trace.

    Attributes:
        links: Links of the map.
        batches: Batches of the map.
        finished: Of these, how many are kept from an earlier run.
        start_s: Time until a worker begins [s]: libraries, geometry, compilation.
        batch_s: Median processor time of a batch [s]: how long it takes on a core of its own.
        batch_p90_s: Processor time that nine in ten do not exceed [s].
        busy: How many times as long the batches took here, beside other work.
        peak_bytes: Memory that a worker took.
        memory_bytes: Most that a worker may take.
        workers: As many as this machine has cores and memory for.
    """

    links: int
    batches: int
    finished: int
    start_s: float
    batch_s: float
    batch_p90_s: float
    busy: float
    peak_bytes: int
    memory_bytes: int
    workers: int

    def seconds(self, workers: int) -> float:
        """Return the time that so many workers take, each on a core of this machine's kind [s]."""
        left = self.batches - self.finished
        if not left:
            return 0.0
        rounds = math.ceil((1 + NOISE_SHARE) * left / workers)
        return self.start_s + rounds * self.batch_s

    def rows(self, more: Sequence[int] = ()) -> list[tuple[int, float, float]]:
        """Return (workers, seconds, memory of all [bytes]) for some numbers of workers."""
        return [(count, self.seconds(count), count * float(self.memory_bytes))
                for count in sorted({*WORKERS, *more, self.workers})]


@dataclass(frozen=True)
class _Measured:
    """Solves a piece; also returns wall and processor time [s] and the most memory taken."""

    function: Any

    def __call__(self, piece: Links) -> tuple[np.ndarray, float, float, int]:
        wall_s, processor_s = time.perf_counter(), time.process_time()
        found = self.function(piece)
        return (found, time.perf_counter() - wall_s, time.process_time() - processor_s,
                peak_bytes())


def plan_trace(scene: Scene, settings: SolverSettings, devices: list[str] | None = None
               ) -> TracePlan:
    """Estimate what a map costs; the batches that are solved for that are kept for it.

    One worker on one core solves a few batches that are drawn by the settings' seed. Batches over
    dense parts of a city take longer than others: the figures are as good as the sample.

    Args:
        scene: City, devices and lattice.
        settings: Settings of the solver.
        devices: Names; None: all devices of the scene.

    Raises:
        BadInput: As `trace_map`.
        RunFailed: As `trace_map`, or there is not enough memory for one worker.
    """
    index = device_indices(scene, devices)
    settings = with_radius(scene, settings)
    store = open_store(scene, settings)
    kept, (pieces, _) = KeptBatches(store), lattice_pieces(scene, settings, index)
    missing = [piece for piece in pieces if kept.get(piece) is None]
    job = link_job(scene, settings, "calibrating")
    pool = LocalPool(1)
    try:
        rng = np.random.default_rng(settings.seed)
        count = min(CALIBRATED, len(missing))
        chosen = [missing[i] for i in rng.choice(len(missing), count, replace=False)]
        begun = time.perf_counter()
        found = Executor(pool).run(Job("calibrating", _Measured(job.function), job.resources, len),
                                   chosen)
        taken_s = time.perf_counter() - begun
        workers = max(min(LocalPool().room(job.resources), loky.cpu_count()), 1)
    finally:
        pool.close()
    for piece, (gain_db, *_) in zip(chosen, found):
        kept.put(piece, gain_db, [], 0.0)
    # The first one compiles kernels.
    walls_s, seconds = np.array([each[1:3] for each in found[1:] or found] or [(0.0, 0.0)]).T
    busy = float(walls_s.sum() / max(seconds.sum(), 1e-9)) if count else 1.0
    return TracePlan(
        links=sum(map(len, pieces)), batches=len(pieces),
        finished=len(pieces) - len(missing) + count,
        start_s=max(taken_s - walls_s.sum(), 0.0) / busy, batch_s=float(np.median(seconds)),
        batch_p90_s=float(np.quantile(seconds, 0.9)),
        busy=busy,
        peak_bytes=max((each[3] for each in found), default=0),
        memory_bytes=job.resources.memory_bytes, workers=workers)
