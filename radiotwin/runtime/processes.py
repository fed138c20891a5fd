"""This process, its machine and its threads: memory, cores, the end together with its parent."""

import ctypes
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

PARENT_CHECK_S = 1.0
_GROUPS = Path("/sys/fs/cgroup")
Item = TypeVar("Item")
Result = TypeVar("Result")
MOST = 4  # more wait for each other: the parts between run one at a time


def die_with_parent(parent: int) -> None:
    """Have this process end when the one that started it is killed, or has died already.

    On Linux the kernel sees to it, even in a long computation; elsewhere a thread looks once a
    second (on Windows nothing does).
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, int(signal.SIGKILL))  # PR_SET_PDEATHSIG of sys/prctl.h
        if os.getppid() != parent:
            os._exit(1)
    elif os.name == "posix":
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(PARENT_CHECK_S)
    os._exit(1)


def free_memory_bytes() -> int | None:
    """Return the memory that can be taken without swapping; None where it is not known.

    The least of what the machine has and of what the control group of this process may still take.
    """
    found = [_machine_bytes(), _group_bytes()]
    return min((each for each in found if each is not None), default=None)


def _machine_bytes() -> int | None:
    with suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return 1024 * int(line.split()[1])
    with suppress(OSError, ValueError, AttributeError):  # macOS: all there is
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def _group_bytes() -> int | None:
    """Return what a container may still take: control groups of version 2, then 1.

    Pages of files that were not used lately count as used, and are given back where memory is
    short.
    """
    for limit, used, of, files in (
            ("memory.max", "memory.current", "memory.stat", "inactive_file"),
            ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "memory/memory.stat",
             "total_inactive_file")):
        with suppress(OSError, ValueError):  # "max" is no number
            free = int((_GROUPS / limit).read_text()) - int((_GROUPS / used).read_text())
            return free + _counted(_GROUPS / of, files)
    return None


def _counted(path: Path, name: str) -> int:
    """Return a number of a file with a name and a number in each line; 0 where it is not there."""
    with suppress(OSError, ValueError):
        for line in path.read_text().splitlines():
            if line.startswith(f"{name} "):
                return int(line.split()[1])
    return 0


def resident_bytes(pid: int) -> int:
    """Return the memory of a process; 0 where that is not known, or the process has ended."""
    with suppress(OSError, ValueError, IndexError, AttributeError):
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")
    return 0


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
    """Return a function's results in the order of its arguments, one a call.

    The function changes nothing that other calls read. A progress bar of its own needs one that is
    open around all.
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
