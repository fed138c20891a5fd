"""Replicas of a trainer that train side by side, each in a process of its own.

With them: the threads and the memory of a process that trains, checked before any is taken.
"""

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

_COPIES = 4  # of the weights: target network, and two moments of the optimiser


def limit_threads(count: int) -> None:
    """Let PyTorch and every BLAS use `count` threads in this process from now on.

    On matrices as small as here, one is fastest.
    """
    torch.set_num_threads(count)
    threadpoolctl.threadpool_limits(count)


def keep_memory() -> None:
    """Let the C library keep freed memory for the next update, which saves an eighth of the time.

    Only the GNU library needs this.
    """
    if sys.platform == "linux" and hasattr(ctypes.CDLL(None), "mallopt"):
        mmap_threshold, trim_threshold = -3, -1  # M_MMAP_THRESHOLD, M_TRIM_THRESHOLD of malloc.h
        ctypes.CDLL(None).mallopt(mmap_threshold, 32 << 20)
        ctypes.CDLL(None).mallopt(trim_threshold, 512 << 20)


def check_sizes(run: RunSettings, settings: LearnerSettings, mission: Mission) -> None:
    """Refuse settings that take more memory than `TRAINING_BYTES`; the mission gives the sizes.

    Raises:
        BadInput: names the option.
    """
    uavs, devices, slots = mission.uavs, mission.devices, mission.longest
    flight = slots * (4 * (uavs * devices + devices + uavs) + 9 * uavs)  # see Frame and Flights
    field = 4 * math.prod(mission.snr_db.shape[1:])  # shadowing that stays for a flight
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
    """Trainers side by side; to be closed.

    Processes, because three of them use two cores a quarter better than three threads do. With a
    single replica or core they train one after the other in this process, to the same result.

    Args:
        made: class of the trainers, such as `marl.qmix.Trainer`.
        arguments: of each of them.
    """

    def __init__(self, made: Callable[..., Any], arguments: Sequence[tuple]) -> None:
        self._here: list[Any] = []
        self._pools: list[Any] = []
        self._begun: list[Future[None]] = []
        if len(arguments) == 1 or usable_cores() == 1:
            self._here = [made(*each) for each in arguments]
            return
        try:
            for each in arguments:
                pool, _ = start_process({})
                self._pools.append(pool)
                self._begun.append(pool.submit(_begin, made, each))
        except BaseException:  # interrupted, too
            self.close()
            raise

    def call(self, method: str, *arguments: Any, each: list | None = None) -> list:
        """Call a method of all trainers at once.

        Args:
            method: name of a method of a trainer.
            arguments: the same for all.
            each: one more argument for every replica, after the others.

        Returns:
            The result of every replica.

        Raises:
            RunFailed: a process has ended.
        """
        own = [()] * len(self._here or self._pools) if each is None else [(one,) for one in each]
        if self._here:
            return [getattr(trainer, method)(*arguments, *mine)
                    for trainer, mine in zip(self._here, own)]
        for begun in self._begun:
            result_of(begun)
        return [result_of(call) for call in [pool.submit(_call, method, (*arguments, *mine))
                                             for pool, mine in zip(self._pools, own)]]

    def close(self) -> None:
        """End the processes, whatever they do."""
        for pool in self._pools:
            shut(pool)


def shut(pool: Any) -> None:
    """End a pool's process, whatever it does."""
    with deferred():
        pool.shutdown(wait=True, kill_workers=True)


def result_of(call: "Future[Any]") -> Any:
    """Return what a process that trains gives back.

    Raises:
        RunFailed: it has ended.
    """
    from loky.process_executor import TerminatedWorkerError

    try:
        return call.result()
    except TerminatedWorkerError as error:
        if "SIGTERM" in str(error):  # sent to all, and to this one as well
            raise SystemExit(143) from None
        raise RunFailed("a process that trains has ended, perhaps for lack of memory; start the "
                        "same command with --resume to go on from the last checkpoint") from None


_trainer: Any  # of a process that is nothing but a replica's


def _begin(made: Callable[..., Any], arguments: tuple) -> None:
    global _trainer
    limit_threads(1)
    keep_memory()
    _trainer = made(*arguments)


def _call(method: str, arguments: tuple) -> Any:
    return getattr(_trainer, method)(*arguments)
