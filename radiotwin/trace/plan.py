"""Before a trace: estimate its cost from a few batches, and choose the quality by a few links."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import loky
import numpy as np

from radiotwin.errors import BadInput, RunFailed
from radiotwin.runtime.console import progress
from radiotwin.runtime.execution import Executor, Job, LocalPool
from radiotwin.runtime.jobs import peak_bytes
from radiotwin.runtime.pieces import cached
from radiotwin.scene import Scene
from radiotwin.trace.link_job import (
    LinkBatch,
    exchanged_calls,
    lattice_pieces,
    link_job,
    with_radius,
)
from radiotwin.trace.run import detected, device_indices, noise_figures, open_store
from radiotwin.trace.settings import FINER, QUALITIES, SolverSettings
from radiotwin.trace.solver import PathGains

CALIBRATED = 6  # batches that are timed; the first one also compiles kernels
NOISE_SHARE = 0.1  # additional time for the noise: 1 % of the links with ten times the rays
WORKERS = (1, 2, 4, 8, 16, 64, 256)
TARGETS_DB = (0.05, 20.0)  # allowed range of the error target
_CALLS, _POINTS = 4, 40  # of the pilot: calls of one device each, and points per call
_MIN_LINKS = 20  # detected links that an RMS needs


@dataclass(frozen=True)
class TracePlan:
    """Cost of a trace.

    Attributes:
        links: Number of links of the map.
        batches: Number of batches of the map.
        finished: Number of batches in the cache.
        start_s: Time until a worker begins [s]: libraries, geometry, compilation.
        batch_s: Median processor time of a batch [s].
        batch_p90_s: 90th percentile of the processor time of a batch [s].
        busy: Wall time over processor time of the timed batches: more than 1 on a busy machine.
        peak_bytes: Memory that the worker used.
        memory_bytes: Memory that a worker may use.
        workers: Number of workers that this machine has cores and memory for.
        exchanged: Number of additional batches, with exchanged ends.
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
    exchanged: int = 0

    def seconds(self, workers: int) -> float:
        """Estimate how long the rest of the trace takes [s] with a number of workers.

        Each has a core like this machine's. Counted are a worker's start, the unfinished batches,
        10 % more for the noise estimate, and batches with exchanged ends.
        """
        unfinished = self.batches - self.finished
        if not unfinished:
            return 0.0
        rounds = math.ceil(((1 + NOISE_SHARE) * unfinished + self.exchanged) / workers)
        return self.start_s + rounds * self.batch_s

    def rows(self) -> list[tuple[int, float, float]]:
        """Return (workers, duration [s], their memory [bytes]) for usual numbers of workers."""
        return [(count, self.seconds(count), count * float(self.memory_bytes))
                for count in sorted({*WORKERS, self.workers})]


@dataclass(frozen=True)
class _Measured:
    """Calls a function of a batch; also returns wall and processor time [s] and peak memory."""

    function: Any

    def __call__(self, piece: LinkBatch) -> tuple[np.ndarray, float, float, int]:
        wall_s, processor_s = time.perf_counter(), time.process_time()
        found = self.function(piece)
        return (found, time.perf_counter() - wall_s, time.process_time() - processor_s,
                peak_bytes())


