"""Runs jobs where the user wants them: the order of the pieces, retries, the cache, progress.

It knows no backend.
"""

import logging
import math
import pickle
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic

from radiotwin.errors import BadInput, RunFailed
from radiotwin.runtime.console import progress
from radiotwin.runtime.execution.job import (
    Cache,
    Death,
    Job,
    NoCache,
    Outcome,
    P,
    Pool,
    R,
    Resources,
    Worker,
)
from radiotwin.runtime.execution.local import LocalPool
from radiotwin.runtime.pieces import noted_warnings
from radiotwin.runtime.processes import usable_cores

CHECK_S = 0.5  # between looks at the memory of the workers
RETRIES = 1  # of a piece whose worker died of something else than memory, before it is halved
AUTO = "auto"
PATIENCE_S = 20.0  # of `auto`: workers take about five seconds to start
MAX_WORKERS = 10_000


class Executor:
    """Runs jobs in this process, or on the workers of a pool.

    Results are the same to the bit, and in the order of the pieces, wherever they were computed.

    Args:
        pool: Workers; None: this process.
        patience_s: Work that takes less is done in this process: workers are started when what is
            left would take longer, judging by the pieces so far.
        say: Called with one line when workers are started.
    """

    def __init__(self, pool: Pool | None = None, patience_s: float = 0.0,
                 say: Callable[[str], None] = lambda text: None) -> None:
        self._pool, self._patience_s, self._say = pool, patience_s, say
        self._opened_s, self._has_workers = time.monotonic(), False
        self._said: set[str] = set()

    @property
    def is_worth_it(self) -> bool:
        """Whether other processes work already, or had better, as the work goes on for long."""
        return self._pool is not None and (
            self._has_workers or time.monotonic() - self._opened_s >= self._patience_s)

    def run_ahead(self, job: Job[P, R], pieces: Sequence[P], cache: Cache[P, R]) -> None:
        """Run in other processes what this one will need, for it to find it in the cache.

        Without other processes, or where they are not worth it, nothing is done. A piece that
        cannot be run there is left to this process, where its error shows; that it could not is
        said. Arguments are those of `run`.
        """
        if self.is_worth_it:
            missing = deque(_Todo(piece, lambda result: None) for piece in pieces
                            if cache.get(piece) is None)
            if missing:
                with progress(job.description, len(missing)) as advance:
                    try:
                        self._run_there(job, missing, cache, advance)
                    except RunFailed as error:
                        self._say_once(f"{error}. It is done in this process")

    def run(self, job: Job[P, R], pieces: Sequence[P], cache: Cache[P, R] | None = None
            ) -> list[R]:
        """Run a job.

        Args:
            job: Function and what it needs.
            pieces: Its arguments.
            cache: Results of earlier runs, and of this one as soon as they are there; None: none.

        Returns:
            Results in the order of the pieces.

        Raises:
            RunFailed: Workers died of a piece again and again, or cannot be had.
            Exception: Whatever the function raised; then the other pieces are given up.
        """
        kept = cache or NoCache()
        results: list[Any] = [None] * len(pieces)
        missing = []
        for place, piece in enumerate(pieces):
            found = kept.get(piece)
            if found is None:
                missing.append(_Todo(piece, partial(results.__setitem__, place)))
            else:
                results[place] = found[0]
        if missing:
            steps = sum(job.size(each.piece) for each in missing)
            with progress(job.description, total=steps) as advance:
                todo = deque(missing)
                if not self._has_workers:
                    self._run_here(job, todo, kept, advance, self._patience_s)
                if todo and not self._run_there(job, todo, kept, advance):
                    self._run_here(job, todo, kept, advance, math.inf)
        return results

    def _run_here(self, job: Job, todo: "deque[_Todo]", cache: Cache,
                  advance: Callable[..., None], patience_s: float) -> None:
        """Run pieces in this process until it has taken so long, or what is left would."""
        first_s = total_s = 0.0
        done = 0
        while todo and (self._pool is None or max(
                total_s, (total_s - first_s) / max(done - 1, 1) * len(todo)) < patience_s):
            one, started = todo.popleft(), time.perf_counter()
            with noted_warnings() as messages:
                result = job.function(one.piece)
            seconds = time.perf_counter() - started
            first_s, total_s, done = first_s or seconds, total_s + seconds, done + 1
            cache.put(one.piece, result, messages, seconds)
            one.deliver(result)
            advance(job.size(one.piece))

    def _run_there(self, job: Job, todo: "deque[_Todo]", cache: Cache,
                   advance: Callable[..., None]) -> bool:
        """Run pieces on workers; return whether there are any."""
        assert self._pool is not None
        workers = self._pool.prepare(_pickled(job), job.resources, len(todo))
        if not workers:
            return False
        self._has_workers = True
        self._say_once(_said(job, workers, self._pool))
        _Run(job, todo, cache, advance).on(workers)
        return True

    def _say_once(self, line: str) -> None:
        if line not in self._said:
            self._said.add(line)
            self._say(line)


