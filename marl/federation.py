"""Federated averaging (McMahan et al., AISTATS 2017) of what replicas have learned."""

import numpy as np

Weights = dict[str, np.ndarray]


def average(replicas: list[Weights]) -> Weights:
    """The mean of each weight over the replicas, in new memory (paper, Eq. 14).

    Args:
        replicas: the same names and shapes in each.
    """
    return {name: np.mean([weights[name] for weights in replicas], axis=0, dtype=float).astype(first.dtype)
            for name, first in replicas[0].items()}
