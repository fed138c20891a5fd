"""FedProx: a term of the loss that keeps a replica near the mean it set out from."""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from marl.qmix import QNetworks


class ProximalNetworks(QNetworks):
    """QMIX's networks with the proximal term µ/2 ‖w - w^t‖² (Li et al., MLSys 2020, Eq. 2).

    Args:
        *arguments: of `QNetworks`.
        mu: µ.
    """

    def __init__(self, *arguments: Any, mu: float) -> None:
        super().__init__(*arguments)
        self.mu = mu
        self._keep()

    def _keep(self) -> None:
        self._mean = [weight.detach().clone() for weight in self.parameters()]

    @override
    def set_weights(self, weights: dict[str, np.ndarray]) -> None:
        super().set_weights(weights)
        self._keep()

    @override
    def penalty(self) -> Tensor:
        distances = [(weight - mean).square().sum()
                     for weight, mean in zip(self.parameters(), self._mean)]
        return self.mu / 2 * torch.stack(distances).sum()
