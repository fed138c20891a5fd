"""The part of a job that runs in a worker's process."""

import logging
import os
import pickle
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from radiotwin.processes import die_with_parent

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS",
                    "NUMEXPR_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Read by libraries when they are imported, so they must be set before a worker starts."""


@dataclass
class Outcome:
    """Result of a piece.

    Attributes:
        result: of the function.
        messages: texts of the warnings that it gave.
        records: (logger, level, text) that it logged, from warnings upwards.
        seconds: that it took.
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
        """Run a piece.

        Args:
            piece: argument of the function.
            function: pickled, where it is another one than that of the piece before.
        """
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


@cache
def of_this_process() -> PieceRunner:
    """Return the runner of a process that is nothing but a worker."""
    return PieceRunner()


def run_piece(piece: Any, function: bytes | None = None) -> Outcome:
    """Run a piece in a process that is nothing but a worker; see `PieceRunner.run`."""
    return of_this_process().run(piece, function)


def begin(parent: int) -> int:
    """Prepare a worker's process; return its number.

    Args:
        parent: process that started it, with which it ends.
    """
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
