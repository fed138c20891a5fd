"""FedQMIX: a QMIX replica for each UAV, with periodic averaging of weights (paper, Sec. III-C)."""

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
    """Average the weights of replicas (paper, Eq. 14), rounded to their type."""
    mean = weighted_mean(replicas, [1] * len(replicas))
    return {name: mean[name].astype(first.dtype) for name, first in replicas[0].items()}


def weighted_mean(replicas: Sequence[Weights], counts: Sequence[int]) -> Weights:
    """Average the weights of replicas by their episode counts, in double precision.

    This is federated averaging (McMahan et al., AISTATS 2017). Sums of a few single-precision
    weights are practically exact, so the order of replicas does not matter.
    """
    return {name: sum((weights[name].astype(float) * count
                       for weights, count in zip(replicas, counts, strict=True)),
                      np.zeros_like(first, dtype=float)) / sum(counts)
            for name, first in replicas[0].items()}


def require_weights(given: Mapping[str, np.ndarray], like: Weights) -> None:
    """Refuse weights from another party that differ in form from these networks' weights.

    Raises:
        BadInput: other names, shapes or types; values that are not finite; negative squares.
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
    """Return the initial weights of `FedQMIX`, which depend on seed and array sizes only."""
    links = np.zeros((shared.uavs, shared.devices, 1, 1), np.float32)
    each = np.zeros(shared.uavs, np.int64)
    sizes = Mission(links, links, np.zeros((shared.uavs, 1, 1), np.int64),
                    np.zeros((shared.uavs, 2), np.int64), each, each, each.astype(float),
                    np.zeros(shared.devices), np.zeros((shared.devices, 2)), 1.0, 1.0, 0.0, 0.0,
                    np.zeros(2), False)
    return QNetworks(shared.learner, sizes, shared.run.seed).weights()


def rounds_of(run: RunSettings, settings: LearnerSettings) -> list[tuple[int, int]]:
    """Return (number of the real episode, training episodes) of each round of a federation.

    Rounds are the blocks of `FedQMIX`: weights are averaged after every `federate_every` episodes,
    and before the next real episode.
    """
    blocks = [min(settings.federate_every, run.episodes - start)
              for start in range(0, run.episodes, settings.federate_every)]
    return [(number, block) for number in range(run.real_episodes) for block in blocks]


class FedQMIX(QMIX):
    """`--algorithm fedqmix`: `QMIX` with a replica for each UAV.

    Each replica has its own environment, replay memory, exploration, target network and optimiser.
    After every block of `federate_every` episodes all replicas continue from the mean weights.
    """

    def __init__(self, setup: Setup) -> None:
        super().__init__(setup, numbers=range(setup.mission.uavs))

    @override
    def _merged(self, weights: list[Weights]) -> Weights:
        mean = average(weights)
        self._trainers.call("set_weights", mean)
        return mean


class Replica(QMIX):
    """A single replica of `FedQMIX`, whose weights the coordinator averages."""

    def __init__(self, setup: Setup, number: int) -> None:
        super().__init__(setup, [number])

    def train(self, mean: Weights, episodes: int) -> Weights:
        """Train for some episodes from mean weights, and return the weights."""
        self._trainers.call("set_weights", mean)
        _, weights = self._train(episodes)
        self.episodes += episodes
        return weights

    def weights(self) -> Weights:
        """Return the present weights."""
        return self._trainers.call("weights")[0]

    def go_on(self, mission: Mission, state: dict) -> None:
        """Restore the replica from a checkpoint's state, in the mission of that time."""
        self.load_state(state)
        self.mission = mission
        self._trainers.call("enter", mission)
