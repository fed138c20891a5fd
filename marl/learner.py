"""Interface of learners: `prepare` in a map, then return a `policy` that flies.

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
        mission: mission with a blank map, for array sizes only.
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
    """Counter of simulated flights and of what they collected.

    Attributes:
        flights: number of flights.
        collected: sum over flights of the share of all data collected.
    """

    flights: int = 0
    collected: float = 0.0

    def add(self, ratio: np.ndarray) -> None:
        """Add flights, given the share (E,) of all data that each collected."""
        self.flights += len(ratio)
        self.collected += float(ratio.sum())

    @classmethod
    def of(cls, state: dict) -> "Flown":
        """Restore the counter from a checkpoint, which holds its `vars`."""
        require(state, {"flights": COUNT, "collected": ...})
        return cls(state["flights"], float(state["collected"]))


class Learner(ABC):
    """Algorithm that decides where the UAVs fly.

    Attributes:
        learns: whether it trains; only such learners are compared over maps.
        uses_map: whether its flights depend on the map that it is prepared in.
        believes: whether it uses the twin's uncertainty (`believe`).
        mission: in the map in which it was prepared last; before, the setup's.
        replicas: number of copies that simulate `run.episodes` episodes each in a round.
        training: training flights so far.
        selection: flights so far that chose between policies.
    """

    learns: ClassVar[bool] = True
    uses_map: ClassVar[bool] = True
    believes: ClassVar[bool] = False

    def __init__(self, setup: Setup) -> None:
        self.setup, self.mission = setup, setup.mission
        self.replicas = 1 if self.learns else 0
        self.training, self.selection = Flown(), Flown()

    def believe(self, prior: "Prior | None") -> None:  # noqa: B027  most ask for none
        """Receive the twin's uncertainty before `prepare`; None: there is no twin."""

    def prepare(self, mission: Mission,
                on_progress: Callable[[int], None]) -> list[dict[str, float]]:
        """Learn, or plan, in the map of a mission; by default only keep the mission.

        Args:
            mission: in the map of the twin, or of the truth.
            on_progress: called with the number of episodes simulated since the last call.

        Returns:
            One record for each block of episodes, to be logged: metric -> value. `episodes` is
            the number of episodes simulated up to the end of the block.
        """
        self.mission = mission
        return []

    @abstractmethod
    def policy(self, rng: np.random.Generator) -> Policy:
        """Return the learned or planned policy, without exploration; `rng` is for its decisions."""

    def state(self, last: bool) -> dict:
        """Return the state for a checkpoint: nested dicts and lists of numbers, texts and arrays.

        An empty state means that `prepare` restores the learner from the twin.

        Args:
            last: whether `prepare` will not be called again, so that the policy suffices.
        """
        return {}

    def load_state(self, state: dict) -> None:  # noqa: B027  most have something to restore
        """Restore the learner from a checkpoint's state."""

    def close(self) -> None:  # noqa: B027  most have nothing to release
        """Stop worker processes."""


def make_learner(run: RunSettings, settings: LearnerSettings, mission: Mission, rounds: int,
                 device: str = "cpu") -> Learner:
    """Construct the learner named by `run.algorithm`; the mission's map is blanked for it."""
    blank = mission._replace(snr_db=np.full_like(mission.snr_db, -np.inf))
    return learner_class(run.algorithm)(Setup(run, settings, blank, rounds, device))
