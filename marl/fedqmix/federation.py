"""FedQMIX: one QMIX replica for each UAV, averaged from time to time (the paper, Sec. III-C)."""

from collections.abc import Mapping, Sequence

import numpy as np
from typing_extensions import override

from marl.fedqmix.settings import Shared
from marl.learner import Setup
from marl.mission import Mission
from marl.qmix import QMIX, QNetworks
from marl.settings import LearnerSettings, RunSettings
from radiotwin.errors import BadInput

Weights = dict[str, np.ndarray]


def average(replicas: list[Weights]) -> Weights:
    """Return the mean of each weight over the replicas, in new memory (paper, Eq. 14)."""
    mean = weighted_mean(replicas, [1] * len(replicas))
    return {name: mean[name].astype(first.dtype) for name, first in replicas[0].items()}


def weighted_mean(replicas: Sequence[Weights], counts: Sequence[int]) -> Weights:
    """Return the mean of each weight in double precision, whatever the order of the replicas.

    Federated averaging by the counts of the episodes behind each (McMahan et al., AISTATS 2017).
    Products and sums of a few weights in single precision are exact in double precision, but for
    weights of very different sizes.
    """
    return {name: sum((weights[name].astype(float) * count
                       for weights, count in zip(replicas, counts, strict=True)),
                      np.zeros_like(first, dtype=float)) / sum(counts)
            for name, first in replicas[0].items()}


def require_weights(given: Mapping[str, np.ndarray], like: Weights) -> None:
    """Refuse weights that are not like those of these networks: they come from somebody else.

    Raises:
        BadInput: they differ, are not finite, or are negative where squares are averaged.
    """
    if set(given) != set(like):
        odd = sorted(set(given) ^ set(like))[0]
        raise BadInput(f"weights {odd[:100]} are missing or unknown here; all parties need the "
                       "same settings of learning")
    for name, array in given.items():
        expected = like[name]
        if array.shape != expected.shape or array.dtype != expected.dtype:
            raise BadInput(f"weights {name} are {array.dtype} of the shape {array.shape}, and "
                           f"{expected.dtype} of the shape {expected.shape} are needed; all "
                           "scenes of a federation have equal numbers of UAVs and devices")
        if not np.isfinite(array).all() or (name.startswith("square.") and (array < 0).any()):
            raise BadInput(f"weights {name} are not finite, or squares are negative")


def initial_weights(shared: Shared) -> Weights:
    """Return the weights that `FedQMIX` begins with, from the sizes alone."""
    links = np.zeros((shared.uavs, shared.devices, 1, 1), np.float32)
    each = np.zeros(shared.uavs, np.int64)
    sizes = Mission(links, links, np.zeros((shared.uavs, 1, 1), np.int64),
                    np.zeros((shared.uavs, 2), np.int64), each, each, each.astype(float),
                    np.zeros(shared.devices), np.zeros((shared.devices, 2)), 1.0, 1.0, 0.0, 0.0,
                    np.zeros(2), False)
    return QNetworks(shared.learner, sizes, shared.run.seed).weights()


def rounds_of(run: RunSettings, settings: LearnerSettings) -> list[tuple[int, int]]:
    """Return (real episode from 0, training episodes) of each round of a federation.

    They are the blocks of `FedQMIX`: a mean after every `federate_every` episodes, and after the
    last one before the next real episode.
    """
    blocks = [min(settings.federate_every, run.episodes - start)
              for start in range(0, run.episodes, settings.federate_every)]
    return [(number, block) for number in range(run.real_episodes) for block in blocks]


class FedQMIX(QMIX):
    """`--algorithm fedqmix`: as `QMIX`, with a replica for each UAV.

    Each replica has an environment, replay memory, exploration, target network and optimiser of
    its own. After every block of `federate_every` episodes their weights are averaged, and each
    gets a copy.
    """

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup, numbers=range(setup.mission.uavs))

    @override
    def _merged(self, weights: list[Weights]) -> Weights:
        mean = average(weights)
        self._trainers.call("set_weights", mean)
        return mean


class Replica(QMIX):
    """One of the replicas of `FedQMIX`, alone: the mean is made elsewhere."""

    def __init__(self, setup: Setup, number: int) -> None:
        super().__init__(setup, [number])

    def train(self, mean: Weights, episodes: int) -> Weights:
        """Train for some episodes from a mean, and return the weights."""
        self._trainers.call("set_weights", mean)
        _, weights = self._train(episodes)
        self.episodes += episodes
        return weights

    def weights(self) -> Weights:
        """Return the present weights."""
        return self._trainers.call("weights")[0]

    def go_on(self, mission: Mission, state: dict) -> None:
        """Go on from a checkpoint, in the map of that time."""
        self.load_state(state)
        self.mission = mission
        self._trainers.call("enter", mission, self._actions)
