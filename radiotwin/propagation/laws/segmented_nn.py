"""The segmented law, corrected by a small ensemble of networks where measurements support it.

The networks are trained together, and each is stopped early on links held out from it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
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
    require_array,
    require_names,
)
from radiotwin.propagation.laws.log_distance import SegmentedLogDistance
from radiotwin.runtime.console import progress

if TYPE_CHECKING:  # an extra, which takes seconds to load
    import torch

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
BLOCK_M = 100.0  # side of a block on the ground that is held out as a whole
TABLE = 129  # nodes on each axis of the table
TRIM = 0.005  # share of the links at each end that the box of the data leaves out
MAX_HIDDEN, MAX_WEIGHT, MAX_DECADES = 4096, 1e6, 20.0  # of networks that are read
MIN_SPAN = np.array([0.1, 10.0])  # least range that scales log-distance, height difference [m]


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


def _torch() -> Any:
    """Return the module torch; raise BadInput where it is not installed."""
    return optional_package(
        "torch", "the channel model segmented_nn needs torch, which is not installed; install it "
                 "with `pip install 'radiotwin[nn]'`, or take another --model")


@contextmanager
def one_thread() -> Iterator[None]:
    """Restrict torch to one thread, so that sums have one order and repeat bit for bit.

    The layers are too small to gain by more threads.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def forward(weights: dict[str, torch.Tensor], inputs: torch.Tensor) -> torch.Tensor:
    """Return every member's residual in standard deviations of the class, (MEMBERS, n).

    Two tanh layers and a linear one. Weights are by the names in WEIGHTS, inputs (n, INPUTS).
    """
    import torch

    hidden = torch.tanh(torch.baddbmm(weights["b1"], inputs.expand(MEMBERS, -1, -1), weights["w1"]))
    hidden = torch.tanh(torch.baddbmm(weights["b2"], hidden, weights["w2"]))
    return torch.baddbmm(weights["b3"], hidden, weights["w3"])[..., 0]


def _start(generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Return random hidden layers and an output of zero: every member starts as the line."""
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
def _train(data: TrainingData, seed: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Train all members and keep the weights of each that were best on its held-out links.

    The loss is the censored Gaussian likelihood, with one standard deviation for each class and
    member that is learned with the weights. Equal data and seed give equal bits.

    Returns:
        weights by name, (MEMBERS, ...) each, and for every link the output (n,) of the member that
        it was held out from.
    """
    import torch

    from radiotwin.propagation.laws.adam import Adam

    generator = torch.Generator().manual_seed(seed)
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


class SegmentedNN(ChannelModel):
    """Segmented log-distance law plus a residual learned of log-distance, elevation and LoS.

    After Chen et al., 'Model-aided federated reinforcement learning for multi-UAV trajectory
    planning in IoT networks' (GLOBECOM Workshops 2023): the same inputs and likelihood, with a
    standard deviation for each class. Here the network learns only the law's residual. Each member
    of the ensemble holds out one part of the links, starts as the law itself and keeps the weights
    that were best on that part, so that a bad start is never kept; the prediction is the members'
    mean. Outside the measured distances and heights the residual stays as at the edge, and the law
    extrapolates. A class that borrowed its line keeps it uncorrected.

    Predictions come from a table of that mean, TABLE x TABLE values a class, bilinear between them:
    as exact as the network to hundredths of a decibel and fast enough for millions of candidate
    positions.

    Attributes:
        law: the segmented law.
        low, high: (2, 2) for each class, NLoS first: box of the data's coordinates, see
            `_coordinates`.
        residual_db: (2, 2) for each class, lowest and highest residual [dB].
        sd_db: (2,) standard deviation of each class [dB].
        weights: of the ensemble by name, see `ensemble.WEIGHTS`.
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
        _torch()
        links, level_db, limit_db = drop_uninformative(links, level_db, limit_db)
        self.law.fit(links, level_db, limit_db)
        law_db, law_sd_db = self.law.predict(links)
        segment = links.los.astype(np.intp)
        coordinates = _coordinates(links)
        corrected = np.array([self.law.borrowed != "nlos", self.law.borrowed != "los"])
        use = corrected[segment]
        for s in (0, 1):
            # The outermost links are too few to shape the edge that everything beyond is read from.
            source = coordinates[segment == s] if corrected[s] else coordinates[use]
            self.low[s], self.high[s] = np.quantile(source, [TRIM, 1.0 - TRIM], axis=0)
        censored = np.isnan(level_db)
        residual = (np.where(censored, limit_db, level_db) - law_db) / law_sd_db
        data = TrainingData(
            inputs=self._inputs(coordinates, segment)[use],
            target=residual[use],
            censored=censored[use],
            los=links.los[use],
            fold=_folds(links, np.random.default_rng(seed))[use],
        )
        self.weights, heldout = _train(data, seed)
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
        """Return the network's inputs (n, 4), the first and last scaled to [-1, 1].

        These are log-distance, elevation [rad], line of sight, and the height difference: where
        receivers have few altitudes, elevation hardly adds to distance.
        """
        coordinates = np.clip(coordinates, self.low[segment], self.high[segment])
        elevation_rad = np.arcsin(np.clip(coordinates[:, 1] / 10.0 ** coordinates[:, 0], -1.0, 1.0))
        low, high = self.low.min(axis=0), self.high.max(axis=0)
        scaled = (2.0 * coordinates - low - high) / np.maximum(high - low, MIN_SPAN)
        return np.column_stack([scaled[:, 0], elevation_rad, 2.0 * segment - 1.0, scaled[:, 1]])

    def _tabulate(self) -> None:
        """Tabulate the ensemble's mean residual [dB] over each class's box, (2, TABLE, TABLE)."""
        torch = _torch()
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
        own = {"low": self.low, "high": self.high, "residual_db": self.residual_db,
               "sigma_db": self.sd_db}
        return arrays | own | self.weights, settings

    @classmethod
    @override
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
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
            raise ValueError("a least value is above the greatest")
        model.weights = _weights(arrays)
        model._tabulate()
        return model


def _weights(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the weights of the ensemble after a check of their shapes against each other."""
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
    """Return log-distance and height of the receiver above the device [m], (n, 2).

    With these as axes, unlike elevation, the box around data of a few altitudes is full of data.
    """
    return np.column_stack([links.log_distance, links.receiver_m[:, 2] - links.device_m[:, 2]])


def _folds(links: LinkGeometry, rng: np.random.Generator) -> np.ndarray:
    """Return the member (n,) that each link is held out from.

    Whole blocks of one device and BLOCK_M of ground go together: neighbouring links share their
    obstacles, so that a member would be validated on what it has learned already.
    """
    cell = np.floor(links.receiver_m[:, :2] / BLOCK_M).astype(np.int64)
    block = np.unique(np.column_stack([links.device, cell]), axis=0, return_inverse=True)[1]
    return deal_groups(block.ravel(), MEMBERS, rng)
