"""The interface of a learner: prepare in a map, then give a policy that flies.

To add a learner, subclass `Learner` in one file and add one line to `marl.settings.LEARNERS`, or
an entry point to a package of one's own (example in `docs/marl.md`).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from marl.checkpoint import COUNT, require
from marl.flights import Policy
from marl.mission import Mission
from marl.settings import LearnerSettings, RunSettings, learner_class

if TYPE_CHECKING:
    from marl.belief import Prior


@dataclass(frozen=True)
class Setup:
    """Arguments of a learner.

    Attributes:
        run: settings of the run.
        settings: settings of learning.
        mission: gives the sizes only; its map is blank.
        rounds: number of calls of `prepare` to come.
        device: torch device.
    """

    run: RunSettings
    settings: LearnerSettings
    mission: Mission
    rounds: int
    device: str = "cpu"


@dataclass
class Flown:
    """Flights in the map that a learner is prepared in.

    Attributes:
        flights: number of them so far.
        collected: sum of the shares of all data that they collected.
    """

    flights: int = 0
    collected: float = 0.0

    def add(self, ratio: np.ndarray) -> None:
        """Count some more, by the share that each collected."""
        self.flights += len(ratio)
        self.collected += float(ratio.sum())

    @classmethod
    def of(cls, state: dict) -> "Flown":
        """Return what `vars` gave a checkpoint."""
        require(state, {"flights": COUNT, "collected": ...})
        return cls(state["flights"], float(state["collected"]))


class Learner(ABC):
    """Decides where the UAVs fly.

    Attributes:
        learns: whether it trains; only then can it be guided and compared over maps.
        uses_map: whether its flights depend on the map that it is prepared in.
        believes: whether it asks what the twin leaves open (`believe`).
        replicas: copies that simulate `run.episodes` episodes each in a round.
        training: flights that it has trained with so far.
        selection: flights flown in `prepare` so far to choose between policies.
    """

    learns: ClassVar[bool] = True
    uses_map: ClassVar[bool] = True
    believes: ClassVar[bool] = False

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self.replicas = 1 if self.learns else 0
        self.training, self.selection = Flown(), Flown()

    def believe(self, prior: "Prior | None") -> None:  # noqa: B027  most ask for none
        """Take what the twin leaves open, before `prepare`; None: there is no twin."""

    @abstractmethod
    def prepare(self, mission: Mission,
                on_progress: Callable[[int], None]) -> list[dict[str, float]]:
        """Learn, or plan, in the map of a mission.

        Args:
            mission: the twin's, or the truth's.
            on_progress: called with the number of episodes simulated since the last call.

        Returns:
            One record to be logged for each block of episodes: metric -> value. `episodes` is
            the number of episodes simulated up to the end of the block.
        """

    @abstractmethod
    def policy(self, rng: np.random.Generator) -> Policy:
        """Return the learned or planned policy, without exploration."""

    def state(self, last: bool) -> dict:
        """Return a checkpoint: nested dicts and lists of numbers, texts, arrays and tensors.

        Args:
            last: `prepare` will not be called again, so only the policy is needed.
        """
        return {}

    def load_state(self, state: dict) -> None:  # noqa: B027  most have something to restore
        """Go on from a checkpoint."""

    def close(self) -> None:  # noqa: B027  most have nothing to release
        """Release processes."""


def make_learner(run: RunSettings, settings: LearnerSettings, mission: Mission, rounds: int,
                 device: str = "cpu") -> Learner:
    """Make the learner that `run.algorithm` names; the mission's map is hidden from it."""
    blank = mission._replace(snr_db=np.full_like(mission.snr_db, -np.inf))
    return learner_class(run.algorithm)(Setup(run, settings, blank, rounds, device))
