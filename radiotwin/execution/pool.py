"""Interface of a place for work: workers, each of which runs one piece at a time."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from radiotwin.execution.job import Resources
from radiotwin.execution.worker import Outcome


@dataclass(frozen=True)
class Death:
    """Why a worker has ended while it ran a piece.

    Attributes:
        reason: for messages.
        memory: whether it took too much memory for certain.
    """

    reason: str
    memory: bool = False


class Worker(ABC):
    """Runs one piece at a time, in a process of its own; a dead one is replaced by `submit`."""

    @abstractmethod
    def submit(self, piece: Any) -> "Future[Outcome]":
        """Begin with a piece of the job that the pool was last prepared for."""

    @abstractmethod
    def death(self, error: BaseException) -> Death | None:
        """Return why the worker has died; None if `error` was raised by the function."""

    @abstractmethod
    def raised(self, error: BaseException) -> BaseException:
        """Return what the function raised, without what the backend made of it."""

    @abstractmethod
    def close(self) -> None:
        """End the process, whatever it does."""

    @abstractmethod
    def check(self) -> None:
        """End the worker if it takes more memory than it may."""


class Pool(ABC):
    """A place for work.

    Attributes:
        name: as messages have it, such as `this machine`.
    """

    name: str

    @abstractmethod
    def prepare(self, function: bytes, resources: Resources, count: int) -> Sequence[Worker]:
        """Return workers for a job.

        Args:
            function: pickled.
            resources: of each worker.
            count: number of pieces; there are no more workers.

        Returns:
            the workers; none where other processes would not be faster than this one.

        Raises:
            RunFailed: so many workers of this size cannot be had.
        """

    @abstractmethod
    def close(self) -> None:
        """End all workers, whatever they do."""
