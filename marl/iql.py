"""IQL: independent Q-learning (Tan, ICML 1993): QMIX's agents without a mixer.

Each UAV learns the value of its own actions from the reward that all UAVs share.
"""

from torch import Tensor, nn
from typing_extensions import override

from marl.flights import Flights
from marl.mission import Mission
from marl.qmix import QMIX, QNetworks


class IndependentNetworks(QNetworks):
    """Agent and target agent: one TD error for each UAV."""

    mixes = False

    @override
    def mix(self, values: Tensor, state: Tensor, modules: dict[str, nn.Module]) -> Tensor:
        return values

    @override
    def _tensors(self, flights: Flights, mission: Mission) -> tuple[Tensor, ...]:
        *features, reward, valid = super()._tensors(flights, mission)
        return *features, reward.unsqueeze(-1), valid.unsqueeze(-1)  # for all UAVs alike


class IQL(QMIX):
    """`--algorithm iql`: as `QMIX`, without a mixer."""

    networks = IndependentNetworks
