"""From what a user says about workers to an executor."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from radiotwin.errors import BadInput
from radiotwin.execution.executor import Executor
from radiotwin.execution.local import LocalPool
from radiotwin.execution.pool import Pool
from radiotwin.threads import usable_cores

AUTO = "auto"
PATIENCE_S = 20.0  # of `auto`: workers take about five seconds to start
MAX_WORKERS = 10_000


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
    from radiotwin.execution.ray_pool import RayPool

    return RayPool(cluster, workers)
