"""One replica: its environment, memory, learner and exploration."""

import numpy as np

from marl.environment import Environment
from marl.exploration import Exploration
from marl.flights import AgentPolicy, Flights, fly
from marl.learner import Learner
from marl.mission import Mission
from marl.randomness import stream
from marl.replay import Replay
from marl.settings import LearnerSettings

GUIDED_SHARE = 0.25  # of the flights, with the planner's help


class Trainer:
    """Learns a policy by flying in a mission.

    Args:
        settings: of the learning.
        mission: what is flown.
        horizon: episodes over which the learning rate falls.
        seed: of the initial weights. Replicas that are to be averaged share it.
        number: of the replica; tells its random numbers from those of the others.
        device: torch device.
    """

    def __init__(self, settings: LearnerSettings, mission: Mission, horizon: int, seed: int, number: int = 0,
                 device: str = "cpu"):
        self.settings, self.horizon = settings, horizon
        self.learner = Learner(settings, mission, seed, device)
        self.replay = Replay(settings.replay, mission)
        self.episodes, self.slots, self._entered = 0, 0, 0
        self.mission = mission
        self._plan: np.ndarray | None = None
        self._rng = stream(seed, "learning", number)

    def enter(self, mission: Mission, plan: np.ndarray | None = None) -> None:
        """Go on in another map of the same mission.

        Args:
            mission: its map.
            plan: (T, U) actions of a good flight in it, to learn from; None: no help.
        """
        self.mission, self._plan, self._entered = mission, plan, self.slots
        if self.settings.fly_again:
            self.replay.fly_again(mission, self._rng)

    @property
    def epsilon(self) -> float:
        """Present share of explored slots."""
        settings = self.settings
        done = min(self.slots / settings.epsilon_slots, 1.0) if settings.epsilon_slots else 1.0
        here = min((self.slots - self._entered) / settings.restart_slots, 1.0)
        return max(settings.first_epsilon + done * (settings.last_epsilon - settings.first_epsilon),
                   settings.restart_epsilon * (1 - here))

    @property
    def learning_rate(self) -> float:
        settings = self.settings
        done = min(self.episodes / self.horizon, 1.0)
        return settings.learning_rate + done * (settings.last_learning_rate - settings.learning_rate)

    def train(self, episodes: int) -> dict[str, float]:
        """Fly some flights and learn from them.

        Returns:
            means over them: `train_ratio` of collected data, and what `Learner.update` returns; at their end:
            `epsilon`, `learning_rate`
        """
        settings, ratios, losses = self.settings, [], []
        for start in range(0, episodes, settings.parallel):
            flights = self._fly(min(settings.parallel, episodes - start))
            self.replay.add(flights)
            ratios.append(flights.ratio(self.mission))
            before = self.episodes // settings.episodes_per_update
            self.episodes += len(flights.length)
            self.slots += int(flights.length.sum())
            if self.replay.size >= settings.batch:
                losses += [self.learner.update(self.replay.sample(settings.batch, self._rng), self.mission,
                                               self.learning_rate)
                           for _ in range(self.episodes // settings.episodes_per_update - before)]
        means = {name: float(np.mean([loss[name] for loss in losses])) for name in (losses[0] if losses else ())}
        return {"train_ratio": float(np.concatenate(ratios).mean()), "epsilon": self.epsilon,
                "learning_rate": self.learning_rate, **means}

    def _fly(self, count: int) -> Flights:
        guide = None if self._plan is None else (self._plan, self._follow(count))
        exploration = Exploration(self.epsilon, self.settings.excursion_slots, self._rng)
        policy = AgentPolicy(self.learner.agent, self.learner.device, exploration, guide)
        return fly(self._environment(count), policy)

    def _environment(self, count: int) -> Environment:
        return Environment(self.mission, count, self._rng)

    def _follow(self, count: int) -> np.ndarray:
        """Slots that each flight follows the plan: a quarter of the flights all the way, the others a random part,
        which fades out as training goes on."""
        assert self._plan is not None
        longest = len(self._plan) * (1 - min(self.episodes / self.horizon, 1.0))
        slots = self._rng.integers(0, int(longest) + 1, count)
        slots[:int(np.ceil(GUIDED_SHARE * count))] = len(self._plan)
        return slots

    def weights(self) -> dict:
        """What is averaged over replicas: see `Learner.weights`."""
        return self.learner.weights()

    def set_weights(self, weights: dict) -> None:
        """Go on from averaged weights."""
        self.learner.set_weights(weights)

    def state(self) -> dict:
        """Everything that training goes on from, for a checkpoint."""
        return {"episodes": self.episodes, "slots": self.slots, "entered": self._entered,
                "rng": self._rng.bit_generator.state, "learner": self.learner.state(), "replay": self.replay.state()}

    def load_state(self, state: dict) -> None:
        self.episodes, self.slots, self._entered = state["episodes"], state["slots"], state["entered"]
        self._rng.bit_generator.state = state["rng"]
        self.learner.load_state(state["learner"])
        self.replay.load_state(state["replay"])
