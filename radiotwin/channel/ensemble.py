"""A small ensemble of networks, trained together, each stopped early on links held out from it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch

from radiotwin.channel.adam import Adam
from radiotwin.inference.gaussian import gaussian_nll_torch
from radiotwin.progress import progress

WEIGHTS = ("w1", "b1", "w2", "b2", "w3", "b3")  # names of the tensors, as stored
INPUTS = 4  # see TrainingData.inputs
MEMBERS = 8  # networks, each with an eighth of the links held out
HIDDEN = 24  # units of each hidden layer
LEARNING_RATE = 1e-2  # at the first step; a cosine lowers it to a fiftieth
WEIGHT_DECAY = 1e-2  # of weights, not of biases
BATCH = 256  # links a step
STEPS = 1200  # at most
CHECK_EVERY = 20  # steps between two evaluations of the held-out loss
PATIENCE = 300  # steps without a better member, then training ends


@dataclass(frozen=True)
class TrainingData:
    """n links in the units of the network.

    Attributes:
        inputs: (n, INPUTS), each of about unit range.
        target: (n,) residual in standard deviations of its class; where `censored`, the limit's.
        censored: (n,) bool, links that were not detected.
        los: (n,) bool, line of sight.
        fold: (n,) in 0..MEMBERS-1, the member that does not train on the link.
    """

    inputs: np.ndarray
    target: np.ndarray
    censored: np.ndarray
    los: np.ndarray
    fold: np.ndarray


@contextmanager
def one_thread() -> Iterator[None]:
    """Restrict torch to one thread, so that sums have one order and repeat bit for bit.

    The layers are too small to gain by more threads.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def forward(weights: dict[str, torch.Tensor], inputs: torch.Tensor) -> torch.Tensor:
    """Return the output of every member: two tanh layers and a linear one.

    Args:
        weights: tensors by the names in WEIGHTS, each with the members as first dimension.
        inputs: (n, INPUTS).

    Returns:
        (MEMBERS, n) residual in standard deviations of its class.
    """
    hidden = torch.tanh(torch.baddbmm(weights["b1"], inputs.expand(MEMBERS, -1, -1), weights["w1"]))
    hidden = torch.tanh(torch.baddbmm(weights["b2"], hidden, weights["w2"]))
    return torch.baddbmm(weights["b3"], hidden, weights["w3"])[..., 0]


def _start(generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Return random hidden layers and an output of zero: every member starts as the line."""
    shapes = {"w1": (INPUTS, HIDDEN), "w2": (HIDDEN, HIDDEN)}
    weights = {
        name: torch.randn((MEMBERS, *shape), generator=generator) / shape[0] ** 0.5
        for name, shape in shapes.items()
    }
    weights["b1"] = torch.randn((MEMBERS, 1, HIDDEN), generator=generator) * 0.5
    weights["b2"] = torch.zeros(MEMBERS, 1, HIDDEN)
    weights["w3"] = torch.zeros(MEMBERS, HIDDEN, 1)
    weights["b3"] = torch.zeros(MEMBERS, 1, 1)
    return weights


def train(data: TrainingData, seed: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Train all members and keep the weights of each that were best on its held-out links.

    The loss is the censored Gaussian likelihood, with one standard deviation for each class and
    member that is learned with the weights.

    Args:
        data: n links.
        seed: of the first weights and the batches; equal data and seed give equal bits.

    Returns:
        weights by name, (MEMBERS, ...) each, and for every link the output (n,) of the member that
        it was held out from.
    """
    with one_thread():
        return _train(data, torch.Generator().manual_seed(seed))


def _train(data: TrainingData,
           generator: torch.Generator) -> tuple[dict[str, np.ndarray], np.ndarray]:
    inputs = torch.as_tensor(data.inputs, dtype=torch.float32)
    target = torch.as_tensor(data.target, dtype=torch.float32)
    censored, fold = torch.as_tensor(data.censored), torch.as_tensor(data.fold)
    segment = torch.as_tensor(data.los.astype(np.int64))
    held_out = fold[None, :] == torch.arange(MEMBERS)[:, None]
    share = held_out.sum(1).clamp(min=1)

    weights, log_sd = _start(generator), torch.zeros(MEMBERS, 2)
    learnt = [tensor.requires_grad_() for tensor in (*weights.values(), log_sd)]
    optimiser = Adam(learnt, [WEIGHT_DECAY if name.startswith("w") else 0.0
                              for name in (*weights, "log_sd")])
    best = {name: tensor.detach().clone() for name, tensor in weights.items()}
    best_loss = torch.full((MEMBERS,), torch.inf)
    last_better = 0
    order, at = torch.empty(0, dtype=torch.int64), 0

    def loss_of(rows: torch.Tensor | slice) -> torch.Tensor:
        output = forward(weights, inputs[rows])
        return gaussian_nll_torch(target[rows], output, log_sd[:, segment[rows]], censored[rows])

    with progress("training the channel", total=STEPS) as advance:
        for step in range(STEPS + 1):
            if step % CHECK_EVERY == 0:
                with torch.no_grad():
                    loss = (loss_of(slice(None)) * held_out).sum(1) / share
                    better = loss < best_loss
                    best_loss = torch.where(better, loss, best_loss)
                    for name, tensor in weights.items():
                        best[name][better] = tensor[better]
                if better.any():
                    last_better = step
            if step == STEPS or step - last_better >= PATIENCE:
                break
            if at + BATCH > len(order):
                order, at = torch.randperm(len(target), generator=generator), 0
            rows = order[at : at + BATCH]
            at += BATCH
            loss = torch.where(held_out[:, rows], 0.0, loss_of(rows)).mean(1).sum()
            rate = LEARNING_RATE * (0.51 + 0.49 * math.cos(math.pi * step / STEPS))
            optimiser.step(torch.autograd.grad(loss, learnt), rate)
            advance(1)
    with torch.no_grad():
        unseen = forward(best, inputs)[fold, torch.arange(len(target))]
    return {name: tensor.numpy() for name, tensor in best.items()}, unseen.numpy().astype(float)
