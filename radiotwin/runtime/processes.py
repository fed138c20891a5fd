"""Memory, cores and threads of this process, and its end together with its parent."""

import ctypes
import os
import signal
import subprocess
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
MAX_THREADS = 4  # more threads wait for each other in the serial parts


def die_with_parent(parent: int) -> None:
    """Let this process end when its parent has died.

    The kernel does this on Linux; elsewhere a thread checks once a second (not on Windows).
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, int(signal.SIGKILL))  # PR_SET_PDEATHSIG of sys/prctl.h
        if os.getppid() != parent:
            os._exit(1)
    elif os.name == "posix":
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    """Exit once the parent process has died."""
    while os.getppid() == parent:
        time.sleep(PARENT_CHECK_S)
    os._exit(1)


def free_memory_bytes() -> int | None:
    """Return the memory [bytes] that can be allocated without swapping; None if unknown.

    It is the smaller of the machine's free memory and the rest of this process's control group.
    """
    found = [_machine_bytes(), _group_bytes()]
    return min((each for each in found if each is not None), default=None)


def _machine_bytes() -> int | None:
    """Return the available memory of the machine [bytes]; on macOS all of it; None: unknown."""
    with suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return 1024 * int(line.split()[1])
    with suppress(OSError, ValueError, AttributeError):  # macOS: all there is
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def _group_bytes() -> int | None:
    """Return the free memory [bytes] of a container's control group (version 2, else 1), or None.

    The group's usage includes file pages that were not used lately; they count as free here, as
    they can be dropped.
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
    """Read a value from a file of lines `name number`; 0 if it is missing."""
    with suppress(OSError, ValueError):
        for line in path.read_text().splitlines():
            if line.startswith(f"{name} "):
                return int(line.split()[1])
    return 0


def resident_bytes(pid: int) -> int:
    """Return the resident memory [bytes] of a process; 0 if unknown, or if it has ended."""
    with suppress(OSError, ValueError, IndexError, AttributeError):
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")
    return 0


def try_program(program: str, argument: str, timeout_s: float) -> tuple[str, str]:
    """Run a Python program in another process; return its output, and why it failed, or `""`."""
    try:
        done = subprocess.run([sys.executable, "-P", "-c", program, argument], check=False,
                              capture_output=True, text=True, timeout=timeout_s)
    except subprocess.TimeoutExpired:
        return "", f"it did not end within {timeout_s} s"
    if done.returncode == 0:
        return done.stdout, ""
    return "", (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]


def usable_cores() -> int:
    """Return the number of cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):  # missing on macOS and Windows
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def allowed_cores() -> int:
    """Return the number of cores that this process may use, at most OMP_NUM_THREADS."""
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return min(usable_cores(), max(int(limit), 1) if limit.isdigit() else usable_cores())


def thread_count() -> int:
    """Return the number of threads for `in_threads`: allowed cores, at most `MAX_THREADS`."""
    return min(allowed_cores(), MAX_THREADS)


def in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Call a function with each item, in several threads; return the results in their order.

    The function must be thread-safe. A progress bar in it needs an outer one around the call.
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
