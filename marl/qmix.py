"""QMIX: recurrent agents with a monotonic mixer of their action values [1]; IQL: without it [2].

From top to bottom: agent, mixer, loss and update, policy, trainer of a replica, learner.
Exploration and replay memory are in `marl.training`, the recurrent layer in `marl.gru`.

[1] Rashid et al., "QMIX: Monotonic value function factorisation for deep multi-agent reinforcement
    learning", ICML 2018.
[2] Tan, "Multi-agent reinforcement learning: independent vs. cooperative agents", ICML 1993.
"""

import copy
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from typing_extensions import override

from marl.checkpoint import COUNT, GENERATOR, require
from marl.environment import (
    ACTION_COUNT,
    Environment,
    Frame,
    global_state,
    observation_size,
    observe,
    state_size,
)
from marl.flights import Flights, Policy, evaluate, fly
from marl.gru import gru
from marl.learner import Flown, Learner, Setup
from marl.mission import Mission
from marl.replicas import Replicas
from marl.settings import LearnerSettings, stream
from marl.training import Batch, Exploration, Replay
from radiotwin.propagation.laws.adam import Adam

MAX_GRADIENT_NORM = 10.0  # gradients are clipped to this


class Agent(nn.Module):
    """Recurrent network of a UAV's action values from its observations; all UAVs share the weights.

    The UAV's number enters as a one-hot vector.
    """

    def __init__(self, observation_size: int, uavs: int, hidden: int,
                 generator: torch.Generator) -> None:
        super().__init__()
        self.uavs, self.hidden = uavs, hidden
        self.encoder = nn.Linear(observation_size + ACTION_COUNT + uavs, hidden)
        self.memory = nn.GRU(hidden, hidden)
        self.head = nn.Linear(hidden, ACTION_COUNT)
        _initialise(self, generator)

    def forward(self, observation: Tensor, last_action: Tensor, sizes: np.ndarray,
                memory: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Compute the action values in all slots of flights that are packed as in `Batch`.

        Args:
            observation: (N, U, observation_size) observations.
            last_action: (N, U) int64 action of the slot before; -1 in the first one.
            sizes: (T,) int64 number of flights in each slot.
            memory: (sizes[0] * U, hidden) initial hidden state; None: zero.

        Returns:
            (N, U, 6) action values, and the hidden state after the last slot.
        """
        # Products with one-hot vectors are computed as embeddings.
        weight, size = self.encoder.weight, observation.shape[-1]
        rows = torch.cat([weight[:, size:size + ACTION_COUNT].t(),
                          weight.new_zeros(1, self.hidden)])
        encoded = nn.functional.linear(observation, weight[:, :size], self.encoder.bias)
        encoded = encoded + nn.functional.embedding(last_action % (ACTION_COUNT + 1), rows)
        encoded = torch.relu(encoded + weight[:, size + ACTION_COUNT:].t())
        remembered, memory = gru(encoded.flatten(0, 1), self.uavs * sizes, memory, self.memory)
        return self.head(remembered).unflatten(0, (-1, self.uavs)), memory


class Mixer(nn.Module):
    """Network of Q_tot from the UAVs' action values and the state, monotonic in each value."""

    def __init__(self, state_size: int, uavs: int, width: int,
                 generator: torch.Generator) -> None:
        super().__init__()
        self.uavs, self.width = uavs, width
        self.first_weight = nn.Linear(state_size, uavs * width)
        self.first_bias = nn.Linear(state_size, width)
        self.last_weight = nn.Linear(state_size, width)
        self.value = nn.Sequential(nn.Linear(state_size, width), nn.ReLU(), nn.Linear(width, 1))
        _initialise(self, generator)

    def forward(self, chosen: Tensor, state: Tensor) -> Tensor:
        """Return Q_tot (…) for action values (…, U) and states (…, state_size)."""
        # Absolute values of the hypernetworks' weights make the mixing monotonic.
        first = self.first_weight(state).abs().unflatten(-1, (self.uavs, self.width))
        mixed = (chosen.unsqueeze(-1) * first).sum(-2) + self.first_bias(state)
        mixed = nn.functional.elu(mixed) * self.last_weight(state).abs()
        return mixed.sum(-1) + self.value(state).squeeze(-1)


@torch.no_grad()
def _initialise(module: nn.Module, generator: torch.Generator) -> None:
    """Draw weights from PyTorch's default distributions with a given generator."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear | nn.GRU):
            width = layer.in_features if isinstance(layer, nn.Linear) else layer.hidden_size
            for parameter in layer.parameters():
                parameter.uniform_(-1 / math.sqrt(width), 1 / math.sqrt(width),
                                   generator=generator)


class QNetworks:
    """Agent and mixer with their target networks and optimiser; `seed` is of the weights."""

    mixes = True

    def __init__(self, settings: LearnerSettings, mission: Mission, seed: int,
                 device: str = "cpu") -> None:
        generator = torch.Generator().manual_seed(seed)
        self.settings, self.device, self.updates = settings, device, 0
        self.agent = Agent(observation_size(mission), mission.uavs, settings.hidden, generator)
        self.modules: dict[str, nn.Module] = {"agent": self.agent.to(device)}
        if self.mixes:
            mixer = Mixer(state_size(mission), mission.uavs, settings.mixing_width, generator)
            self.modules["mixer"] = mixer.to(device)
        self.targets = copy.deepcopy(self.modules)
        self.optimiser = Adam(self.parameters())

    def parameters(self) -> list[Tensor]:
        """Return the trainable weights."""
        return [weight for module in self.modules.values() for weight in module.parameters()]

    def update(self, flights: Flights, mission: Mission, learning_rate: float) -> dict[str, float]:
        """Make one gradient step on the squared TD errors of recorded flights.

        They may be of an earlier map; features are computed by the present mission. Returned are
        `loss`, `gradient_norm` (before it is clipped to `MAX_GRADIENT_NORM`) and `mean_value` (mean
        of Q_tot, or of the UAVs' action values without a mixer).
        """
        settings, batch = self.settings, self._batch(flights, mission)
        values, _ = self.agent(batch.observation, batch.last_action, batch.sizes)
        chosen = self.mix(values.gather(-1, batch.action.unsqueeze(-1)).squeeze(-1), batch.state,
                          self.modules)
        with torch.no_grad():
            target_values, _ = self.targets["agent"](batch.observation, batch.last_action,
                                                     batch.sizes)
            # Double Q-learning: the online network chooses, the target network values the action.
            ranked = (values.detach() if settings.double_q else target_values)
            best = ranked.masked_fill(~batch.mask, -torch.inf).argmax(-1, keepdim=True)
            best = self.mix(target_values.gather(-1, best).squeeze(-1), batch.state, self.targets)
            target = td_lambda_targets(batch.reward, batch.unpacked(best), batch.valid,
                                       settings.discount, settings.td_lambda)
            target = target[batch.slot, batch.flight]
        loss = (chosen - target).square().mean()
        gradients = torch.autograd.grad(loss, self.parameters())
        norm = torch.stack([gradient.norm() for gradient in gradients]).norm()
        scale = (MAX_GRADIENT_NORM / norm).clamp(max=1.0)
        self.optimiser.step([gradient * scale for gradient in gradients], learning_rate)
        self.updates += 1
        if self.updates % settings.target_every == 0:
            self.copy_to_targets()
        return {"loss": float(loss.detach()), "gradient_norm": float(norm),
                "mean_value": float(chosen.detach().mean())}

    def reward(self, flights: Flights) -> np.ndarray:
        """Return the rewards (E, T) float32 of flights; a subclass may shape them."""
        return flights.collected.sum(axis=2) / np.float32(self.settings.reward_scale)

    def mix(self, values: Tensor, state: Tensor, modules: dict[str, nn.Module]) -> Tensor:
        """Return the values to be learned from action values (N, U): Q_tot (N, 1)."""
        return modules["mixer"](values, state).unsqueeze(-1)

    def copy_to_targets(self) -> None:
        """Copy the online networks to the target networks."""
        for name, module in self.modules.items():
            self.targets[name].load_state_dict(module.state_dict())

    def _batch(self, flights: Flights, mission: Mission) -> Batch:
        """Pack flights into a training batch, with features computed for the present mission."""
        order = np.argsort(-flights.length, kind="stable")
        slots = np.arange(flights.length.max())
        valid = slots[:, None] < flights.length[order]
        slot, place = np.nonzero(valid)
        flight, action = order[place], flights.action.astype(np.int64)
        frame = Frame(*(array[flight, slot] for array in flights.frames))
        state = global_state(mission, frame) if self.mixes else np.zeros((len(slot), 0), "f4")
        last_action = np.where(slot[:, None] > 0, action[flight, slot - 1], -1)
        reward = self.reward(flights)[order[:, None], slots].T

        def tensor(array: np.ndarray) -> Tensor:
            return torch.from_numpy(array).to(self.device)

        observation, mask = observe(mission, frame)
        return Batch(tensor(observation), tensor(mask), tensor(state),
                     tensor(action[flight, slot]), tensor(last_action), tensor(reward[..., None]),
                     tensor(valid.astype(np.float32)[..., None]), tensor(slot), tensor(place),
                     valid.sum(axis=1))

    def weights(self) -> dict[str, np.ndarray]:
        """Return copies of the weights that replicas average.

        With `federate_all` they include the target networks and the optimiser's moments.
        """
        return {name: tensor.detach().cpu().numpy().copy() for name, tensor in self._federated()}

    @torch.no_grad()
    def set_weights(self, weights: dict[str, np.ndarray]) -> None:
        """Copy averaged weights into the networks."""
        for name, parameter in self._federated():
            parameter.copy_(torch.from_numpy(weights[name]))

    def _federated(self) -> list[tuple[str, Tensor]]:
        """Return the names and tensors that replicas average."""
        modules, moments = dict(self.modules), {}
        if self.settings.federate_all:
            modules |= {f"target_{name}": module for name, module in self.targets.items()}
            moments = {"mean": self.optimiser.mean, "square": self.optimiser.square}
        return [(f"{name}.{part}", tensor) for name, module in modules.items()
                for part, tensor in module.named_parameters()] + \
               [(f"{name}.{number}", tensor) for name, tensors in moments.items()
                for number, tensor in enumerate(tensors)]

    def state(self) -> dict:
        """Return the state for a checkpoint."""
        return {"updates": self.updates, "optimiser": self.optimiser.state_dict(),
                **{name: module.state_dict() for name, module in self.modules.items()},
                **{f"target_{name}": module.state_dict() for name, module in self.targets.items()}}

    def load_state(self, state: dict) -> None:
        """Restore networks and optimiser from a checkpoint's state."""
        like = self.state()
        require(state, like | {"updates": COUNT, "optimiser": like["optimiser"] | {"count": COUNT}})
        self.updates = state["updates"]
        self.optimiser.load_state_dict(state["optimiser"])
        for name, module in self.modules.items():
            module.load_state_dict(state[name])
            self.targets[name].load_state_dict(state[f"target_{name}"])


def td_lambda_targets(reward: Tensor, best: Tensor, valid: Tensor, discount: float,
                      td_lambda: float) -> Tensor:
    """Compute TD(λ) targets: G_t = r_t + γ ((1 - λ) V_{t+1} + λ G_{t+1}), backwards in time.

    `reward` is (T, E, 1), `best` (T, E, 1) or (T, E, U) the value of the best action in each slot,
    `valid` (T, E, 1) 1 in flight and 0 after its end, where values count as 0.
    """
    ahead = torch.cat([valid[1:], torch.zeros_like(valid[:1])])
    following = torch.cat([best[1:], torch.zeros_like(best[:1])])
    target = reward + discount * (1 - td_lambda) * ahead * following
    if td_lambda > 0:
        decay = discount * td_lambda * ahead
        for slot in range(len(best) - 2, -1, -1):
            target[slot].addcmul_(decay[slot], target[slot + 1])
    return target


class AgentPolicy:
    """Policy that flies the feasible action with the largest value; exploration replaces some.

    The agent's present weights are used in every slot.
    """

    def __init__(self, agent: torch.nn.Module, device: str = "cpu",
                 exploration: Exploration | None = None) -> None:
        self._agent, self._device, self._exploration = agent, device, exploration

    def start(self, mission: Mission, flights: int) -> None:
        """See `marl.flights.Policy`."""
        self._mission = mission
        self._memory = None
        self._last = np.full((flights, mission.uavs), -1, dtype=np.int64)
        self._sizes = np.array([flights])
        if self._exploration is not None:
            self._exploration.start(flights, mission.uavs)

    @torch.inference_mode()
    def act(self, frame: Frame) -> np.ndarray:
        """See `marl.flights.Policy`."""
        observation, mask = observe(self._mission, frame)
        values, self._memory = self._agent(
            torch.from_numpy(observation).to(self._device),
            torch.from_numpy(self._last).to(self._device), self._sizes, self._memory)
        action = np.where(mask, values.cpu().numpy(), -np.inf).argmax(axis=-1)
        if self._exploration is not None:
            action = self._exploration.change(action, mask)
        self._last = action
        return action


class Trainer:
    """One replica, which trains networks on flights in a mission.

    The learning rate falls over `horizon` episodes. Initial weights, by `seed`, are common to all
    replicas; other random numbers depend on the `number` of the replica.
    """

    def __init__(self, make_networks: Callable[..., Any], settings: LearnerSettings,
                 mission: Mission, horizon: int, seed: int, number: int = 0,
                 device: str = "cpu") -> None:
        self.settings, self.horizon, self.mission = settings, horizon, mission
        self.networks: QNetworks = make_networks(settings, mission, seed, device)
        self.replay = Replay(settings.replay, mission)
        self.episodes, self.slots = 0, 0
        self._rng = stream(seed, "learning", number)

    def enter(self, mission: Mission) -> None:
        """Continue training in another map of the mission."""
        self.mission = mission

    @property
    def epsilon(self) -> float:
        """Present share of slots in which UAVs explore."""
        settings = self.settings
        done = min(self.slots / settings.epsilon_slots, 1.0) if settings.epsilon_slots else 1.0
        return settings.first_epsilon + done * (settings.last_epsilon - settings.first_epsilon)

    @property
    def learning_rate(self) -> float:
        """Present learning rate."""
        first, last = self.settings.learning_rate, self.settings.last_learning_rate
        return first + min(self.episodes / self.horizon, 1.0) * (last - first)

    def train(self, episodes: int) -> dict[str, float]:
        """Fly `episodes` flights with exploration, and update the networks.

        Returns:
            means of `train_ratio` (collected share) and of the entries of `QNetworks.update`, which
            are missing until the memory holds a batch; `epsilon` and `learning_rate` at the end.
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
        """Fly some flights with exploration."""
        exploration = Exploration(self.epsilon, self.settings.excursion_slots, self._rng)
        policy = AgentPolicy(self.networks.agent, self.networks.device, exploration)
        return fly(Environment(self.mission, count, self._rng), policy)

    def weights(self) -> dict[str, np.ndarray]:
        """Return copies of the weights that replicas average."""
        return self.networks.weights()

    def set_weights(self, weights: dict[str, np.ndarray]) -> None:
        """Continue training from averaged weights."""
        self.networks.set_weights(weights)

    def state(self) -> dict:
        """Return the state for a checkpoint."""
        return {"episodes": self.episodes, "slots": self.slots,
                "rng": self._rng.bit_generator.state, "learner": self.networks.state(),
                "replay": self.replay.state()}

    def load_state(self, state: dict) -> None:
        """Restore the replica from a checkpoint's state."""
        require(state, {"episodes": COUNT, "slots": COUNT, "rng": GENERATOR, "learner": ...,
                        "replay": ...})
        self.episodes, self.slots = state["episodes"], state["slots"]
        self._rng.bit_generator.state = state["rng"]
        self.networks.load_state(state["learner"])
        self.replay.load_state(state["replay"])


class QMIX(Learner):
    """`--algorithm qmix`: train one replica of QMIX in one map after the other.

    After every block of `federate_every` episodes the present policy is evaluated in the map it is
    trained in. The best policy so far, earlier rounds included, is the learner's policy; with
    `selection_flights` 0 nothing is evaluated (`twin_ratio` is NaN), and it is the last one.
    """

    networks: Callable[..., QNetworks] = QNetworks

    def __init__(self, setup: Setup, numbers: Sequence[int] = (0,)) -> None:
        super().__init__(setup)
        run, settings, mission = setup.run, setup.settings, setup.mission
        self.replicas = len(numbers)
        self._current = self.networks(settings, mission, run.seed, setup.device).agent
        self._best = copy.deepcopy(self._current)
        self.episodes, self._highest, self.mission = 0, -np.inf, mission
        horizon = setup.rounds * run.episodes
        self._trainers = Replicas(Trainer, [(self.networks, settings, mission, horizon, run.seed,
                                             number, setup.device) for number in numbers])

    @override
    def prepare(self, mission: Mission,
                on_progress: Callable[[int], None]) -> list[dict[str, float]]:
        self.enter(mission)
        records, left = [], self.setup.run.episodes
        while left:
            block = min(left, self.setup.settings.federate_every)
            trained, weights = self._train(block)
            left, self.episodes = left - block, self.episodes + block
            ratio = self.judge(weights)
            records.append({"episodes": self.episodes, "twin_ratio": ratio} | trained)
            on_progress(block)
        return records

    def enter(self, mission: Mission) -> None:
        """Continue training in another map, in which the best policy so far is evaluated anew."""
        self.mission = mission
        self._trainers.call("enter", mission)
        self._highest = self._ratio(mission, self._best) if self.episodes else -np.inf

    def judge(self, weights: dict[str, np.ndarray]) -> float:
        """Return the share that a policy with these weights collects in the map; keep the best."""
        _load(self._current, weights)
        ratio = self._ratio(self.mission, self._current)
        if not ratio <= self._highest:  # also if it is NaN, so that the last policy is kept
            self._highest = ratio
            _load(self._best, weights)
        return ratio

    def _train(self, episodes: int) -> tuple[dict[str, float], dict[str, np.ndarray]]:
        """Train all replicas; return the mean of their records, and their weights (`_merged`)."""
        records, weights = self._trainers.call("train", episodes), self._trainers.call("weights")
        for record in records:
            self.training.flights += episodes
            self.training.collected += episodes * record["train_ratio"]
        return {name: float(np.mean([record[name] for record in records]))
                for name in records[0]}, self._merged(weights)

    def _merged(self, weights: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        """Return the weights with which the replicas continue, given those of each."""
        return weights[0]

    def _ratio(self, mission: Mission, agent: Agent) -> float:
        """Return the mean share that an agent collects; NaN if `selection_flights` is 0.

        The shadowing is the same for all agents; the flights are counted in `selection`.
        """
        flights, seed = self.setup.settings.selection_flights, self.setup.run.seed
        if not flights:
            return np.nan
        policy = AgentPolicy(agent, self.setup.device)
        ratio = evaluate(mission, policy, flights, stream(seed, "choice")).ratio(mission)
        self.selection.add(ratio)
        return float(ratio.mean())

    @override
    def policy(self, rng: np.random.Generator) -> Policy:
        return AgentPolicy(self._best, self.setup.device)

    @override
    def state(self, last: bool) -> dict:
        # The replicas' replay memories are most of a checkpoint.
        return {"episodes": self.episodes, "best": self._best.state_dict(),
                "highest": float(self._highest),
                "training": vars(self.training), "selection": vars(self.selection),
                "replicas": None if last else self._trainers.call("state")}

    @override
    def load_state(self, state: dict) -> None:
        replicas = state["replicas"]
        require(state, {"episodes": COUNT, "best": self._best.state_dict(),
                        "training": ..., "selection": ..., "highest": ...,
                        "replicas": None if replicas is None else [...] * self.replicas})
        self.episodes, self._highest = state["episodes"], float(state["highest"])
        self.training, self.selection = Flown.of(state["training"]), Flown.of(state["selection"])
        self._best.load_state_dict(state["best"])
        if replicas is not None:
            self._trainers.call("load_state", each=replicas)

    @override
    def close(self) -> None:
        self._trainers.close()


@torch.no_grad()
def _load(agent: nn.Module, weights: dict[str, np.ndarray]) -> None:
    """Copy the agent's part of averaged weights into an agent."""
    for name, parameter in agent.named_parameters():
        parameter.copy_(torch.from_numpy(weights[f"agent.{name}"]))


class IndependentNetworks(QNetworks):
    """Networks without a mixer: one TD error for each UAV."""

    mixes = False

    @override
    def mix(self, values: Tensor, state: Tensor, modules: dict[str, nn.Module]) -> Tensor:
        return values


class IQL(QMIX):
    """`--algorithm iql`: independent Q-learning, `QMIX` without a mixer."""

    networks = IndependentNetworks
