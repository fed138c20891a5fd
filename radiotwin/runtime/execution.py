"""Run jobs in this process, on worker processes of this machine, or on a Ray cluster.

The executor keeps the order of the pieces, retries them, fills the cache and shows progress. Each
local worker is a loky pool of one process, so that the piece of a dead worker is known and the
others go on. Unlike Python's pools, loky starts processes without running the user's script again
(no `if __name__ == "__main__"` needed), sets their environment before any library is imported, and
reports their death as an error instead of a deadlock.
"""

import logging
import math
import os
import pickle
import signal
import sys
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
from radiotwin.io.signals import kept_from_children
from radiotwin.runtime.console import progress
from radiotwin.runtime.jobs import (
    SHARE_ROUNDING,
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
    begin_worker,
    run_piece,
    thread_variables,
)
from radiotwin.runtime.pieces import noted_warnings
from radiotwin.runtime.processes import free_memory_bytes, resident_bytes, usable_cores

__all__ = ["AUTO", "Executor", "Job", "LocalPool", "Resources", "open_executor", "start_process",
           "worker_count"]

_NO_LEAK_CHECK = {"LOKY_MAX_MEMORY_LEAK_SIZE": "1e15"}  # the memory is bounded here
CHECK_S = 0.5  # between checks of the workers' memory
RETRIES = 1  # of a piece whose worker died, but not of memory, before the piece is halved
AUTO = "auto"
PATIENCE_S = 20.0  # work that takes longer gets workers; they take about five seconds to start
MAX_WORKERS = 10_000


