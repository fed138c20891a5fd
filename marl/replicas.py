"""Replicas that learn side by side: one in this process, several in a process each.

Processes, because three of them use two cores a quarter better than three threads do (`python -m studies speed`).
Where this process may use one core only, they learn one after the other in it, which comes to the same.
"""

import multiprocessing
import pickle
import traceback
from concurrent.futures import ThreadPoolExecutor

from marl.mission import Mission
from marl.settings import LearnerSettings
from marl.threads import keep_memory, limit_threads, usable_cores
from marl.trainer import Trainer
from radiotwin.errors import RunFailed


class Replicas:
    """Trainers with equal initial weights and random numbers of their own; to be closed.

    Args:
        count: of the replicas.
        settings, mission, horizon, seed, device: of each `Trainer`.
    """

    def __init__(self, count: int, settings: LearnerSettings, mission: Mission, horizon: int, seed: int,
                 device: str = "cpu"):
        arguments = [(settings, mission, horizon, seed, number, device) for number in range(count)]
        here = count == 1 or usable_cores() == 1
        self._replicas: list = [(_Local if here else _Remote)(*each) for each in arguments]
        self._pool = ThreadPoolExecutor(1 if here else count)  # only waits for the processes, where there are any

    def call(self, method: str, *arguments, each: list | None = None) -> list:
        """Call a method of all trainers at once.

        Args:
            method: name of a method of `Trainer`.
            arguments: the same for all.
            each: one more argument for every replica, after the others.

        Returns:
            the result of every replica
        """
        own = [()] * len(self._replicas) if each is None else [(one,) for one in each]
        calls = [self._pool.submit(replica.call, method, *arguments, *mine)
                 for replica, mine in zip(self._replicas, own)]
        return [call.result() for call in calls]

    def close(self) -> None:
        """End the processes."""
        for replica in self._replicas:
            replica.close()
        self._pool.shutdown()


class _Local:
    def __init__(self, *arguments):
        self._trainer = Trainer(*arguments)

    def call(self, method: str, *arguments):
        return getattr(self._trainer, method)(*arguments)

    def close(self) -> None:
        pass


class _Remote:
    def __init__(self, *arguments):
        # A forked process would inherit the locks of threads that it does not have.
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, arguments), daemon=True)
        self._process.start()
        other.close()

    def call(self, method: str, *arguments):
        try:
            _send(self._pipe, (method, arguments))
            done, result = _receive(self._pipe)
        except (EOFError, OSError):
            raise RunFailed("a process that trains a replica has ended, perhaps for lack of memory; start the same "
                            "command with --resume to go on from the last checkpoint") from None
        if not done:
            raise RuntimeError(f"in a replica's process:\n{result}")
        return result

    def close(self) -> None:
        self._pipe.close()
        self._process.join(timeout=10)
        self._process.kill()


def _serve(pipe, arguments) -> None:
    """Answer calls until the other end of the pipe closes."""
    limit_threads(1)
    keep_memory()
    trainer = Trainer(*arguments)
    while True:
        try:
            method, call = _receive(pipe)
        except (EOFError, KeyboardInterrupt):
            return
        try:
            _send(pipe, (True, getattr(trainer, method)(*call)))
        except KeyboardInterrupt:
            return
        except Exception:
            _send(pipe, (False, traceback.format_exc()))


def _send(pipe, message) -> None:
    """As plain bytes: `pipe.send` would hand over tensors as shared memory, one file each."""
    pipe.send_bytes(pickle.dumps(message, pickle.HIGHEST_PROTOCOL))


def _receive(pipe):
    return pickle.loads(pipe.recv_bytes())
