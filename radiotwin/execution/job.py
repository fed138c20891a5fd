"""A function over pieces of work, and what a process needs to run it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from radiotwin.errors import BadInput

P = TypeVar("P")
R = TypeVar("R")
SHARE_ROUNDING = 1e-6  # ten tenths are one
P_contra = TypeVar("P_contra", contravariant=True)


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

    def __post_init__(self) -> None:
        if self.memory_bytes < 0 or self.cores < 1 or not 0 <= self.gpu_share <= 1:
            raise BadInput(f"{self}: allowed are at least 0 bytes, at least 1 core and a share of "
                           "a GPU from 0 to 1")


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


def _cannot(piece: object) -> None:
    return None


def _one(piece: object) -> int:
    return 1


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
    size: Callable[[P], int] = _one
    halve: Callable[[P], tuple[P, P] | None] = _cannot
    join: Callable[[R, R], R] | None = None
