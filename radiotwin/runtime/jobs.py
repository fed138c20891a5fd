"""Jobs (a function over pieces of work), and the interfaces of pools and workers that run them.

A worker runs one piece at a time. Some functions here run in worker processes.
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

from radiotwin.io.signals import deferred
from radiotwin.runtime.processes import die_with_parent

P = TypeVar("P")
R = TypeVar("R")
SHARE_ROUNDING = 1e-6  # of shares of a GPU: ten tenths are one
P_contra = TypeVar("P_contra", contravariant=True)
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS",
                    "NUMEXPR_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Read by libraries when they are imported, so they must be set before a worker starts."""


@dataclass(frozen=True)
class Resources:
    """Resources of one worker.

    Attributes:
        memory_bytes: of memory; 0: not known.
        is_bound: whether that is an upper bound: a local worker that exceeds it is killed, and its
            piece retried in halves. Otherwise it only limits the number of workers.
        cores: threads.
        gpu_share: part of a GPU, 0 to 1.
    """

    memory_bytes: int = 0
    is_bound: bool = True
    cores: int = 1
    gpu_share: float = 0.0


class Cache(Protocol[P_contra, R]):
    """Results of finished pieces, kept between runs."""

    def get(self, piece: P_contra) -> tuple[R] | None:
        """Return the result of a piece in a tuple; None if there is none."""

    def put(self, piece: P_contra, result: R, messages: list[str], seconds: float) -> None:
        """Store the result of a piece with its warnings and its computing time."""


class NoCache:
    """A cache that stores nothing."""

    def get(self, piece: object) -> None:
        """Return None."""

    def put(self, piece: object, result: object, messages: list[str], seconds: float) -> None:
        """Do nothing."""


@dataclass(frozen=True, eq=False)
class Job(Generic[P, R]):
    """A pure function over pieces.

    Its result must not depend on the process or on earlier pieces; then it does not depend on the
    number of workers.

    Attributes:
        description: shown with the progress.
        function: piece -> result. It is sent to each worker once, and may keep objects there that
            take long to make, such as a compiled kernel, but not pickle them.
        resources: of a worker.
        size: piece -> steps of the progress bar.
        halve: piece -> two pieces that need half the memory; None: it cannot be halved.
        join: results of both halves -> result of the piece. That may differ from the result of the
            whole piece, so only the halves are cached.
    """

    description: str
    function: Callable[[P], R]
    resources: Resources = Resources()
    size: Callable[[P], int] = lambda piece: 1
    halve: Callable[[P], tuple[P, P] | None] = lambda piece: None
    join: Callable[[R, R], R] | None = None


@dataclass
class Outcome:
    """Result of a piece, its warnings, log records (logger, level, text), and computing time."""

    result: Any
    messages: list[str] = field(default_factory=list)
    records: list[tuple[str, int, str]] = field(default_factory=list)
    seconds: float = 0.0


class PieceRunner:
    """Worker-side holder of the present job's function."""

    def __init__(self) -> None:
        self._function: Callable[[Any], Any] | None = None

    def run(self, piece: Any, function: bytes | None = None) -> Outcome:
        """Run the function on a piece; if given, a pickled function replaces the present one."""
        if function is not None:
            self._function = None  # frees its memory first
            self._function = pickle.loads(function)  # sent by the process that started this one
        assert self._function is not None
        outcome = Outcome(None)
        started = time.perf_counter()
        with _noted(outcome):
            outcome.result = self._function(piece)
        outcome.seconds = time.perf_counter() - started
        return outcome


_of_this_process = PieceRunner()


def run_piece(piece: Any, function: bytes | None = None) -> Outcome:
    """Run a piece in a local worker process; see `PieceRunner.run`."""
    return _of_this_process.run(piece, function)


def begin_worker(parent: int) -> int:
    """Initialise a worker process, which ends with its parent; return its process id."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all; the parent ends
    die_with_parent(parent)
    return os.getpid()


def peak_bytes() -> int:
    """Return the largest memory that this process has had [bytes]; 0 if unknown."""
    if os.name != "posix":
        return 0
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def thread_variables(cores: int) -> dict[str, str]:
    """Return the environment variables that limit a worker's threads."""
    return dict.fromkeys(THREAD_VARIABLES, str(cores))


@contextmanager
def _noted(outcome: Outcome) -> Iterator[None]:
    """Add the block's UserWarnings (no subclasses) to `messages`, log records to `records`.

    Both are of `outcome`. Records count from the level WARNING; warnings are lost on an error.
    """
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
    """Log handler that collects records from warnings upwards."""

    def __init__(self, outcome: Outcome) -> None:
        super().__init__(logging.WARNING)
        self._outcome = outcome

    def emit(self, record: logging.LogRecord) -> None:
        self._outcome.records.append((record.name, record.levelno, record.getMessage()))


@dataclass(frozen=True)
class Death:
    """Reason why a worker died while it ran a piece, and whether it exceeded its memory."""

    reason: str
    memory: bool = False


class Worker(ABC):
    """A process that runs one piece at a time.

    Attributes:
        function: of the present job, as it is sent to the process.
        process: handle of the process; None: it is not started, or has died.
    """

    def __init__(self, resources: Resources) -> None:
        self.resources = resources
        self.function: Any = None
        self.process: Any = None
        self._sent: Any = None

    def submit(self, piece: Any) -> "Future[Outcome]":
        """Run a piece in the worker's process, started if needed; send a new function with it."""
        if self.process is None:
            self.start()
            self._sent = None
        if self._sent == self.function:
            return self.run(piece)
        self._sent = self.function
        return self.run(piece, self.function)

    @abstractmethod
    def start(self) -> None:
        """Start the process."""

    @abstractmethod
    def run(self, *arguments: Any) -> "Future[Outcome]":
        """Call `PieceRunner.run` in the process."""

    @abstractmethod
    def death(self, error: BaseException) -> Death | None:
        """Return why the worker died; None if `error` was raised by the function."""

    def raised(self, error: BaseException) -> BaseException:
        """Return the error that the function raised, unwrapped from the backend's."""
        return error

    @abstractmethod
    def close(self) -> None:
        """Kill the process."""

    def check(self) -> None:  # noqa: B027  # Ray's own nodes do it
        """Kill the worker if it exceeds its memory."""


W = TypeVar("W", bound=Worker)


class Pool(ABC, Generic[W]):
    """A set of workers.

    Attributes:
        name: for messages, such as `this machine`.
    """

    name: str

    def __init__(self, workers: int | None = None) -> None:
        self._most = workers
        self._workers: list[W] = []

    @abstractmethod
    def prepare(self, function: bytes, resources: Resources, count: int) -> Sequence[Worker]:
        """Return workers for a job.

        Args:
            function: pickled.
            resources: of each worker.
            count: number of pieces, and largest number of workers.

        Returns:
            the workers; no worker if they would not be faster than this process.

        Raises:
            RunFailed: the requested workers do not fit on the machine.
        """

    def close(self) -> None:
        """Kill all workers."""
        with deferred():
            for each in self._workers:
                each.close()
            self._workers = []
