"""Weights as Flower's records."""

import numpy as np
from flwr.app import Array, ArrayRecord, Message

from marl.fedqmix.federation import Weights


def arrays_of(weights: Weights) -> ArrayRecord:
    """Return weights as Flower sends them.

    In double precision: Flower averages in the precision of what it gets, and the mean in single
    precision would be another one than `marl.fedqmix.federation.average`, after rounding.
    """
    return ArrayRecord({name: Array(array.astype(np.float64)) for name, array in weights.items()})


def weights_of(message: Message) -> Weights:
    """Return the weights in a message, in single precision."""
    [record] = message.content.array_records.values()
    return {name: np.asarray(array.numpy(), np.float32) for name, array in record.items()}
