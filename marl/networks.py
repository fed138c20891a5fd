"""The recurrent agent and the monotonic mixer of QMIX (Rashid et al., ICML 2018)."""

import math

import torch
from torch import Tensor, nn

from marl.environment import ACTION_COUNT
from marl.gru import gru


class Agent(nn.Module):
    """Action values of one UAV from what it has seen so far; all UAVs share the weights.

    Args:
        observation_size: of one UAV.
        uavs: their number; each sees its own as a one-hot vector.
        hidden: width.
        generator: of the initial weights.
    """

    def __init__(self, observation_size: int, uavs: int, hidden: int, generator: torch.Generator):
        super().__init__()
        self.uavs, self.hidden = uavs, hidden
        self.encoder = nn.Linear(observation_size + ACTION_COUNT + uavs, hidden)
        self.memory = nn.GRU(hidden, hidden)
        self.head = nn.Linear(hidden, ACTION_COUNT)
        _initialise(self, generator)

    def forward(self, observation: Tensor, last_action: Tensor, memory: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Walk through a sequence.

        Args:
            observation: (T, E, U, observation_size)
            last_action: (T, E, U) int64, of the slot before; -1 in the first one.
            memory: (1, E * U, hidden) from the slot before the first; None for zero.

        Returns:
            (T, E, U, 6) action values, and the memory after the last slot
        """
        slots, flights = observation.shape[:2]
        # One-hot vectors times a matrix are rows of it: no need to build and multiply them.
        weight, size = self.encoder.weight, observation.shape[-1]
        rows = torch.cat([weight[:, size:size + ACTION_COUNT].t(), weight.new_zeros(1, self.hidden)])
        encoded = nn.functional.linear(observation, weight[:, :size], self.encoder.bias)
        encoded = encoded + nn.functional.embedding(last_action % (ACTION_COUNT + 1), rows)
        encoded = torch.relu(encoded + weight[:, size + ACTION_COUNT:].t())
        remembered, memory = gru(encoded.reshape(slots, flights * self.uavs, self.hidden), memory, self.memory)
        return self.head(remembered).reshape(slots, flights, self.uavs, ACTION_COUNT), memory


class Mixer(nn.Module):
    """Q_tot of all UAVs from the values of their actions and the state; never falls when one of them rises.

    Args:
        state_size, uavs: of the mission.
        width: of the mixing layer.
        generator: of the initial weights.
    """

    def __init__(self, state_size: int, uavs: int, width: int, generator: torch.Generator):
        super().__init__()
        self.uavs, self.width = uavs, width
        self.first_weight = nn.Linear(state_size, uavs * width)
        self.first_bias = nn.Linear(state_size, width)
        self.last_weight = nn.Linear(state_size, width)
        self.value = nn.Sequential(nn.Linear(state_size, width), nn.ReLU(), nn.Linear(width, 1))
        _initialise(self, generator)

    def forward(self, chosen: Tensor, state: Tensor) -> Tensor:
        """Q_tot: (…, U) values and (…, state_size) states -> (…)."""
        # The absolute value of what the hypernetworks give keeps the mixing monotonic.
        first = self.first_weight(state).abs().unflatten(-1, (self.uavs, self.width))
        mixed = nn.functional.elu((chosen.unsqueeze(-1) * first).sum(-2) + self.first_bias(state))
        return (mixed * self.last_weight(state).abs()).sum(-1) + self.value(state).squeeze(-1)


@torch.no_grad()
def _initialise(module: nn.Module, generator: torch.Generator) -> None:
    """PyTorch's own uniform distributions, from a generator that is passed and not a global one."""
    for layer in module.modules():
        if isinstance(layer, nn.Linear | nn.GRU):
            width = layer.in_features if isinstance(layer, nn.Linear) else layer.hidden_size
            for parameter in layer.parameters():
                parameter.uniform_(-1 / math.sqrt(width), 1 / math.sqrt(width), generator=generator)