@dataclass
class _Todo(Generic[P]):
    """A piece that is to be run.

    Attributes:
        piece: argument of the function.
        deliver: takes its result.
        deaths: number of workers that died of it.
        is_half: whether it is half of a piece that was too large.
    """

    piece: P
    deliver: Callable[[Any], None]
    deaths: int = 0
    is_half: bool = False


class _Run(Generic[P, R]):
    """A job on workers."""

    def __init__(self, job: Job[P, R], todo: "deque[_Todo[P]]", cache: Cache[P, R],
                 advance: Callable[..., None]) -> None:
        self._job, self._todo, self._cache, self._advance = job, todo, cache, advance
        self._shown: set[Any] = set()

    def on(self, workers: Sequence[Worker]) -> None:
        """Keep every worker at work until nothing is left."""
        idle = list(workers)
        running: dict[Future[Outcome], tuple[Worker, _Todo[P]]] = {}
        try:
            while self._todo or running:
                while self._todo and idle:
                    worker, one = idle.pop(), self._todo.popleft()
                    running[worker.submit(one.piece)] = worker, one
                done, _ = wait(running, timeout=CHECK_S, return_when=FIRST_COMPLETED)
                for future in done:
                    worker, one = running.pop(future)
                    idle.append(worker)
                    self._take(future, worker, one)
                for worker, _ in running.values():
                    worker.check()
        except BaseException:  # interrupted, too: what others still do is of no use
            for worker, _ in running.values():
                worker.close()
            raise

    def _take(self, future: "Future[Outcome]", worker: Worker, one: "_Todo[P]") -> None:
        error = future.exception()
        if error is None:
            self._finish(one, future.result())
            return
        death = worker.death(error)
        if death is None:
            raise worker.raised(error)
        self._again(one, death)

    def _finish(self, one: "_Todo[P]", outcome: Outcome) -> None:
        self._cache.put(one.piece, outcome.result, outcome.messages, outcome.seconds)
        self._show(outcome)
        one.deliver(outcome.result)
        self._advance(self._job.size(one.piece))

    def _show(self, outcome: Outcome) -> None:
        """Show what a worker warned of and logged, each text once."""
        for message in outcome.messages:
            if message not in self._shown:
                self._shown.add(message)
                warnings.warn(message, stacklevel=2)
        for record in outcome.records:
            if record not in self._shown:
                self._shown.add(record)
                name, level, text = record
                logging.getLogger(name).log(level, "%s", text)

    def _again(self, one: "_Todo[P]", death: Death) -> None:
        """Try a piece again after its worker has died: whole, or else in halves."""
        one.deaths += 1
        if not death.memory and one.deaths <= RETRIES:
            self._todo.appendleft(one)
            return
        halves, join = None if one.is_half else self._job.halve(one.piece), self._job.join
        if halves is None or join is None:
            what = "half a piece" if one.is_half else "a piece"
            raise RunFailed(f"{self._job.description}: the process that worked on {what} of the "
                            f"work ended {_times(one.deaths)} ({death.reason}); finished pieces "
                            f"are kept. {self._advice()}")
        warnings.warn(f"{self._job.description}: a piece is done in halves, as its process ended "
                      f"({death.reason}); single results may differ a little from those of the "
                      "whole piece", stacklevel=2)
        found: list[Any] = [None, None]

        def joined(place: int) -> Callable[[Any], None]:
            def deliver(result: Any) -> None:
                found[place] = (result,)
                if None not in found:
                    one.deliver(join(found[0][0], found[1][0]))
            return deliver

        for place, half in enumerate(halves):
            known = self._cache.get(half)
            if known is not None:
                joined(place)(known[0])
            else:
                self._todo.appendleft(_Todo(half, joined(place), is_half=True))

    def _advice(self) -> str:
        resources = self._job.resources
        if not resources.memory_bytes:
            return "Run it with fewer workers, or on a machine with more memory"
        return (f"A worker may take {_gigabytes(resources.memory_bytes)}; run it with fewer "
                "workers on a machine with more memory, or with a lower quality")


