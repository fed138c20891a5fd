"""One learner: QMIX, or independent Q-learning where it has no mixer."""

import copy
from itertools import chain

import numpy as np
import torch
from torch import Tensor

from marl.environment import Frame
from marl.features import global_state, observation_size, observe, state_size
from marl.flights import Flights
from marl.mission import Mission
from marl.networks import Agent, Mixer
from marl.settings import LearnerSettings
from radiotwin.channel.adam import Adam

GRADIENT_NORM = 10.0


class Learner:
    """Networks, their slowly following copies, and the optimiser.

    Args:
        settings: of the learning.
        mission: gives the sizes.
        seed: of the initial weights.
        device: torch device.
    """

    def __init__(self, settings: LearnerSettings, mission: Mission, seed: int, device: str = "cpu"):
        generator = torch.Generator().manual_seed(seed)
        self.settings, self.device, self.updates = settings, device, 0
        self.agent = Agent(observation_size(mission), mission.uavs, settings.hidden, generator).to(device)
        self.mixer = None
        if settings.mix:
            self.mixer = Mixer(state_size(mission), mission.uavs, settings.mixing_width, generator).to(device)
        self.target_agent, self.target_mixer = copy.deepcopy(self.agent), copy.deepcopy(self.mixer)
        self.optimiser = Adam(self.parameters())

    def parameters(self) -> list[Tensor]:
        """Weights of agent and mixer."""
        return list(chain(self.agent.parameters(), self.mixer.parameters() if self.mixer else ()))

    def update(self, flights: Flights, mission: Mission, learning_rate: float) -> dict[str, float]:
        """One step of gradient descent on the squared TD errors of some flights.

        Args:
            flights: a batch, recorded in this mission's map or an earlier one.
            mission: what the features are made with.
            learning_rate: of this step.

        Returns:
            `loss`, `gradient_norm` and `mean_value` (mean of Q_tot)
        """
        settings = self.settings
        observation, mask, state, action, reward, valid = self._tensors(flights, mission)
        last_action = torch.cat([torch.full_like(action[:1], -1), action[:-1]])
        values, _ = self.agent(observation, last_action)
        chosen = values.gather(-1, action.unsqueeze(-1)).squeeze(-1)
        with torch.no_grad():
            target_values, _ = self.target_agent(observation, last_action)
            # Double Q-learning: the present network says which action, the target network what it is worth.
            ranked = (values.detach() if settings.double_q else target_values).masked_fill(~mask, -torch.inf)
            best = target_values.gather(-1, ranked.argmax(-1, keepdim=True)).squeeze(-1)
            if self.target_mixer is not None:
                best = self.target_mixer(best, state)
            target = _lambda_targets(reward, best, valid, settings.discount, settings.td_lambda)
        if self.mixer:
            chosen = self.mixer(chosen, state)
        loss = ((chosen - target) * valid).square().sum() / (valid.sum() * chosen[0, 0].numel())
        gradients = torch.autograd.grad(loss, self.parameters())
        norm = torch.stack([gradient.norm() for gradient in gradients]).norm()
        self.optimiser.step([gradient * (GRADIENT_NORM / norm).clamp(max=1.0) for gradient in gradients], learning_rate)
        self.updates += 1
        if self.updates % settings.target_every == 0:
            self.copy_to_target()
        return {"loss": float(loss.detach()), "gradient_norm": float(norm),
                "mean_value": float(((chosen.detach() * valid).sum() / valid.sum() / chosen[0, 0].numel()))}

    def copy_to_target(self) -> None:
        self.target_agent.load_state_dict(self.agent.state_dict())
        if self.mixer is not None and self.target_mixer is not None:
            self.target_mixer.load_state_dict(self.mixer.state_dict())

    def _tensors(self, flights: Flights, mission: Mission):
        """Features of a batch, slots first; reward and valid have the shape of the values that are learned:
        (T, E) for the team, (T, E, 1) to be shared by independent learners."""
        count, slots = flights.action.shape[:2]
        flat = Frame(*(array.swapaxes(0, 1).reshape(count * slots, *array.shape[2:]) for array in flights.frames))
        observation, mask = observe(mission, flat)
        state = global_state(mission, flat) if self.mixer else np.zeros((count * slots, 1), np.float32)
        arrays = (observation, mask, state)
        observation, mask, state = (torch.from_numpy(array).to(self.device).unflatten(0, (slots, count))
                                    for array in arrays)
        action = torch.from_numpy(flights.action.swapaxes(0, 1).astype(np.int64)).to(self.device)
        scaled = flights.collected.sum(axis=2).T / np.float32(self.settings.reward_scale)
        flown = (np.arange(slots)[:, None] < flights.length[None]).astype(np.float32)
        reward, valid = torch.from_numpy(scaled).to(self.device), torch.from_numpy(flown).to(self.device)
        if not self.mixer:
            reward, valid = reward.unsqueeze(-1), valid.unsqueeze(-1)
        return observation, mask, state, action, reward, valid

    def weights(self) -> dict[str, np.ndarray]:
        """Copies of the weights of agent and mixer; with `federate_all` of the target networks and of the optimiser's
        moments, too."""
        tensors = {name: parameter.detach() for name, parameter in self._federated()}
        return {name: tensor.cpu().numpy().copy() for name, tensor in tensors.items()}

    @torch.no_grad()
    def set_weights(self, weights: dict[str, np.ndarray]) -> None:
        """Copy averaged weights into the networks."""
        for name, parameter in self._federated():
            parameter.copy_(torch.from_numpy(weights[name]))

    def _federated(self) -> list[tuple[str, Tensor]]:
        modules = {"agent": self.agent, "mixer": self.mixer}
        if self.settings.federate_all:
            modules |= {"target_agent": self.target_agent, "target_mixer": self.target_mixer}
        named: list[tuple[str, Tensor]] = [
            (f"{module}.{name}", parameter) for module, network in modules.items() if network
            for name, parameter in network.named_parameters()]
        if self.settings.federate_all:
            moments = {"mean": self.optimiser.mean, "square": self.optimiser.square}
            named += [(f"{moment}.{number}", tensor) for moment, tensors in moments.items()
                      for number, tensor in enumerate(tensors)]
        return named

    def state(self) -> dict:
        """Everything that learning goes on from."""
        modules = {"agent": self.agent, "mixer": self.mixer, "target_agent": self.target_agent,
                   "target_mixer": self.target_mixer, "optimiser": self.optimiser}
        return {"updates": self.updates, **{name: module.state_dict() for name, module in modules.items() if module}}

    def load_state(self, state: dict) -> None:
        self.updates = state["updates"]
        for name in ("agent", "mixer", "target_agent", "target_mixer", "optimiser"):
            if name in state:
                getattr(self, name).load_state_dict(state[name])


def _lambda_targets(reward: Tensor, best: Tensor, valid: Tensor, discount: float, td_lambda: float) -> Tensor:
    """TD(λ) returns, from the last slot backwards: G_t = r_t + γ ((1 - λ) V_{t+1} + λ G_{t+1}).

    Args:
        reward, valid: (T, E) or (T, E, 1)
        best: (T, E) or (T, E, U) value of the best action in each slot.

    Returns:
        the shape of `best`
    """
    # Behind the end of a flight nothing is worth anything.
    ahead = torch.cat([valid[1:], torch.zeros_like(valid[:1])])
    target = reward + discount * (1 - td_lambda) * ahead * torch.cat([best[1:], torch.zeros_like(best[:1])])
    if td_lambda > 0:
        decay = discount * td_lambda * ahead
        for slot in range(len(best) - 2, -1, -1):
            target[slot].addcmul_(decay[slot], target[slot + 1])
    return target
