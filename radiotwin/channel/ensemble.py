"""A small ensemble of networks, trained together, each stopped early on links that it does not train on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch

from radiotwin.channel.likelihood import gaussian_nll_torch
from radiotwin.progress import progress

MEMBERS = 8
HIDDEN = 24
STEPS = 1200
BATCH = 512
CHECK_EVERY = 20
PATIENCE = 20
WEIGHTS = ("w1", "b1", "w2", "b2", "w3", "b3")
LEARNING_RATE = 5e-3
WEIGHT_DECAY = 1e-2


@dataclass(frozen=True)
class TrainingData:
    """n links in the units of the network.

    inputs: (n, 3); target: (n,) residual over the line in class sigmas, or the limit's where `censored`; los: (n,);
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
    """(members, n) output of every member for inputs (n, 3): two tanh layers and a linear one."""
    hidden = torch.tanh(torch.baddbmm(weights["b1"], inputs.expand(MEMBERS, -1, -1), weights["w1"]))
    hidden = torch.tanh(torch.baddbmm(weights["b2"], hidden, weights["w2"]))
    return torch.baddbmm(weights["b3"], hidden, weights["w3"])[..., 0]


def _start(generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Random hidden layers and an output of zero: every member starts as the line, and can only be better."""
    shapes = {"w1": (3, HIDDEN), "w2": (HIDDEN, HIDDEN)}
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

    weights = _start(generator)
    log_sigma = torch.zeros(MEMBERS, 2)
    trained = [*weights.values(), log_sigma]
    for tensor in trained:
        tensor.requires_grad_()
    matrices = [weights[name] for name in ("w1", "w2", "w3")]
    others = [weights[name] for name in ("b1", "b2", "b3")] + [log_sigma]
    optimiser = torch.optim.AdamW(
        [{"params": matrices, "weight_decay": WEIGHT_DECAY}, {"params": others, "weight_decay": 0.0}],
        lr=LEARNING_RATE,
    )
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS, eta_min=LEARNING_RATE / 50)

    best = {name: tensor.detach().clone() for name, tensor in weights.items()}
    best_loss = torch.full((MEMBERS,), torch.inf)
    last_better = 0
    n, order, at = len(target), torch.empty(0, dtype=torch.int64), 0
    with progress("training the channel", total=STEPS) as advance:
        for step in range(STEPS + 1):
            if step % CHECK_EVERY == 0:
                with torch.no_grad():
                    nll = gaussian_nll_torch(target, forward(weights, inputs), log_sigma[:, segment], censored)
                    loss = (nll * held_out).sum(1) / share
                    better = loss < best_loss
                    best_loss = torch.where(better, loss, best_loss)
                    for name, tensor in weights.items():
                        best[name][better] = tensor[better]
                if better.any():
                    last_better = step
                elif step - last_better >= PATIENCE * CHECK_EVERY:
                    break
            if step == STEPS:
                break
            if at + BATCH > len(order):
                order, at = torch.randperm(n, generator=generator), 0
            rows = order[at : at + BATCH]
            at += BATCH
            nll = gaussian_nll_torch(
                target[rows], forward(weights, inputs[rows]), log_sigma[:, segment[rows]], censored[rows]
            )
            optimiser.zero_grad(set_to_none=True)
            torch.where(held_out[:, rows], 0.0, nll).mean(1).sum().backward()
            optimiser.step()
            schedule.step()
            advance(1)
    with torch.no_grad():
        unseen = forward(best, inputs)[fold, torch.arange(n)]
    return {name: tensor.numpy() for name, tensor in best.items()}, unseen.numpy().astype(float)
