"""Cost of workers: `workers`, a trace by one process, by local ones and by Ray; `scheduler`."""

import os
import threading
import time
import uuid
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from radiotwin import Scene, SolverSettings
from radiotwin.runtime.execution import Executor, Job, Resources, open_executor
from radiotwin.runtime.execution.job import Death, Outcome, Pool, Worker
from radiotwin.trace import trace_gains
from studies.runner import Study
from studies.tables import markdown, scene_folder

PLACES = {"one process": ("1", None), "1 local worker": ("1 process", None),
          "2 local workers": ("2", None), "2 workers on Ray": ("2", "auto")}
MARK = "RADIOTWIN_STUDY_OF_WORKERS"
SAMPLE_S = 0.2


def worker_cases(seed: int) -> dict[str, dict]:
    """Return places; each has one core a process, so that speeds are comparable."""
    def case(place: str, devices: int, points: int) -> dict:
        return {"scene": "rbm", "quality": "fast", "devices": devices, "points": points,
                "place": place}

    return {**{name: case(name, 5, 3000) for name in PLACES},
            **{f"{name}, whole map": case(name, 10, 3813)
               for name in ("2 local workers", "2 workers on Ray")}}


def measure_workers(seed: int, settings: dict) -> dict:
    """Trace once with kernels that are compiled already.

    Returns:
        Wall time, processor time of this and all other processes from the start of the workers to
        their end [s], links, the hash of the gains, and the load of the machine before.
    """
    scene = Scene.load(scene_folder(settings["scene"]))
    solver = SolverSettings.of_quality(settings["quality"])
    points_m = scene.lattice.positions_m[~scene.blocked.ravel()]
    rng = np.random.default_rng(seed)
    points_m = points_m[np.sort(rng.choice(len(points_m), settings["points"], replace=False))]
    device_m = scene.device_m[:settings["devices"]]
    load = os.getloadavg()[0]
    trace_gains(scene, device_m[:1], points_m[:solver.batch_receivers], solver)  # compiles
    workers, cluster = PLACES[settings["place"]]
    os.environ["OMP_NUM_THREADS"] = "1"
    started, own_s = time.perf_counter(), time.process_time()
    with _processor_time() as others_s:
        with _opened(workers, cluster) as executor:
            gain_db = trace_gains(scene, device_m, points_m, solver, executor=executor)
    return {"links": gain_db.size, "wall_s": time.perf_counter() - started,
            "processor_s": time.process_time() - own_s + others_s(), "load_before": load,
            "sha256": sha256(gain_db.tobytes()).hexdigest()[:16]}


@contextmanager
def _opened(workers: str, cluster: str | None) -> Iterator[Executor]:
    from radiotwin.runtime.execution.local import LocalPool

    if workers != "1 process":
        with open_executor(workers, cluster) as executor:
            yield executor
        return
    pool = LocalPool(1)
    try:
        yield Executor(pool)
    finally:
        pool.close()


@contextmanager
def _processor_time() -> Iterator[Any]:
    """Yield a function: processor time [s] of all processes that were started inside."""
    mark, seen, done = uuid.uuid4().hex, dict[int, float](), threading.Event()
    os.environ[MARK] = mark
    tick_s = os.sysconf("SC_CLK_TCK")

    def sample() -> None:
        while not done.wait(SAMPLE_S):
            for folder in Path("/proc").glob("[0-9]*"):
                try:
                    if int(folder.name) != os.getpid() \
                            and mark.encode() in (folder / "environ").read_bytes():
                        fields = (folder / "stat").read_text().rpartition(")")[2].split()
                        seen[int(folder.name)] = (int(fields[11]) + int(fields[12])) / tick_s
                except (OSError, ValueError):
                    continue

    sampler = threading.Thread(target=sample)
    sampler.start()
    try:
        yield lambda: sum(seen.values())
    finally:
        done.set()
        sampler.join()
        del os.environ[MARK]


