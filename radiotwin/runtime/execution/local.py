"""Workers on this machine: one process each, by loky.

loky rather than the pools of Python: its processes are spawned without running the user's script
again (no `if __name__ == "__main__"` needed, also in notebooks), get an environment of their own
before any library is imported, and their death is an error instead of a deadlock. Each worker is a
pool of one process, so that it is known whose piece a dead one had, and the others go on.
"""

import os
import signal
import sys
from collections.abc import Sequence
from concurrent.futures import Future
from typing import Any

from radiotwin.errors import RunFailed
from radiotwin.io.signals import deferred, kept_from_children
from radiotwin.runtime.execution.job import (
    SHARE_ROUNDING,
    Death,
    Outcome,
    Pool,
    Resources,
    Worker,
    begin,
    run_piece,
    thread_variables,
)
from radiotwin.runtime.processes import free_memory_bytes, resident_bytes

_NO_LEAK_CHECK = {"LOKY_MAX_MEMORY_LEAK_SIZE": "1e15"}  # the memory is bounded here


class LocalPool(Pool):
    """Processes of this machine.

    Args:
        workers: Most of them; None: as many as there are cores and memory.
    """

    name = "this machine"

    def __init__(self, workers: int | None = None) -> None:
        self._most = workers
        self._workers: list[_LocalWorker] = []

    def prepare(self, function: bytes, resources: Resources, count: int) -> Sequence[Worker]:
        """Return workers for a job; those that are there already are used again."""
        room, on_gpu = self.room(resources), _room_on_gpu(resources)
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
            self._workers.append(_LocalWorker())
        for each in self._workers:
            each.function, each.resources = function, resources
        return self._workers

    def room(self, resources: Resources) -> int:
        """Return how many workers fit into memory; the number of cores where it is not known."""
        free = free_memory_bytes()
        if free is None or not resources.memory_bytes:
            return max(self._most or 0, _cores() // resources.cores)
        # What workers take now is free once they are given the next job.
        return (free + sum(each.memory_bytes for each in self._workers)) // resources.memory_bytes

    def close(self) -> None:
        """End all workers."""
        with deferred():
            for each in self._workers:
                each.close()
            self._workers = []


def _room_on_gpu(resources: Resources) -> int:
    """Return how many workers share one GPU; CUDA gives all of a machine the first one."""
    if not resources.gpu_share:
        return sys.maxsize
    return int(1 / resources.gpu_share + SHARE_ROUNDING)


def _cores() -> int:
    import loky

    return loky.cpu_count()  # of the control group, too


def start_process(environment: dict[str, str]) -> tuple[Any, "Future[int]"]:
    """Return loky's pool of one new process, which gets no Ctrl-C; and its number, once begun."""
    import loky
    from loky.backend import resource_tracker

    with kept_from_children():
        resource_tracker.ensure_running()
        pool = loky.ProcessPoolExecutor(1, env=environment | _NO_LEAK_CHECK)
        return pool, pool.submit(begin, os.getpid())


class _LocalWorker(Worker):
    def __init__(self) -> None:
        self.function, self.resources = b"", Resources()
        self._sent = b""
        self._pool: Any = None
        self._begun: Future[int] = Future()
        self._over_memory = False

    @property
    def memory_bytes(self) -> int:
        """Memory that the process takes now."""
        begun = self._begun.done() and self._begun.exception() is None
        return resident_bytes(self._begun.result()) if begun else 0

    def submit(self, piece: Any) -> "Future[Outcome]":
        if self._pool is None:
            self._start()
        if self._sent == self.function:
            return self._pool.submit(run_piece, piece)
        self._sent = self.function
        return self._pool.submit(run_piece, piece, self.function)

    def _start(self) -> None:
        self._over_memory, self._sent = False, b""
        self._pool, self._begun = start_process(thread_variables(self.resources.cores))

    def death(self, error: BaseException) -> Death | None:
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

    def raised(self, error: BaseException) -> BaseException:
        return error

    def check(self) -> None:
        resources = self.resources
        if resources.is_bound and 0 < resources.memory_bytes < self.memory_bytes:
            self._over_memory = True
            os.kill(self._begun.result(), signal.SIGKILL)

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, kill_workers=True)
            self._pool, self._begun = None, Future()