class Executor:
    """Runs jobs in this process, or on the workers of a pool.

    Results are in the order of the pieces, and the same to the bit wherever they were computed,
    except those of a piece that was done in halves after its worker died (`Job.halve`): a warning
    says so.

    Args:
        pool: of workers; None: this process.
        patience_s: start workers if the remaining pieces would take longer than this in this
            process, extrapolated from the pieces so far.
        say: called with one line when workers are started.
    """

    def __init__(self, pool: Pool | None = None, patience_s: float = 0.0,
                 say: Callable[[str], None] = lambda text: None) -> None:
        self._pool, self._patience_s, self._say = pool, patience_s, say
        self._opened_s, self._has_workers = time.monotonic(), False
        self._said: set[str] = set()

    @property
    def is_worth_it(self) -> bool:
        """Whether workers are running, or the executor has been open longer than `patience_s`."""
        return self._pool is not None and (
            self._has_workers or time.monotonic() - self._opened_s >= self._patience_s)

    def run_ahead(self, job: Job[P, R], pieces: Sequence[P], cache: Cache[P, R]) -> None:
        """Compute in worker processes the results that this process will need, into the cache.

        Nothing is done unless `is_worth_it`. If workers fail, a message says so, and the missing
        results are left to this process. Arguments are those of `run`.
        """
        if self.is_worth_it:
            missing = deque(_Todo(piece, lambda result: None) for piece in pieces
                            if cache.get(piece) is None)
            if missing:
                with progress(job.description, len(missing)) as advance:
                    try:
                        self._run_on_workers(job, missing, cache, advance)
                    except RunFailed as error:
                        self._say_once(f"{error}. It is done in this process")

    def run(self, job: Job[P, R], pieces: Sequence[P], cache: Cache[P, R] | None = None
            ) -> list[R]:
        """Call a job's function with each piece, here or on workers, and return the results.

        Args:
            job: function and resources.
            pieces: arguments of the function.
            cache: of finished results; new ones are added at once. None: no cache.

        Returns:
            results in the order of the pieces.

        Raises:
            RunFailed: workers died repeatedly on one piece, or cannot be started.
            Exception: any error of the function; the other pieces are cancelled.
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
                    self._run_in_process(job, todo, kept, advance, self._patience_s)
                if todo and not self._run_on_workers(job, todo, kept, advance):
                    self._run_in_process(job, todo, kept, advance, math.inf)
        return results

    def _run_in_process(self, job: Job, todo: "deque[_Todo]", cache: Cache,
                        advance: Callable[..., None], patience_s: float) -> None:
        """Run pieces of `todo` in this process, and remove them, until it would take too long.

        That is if the time so far, or the extrapolated time of the pieces left (by the mean of all
        but the first), exceeds `patience_s` [s]. Without a pool all are run.
        """
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

    def _run_on_workers(self, job: Job, todo: "deque[_Todo]", cache: Cache,
                        advance: Callable[..., None]) -> bool:
        """Run all pieces of `todo` on workers; return False, and run none, if the pool has none."""
        assert self._pool is not None
        workers = self._pool.prepare(_pickled(job), job.resources, len(todo))
        if not workers:
            return False
        self._has_workers = True
        self._say_once(_workers_text(job, workers, self._pool))
        _Run(job, todo, cache, advance).on(workers)
        return True

    def _say_once(self, line: str) -> None:
        if line not in self._said:
            self._said.add(line)
            self._say(line)


@dataclass
class _Todo(Generic[P]):
    """A piece to run.

    Attributes:
        piece: argument of the function.
        deliver: called with its result.
        deaths: number of workers that died while they ran it.
        is_half: whether it is half of a piece whose worker died.
    """

    piece: P
    deliver: Callable[[Any], None]
    deaths: int = 0
    is_half: bool = False


class _Run(Generic[P, R]):
    """Run of one job on workers."""

    def __init__(self, job: Job[P, R], todo: "deque[_Todo[P]]", cache: Cache[P, R],
                 advance: Callable[..., None]) -> None:
        self._job, self._todo, self._cache, self._advance = job, todo, cache, advance
        self._shown: set[Any] = set()

    def on(self, workers: Sequence[Worker]) -> None:
        """Hand pieces to idle workers until all are done."""
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
                    self._collect(future, worker, one)
                for worker, _ in running.values():
                    worker.check()
        except BaseException:  # also a signal: the running pieces are not needed any more
            for worker, _ in running.values():
                worker.close()
            raise

    def _collect(self, future: "Future[Outcome]", worker: Worker, one: "_Todo[P]") -> None:
        """Store a result; retry the piece if its worker died; raise an error of its function."""
        error = future.exception()
        if error is None:
            self._finish(one, future.result())
            return
        death = worker.death(error)
        if death is None:
            raise worker.raised(error)
        self._retry(one, death)

    def _finish(self, one: "_Todo[P]", outcome: Outcome) -> None:
        self._cache.put(one.piece, outcome.result, outcome.messages, outcome.seconds)
        self._show(outcome)
        one.deliver(outcome.result)
        self._advance(self._job.size(one.piece))

    def _show(self, outcome: Outcome) -> None:
        """Show the warnings and log records of a worker in this process, each text once."""
        for message in outcome.messages:
            if message not in self._shown:
                self._shown.add(message)
                warnings.warn(message, stacklevel=2)
        for record in outcome.records:
            if record not in self._shown:
                self._shown.add(record)
                name, level, text = record
                logging.getLogger(name).log(level, "%s", text)

    def _retry(self, one: "_Todo[P]", death: Death) -> None:
        """Run a piece again whose worker died, as a whole, then in halves; or raise RunFailed."""
        one.deaths += 1
        if not death.memory and one.deaths <= RETRIES:
            self._todo.appendleft(one)
            return
        halves, join = None if one.is_half else self._job.halve(one.piece), self._job.join
        if halves is None or join is None:
            what = "half a piece" if one.is_half else "a piece"
            times = "once" if one.deaths == 1 else f"{one.deaths} times"
            raise RunFailed(f"{self._job.description}: the process that worked on {what} of the "
                            f"work ended {times} ({death.reason}); finished pieces "
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
        """Return what to do about a piece that cannot be run, as the end of a message."""
        resources = self._job.resources
        if not resources.memory_bytes:
            return "Run it with fewer workers, or on a machine with more memory"
        return (f"A worker may take {_gigabytes(resources.memory_bytes)}; run it with fewer "
                "workers on a machine with more memory, or with a lower quality")


def _pickled(job: Job) -> bytes:
    """Pickle the function of a job; RunFailed if that is impossible."""
    import cloudpickle  # unlike pickle it takes functions of a script or a notebook

    try:
        return cloudpickle.dumps(job.function, protocol=pickle.HIGHEST_PROTOCOL)
    except (TypeError, pickle.PicklingError) as error:
        raise RunFailed(f"{job.description}: its function cannot be sent to another process "
                        f"({error}); run it with one worker") from None


def _workers_text(job: Job, workers: Sequence[Worker], pool: Pool) -> str:
    """Return the message about the number and size of a job's workers."""
    resources = job.resources
    parts = ["1 core" if resources.cores == 1 else f"{resources.cores} cores"]
    if resources.memory_bytes:
        word = "at most" if resources.is_bound else "about"
        parts.append(f"{word} {_gigabytes(resources.memory_bytes)} of memory")
    if resources.gpu_share:
        parts.append(f"{resources.gpu_share:g} of a GPU")
    some = "1 worker" if len(workers) == 1 else f"{len(workers)} workers"
    return f"{job.description}: {some} on {pool.name}, {', '.join(parts)} each"


def _gigabytes(count: int) -> str:
    return f"{count / 2**30:.1f} GiB"


