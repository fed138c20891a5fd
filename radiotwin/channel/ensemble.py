"""A small ensemble of networks, trained together, each stopped early on links that it does not train on."""

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

WEIGHTS = ("w1", "b1", "w2", "b2", "w3", "b3")
INPUTS = 4
MEMBERS = 8
HIDDEN = 24
LEARNING_RATE = 1e-2
WEIGHT_DECAY = 1e-2
BATCH = 256
STEPS = 1200
CHECK_EVERY = 20
PATIENCE = 300  # steps without a better member, then training ends


@dataclass(frozen=True)
class TrainingData:
    """n links in the units of the network.

    inputs: (n, INPUTS); target: (n,) residual over the line in class sigmas, or the limit's where
    `censored`; los: (n,);
    fold: (n,) in 0..MEMBERS-1, the member that does not train on the link.
    """

    inputs: np.ndarray
    target: np.ndarray
    censored: np.ndarray
    los: np.ndarray
    fold: np.ndarray


@contextmanager
def one_thread() -> Iterator[None]:
    """One torch thread: the layers are too small to share, and sums in one order repeat bit for bit."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def forward(weights: dict[str, torch.Tensor], inputs: torch.Tensor) -> torch.Tensor:
    """(members, n) output of every member for inputs (n, INPUTS): two tanh layers and a linear one."""
    hidden = torch.tanh(torch.baddbmm(weights["b1"], inputs.expand(MEMBERS, -1, -1), weights["w1"]))
    hidden = torch.tanh(torch.baddbmm(weights["b2"], hidden, weights["w2"]))
    return torch.baddbmm(weights["b3"], hidden, weights["w3"])[..., 0]


def _start(generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Random hidden layers and an output of zero: every member starts as the line, and can only be better."""
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
    """Weights by name, (members, ...) each, and the (n,) output for every link of the member that never saw it.

    The loss is the censored Gaussian likelihood with one sigma per class and member, learned with the weights.
    Equal data and seed give equal bits.
    """
    with one_thread():
        return _train(data, torch.Generator().manual_seed(seed))


def _train(data: TrainingData, generator: torch.Generator) -> tuple[dict[str, np.ndarray], np.ndarray]:
    inputs = torch.as_tensor(data.inputs, dtype=torch.float32)
    target = torch.as_tensor(data.target, dtype=torch.float32)
    censored, fold = torch.as_tensor(data.censored), torch.as_tensor(data.fold)
    segment = torch.as_tensor(data.los.astype(np.int64))
    held_out = fold[None, :] == torch.arange(MEMBERS)[:, None]
    share = held_out.sum(1).clamp(min=1)

    weights, log_sigma = _start(generator), torch.zeros(MEMBERS, 2)
    learnt = [tensor.requires_grad_() for tensor in (*weights.values(), log_sigma)]
    optimiser = Adam(learnt, [WEIGHT_DECAY if name.startswith("w") else 0.0 for name in (*weights, "log_sigma")])
    best = {name: tensor.detach().clone() for name, tensor in weights.items()}
    best_loss = torch.full((MEMBERS,), torch.inf)
    last_better = 0
    order, at = torch.empty(0, dtype=torch.int64), 0

    def loss_of(rows: torch.Tensor | slice) -> torch.Tensor:
        output = forward(weights, inputs[rows])
        return gaussian_nll_torch(target[rows], output, log_sigma[:, segment[rows]], censored[rows])

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
