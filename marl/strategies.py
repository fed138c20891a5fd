"""What decides where UAVs fly, in one form: given a map, prepare; then fly."""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import torch

from marl.environment import Environment
from marl.federation import average
from marl.flights import AgentPolicy, Flights, HeuristicPolicy, Policy, fly
from marl.learner import Learner
from marl.mission import Mission
from marl.networks import Agent
from marl.planner import PlanPolicy, plan
from marl.randomness import stream
from marl.replicas import Replicas
from marl.settings import LearnerSettings, RunSettings

CLEARLY = 0.02  # more of the data, for a plan to be preferred to the one before


class Strategy(Protocol):
    """A way to decide.

    Attributes:
        selection_flights: flown in `prepare` so far to choose between policies.
    """

    selection_flights: int

    def prepare(self, mission: Mission, advance: Callable[[int], None]) -> list[dict[str, float]]:
        """Learn, or plan, in the map of `mission`.

        Args:
            mission: the twin's, or the truth's.
            advance: called with the number of episodes that were simulated.

        Returns:
            records to be logged, one for every block of episodes; `episodes` is how many there were before and in it
        """

    def policy(self, rng: np.random.Generator) -> Policy:
        """What was learned or planned, without exploration."""

    def state(self, last: bool) -> dict:
        """What `load_state` goes on from; when nothing will be prepared any more (`last`), only what flies."""

    def load_state(self, state: dict) -> None:
        """Go on from a checkpoint."""

    def close(self) -> None:
        """Give back processes."""


def make_strategy(run: RunSettings, learner: LearnerSettings, mission: Mission, rounds: int, device: str) -> Strategy:
    """The strategy of `run.algorithm`; it will be prepared `rounds` times."""
    if run.algorithm in ("random", "greedy"):
        return Heuristic(run.algorithm)
    if run.algorithm == "planner":
        return Planned(run.planner_iterations, run.seed)
    return Learned(run, learner, mission, rounds, device)


def evaluate(mission: Mission, policy: Policy, flights: int, rng: np.random.Generator) -> Flights:
    """Fly without learning from it; `rng` draws the shadowing."""
    return fly(Environment(mission, flights, rng), policy)


class Heuristic:
    """`random` or `greedy`: nothing to prepare."""

    selection_flights = 0

    def __init__(self, name: str):
        self._name = name

    def prepare(self, mission: Mission, advance) -> list[dict[str, float]]:
        return []

    def policy(self, rng: np.random.Generator) -> Policy:
        return HeuristicPolicy(self._name, rng)

    def state(self, last: bool) -> dict:
        return {}

    def load_state(self, state: dict) -> None:
        pass

    def close(self) -> None:
        pass


class Planned:
    """Search a plan in the map and fly it as it is."""

    selection_flights = 0

    def __init__(self, iterations: int, seed: int):
        self._iterations, self._seed = iterations, seed
        self._actions: Any = None  # until the first `prepare`

    def prepare(self, mission: Mission, advance) -> list[dict[str, float]]:
        self._actions = plan(mission, self._iterations, self._seed).actions
        return []

    def policy(self, rng: np.random.Generator) -> Policy:
        return PlanPolicy(self._actions)

    def state(self, last: bool) -> dict:
        return {"actions": self._actions}

    def load_state(self, state: dict) -> None:
        self._actions = state["actions"]

    def close(self) -> None:
        pass


class Learned:
    """QMIX, independent learners, or federated QMIX with one replica for each UAV.

    After every block of `federate_every` episodes the present policy flies in the map that it is trained in; the one
    that does best there, those of earlier rounds included, is the one that flies in reality.

    Attributes:
        selection_flights: flown so far to choose the policy, none of them learned from.
    """

    def __init__(self, run: RunSettings, settings: LearnerSettings, mission: Mission, rounds: int, device: str):
        self._run, self._settings, self.selection_flights = run, settings, 0
        count = mission.uavs if run.algorithm == "fedqmix" else 1
        # Only its sizes are needed here, and what the replicas do not have they cannot learn from.
        mission = mission._replace(snr_db=np.full_like(mission.snr_db, -np.inf))
        self._replicas = Replicas(count, settings, mission, rounds * run.episodes, run.seed, device)
        self._best = Learner(settings, mission, run.seed, device).agent  # before any episode: the initial weights
        self._present = Learner(settings, mission, run.seed, device).agent
        self._device, self._federated, self._episodes = device, count > 1, 0
        self._actions: np.ndarray | None = None

    def prepare(self, mission: Mission, advance) -> list[dict[str, float]]:
        if self._run.guide == "planner":
            self._actions = self._better_plan(mission)
        self._replicas.call("enter", mission, self._actions)
        records, left = [], self._run.episodes
        highest = self._look(mission, self._best) if self._episodes else -np.inf
        while left:
            block = min(left, self._settings.federate_every)
            trained = self._replicas.call("train", block)
            weights = self._replicas.call("weights")
            mean = average(weights)
            if self._federated:
                self._replicas.call("set_weights", mean)
            left, self._episodes = left - block, self._episodes + block
            _load(self._present, mean)
            ratio = self._look(mission, self._present)
            if not ratio <= highest:  # NaN: nobody looks, and the last one flies
                highest = ratio
                _load(self._best, mean)
            records.append({"episodes": self._episodes, "twin_ratio": ratio} | _means(trained))
            advance(block)
        return records

    def _look(self, mission: Mission, agent: Agent) -> float:
        """Share of the data that a policy collects; always in the same shadowing. NaN where nobody looks."""
        flights, seed = self._settings.selection_flights, self._run.seed
        if not flights:
            return np.nan
        self.selection_flights += flights
        policy = AgentPolicy(agent, self._device)
        return float(evaluate(mission, policy, flights, stream(seed, "choice")).ratio(mission).mean())

    def _better_plan(self, mission: Mission) -> np.ndarray:
        """Plan anew, but stay with the plan before unless the new one is clearly better: a teacher that changes its
        mind every round teaches little."""
        new = plan(mission, self._run.planner_iterations, self._run.seed).actions
        if self._actions is None:
            return new
        self.selection_flights += 2 * self._run.flights
        before, after = (evaluate(mission, PlanPolicy(actions), self._run.flights, stream(self._run.seed, "choice"))
                         .ratio(mission).mean() for actions in (self._actions, new))
        return new if after > before + CLEARLY else self._actions

    def policy(self, rng: np.random.Generator) -> Policy:
        return AgentPolicy(self._best, self._device)

    def state(self, last: bool) -> dict:
        # The replicas' memories are most of a checkpoint.
        return {"episodes": self._episodes, "best": self._best.state_dict(), "actions": self._actions,
                "selection_flights": self.selection_flights,
                "replicas": None if last else self._replicas.call("state")}

    def load_state(self, state: dict) -> None:
        self._episodes, self._actions = state["episodes"], state["actions"]
        self.selection_flights = state["selection_flights"]
        self._best.load_state_dict(state["best"])
        if state["replicas"] is not None:
            self._replicas.call("load_state", each=state["replicas"])

    def close(self) -> None:
        self._replicas.close()


@torch.no_grad()
def _load(agent: torch.nn.Module, weights: dict[str, np.ndarray]) -> None:
    for name, parameter in agent.named_parameters():
        parameter.copy_(torch.from_numpy(weights[f"agent.{name}"]))


def _means(records: list[dict[str, float]]) -> dict[str, float]:
    """Over the replicas."""
    return {name: float(np.mean([record[name] for record in records])) for name in records[0]}