def plan_trace(scene: Scene, settings: SolverSettings, devices: list[str] | None = None
               ) -> TracePlan:
    """Estimate the cost of a map by solving a few batches, which stay in the cache for the trace.

    One worker on one core solves a few batches that are drawn by the settings' seed. Batches over
    dense parts of a city take longer than others: the estimate is as good as the sample.

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
    pieces, _ = lattice_pieces(scene, settings, index)
    missing = [piece for piece in pieces if store.get(piece) is None]
    job = link_job(scene, settings, "calibrating")
    pool = LocalPool(1)
    try:
        rng = np.random.default_rng(settings.seed)
        count = min(CALIBRATED, len(missing))
        chosen = [missing[i] for i in rng.choice(len(missing), count, replace=False)]
        begun = time.perf_counter()
        found = Executor(pool).run(Job("calibrating", _Measured(job.function), job.resources, len),
                                   chosen)
        elapsed_s = time.perf_counter() - begun
        workers = max(min(LocalPool().room(job.resources), loky.cpu_count()), 1)
    finally:
        pool.close()
    for piece, (gain_db, *_) in zip(chosen, found):
        store.put(piece, gain_db, [], 0.0)
    # The first batch also compiles kernels
    walls_s, seconds = np.array([times[1:3] for times in found[1:] or found] or [(0.0, 0.0)]).T
    busy = float(walls_s.sum() / max(seconds.sum(), 1e-9)) if count else 1.0
    return TracePlan(
        links=sum(map(len, pieces)), batches=len(pieces),
        finished=len(pieces) - len(missing) + count,
        start_s=max(elapsed_s - walls_s.sum(), 0.0) / busy, batch_s=float(np.median(seconds)),
        batch_p90_s=float(np.quantile(seconds, 0.9)),
        busy=busy,
        peak_bytes=max((memory_bytes for *_, memory_bytes in found), default=0),
        memory_bytes=job.resources.memory_bytes, workers=workers,
        exchanged=exchanged_calls(scene, settings, len(index)) if settings.solver == "paths"
        else 0)


@dataclass(frozen=True)
class Rung:
    """Numerical error and cost of a quality on the pilot's links.

    Attributes:
        quality: `fast`, `default` or `high`.
        settings: Its settings.
        links: Links that are detected with its rays and with ten times as many.
        rms_db: RMS of the differences of their gains [dB].
        p90_db: 90th percentile of the absolute differences [dB].
        bias_db: Mean of the gains minus those with ten times the rays [dB].
        seconds_per_link: Duration of a full batch over its number of links [s].
    """

    quality: str
    settings: SolverSettings
    links: int
    rms_db: float
    p90_db: float
    bias_db: float
    seconds_per_link: float


def choose_quality(scene: Scene, points_m: np.ndarray, target_db: float,
                   devices: list[str] | None = None, **others: str | int | float | None
                   ) -> list[Rung]:
    """Find the quality with the fewest rays whose numerical error is within a target.

    Up to 160 links from devices to points outdoors are drawn by the settings' seed. They are
    solved with each quality, from the fewest rays on, and again with ten times its rays, until the
    RMS difference of detected links is within the target. `noise_floor_db` of a traced map is the
    same figure for 1 % of the map. In the context `keep_pieces`, each quality's gains are cached.

    Args:
        scene: City, devices and radio.
        points_m: (n, 3) positions of the receivers [m].
        target_db: Highest RMS difference [dB].
        devices: Names; None: all devices of the scene.
        others: Fields of `SolverSettings` that differ from the qualities'.

    Returns:
        The qualities that were tried; the last one reaches the target.

    Raises:
        BadInput: A target outside 0.05 to 20 dB, or that no quality reaches; an unknown device;
            the solver `map`; all points inside buildings.
        RunFailed: Too few of the links are detected; no usable libLLVM.
    """
    low_db, high_db = TARGETS_DB
    if not low_db <= target_db <= high_db:
        raise BadInput(f"target_db = {target_db:g}: allowed is {low_db:g} to {high_db:g} dB")
    if others.get("solver", "paths") != "paths":
        raise BadInput("the error target needs the solver 'paths'; give a quality instead")
    index = device_indices(scene, devices)
    outdoors_m = points_m[~scene.city.inside(points_m)]
    if not len(outdoors_m):
        raise BadInput(f"all {len(points_m)} points are inside buildings: nothing to estimate an "
                       "error from; give a quality instead of a target")
    tried: list[Rung] = []
    with progress("numerical error of a few links", total=len(QUALITIES)) as advance:
        for quality in QUALITIES:
            settings = SolverSettings.of_quality(quality, **others)
            calls = _draw_calls(outdoors_m, index, settings.seed)
            tried.append(_try_quality(scene, quality, settings, calls))
            advance(1)
            if tried[-1].rms_db <= target_db:
                return tried
    figures = ", ".join(f"{rung.quality} {rung.rms_db:.2f} dB" for rung in tried)
    raise BadInput(f"target_db = {target_db:g}: no quality reaches it here; RMS differences from "
                   f"ten times the rays, over {tried[-1].links} links: {figures}. Give a larger "
                   f"target, or --quality {tried[-1].quality}")


def _draw_calls(points_m: np.ndarray, index: Sequence[int], seed: int
                ) -> list[tuple[int, np.ndarray]]:
    """Draw the links on which qualities are compared: device and points (n, 3) of each call."""
    rng = np.random.default_rng([seed, len(points_m), *index])
    devices = np.resize(rng.permutation(index), _CALLS)
    count = min(_POINTS, len(points_m))
    return [(int(device), points_m[np.sort(rng.choice(len(points_m), count, replace=False))])
            for device in devices]


def _try_quality(scene: Scene, quality: str, settings: SolverSettings,
                 calls: list[tuple[int, np.ndarray]]) -> Rung:
    """Solve sampled links with a quality and with ten times its rays, and compare the gains."""
    solved = [cached("pilot", (scene.content_hash(), one.attributes(), *calls),
                     partial(_solve_pilot, scene, one, calls),
                     lambda found: ({"found": found}, None), lambda arrays, _: arrays["found"])
              for one in (settings, settings.finer(FINER))]
    coarse, finer = solved[0][:-1], solved[1][:-1]
    both = np.isfinite(coarse) & np.isfinite(finer)
    if both.sum() < _MIN_LINKS:
        raise RunFailed(f"of {coarse.size} links of the pilot {both.sum()} are detected; at least "
                        f"{_MIN_LINKS} are needed to estimate an error: give more points, or a "
                        "quality instead of a target")
    figures = noise_figures(coarse, finer)
    return Rung(quality, settings, int(both.sum()), float(figures["noise_floor_db"]),
                float(figures["noise_floor_p90_db"]), float(np.mean((coarse - finer)[both])),
                float(solved[0][-1]))


def _solve_pilot(scene: Scene, settings: SolverSettings, calls: list[tuple[int, np.ndarray]]
                 ) -> np.ndarray:
    """Return the drawn links' gains (n + 1,) [dB], NaN: not detected; last the seconds per link."""
    solver = PathGains(scene.xml_path, scene.config.radio.frequency_hz, settings)
    gains, seconds = [], []
    for device, points_m in calls:
        started = time.perf_counter()
        gains.append(solver.gains(scene.device_m[device], points_m,
                                  (scene.device_antennas[device], scene.uav_antenna)))
        solved = len(solver.batches(len(points_m))) * settings.batch_receivers
        seconds.append((time.perf_counter() - started) / solved)
    gain_db = detected(np.concatenate(gains), scene.config.gain_limit_db)
    return np.append(gain_db, np.median(seconds[1:]))  # the first call compiles the kernels
