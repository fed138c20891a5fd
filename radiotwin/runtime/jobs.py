"""A job, a function over pieces of work, and the interface of a place for it.

A place has workers, each of which runs one piece at a time. Some of the code here runs in their
processes.
"""

import logging
import os
import pickle
import signal
import sys
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

from radiotwin.runtime.processes import die_with_parent

P = TypeVar("P")
R = TypeVar("R")
SHARE_ROUNDING = 1e-6  # ten tenths are one
P_contra = TypeVar("P_contra", contravariant=True)
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS",
                    "NUMEXPR_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Read by libraries when they are imported, so they must be set before a worker starts."""


@dataclass(frozen=True)
class Resources:
    """Resources of one worker.

    Attributes:
        memory_bytes: Memory that it takes; 0: not known.
        is_bound: Whether that is the most that it may take: beyond, a worker of this machine is
            ended, and its piece tried again in halves. Otherwise it is only planned with.
        cores: Threads that it may run.
        gpu_share: Part of a GPU, 0 to 1.
    """

    memory_bytes: int = 0
    is_bound: bool = True
    cores: int = 1
    gpu_share: float = 0.0


class Cache(Protocol[P_contra, R]):
    """Results of finished pieces, kept between runs."""

    def get(self, piece: P_contra) -> tuple[R] | None:
        """Return the result of a piece in a tuple; None where there is none."""

    def put(self, piece: P_contra, result: R, messages: list[str], seconds: float) -> None:
        """Keep the result of a piece, with the warnings and the time that it came with."""


class NoCache:
    """Keeps nothing."""

    def get(self, piece: object) -> None:
        """Return None."""

    def put(self, piece: object, result: object, messages: list[str], seconds: float) -> None:
        """Do nothing."""


@dataclass(frozen=True, eq=False)
class Job(Generic[P, R]):
    """A pure function over pieces.

    Its result must not depend on the process that computes it, nor on the pieces before: then it
    does not depend on the number of workers either.

    Attributes:
        description: Shown with its progress.
        function: One piece -> its result. It is sent to each worker once, and may keep there what
            takes long to make, such as a compiled kernel; it is not pickled with that.
        resources: Of a worker.
        size: Piece -> steps of the progress bar.
        halve: Piece -> two pieces that need half the memory; None: it cannot be halved.
        join: Results of both halves -> result of the piece. It may differ from that of the whole
            piece, so it is kept as the halves', not as the piece's.
    """

    description: str
    function: Callable[[P], R]
    resources: Resources = Resources()
    size: Callable[[P], int] = lambda piece: 1
    halve: Callable[[P], tuple[P, P] | None] = lambda piece: None
    join: Callable[[R, R], R] | None = None


@dataclass
class Outcome:
    """Result of a piece, with the texts of its warnings, what it logged, and how long it took.

    Records are (logger, level, text), from warnings upwards.
    """

    result: Any
    messages: list[str] = field(default_factory=list)
    records: list[tuple[str, int, str]] = field(default_factory=list)
    seconds: float = 0.0


class PieceRunner:
    """The function of the job that a worker's process has last been given."""

    def __init__(self) -> None:
        self._function: Callable[[Any], Any] | None = None

    def run(self, piece: Any, function: bytes | None = None) -> Outcome:
        """Run a piece; with a function, pickled, where it is another one than before."""
        if function is not None:
            self._function = None  # its memory is free before that of the next one is taken
            self._function = pickle.loads(function)  # of the process that started this one
        assert self._function is not None
        outcome = Outcome(None)
        started = time.perf_counter()
        with _noted(outcome):
            outcome.result = self._function(piece)
        outcome.seconds = time.perf_counter() - started
        return outcome


_of_this_process = PieceRunner()


def run_piece(piece: Any, function: bytes | None = None) -> Outcome:
    """Run a piece in a process that is nothing but a worker; see `PieceRunner.run`."""
    return _of_this_process.run(piece, function)


def begin(parent: int) -> int:
    """Prepare a worker's process, which ends with its parent; return its number."""
    if hasattr(signal, "SIGINT"):
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all; the driver ends
    die_with_parent(parent)
    return os.getpid()


def peak_bytes() -> int:
    """Return the most memory that this process has taken so far; 0 where that is not known."""
    if os.name != "posix":
        return 0
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def thread_variables(cores: int) -> dict[str, str]:
    """Return the environment of a worker that may run so many threads."""
    return dict.fromkeys(THREAD_VARIABLES, str(cores))


@contextmanager
def _noted(outcome: Outcome) -> Iterator[None]:
    """Note what is warned of and logged, for the process that shows it."""
    handler = _Noting(outcome)
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("default", UserWarning)
            yield
    finally:
        root.removeHandler(handler)
    outcome.messages += [str(each.message) for each in caught if each.category is UserWarning]


class _Noting(logging.Handler):
    def __init__(self, outcome: Outcome) -> None:
        super().__init__(logging.WARNING)
        self._outcome = outcome

    def emit(self, record: logging.LogRecord) -> None:
        self._outcome.records.append((record.name, record.levelno, record.getMessage()))


@dataclass(frozen=True)
class Death:
    """Why a worker has ended while it ran a piece, and whether for certain of too much memory."""

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
        """Return workers for a job of so many pieces, and no more of them.

        The function is pickled. There are none where other processes would not be faster than this
        one.

        Raises:
            RunFailed: so many workers of this size cannot be had.
        """

    @abstractmethod
    def close(self) -> None:
        """End all workers, whatever they do."""
