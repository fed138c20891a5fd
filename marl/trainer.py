"""One replica: its environment, memory, learner and exploration."""

import numpy as np
import torch

from marl.environment import Environment
from marl.flights import AgentPolicy, Flights, fly
from marl.learner import Learner
from marl.mission import Mission
from marl.replay import Replay
from marl.settings import LearnerSettings


class Trainer:
    """Learns a policy by flying in a mission.

    Args:
        settings: of the learning.
        mission: what is flown.
        horizon: episodes over which the learning rate falls.
        seed: of the initial weights. Replicas that are to be averaged share it.
        stream: number of the replica; tells its random numbers from those of the others.
        device: torch device.
    """

    def __init__(self, settings: LearnerSettings, mission: Mission, horizon: int, seed: int, stream: int = 0,
                 device: str = "cpu"):
        self.settings, self.horizon = settings, horizon
        self.learner = Learner(settings, mission, seed, device)
        self.replay = Replay(settings.replay, mission)
        self.episodes, self.slots = 0, 0
        self._rng = np.random.default_rng([seed, stream])
        self._environment = Environment(mission, settings.parallel, self._rng)

    @property
    def mission(self) -> Mission:
        return self._environment.mission

    def enter(self, mission: Mission) -> None:
        """Go on in another map of the same mission."""
        self._environment.mission = mission

    @property
    def epsilon(self) -> float:
        """Present chance of a random action."""
        settings = self.settings
        done = min(self.slots / settings.epsilon_slots, 1.0) if settings.epsilon_slots else 1.0
        return settings.first_epsilon + done * (settings.last_epsilon - settings.first_epsilon)

    @property
    def learning_rate(self) -> float:
        settings = self.settings
        done = min(self.episodes / self.horizon, 1.0)
        return settings.learning_rate + done * (settings.last_learning_rate - settings.learning_rate)

    def train(self, episodes: int) -> list[dict[str, float]]:
        """Fly `episodes` flights, a multiple of `parallel`, and learn from them.

        Returns:
            a record for every batch of flights: `ratio`, `epsilon`, `learning_rate`, and the means of what
            `Learner.update` returns
        """
        settings, records = self.settings, []
        for _ in range(episodes // settings.parallel):
            flights = self._fly()
            self.replay.add(flights)
            before = self.episodes // settings.episodes_per_update
            self.episodes += settings.parallel
            self.slots += int(flights.length.sum())
            updates = self.episodes // settings.episodes_per_update - before
            losses = []
            if self.replay.size >= settings.batch:
                losses = [self.learner.update(self.replay.sample(settings.batch, self._rng), self.mission,
                                              self.learning_rate) for _ in range(updates)]
            record = {"ratio": float(flights.ratio(self.mission).mean()), "epsilon": self.epsilon,
                      "learning_rate": self.learning_rate}
            records.append(record | {name: float(np.mean([loss[name] for loss in losses]))
                                     for name in (losses[0] if losses else ())})
        return records

    def _fly(self) -> Flights:
        policy = AgentPolicy(self.learner.agent, self.epsilon, self._rng, self.learner.device)
        return fly(self._environment, policy)

    def state(self) -> dict:
        """Everything that training goes on from, for a checkpoint."""
        return {"episodes": self.episodes, "slots": self.slots, "rng": self._rng.bit_generator.state,
                "learner": self.learner.state(), "replay": self.replay.state()}

    def load_state(self, state: dict) -> None:
        self.episodes, self.slots = state["episodes"], state["slots"]
        self._rng.bit_generator.state = state["rng"]
        self.learner.load_state(state["learner"])
        self.replay.load_state(state["replay"])


def evaluate(agent, mission: Mission, flights: int, seed: int, device: str = "cpu") -> np.ndarray:
    """Fly without exploration: (flights,) collection ratios."""
    rng = np.random.default_rng(seed)
    with torch.inference_mode():
        record = fly(Environment(mission, flights, rng), AgentPolicy(agent, 0.0, rng, device))
    return record.ratio(mission)