def _pickled(job: Job) -> bytes:
    import cloudpickle  # unlike pickle it takes functions of a script or a notebook

    try:
        return cloudpickle.dumps(job.function, protocol=pickle.HIGHEST_PROTOCOL)
    except (TypeError, pickle.PicklingError) as error:
        raise RunFailed(f"{job.description}: its function cannot be sent to another process "
                        f"({error}); run it with one worker") from None


def _said(job: Job, workers: Sequence[Worker], pool: Pool) -> str:
    """Return the line about the workers of a job."""
    each = _resources_text(job.resources)
    some = "1 worker" if len(workers) == 1 else f"{len(workers)} workers"
    return f"{job.description}: {some} on {pool.name}, {each} each"


def _resources_text(resources: Resources) -> str:
    cores = "1 core" if resources.cores == 1 else f"{resources.cores} cores"
    parts = [cores]
    if resources.memory_bytes:
        word = "at most" if resources.is_bound else "about"
        parts.append(f"{word} {_gigabytes(resources.memory_bytes)} of memory")
    if resources.gpu_share:
        parts.append(f"{resources.gpu_share:g} of a GPU")
    return ", ".join(parts)


def _gigabytes(count: int) -> str:
    return f"{count / 2**30:.1f} GiB"


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


@contextmanager
def open_executor(workers: str = AUTO, cluster: str | None = None,
                  say: Callable[[str], None] = lambda text: None) -> Iterator[Executor]:
    """Open a place where jobs run; all its processes have ended afterwards.

    Args:
        workers: Number of processes. `1`: this one. `auto`: as many as there are cores and memory,
            where the work takes long enough to be worth it.
        cluster: None: this machine. `auto`: a Ray cluster of its own on this machine. Else the
            address of a Ray cluster.
        say: Called with a line about the workers of each job.

    Raises:
        BadInput: Not a number of workers, or no such cluster.
    """
    count = worker_count(workers)
    if cluster is None and (count == 1 or (count is None and usable_cores() == 1)):
        yield Executor()
        return
    pool = LocalPool(count) if cluster is None else _ray_pool(cluster, count)
    try:
        yield Executor(pool, 0.0 if count or cluster else PATIENCE_S, say)
    finally:
        pool.close()


def worker_count(workers: str) -> int | None:
    """Return the number of processes that the user gives; None for `auto`.

    Raises:
        BadInput: not a number of workers.
    """
    if workers == AUTO:
        return None
    if not (workers.isascii() and workers.isdigit() and 0 < int(workers) <= MAX_WORKERS):
        raise BadInput(f"--workers {workers[:60]!r}: allowed are auto, or a number from 1 to "
                       f"{MAX_WORKERS}")
    return int(workers)


def _ray_pool(cluster: str, workers: int | None) -> Pool:
    from radiotwin.runtime.execution.ray_pool import RayPool

    return RayPool(cluster, workers)
