"""Run replicas of a trainer in parallel processes; limit threads and memory of training."""

import ctypes
import math
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import Any

import scipy.linalg  # noqa: F401  compiled code uses its BLAS, limited only once it is loaded
import threadpoolctl
import torch

from marl.environment import observation_size, state_size
from marl.mission import Mission
from marl.settings import LearnerSettings, RunSettings, learner_class
from radiotwin.errors import RunFailed
from radiotwin.io.budgets import TRAINING_BYTES
from radiotwin.io.signals import deferred
from radiotwin.runtime.execution import start_process
from radiotwin.runtime.processes import usable_cores

_COPIES = 4  # copies of the weights: network, target network, two moments of the optimiser


def limit_threads(count: int) -> None:
    """Limit PyTorch and BLAS in this process for good; one thread is fastest for small matrices."""
    torch.set_num_threads(count)
    threadpoolctl.threadpool_limits(count)


def keep_memory() -> None:
    """Let the GNU C library keep freed memory for the next update, which saves 1/8 of the time."""
    if sys.platform == "linux" and hasattr(ctypes.CDLL(None), "mallopt"):
        mmap_threshold, trim_threshold = -3, -1  # M_MMAP_THRESHOLD, M_TRIM_THRESHOLD of malloc.h
        ctypes.CDLL(None).mallopt(mmap_threshold, 32 << 20)
        ctypes.CDLL(None).mallopt(trim_threshold, 512 << 20)


def check_sizes(run: RunSettings, settings: LearnerSettings, mission: Mission) -> None:
    """Refuse settings that need more memory than `TRAINING_BYTES` for a mission of this size.

    Raises:
        BadInput: names the option.
    """
    uavs, devices, slots = mission.uavs, mission.devices, mission.longest
    flight = slots * (4 * (uavs * devices + devices + uavs) + 9 * uavs)  # see Frame and Flights
    field = 4 * math.prod(mission.snr_db.shape[1:])  # shadowing that lasts for a flight
    subject = f"{slots} slots, {uavs} UAVs and {devices} devices"
    needed = {"flights": run.flights * (flight + field)}
    if learner_class(run.algorithm).learns:
        replicas = uavs if run.algorithm == "fedqmix" else 1
        kept = min(settings.replay, run.real_episodes * run.episodes)
        width, hidden = observation_size(mission) + uavs + 6, settings.hidden
        mixer = state_size(mission) * settings.mixing_width * (uavs + 3)
        needed |= {
            "selection_flights": settings.selection_flights * (flight + field),
            "parallel": settings.parallel * (flight + field),
            "replay": replicas * kept * flight,
            "batch": settings.batch * slots * uavs * 4 * (width + 10 * hidden),
            "hidden": replicas * _COPIES * 4 * hidden * (width + 6 * hidden),
            "mixing_width": replicas * _COPIES * 4 * mixer}
    for name, size in needed.items():
        given = getattr(run if hasattr(run, name) else settings, name)
        TRAINING_BYTES.check(size, f"--{name.replace('_', '-')} {given} with {subject}")


class Replicas:
    """Trainers in parallel processes; `close` ends them.

    Three processes use two cores 25 % better than three threads. With a single replica or core they
    train one after the other in this process, with the same result.
    """

    def __init__(self, made: Callable[..., Any], arguments: Sequence[tuple]) -> None:
        self._local: list[Any] = []
        self._pools: list[Any] = []
        self._begun: list[Future[None]] = []
        if len(arguments) == 1 or usable_cores() == 1:
            self._local = [made(*each) for each in arguments]
            return
        try:
            for each in arguments:
                pool, _ = start_process({})
                self._pools.append(pool)
                self._begun.append(pool.submit(_begin, made, each))
        except BaseException:  # also if interrupted
            self.close()
            raise

    def call(self, method: str, *arguments: Any, each: list | None = None) -> list:
        """Call a method of all trainers in parallel; `each` lists one further argument a trainer.

        Raises:
            RunFailed: a process has ended.
        """
        given = [arguments] * len(self._local or self._pools) if each is None else \
            [(*arguments, one) for one in each]
        if self._local:
            return [getattr(trainer, method)(*args) for trainer, args in zip(self._local, given)]
        for begun in self._begun:
            result_of(begun)
        calls = [pool.submit(_call, method, args) for pool, args in zip(self._pools, given)]
        return [result_of(call) for call in calls]

    def close(self) -> None:
        """Kill the processes."""
        for pool in self._pools:
            shut(pool)


def shut(pool: Any) -> None:
    """Kill the process of a pool, and wait for its end."""
    with deferred():
        pool.shutdown(wait=True, kill_workers=True)


def result_of(call: "Future[Any]") -> Any:
    """Return the result of a call in a training process.

    Raises:
        RunFailed: the process has ended.
    """
    from loky.process_executor import TerminatedWorkerError

    try:
        return call.result()
    except TerminatedWorkerError as error:
        if "SIGTERM" in str(error):  # the signal was sent to all processes, also to this one
            raise SystemExit(143) from None
        raise RunFailed("a process that trains has ended, perhaps for lack of memory; start the "
                        "same command with --resume to go on from the last checkpoint") from None


_trainer: Any  # the trainer of a replica's process


def _begin(made: Callable[..., Any], arguments: tuple) -> None:
    """Construct the trainer of this process."""
    global _trainer
    limit_threads(1)
    keep_memory()
    _trainer = made(*arguments)


def _call(method: str, arguments: tuple) -> Any:
    """Call a method of the trainer of this process."""
    return getattr(_trainer, method)(*arguments)