def worker_table(rows: pd.DataFrame) -> str:
    """Return times by place, and how they compare."""
    def seconds(place: str, kind: str) -> dict[tuple, float]:
        return {(row["seed"], row["links"]): row[kind] for _, row in rows.iterrows()
                if row["name"].split(",")[0] == place}

    local, one = seconds("2 local workers", "processor_s"), seconds("1 local worker", "wall_s")
    lines = []
    for _, row in rows.iterrows():
        of = row["seed"], row["links"]
        faster = f"{one[of] / row['wall_s']:.2f}" if of in one else "–"
        lines.append([
            row["name"], str(row["seed"]), f"{row['links']:,}", f"{row['wall_s']:.1f}",
            f"{row['processor_s']:.1f}",
            f"{row['processor_s'] / local.get(of, np.nan):.2f}", faster,
            f"{row['load_before']:.1f}", f"`{row['sha256']}`"])
    return markdown(["place", "seed", "links", "wall [s]", "processor [s]",
                     "processor time against 2 local", "speed against 1 local", "load before",
                     "hash of the gains"], lines)


class _Simulated(Worker):
    """A worker that waits instead of working."""

    def __init__(self, threads: ThreadPoolExecutor) -> None:
        self._threads = threads

    def submit(self, piece: float) -> "Future[Outcome]":
        return self._threads.submit(self._wait, piece)

    def _wait(self, seconds: float) -> Outcome:
        time.sleep(seconds)
        return Outcome(seconds, seconds=seconds)

    def raised(self, error: BaseException) -> BaseException:
        return error

    def death(self, error: BaseException) -> Death | None:
        return None

    def check(self) -> None:
        pass

    def close(self) -> None:
        pass


class _SimulatedPool(Pool):
    """So many workers that wait instead of working."""

    name = "no machine"

    def __init__(self, workers: int) -> None:
        self._count, self._threads = workers, ThreadPoolExecutor(workers)

    def prepare(self, function: bytes, resources: Resources, count: int) -> Sequence[Worker]:
        return [_Simulated(self._threads) for _ in range(min(self._count, count))]

    def close(self) -> None:
        self._threads.shutdown()


def scheduler_cases(seed: int) -> dict[str, dict]:
    """Return numbers of workers; the pieces take as long as a batch of `default` does."""
    return {f"{count} workers": {"workers": count, "pieces_each": 10, "mean_s": 1.6}
            for count in (4, 16, 64)}


def measure_scheduler(seed: int, settings: dict) -> dict:
    """Run pieces that only wait: exponential times around a mean.

    Returns:
        Wall time, the least that any order could take, and processor time a piece [s].
    """
    count = settings["workers"] * settings["pieces_each"]
    seconds = np.random.default_rng(seed).exponential(settings["mean_s"], count)
    pool = _SimulatedPool(settings["workers"])
    started, own_s = time.perf_counter(), time.process_time()
    Executor(pool).run(Job("waiting", float), seconds.tolist())
    wall_s, own_s = time.perf_counter() - started, time.process_time() - own_s
    pool.close()
    bound_s = max(seconds.sum() / settings["workers"], seconds.max())
    return {"pieces": count, "wall_s": wall_s, "bound_s": bound_s,
            "processor_ms_per_piece": 1000 * own_s / count}


def scheduler_table(rows: pd.DataFrame) -> str:
    """Return what the order of the pieces and the scheduler cost."""
    return markdown(
        ["workers", "seed", "pieces", "wall [s]", "lower bound [s]", "scheduler [ms a piece]"],
        [[row["name"], str(row["seed"]), str(row["pieces"]), f"{row['wall_s']:.2f}",
          f"{row['bound_s']:.2f}", f"{row['processor_ms_per_piece']:.2f}"]
         for _, row in rows.iterrows()])


STUDIES = {
    "workers": Study("What do workers of this machine, and of Ray, cost and bring?",
                     measure_workers, worker_cases, worker_table, seeds=1),
    "scheduler": Study("What does the scheduler cost with many workers?",
                       measure_scheduler, scheduler_cases, scheduler_table, seeds=1)}