class LocalPool(Pool["_LocalWorker"]):
    """Processes of this machine: a number of them, or (None) as many as cores and memory allow."""

    name = "this machine"

    def prepare(self, function: bytes, resources: Resources, count: int) -> Sequence[Worker]:
        """Return workers for a job, at most `count`; running ones are used again, others ended.

        Empty if fewer than two would be chosen automatically; RunFailed if a requested number does
        not fit.
        """
        room, on_gpu = self.room(resources), sys.maxsize
        if resources.gpu_share:  # of the first GPU, which CUDA gives to all processes
            on_gpu = int(1 / resources.gpu_share + SHARE_ROUNDING)
        wanted = min(self._most or min(room, on_gpu, _cores() // resources.cores), count)
        if self._most is None and wanted < 2:
            return []
        if room < wanted:
            raise RunFailed(
                f"{wanted} worker(s) may take {resources.memory_bytes / 2**30:.1f} GiB of "
                f"memory each, and {room} would fit into what is free on this machine; ask for "
                "fewer, choose a lower quality, or a machine with more memory")
        if on_gpu < wanted:
            raise RunFailed(f"{wanted} workers are asked for, and {on_gpu} share a GPU "
                            f"({resources.gpu_share:g} of it each); ask for fewer")
        reusable = [each for each in self._workers if each.resources.cores == resources.cores]
        for each in [each for each in self._workers if each not in reusable] + reusable[wanted:]:
            each.close()
        self._workers = reusable[:wanted]
        while len(self._workers) < wanted:
            self._workers.append(_LocalWorker(resources))
        for each in self._workers:
            each.function, each.resources = function, resources
        return self._workers

    def room(self, resources: Resources) -> int:
        """Return how many workers fit into free memory; as many as cores if memory is unknown."""
        free = free_memory_bytes()
        if free is None or not resources.memory_bytes:
            return max(self._most or 0, _cores() // resources.cores)
        # Present workers free their memory when they get the next job.
        return (free + sum(each.memory_bytes for each in self._workers)) // resources.memory_bytes


def _cores() -> int:
    import loky

    return loky.cpu_count()  # of the control group, too


def start_process(environment: dict[str, str]) -> tuple[Any, "Future[int]"]:
    """Start a process that ignores Ctrl-C; return its loky pool and a future of its process id."""
    import loky
    from loky.backend import resource_tracker

    with kept_from_children():
        resource_tracker.ensure_running()
        pool = loky.ProcessPoolExecutor(1, env=environment | _NO_LEAK_CHECK)
        return pool, pool.submit(begin_worker, os.getpid())


class _LocalWorker(Worker):
    """A process of this machine; it is killed if it exceeds its memory."""

    _begun: "Future[int]"
    _over_memory = False

    @property
    def memory_bytes(self) -> int:
        """Present memory of the process."""
        if self.process is None or not self._begun.done() or self._begun.exception() is not None:
            return 0
        return resident_bytes(self._begun.result())

    def start(self) -> None:
        self._over_memory = False
        self.process, self._begun = start_process(thread_variables(self.resources.cores))

    def run(self, *arguments: Any) -> "Future[Outcome]":
        return self.process.submit(run_piece, *arguments)

    def death(self, error: BaseException) -> Death | None:
        """Return why the process died, if an error means that; None: an error of the function."""
        import loky

        if not isinstance(error, loky.process_executor.TerminatedWorkerError):
            return None
        over_memory = self._over_memory
        self.close()
        if over_memory:
            return Death(f"it took more than {self.resources.memory_bytes / 2**30:.1f} GiB of "
                         "memory", memory=True)
        codes = str(error).partition("exit codes of the workers are ")[2].partition("\n")[0]
        return Death(codes.strip("{}") or "killed")

    def check(self) -> None:
        resources = self.resources
        if resources.is_bound and 0 < resources.memory_bytes < self.memory_bytes:
            self._over_memory = True
            os.kill(self._begun.result(), signal.SIGKILL)

    def close(self) -> None:
        if self.process is not None:
            self.process.shutdown(wait=True, kill_workers=True)
            self.process = None


@contextmanager
def open_executor(workers: str = AUTO, cluster: str | None = None,
                  say: Callable[[str], None] = lambda text: None) -> Iterator[Executor]:
    """Open an executor of jobs; all its processes end with the block.

    Args:
        workers: number of processes. `1`: this process. `auto`: as many as cores and memory allow,
            if the work takes longer than `PATIENCE_S`.
        cluster: None: this machine. `auto`: a new Ray cluster on this machine. Else the address of
            a Ray cluster.
        say: called with a line about the workers of each job.

    Raises:
        BadInput: `workers` is no number of workers, or there is no such cluster.
    """
    count = worker_count(workers)
    if cluster is None and (count == 1 or (count is None and usable_cores() == 1)):
        yield Executor()
        return
    pool: Pool
    if cluster is None:
        pool = LocalPool(count)
    else:
        from radiotwin.runtime.ray_pool import RayPool

        pool = RayPool(cluster, count)
    try:
        yield Executor(pool, 0.0 if count or cluster else PATIENCE_S, say)
    finally:
        pool.close()


def worker_count(workers: str) -> int | None:
    """Parse the option `--workers`; None for `auto`. BadInput if it is no number from 1."""
    if workers == AUTO:
        return None
    if not (workers.isascii() and workers.isdigit() and 0 < int(workers) <= MAX_WORKERS):
        raise BadInput(f"--workers {workers[:60]!r}: allowed are auto, or a number from 1 to "
                       f"{MAX_WORKERS}")
    return int(workers)
