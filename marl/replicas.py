"""Replicas of a trainer that train side by side, each in a process of its own.

With them: the threads and the memory of a process that trains, checked before any is taken.
"""

import ctypes
import math
import multiprocessing
import os
import pickle
import signal
import sys
import traceback
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

import scipy.linalg  # noqa: F401  compiled code uses its BLAS, limited only once it is loaded
import threadpoolctl
import torch

from marl.checkpoint import Damaged
from marl.environment import observation_size, state_size
from marl.mission import Mission
from marl.settings import LearnerSettings, RunSettings, learner_class
from marl.training import Trainer
from radiotwin.errors import RunFailed
from radiotwin.io.budgets import TRAINING_BYTES
from radiotwin.io.signals import kept_from_children
from radiotwin.runtime.processes import die_with_parent, usable_cores

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
        arguments: of each `Trainer`.
    """

    def __init__(self, arguments: Sequence[tuple]) -> None:
        here = len(arguments) == 1 or usable_cores() == 1
        self._replicas: list[Any] = []
        self._pool: ThreadPoolExecutor | None = None
        try:
            for each in arguments:
                self._replicas.append(_Local(*each) if here else _Remote(*each))
            if not here:  # the threads only wait for the processes
                self._pool = ThreadPoolExecutor(len(arguments))
        except BaseException:  # interrupted, too
            self.close()
            raise

    def call(self, method: str, *arguments: Any, each: list | None = None) -> list:
        """Call a method of all trainers at once.

        Args:
            method: name of a method of `Trainer`.
            arguments: the same for all.
            each: one more argument for every replica, after the others.

        Returns:
            The result of every replica.

        Raises:
            RunFailed: a process has ended.
        """
        own = [()] * len(self._replicas) if each is None else [(one,) for one in each]
        if self._pool is None:
            return [replica.call(method, *arguments, *mine)
                    for replica, mine in zip(self._replicas, own)]
        calls = [self._pool.submit(replica.call, method, *arguments, *mine)
                 for replica, mine in zip(self._replicas, own)]
        return [call.result() for call in calls]

    def close(self) -> None:
        """End the processes, whatever they do."""
        for replica in self._replicas:
            replica.kill()
        if self._pool is not None:
            self._pool.shutdown()
        for replica in self._replicas:
            replica.close()


class _Local:
    def __init__(self, *arguments: Any) -> None:
        self._trainer = Trainer(*arguments)

    def call(self, method: str, *arguments: Any) -> Any:
        return getattr(self._trainer, method)(*arguments)

    def kill(self) -> None:
        pass

    def close(self) -> None:
        pass


class _Remote:
    def __init__(self, *arguments: Any) -> None:
        # A forked process would inherit the locks of threads that it does not have.
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, os.getpid(), arguments),
                                        daemon=True)
        with kept_from_children():
            self._process.start()
        other.close()

    def call(self, method: str, *arguments: Any) -> Any:
        try:
            _send(self._pipe, (method, arguments))
            done, result = _receive(self._pipe)
        except (EOFError, OSError):
            self._process.join(timeout=1)
            if self._process.exitcode == -signal.SIGTERM:  # sent to all, and to this one as well
                raise SystemExit(128 + signal.SIGTERM) from None
            raise RunFailed("a process that trains a replica has ended, perhaps for lack of "
                            "memory; start the same command with --resume to go on from the last "
                            "checkpoint") from None
        if isinstance(result, Damaged):
            raise result
        if not done:
            raise RuntimeError(f"in a replica's process:\n{result}")
        return result

    def kill(self) -> None:
        if self._process.pid is not None:
            self._process.kill()
            self._process.join()

    def close(self) -> None:
        self._pipe.close()


def _serve(pipe: Connection, parent: int, arguments: tuple) -> None:
    """Answer calls until the other end of the pipe closes, or the parent dies."""
    die_with_parent(parent)
    limit_threads(1)
    keep_memory()
    trainer = Trainer(*arguments)
    try:
        while True:
            method, call = _receive(pipe)
            try:
                answer = True, getattr(trainer, method)(*call)
            except Damaged as error:
                answer = False, error
            except Exception:
                answer = False, traceback.format_exc()
            _send(pipe, answer)
    except (EOFError, OSError, KeyboardInterrupt):  # closed, or interrupted
        return


def _send(pipe: Connection, message: tuple) -> None:
    """Send plain bytes: `pipe.send` would hand over tensors as shared memory, one file each."""
    pipe.send_bytes(pickle.dumps(message, pickle.HIGHEST_PROTOCOL))


def _receive(pipe: Connection) -> tuple:
    return pickle.loads(pipe.recv_bytes())
