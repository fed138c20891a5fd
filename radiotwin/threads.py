"""Work that is mostly compiled code which lets other threads run: rays, paths."""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
MOST = 4  # more wait for each other: the parts between run one at a time


def usable_cores() -> int:
    """Return the number of cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):  # missing on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def allowed_cores() -> int:
    """Return the number of cores that this process may use: no more than OMP_NUM_THREADS."""
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return min(usable_cores(), max(int(limit), 1) if limit.isdigit() else usable_cores())


def thread_count() -> int:
    """Return how many threads may run: the process's cores, no more than OMP_NUM_THREADS."""
    return min(allowed_cores(), MOST)


def in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return a function's results in the order of its arguments.

    Args:
        function: changes nothing that other calls read. A progress bar of its own needs one that is
            open around all.
        items: arguments, one a call.
    """
    listed = list(items)
    count = min(thread_count(), len(listed))
    if count < 2:
        return [function(item) for item in listed]
    pool = ThreadPoolExecutor(count)
    try:
        return list(pool.map(function, listed))
    finally:
        pool.shutdown(cancel_futures=True)  # interrupted: what has not begun does not begin
