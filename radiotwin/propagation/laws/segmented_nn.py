"""SegmentedNN: segmented log-distance law corrected by a small ensemble of neural networks.

The networks are trained together, each with early stopping on its own held-out links.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from typing_extensions import override

from radiotwin.errors import optional_package
from radiotwin.inference.gaussian import Limit, fit_sd_db, gaussian_nll_torch
from radiotwin.inference.held_out import deal_groups
from radiotwin.links import LinkGeometry
from radiotwin.propagation.laws.base import (
    MAX_DB,
    MAX_POSITION_M,
    MAX_SD_DB,
    ChannelModel,
    drop_uninformative,
    ground_blocks,
    require_array,
    require_names,
)
from radiotwin.propagation.laws.log_distance import SegmentedLogDistance
from radiotwin.runtime.console import progress

if TYPE_CHECKING:  # an extra, which takes seconds to load
    import torch

WEIGHTS = ("w1", "b1", "w2", "b2", "w3", "b3")  # names of the tensors, as stored
INPUTS = 4  # see `SegmentedNN._inputs`
MEMBERS = 8  # networks, each with an eighth of the links held out
HIDDEN = 24  # units of each hidden layer
LEARNING_RATE = 1e-2  # at the first step; a cosine lowers it to a fiftieth
WEIGHT_DECAY = 1e-2  # of weights, not of biases
BATCH = 256  # links in a step
STEPS = 1200  # maximum
CHECK_EVERY = 20  # steps between two evaluations of the held-out loss
PATIENCE = 300  # training ends after so many steps in which no member improved
TABLE = 129  # nodes on each axis of the table of residuals
TRIM = 0.005  # quantile at both ends of the data beyond which the residual is held constant
MAX_HIDDEN, MAX_WEIGHT, MAX_DECADES = 4096, 1e6, 20.0  # bounds of networks in a file
MIN_SPAN = np.array([0.1, 10.0])  # least range that scales log-distance, height difference [m]


def require_torch() -> Any:
    """Import torch; raise MissingPackage if it is not installed."""
    return optional_package(
        "torch", "the channel model segmented_nn needs torch, which is not installed; install it "
                 "with `pip install 'radiotwin[nn]'`, or take another channel model")


@contextmanager
def one_thread() -> Iterator[None]:
    """Restrict torch to one thread while in the context, so that results repeat to the bit.

    The layers are too small to gain from more threads.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def forward(weights: dict[str, torch.Tensor], inputs: torch.Tensor) -> torch.Tensor:
    """Evaluate all networks, two tanh layers and a linear one, at inputs (n, INPUTS).

    Returns (MEMBERS, n) residual in standard deviations of the link's class.
    """
    import torch

    hidden = torch.tanh(torch.baddbmm(weights["b1"], inputs.expand(MEMBERS, -1, -1), weights["w1"]))
    hidden = torch.tanh(torch.baddbmm(weights["b2"], hidden, weights["w2"]))
    return torch.baddbmm(weights["b3"], hidden, weights["w3"])[..., 0]


