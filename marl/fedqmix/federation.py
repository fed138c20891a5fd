"""FedQMIX: one QMIX replica for each UAV, averaged from time to time (the paper, Sec. III-C)."""

import numpy as np
from typing_extensions import override

from marl.learner import Setup
from marl.qmix import QMIX

Weights = dict[str, np.ndarray]


def average(replicas: list[Weights]) -> Weights:
    """Return the mean of each weight over the replicas, in new memory (paper, Eq. 14).

    Federated averaging (McMahan et al., AISTATS 2017).

    Args:
        replicas: the same names and shapes in each.
    """
    return {name: np.mean([weights[name] for weights in replicas], axis=0, dtype=float)
            .astype(first.dtype) for name, first in replicas[0].items()}


class FedQMIX(QMIX):
    """`--algorithm fedqmix`: as `QMIX`, with a replica for each UAV.

    Each replica has an environment, replay memory, exploration, target network and optimiser of
    its own. After every block of `federate_every` episodes their weights are averaged, and each
    gets a copy.
    """

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup, replicas=setup.mission.uavs)

    @override
    def _train(self, episodes: int) -> tuple[dict[str, float], Weights]:
        records = self._trainers.call("train", episodes)
        mean = average(self._trainers.call("weights"))
        self._trainers.call("set_weights", mean)
        return {name: float(np.mean([record[name] for record in records]))
                for name in records[0]}, mean
