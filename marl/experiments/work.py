"""Doing the runs of a study: each once, by one process, from where it was stopped."""

import fcntl
import importlib
import multiprocessing
import os
import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from marl.experiments.earlier import earlier_result
from marl.experiments.records import Run, begin, begun, finished, write_record
from marl.threads import keep_memory, limit_threads
from radiotwin.console import complain, say, show_warnings_plainly
from radiotwin.errors import BadInput, RunFailed
from radiotwin.files import atomic_path

KINDS = {"learning": ("learning", "learn"), "twin quality": ("twins", "judge_twin"),
         "trained in": ("twins", "train_in"), "disturbed": ("disturbances", "fly_disturbed")}
"""Kind of a run -> module in this package, and function."""


class Clock:
    """Processor and wall seconds of a run, those before a stop included.

    Of a run that was stopped, what its replicas' processes used before the stop is not in the processor seconds: a
    process is counted when it ends.

    Args:
        folder: where `keep` writes them.
    """

    def __init__(self, folder: Path):
        self._path = folder / "seconds"
        before = self._path.read_text().split() if self._path.is_file() else ("0", "0")
        self._before = tuple(map(float, before))
        self._start = _cpu_s(), time.perf_counter()

    def seconds(self) -> tuple[float, float]:
        now = _cpu_s(), time.perf_counter()
        cpu_s, wall_s = (before + there - start for before, there, start in zip(self._before, now, self._start))
        return cpu_s, wall_s

    def keep(self) -> None:
        """Write down what was needed so far; to be called where the run would go on from."""
        with atomic_path(self._path) as temporary:
            temporary.write_text(" ".join(f"{each:.3f}" for each in self.seconds()))


def do_runs(runs: list[Run], out: Path, jobs: int) -> None:
    """Do all runs that are not finished and that no other process is at.

    Args:
        runs: of a study.
        out: folder of the records.
        jobs: processes side by side, each with one thread and, where the system can do that, a core of its own.

    Raises:
        BadInput: settings that cannot be run.
        RunFailed: a process ended before its time.
    """
    if jobs == 1:
        _work(runs, out)
        return
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=_worker, args=(runs, out, cores[number % len(cores)] if cores else None))
               for number in range(jobs)]
    try:
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
    except BaseException:
        for worker in workers:
            worker.terminate()
        raise
    if any(worker.exitcode == 2 for worker in workers):
        raise BadInput("the runs cannot be done as they are; the message is above")
    if any(worker.exitcode for worker in workers):
        raise RunFailed("a process ended before its time, perhaps for lack of memory; finished runs and rounds are "
                        "kept, and the same command with --resume goes on")


def _worker(runs: list[Run], out: Path, core: int | None) -> None:
    if core is not None:
        os.sched_setaffinity(0, {core})
    show_warnings_plainly()
    try:
        _work(runs, out)
    except BadInput as error:
        complain(str(error))
        sys.exit(2)


def _work(runs: list[Run], out: Path) -> None:
    limit_threads(1)
    keep_memory()
    for number, run in enumerate(runs):
        with _claimed(run, out) as mine:
            if mine and not finished(run, out):
                _do(run, out, f"{number + 1}/{len(runs)}")


@contextmanager
def _claimed(run: Run, out: Path) -> Iterator[bool]:
    """Whether the run is this process's; the lock goes with the process, however that ends."""
    if finished(run, out):
        yield False
        return
    folder = run.unfinished(out)
    lock = folder.parent / f"{folder.name}.lock"  # names have points in them, so not `with_suffix`
    with _opened(lock, folder) as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
            return
        yield True
        if finished(run, out):
            shutil.rmtree(folder, ignore_errors=True)
            lock.unlink(missing_ok=True)
            with suppress(OSError):  # not empty: others are at work
                folder.parent.rmdir()


def _opened(lock: Path, folder: Path) -> TextIO:
    """The lock's file and the folder, which another process may remove as it finishes the last run before this one."""
    try:
        for _ in range(100):
            with suppress(FileNotFoundError):
                folder.mkdir(parents=True, exist_ok=True)
                return lock.open("w")
        raise FileNotFoundError(2, "another process keeps removing it")
    except OSError as error:
        raise BadInput(f"cannot write {folder}: {error.strerror}; choose another --out") from None


def _do(run: Run, out: Path, place: str) -> None:
    copied = earlier_result(run, out)
    if copied is not None:
        result, cpu_s, wall_s, by = copied
        write_record(run, out, result, cpu_s, wall_s, **by)
        say(f"{place} {run.study} {run.name} seed {run.seed}: taken from {by['taken_from']}")
        return
    folder = run.unfinished(out)
    if not begun(run, out):
        begin(run, out)
    clock = Clock(folder)
    result = _kind(run.kind)(run.settings, run.seed, folder, clock.keep)
    cpu_s, wall_s = clock.seconds()
    write_record(run, out, result, cpu_s, wall_s)
    print(f"{place} {run.study} {run.name} seed {run.seed}: {cpu_s:.0f} CPU s", flush=True)


def _kind(name: str) -> Callable[..., dict]:
    """The function that does runs of a kind: (settings, seed, folder to keep things in, keep the time) -> result."""
    module, function = KINDS[name]
    return getattr(importlib.import_module(f"marl.experiments.{module}"), function)


def _cpu_s() -> float:
    """Of this process and of those that it started and that have ended."""
    return sum(usage.ru_utime + usage.ru_stime
               for usage in (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))