def _start(generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Return initial weights: random hidden layers, outputs of zero: the law without correction."""
    import torch

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


@one_thread()
def _train(inputs: np.ndarray, target: np.ndarray, censored: np.ndarray, los: np.ndarray,
           fold: np.ndarray, seed: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Train all networks with early stopping, each at its least held-out loss (censored Gaussian).

    Targets (n,) are residuals over the standard deviation of their class; where `censored`, that of
    the limit of detection. `fold` (n,) is the member that holds out a link. Each member learns a
    standard deviation for LoS and one for NLoS. Returns weights by name, (MEMBERS, ...), and for
    each link (n,) the output of the member that was not trained on it.
    """
    import torch

    from radiotwin.propagation.laws.adam import Adam

    generator = torch.Generator().manual_seed(seed)
    x, y = (torch.as_tensor(values, dtype=torch.float32) for values in (inputs, target))
    blank, member = torch.as_tensor(censored), torch.as_tensor(fold)
    segment = torch.as_tensor(los.astype(np.int64))
    held_out = member[None, :] == torch.arange(MEMBERS)[:, None]
    held_out_count = held_out.sum(1).clamp(min=1)

    weights, log_sd = _start(generator), torch.zeros(MEMBERS, 2)
    learnt = [tensor.requires_grad_() for tensor in (*weights.values(), log_sd)]
    optimiser = Adam(learnt, [WEIGHT_DECAY if name.startswith("w") else 0.0
                              for name in (*weights, "log_sd")])
    best = {name: tensor.detach().clone() for name, tensor in weights.items()}
    best_loss = torch.full((MEMBERS,), torch.inf)
    last_better = 0
    order, start = torch.empty(0, dtype=torch.int64), 0

    def loss_of(rows: torch.Tensor | slice) -> torch.Tensor:
        output = forward(weights, x[rows])
        return gaussian_nll_torch(y[rows], output, log_sd[:, segment[rows]], blank[rows])

    with progress("training the channel", total=STEPS) as advance:
        for step in range(STEPS + 1):
            if step % CHECK_EVERY == 0:
                with torch.no_grad():
                    loss = (loss_of(slice(None)) * held_out).sum(1) / held_out_count
                    better = loss < best_loss
                    best_loss = torch.where(better, loss, best_loss)
                    for name, tensor in weights.items():
                        best[name][better] = tensor[better]
                if better.any():
                    last_better = step
            if step == STEPS or step - last_better >= PATIENCE:
                break
            if start + BATCH > len(order):
                order, start = torch.randperm(len(y), generator=generator), 0
            rows = order[start : start + BATCH]
            start += BATCH
            loss = torch.where(held_out[:, rows], 0.0, loss_of(rows)).mean(1).sum()
            rate = LEARNING_RATE * (0.51 + 0.49 * math.cos(math.pi * step / STEPS))
            optimiser.step(torch.autograd.grad(loss, learnt), rate)
            advance(1)
    with torch.no_grad():
        unseen = forward(best, x)[member, torch.arange(len(y))]
    return {name: tensor.numpy() for name, tensor in best.items()}, unseen.numpy().astype(float)


class SegmentedNN(ChannelModel):
    """Segmented log-distance law plus a residual learnt from log-distance, elevation and LoS.

    After Chen et al., 'Model-aided federated reinforcement learning for multi-UAV trajectory
    planning in IoT networks' (GLOBECOM Workshops 2023): the same inputs and likelihood, with a
    standard deviation for LoS and NLoS each. Unlike there, the networks learn only the residual of
    the law. Each network starts as the law itself, holds out a part of the links, and keeps the
    weights that predict these best; the prediction is the mean of the networks. Outside the
    measured distances and heights the residual is held constant, and the law extrapolates. A class
    with a borrowed line is not corrected.

    Predictions are interpolated bilinearly in a table of that mean, TABLE x TABLE values for LoS
    and NLoS each: exact to hundredths of a decibel, and fast enough for millions of positions.

    Attributes:
        law: the segmented law.
        low, high: (2, 2) box of the data's `_coordinates`; rows NLoS, LoS.
        residual_db: (2, 2) least and greatest residual [dB]; rows NLoS, LoS.
        sd_db: (2,) standard deviation in NLoS, in LoS [dB].
        weights: weights of the networks, by the names in WEIGHTS.
    """

    name = "segmented_nn"
    uses_map = True

    def __init__(self) -> None:
        self.law = SegmentedLogDistance()
        self.low, self.high = np.zeros((2, 2)), np.ones((2, 2))
        self.residual_db = np.zeros((2, 2))
        self.sd_db = np.ones(2)
        self.weights: dict[str, np.ndarray] = {}

    @override
    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: Limit,
            seed: int = 0) -> Self:
        """Fit the law, train networks on its residuals, tabulate their mean; needs torch."""
        require_torch()
        links, level_db, limit_db = drop_uninformative(links, level_db, limit_db)
        self.law.fit(links, level_db, limit_db)
        law_db, law_sd_db = self.law.predict(links)
        segment = links.los.astype(np.intp)
        coordinates = _coordinates(links)
        corrected = np.array([self.law.borrowed != "nlos", self.law.borrowed != "los"])
        use = corrected[segment]
        for s in (0, 1):
            # The outermost links are too few to fit the edge, which extends to all distances.
            source = coordinates[segment == s] if corrected[s] else coordinates[use]
            self.low[s], self.high[s] = np.quantile(source, [TRIM, 1.0 - TRIM], axis=0)
        censored = np.isnan(level_db)
        residual = (np.where(censored, limit_db, level_db) - law_db) / law_sd_db
        # Links of a block stay together: early stopping on single links would overfit.
        fold = deal_groups(ground_blocks(links), MEMBERS, np.random.default_rng(seed))
        self.weights, heldout = _train(self._inputs(coordinates, segment)[use], residual[use],
                                       censored[use], links.los[use], fold[use], seed)
        mean_db = law_db.copy()
        mean_db[use] += heldout * law_sd_db[use]
        for s, line in enumerate((self.law.nlos, self.law.los)):
            mask = segment == s
            if corrected[s]:
                self.residual_db[s] = np.quantile(mean_db[mask] - law_db[mask], [TRIM, 1.0 - TRIM])
                self.sd_db[s] = fit_sd_db(level_db[mask], mean_db[mask], limit_db[mask])
            else:
                self.residual_db[s], self.sd_db[s] = 0.0, line.sd_db
        self._tabulate()
        return self

    @override
    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Return the law's mean plus the tabulated correction, and the sd by class (n,) [dB]."""
        segment = links.los.astype(np.intp)
        scale = (TABLE - 1) / np.maximum(self.high - self.low, 1e-9)
        index, weight = [], []
        for axis, value in enumerate(_coordinates(links).T):
            position = (value - self.low[segment, axis]) * scale[segment, axis]
            position = np.clip(position, 0.0, TABLE - 1)
            index.append(np.minimum(position.astype(np.intp), TABLE - 2))
            weight.append(position - index[-1])
        corner = (segment * TABLE + index[0]) * TABLE + index[1]
        table, (u, v) = self._table.ravel(), weight
        near = table[corner] * (1.0 - v) + table[corner + 1] * v
        far = table[corner + TABLE] * (1.0 - v) + table[corner + TABLE + 1] * v
        return self.law.predict(links)[0] + near * (1.0 - u) + far * u, self.sd_db[segment]

    def _inputs(self, coordinates: np.ndarray, segment: np.ndarray) -> np.ndarray:
        """Return the networks' inputs (n, 4) from `_coordinates` (n, 2) and class (n,), LoS 1.

        Log-distance, elevation [rad], line of sight (1 or -1), and height difference; the first and
        last scaled to [-1, 1]. With few flight altitudes, elevation hardly adds to distance.
        """
        coordinates = np.clip(coordinates, self.low[segment], self.high[segment])
        elevation_rad = np.arcsin(np.clip(coordinates[:, 1] / 10.0 ** coordinates[:, 0], -1.0, 1.0))
        low, high = self.low.min(axis=0), self.high.max(axis=0)
        scaled = (2.0 * coordinates - low - high) / np.maximum(high - low, MIN_SPAN)
        return np.column_stack([scaled[:, 0], elevation_rad, 2.0 * segment - 1.0, scaled[:, 1]])

    def _tabulate(self) -> None:
        """Tabulate the networks' mean residual [dB] over the boxes of NLoS and LoS data."""
        torch = require_torch()
        weights = {name: torch.as_tensor(array) for name, array in self.weights.items()}
        self._table = np.zeros((2, TABLE, TABLE))
        for s, line in enumerate((self.law.nlos, self.law.los)):
            axes = np.linspace(self.low[s], self.high[s], TABLE).T
            grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
            inputs = torch.as_tensor(self._inputs(grid, np.full(len(grid), s)),
                                     dtype=torch.float32)
            with one_thread(), torch.no_grad():
                mean = forward(weights, inputs).mean(0).numpy().astype(float) * line.sd_db
            self._table[s] = np.clip(mean, *self.residual_db[s]).reshape(TABLE, TABLE)

    @override
    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        arrays, settings = self.law.state()
        boxes = {"low": self.low, "high": self.high, "residual_db": self.residual_db,
                 "sigma_db": self.sd_db}
        return arrays | boxes | self.weights, settings

    @classmethod
    @override
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """Restore the model from its `state`, after checking it; fill the table again."""
        model = cls()
        model.law = SegmentedLogDistance.from_state({"lines": arrays["lines"]}, settings)
        require_names("arrays", arrays, ["lines", "low", "high", "residual_db", "sigma_db",
                                         *WEIGHTS])
        model.low, model.high = (
            np.column_stack([
                require_array({name: arrays[name][:, 0]}, name, (2,), -MAX_DECADES, MAX_DECADES),
                require_array({name: arrays[name][:, 1]}, name, (2,), -MAX_POSITION_M,
                              MAX_POSITION_M)])
            for name in ("low", "high"))
        model.residual_db = require_array(arrays, "residual_db", (2, 2), -MAX_DB, MAX_DB)
        model.sd_db = require_array(arrays, "sigma_db", (2,), np.finfo(float).tiny, MAX_SD_DB)
        if (model.low > model.high).any() or (np.diff(model.residual_db) < 0).any():
            raise ValueError("a lower bound is above its upper bound")
        model.weights = _weights(arrays)
        model._tabulate()
        return model


def _weights(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the networks' weights of a file after checking their shapes and values."""
    hidden = arrays["b1"].shape[-1]
    if hidden > MAX_HIDDEN:
        raise ValueError(f"{hidden} units in a layer; allowed are {MAX_HIDDEN}")
    shapes = {"w1": (INPUTS, hidden), "b1": (1, hidden), "w2": (hidden, hidden),
              "b2": (1, hidden), "w3": (hidden, 1), "b3": (1, 1)}
    weights = {name: require_array(arrays, name, (MEMBERS, *shapes[name]), -MAX_WEIGHT, MAX_WEIGHT)
               for name in WEIGHTS}
    if any(array.dtype != np.float32 for array in weights.values()):
        raise ValueError("weights are not in single precision")
    return weights


def _coordinates(links: LinkGeometry) -> np.ndarray:
    """Return log10 of the distance [m], and the receiver's height above the device [m]; (n, 2)."""
    return np.column_stack([links.log_distance, links.receiver_m[:, 2] - links.device_m[:, 2]])
