"""Training of recurrent agents: exploration, memory of whole flights, schedules, updates."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from marl.checkpoint import COUNT, GENERATOR, Within, require
from marl.environment import ACTION_COUNT, Environment, Frame, empty_frame, observe
from marl.flights import Flights, fly
from marl.mission import MAX_SNR_DB, Mission
from marl.settings import LearnerSettings, stream

if TYPE_CHECKING:
    from marl.qmix import QNetworks

GUIDED_SHARE = 0.25  # of the training flights, with the planner's help


class Trainer:
    """One replica: learns a policy by flying in a mission.

    Args:
        make_networks: (settings, mission, seed, device) -> networks.
        settings: of learning.
        mission: the rules and the map.
        horizon: episodes over which the learning rate falls.
        seed: of the initial weights; replicas that are averaged share it.
        number: of the replica; gives it random numbers of its own.
        device: torch device.
    """

    def __init__(self, make_networks: Callable[..., Any], settings: LearnerSettings,
                 mission: Mission, horizon: int, seed: int, number: int = 0,
                 device: str = "cpu") -> None:
        self.settings, self.horizon, self.mission = settings, horizon, mission
        self.networks: QNetworks = make_networks(settings, mission, seed, device)
        self.replay = Replay(settings.replay, mission)
        self.episodes, self.slots = 0, 0
        self._plan: np.ndarray | None = None
        self._rng = stream(seed, "learning", number)

    def enter(self, mission: Mission, plan: np.ndarray | None = None) -> None:
        """Go on in another map of the mission, maybe with a plan (T, U) in it to learn from."""
        self.mission, self._plan = mission, plan

    @property
    def epsilon(self) -> float:
        """Present share of explored slots."""
        settings = self.settings
        done = min(self.slots / settings.epsilon_slots, 1.0) if settings.epsilon_slots else 1.0
        return settings.first_epsilon + done * (settings.last_epsilon - settings.first_epsilon)

    @property
    def learning_rate(self) -> float:
        """Present learning rate."""
        first, last = self.settings.learning_rate, self.settings.last_learning_rate
        return first + min(self.episodes / self.horizon, 1.0) * (last - first)

    def train(self, episodes: int) -> dict[str, float]:
        """Fly some flights and learn from them.

        Returns:
            Means over them: `train_ratio` of collected data, and the entries of
            `QNetworks.update`; at their end: `epsilon`, `learning_rate`.
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
                for _ in range(self.episodes // settings.episodes_per_update - before):
                    batch = self.replay.sample(settings.batch, self._rng)
                    losses.append(self.networks.update(batch, self.mission, self.learning_rate))
        names = losses[0] if losses else ()
        means = {name: float(np.mean([loss[name] for loss in losses])) for name in names}
        return {"train_ratio": float(np.concatenate(ratios).mean()), "epsilon": self.epsilon,
                "learning_rate": self.learning_rate, **means}

    def _fly(self, count: int) -> Flights:
        guide = None if self._plan is None else (self._plan, self._followed_slots(count))
        exploration = Exploration(self.epsilon, self.settings.excursion_slots, self._rng)
        policy = AgentPolicy(self.networks.agent, self.networks.device, exploration, guide)
        return fly(self._environment(count), policy)

    def _environment(self, count: int) -> Environment:
        return Environment(self.mission, count, self._rng)

    def _followed_slots(self, count: int) -> np.ndarray:
        """Draw the slots for which each flight follows the plan.

        A quarter of the flights follow it to the end, the others a random part of it, which
        becomes shorter as training goes on.
        """
        assert self._plan is not None
        longest = len(self._plan) * (1 - min(self.episodes / self.horizon, 1.0))
        slots = self._rng.integers(0, int(longest) + 1, count)
        before, after = (int(np.ceil(GUIDED_SHARE * number)) for number in
                         (self.episodes, self.episodes + count))
        slots[:after - before] = len(self._plan)
        return slots

    def weights(self) -> dict[str, np.ndarray]:
        """Return copies of the weights that are averaged over replicas."""
        return self.networks.weights()

    def set_weights(self, weights: dict[str, np.ndarray]) -> None:
        """Go on from averaged weights."""
        self.networks.set_weights(weights)

    def state(self) -> dict:
        """Return a checkpoint."""
        return {"episodes": self.episodes, "slots": self.slots,
                "rng": self._rng.bit_generator.state, "learner": self.networks.state(),
                "replay": self.replay.state()}

    def load_state(self, state: dict) -> None:
        """Go on from a checkpoint."""
        require(state, {"episodes": COUNT, "slots": COUNT, "rng": GENERATOR, "learner": ...,
                        "replay": ...})
        self.episodes, self.slots = state["episodes"], state["slots"]
        self._rng.bit_generator.state = state["rng"]
        self.networks.load_state(state["learner"])
        self.replay.load_state(state["replay"])


class AgentPolicy:
    """Fly the feasible action of greatest value.

    Args:
        agent: see `marl.qmix.Agent`; its weights are read at every slot.
        device: torch device of the agent.
        exploration: replaces some actions; None: none.
        guide: (T, U) actions of a plan, and the (E,) slots for which each flight follows it before
            the agents take over.
    """

    def __init__(self, agent: torch.nn.Module, device: str = "cpu",
                 exploration: "Exploration | None" = None,
                 guide: tuple[np.ndarray, np.ndarray] | None = None) -> None:
        self._agent, self._device = agent, device
        self._exploration, self._guide = exploration, guide

    def start(self, mission: Mission, flights: int) -> None:
        """See `marl.flights.Policy`."""
        self._mission = mission
        self._memory = None
        self._last = np.full((flights, mission.uavs), -1, dtype=np.int64)
        self._slot = 0
        if self._exploration is not None:
            self._exploration.start(flights, mission.uavs)

    @torch.inference_mode()
    def act(self, frame: Frame) -> np.ndarray:
        """See `marl.flights.Policy`."""
        observation, mask = observe(self._mission, frame)
        values, self._memory = self._agent(
            torch.from_numpy(observation).to(self._device)[None],
            torch.from_numpy(self._last).to(self._device)[None], self._memory)
        action = np.where(mask, values[0].cpu().numpy(), -np.inf).argmax(axis=-1)
        if self._exploration is not None:
            action = self._exploration.change(action, mask)
        if self._guide is not None:
            plan, slots = self._guide
            wanted = plan[self._slot]
            # A UAV that has failed cannot follow.
            feasible = mask[:, np.arange(len(wanted)), wanted]
            action = np.where((slots > self._slot)[:, None] & feasible, wanted, action)
        self._last, self._slot = action, self._slot + 1
        return action


class Exploration:
    """Random actions in place of the best ones, each kept for a while.

    Steps of one slot each take a UAV back and forth, and hardly ever across the city. Kept for
    longer they do: temporally extended ε-greedy exploration (Dabney, Ostrovski and Barreto, ICLR
    2021), with a geometric distribution in place of their zeta distribution. Each UAV of each
    flight explores by itself.

    Args:
        epsilon: share of the slots that UAVs spend on excursions.
        mean_slots: mean length of an excursion, 1 or more; it ends early where its action is not
            feasible.
        rng: of begin, length and action.
    """

    def __init__(self, epsilon: float, mean_slots: float, rng: np.random.Generator) -> None:
        self._mean_slots, self._rng = mean_slots, rng
        # Probability that an excursion begins in a slot in which none is under way.
        self._begin = epsilon / (mean_slots - epsilon * (mean_slots - 1))

    def start(self, flights: int, uavs: int) -> None:
        """Forget the flights before."""
        self._kept = np.zeros((flights, uavs), dtype=np.int64)
        self._left = np.zeros((flights, uavs), dtype=np.int64)

    def change(self, action: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Return the actions (E, U) to be flown in this slot, instead of those of the policy.

        The mask (E, U, 6) has the feasible ones.
        """
        begins = (self._rng.random(action.shape) < self._begin) & (self._left == 0)
        lots = np.where(mask, self._rng.random(mask.shape), -1.0).argmax(axis=-1)
        self._kept[begins] = lots[begins]
        self._left[begins] = self._lengths(action.shape)[begins]
        feasible = np.take_along_axis(mask, self._kept[..., None], axis=-1)[..., 0]
        explores = (self._left > 0) & feasible
        self._left = np.where(explores, self._left - 1, 0)
        return np.where(explores, self._kept, action)

    def _lengths(self, shape: tuple[int, ...]) -> np.ndarray:
        if self._mean_slots == 1:
            return np.ones(shape, dtype=np.int64)
        return self._rng.geometric(1 / self._mean_slots, shape)


class Replay:
    """The last `capacity` flights, in memory allocated once.

    Frames are kept, and features are made of them when they are sampled: frames take a fifth of
    the memory, and a flight in an earlier twin is seen with the positions that are known now.

    Attributes:
        capacity: of flights.
        size: flights that are in it.
    """

    def __init__(self, capacity: int, mission: Mission) -> None:
        self.capacity, self.size, self._next = capacity, 0, 0
        shape = (capacity, mission.longest)
        self._flights = Flights(
            empty_frame(shape, mission), np.zeros((*shape, mission.uavs), np.int8),
            np.zeros((*shape, mission.uavs), np.float32), np.zeros(capacity, np.int32))
        waiting = mission.data_units.astype(np.float32)
        # Of what may be read from a checkpoint.
        self._ranges = {
            "cell": (0, np.array(mission.steps_home.shape[1:]) - 1),
            "battery": (0, mission.battery), "snr_db": (-np.inf, MAX_SNR_DB),
            "data_units": (0, waiting), "assigned": (-1, mission.devices - 1),
            "action": (0, ACTION_COUNT - 1), "collected": (0, waiting.max()),
            "length": (1, mission.longest)}

    def add(self, flights: Flights) -> None:
        """Replace the oldest flights by new ones."""
        rows = (self._next + np.arange(len(flights.length))) % self.capacity
        for kept, new in zip(_arrays(self._flights).values(), _arrays(flights).values()):
            kept[rows] = new
        self._next = int((self._next + len(rows)) % self.capacity)
        self.size = min(self.size + len(rows), self.capacity)

    def sample(self, count: int, rng: np.random.Generator) -> Flights:
        """Draw different flights uniformly; cut to the longest of them."""
        rows, kept = rng.choice(self.size, count, replace=False), self._flights
        slots = kept.length[rows].max()
        return Flights(Frame(*(array[rows, :slots] for array in kept.frames)),
                       kept.action[rows, :slots], kept.collected[rows, :slots], kept.length[rows])

    @property
    def bytes(self) -> int:
        """Memory in use."""
        return sum(array.nbytes for array in _arrays(self._flights).values())

    def state(self) -> dict[str, Any]:
        """Return a checkpoint."""
        return {"next": self._next, "size": self.size,
                **{name: array[:self.size] for name, array in _arrays(self._flights).items()}}

    def load_state(self, state: dict) -> None:
        """Go on from a checkpoint."""
        size = require(state["size"], range(self.capacity + 1), "size")
        arrays = {name: array[:size] for name, array in _arrays(self._flights).items()}
        require(state, {"next": range(self.capacity), "size": ...} | {
            name: Within(array, *self._ranges[name]) for name, array in arrays.items()})
        for name, array in arrays.items():
            array[:] = state[name]
        self._next, self.size = state["next"], size


def _arrays(flights: Flights) -> dict[str, np.ndarray]:
    return flights.frames._asdict() | {"action": flights.action, "collected": flights.collected,
                                       "length": flights.length}
