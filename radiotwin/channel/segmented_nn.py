"""The segmented log-distance law, bent by a neural network where the measurements say so."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
import torch

from radiotwin.channel.base import ChannelModel, drop_uninformative
from radiotwin.inference.censored_line import fit_sigma
from radiotwin.channel.ensemble import MEMBERS, WEIGHTS, TrainingData, forward, one_thread, train
from radiotwin.links.geometry import LinkGeometry
from radiotwin.channel.segmented_log_distance import SegmentedLogDistance

BLOCK_M = 100.0
TABLE = 129
TRIM = 0.005
MIN_SPAN = np.array([0.1, 10.0])
"""Least range of log-distance and of height difference [m] that counts as a difference."""


class SegmentedNN(ChannelModel):
    """Segmented log-distance law plus a learned residual of log-distance, elevation and line of sight.

    After Chen et al., 'Model-aided federated reinforcement learning for multi-UAV trajectory planning in IoT
    networks' (GLOBECOM Workshops 2023): the same inputs and likelihood, with a standard deviation per class. Here
    the network learns only what the law leaves over. Each member of the ensemble holds out one part of the links,
    starts as the law itself and keeps the weights that were best on that part, so that a bad start cannot ship; the
    prediction is the members' mean. Outside the distances and heights measured the residual stays as at the
    edge, and the law extrapolates. A class that borrowed its line keeps it unbent.

    Predictions come from a table of that mean, TABLE x TABLE values a class, bilinear between them: as exact as
    the network to hundredths of a decibel and fast enough for millions of candidate positions.
    """

    name = "segmented_nn"
    uses_map = True

    def __init__(self) -> None:
        self.law = SegmentedLogDistance()
        # Per class, NLoS first: the box of the data's places, see _place, and of the residual [dB].
        self.low, self.high = np.zeros((2, 2)), np.ones((2, 2))
        self.residual_db = np.zeros((2, 2))
        self.sigma_db = np.ones(2)
        self.weights: dict[str, np.ndarray] = {}

    def fit(self, links: LinkGeometry, level_db: np.ndarray, limit_db: float | None, seed: int = 0) -> Self:
        """Law first, then the residual; see ChannelModel.fit. Equal data and seed give equal bits."""
        links, level_db = drop_uninformative(links, level_db, limit_db)
        self.law.fit(links, level_db, limit_db)
        law_db, law_sigma_db = self.law.predict(links)
        segment = links.los.astype(np.intp)
        place = _place(links)
        bent = np.array([self.law.borrowed != "nlos", self.law.borrowed != "los"])
        use = bent[segment]
        for s in (0, 1):
            # The outermost links are too few to shape the edge that everything beyond is read from.
            source = place[segment == s] if bent[s] else place[use]
            self.low[s], self.high[s] = np.quantile(source, [TRIM, 1.0 - TRIM], axis=0)
        censored = np.isnan(level_db)
        residual = (np.where(censored, limit_db or 0.0, level_db) - law_db) / law_sigma_db
        data = TrainingData(
            inputs=self._inputs(place, segment)[use],
            target=residual[use],
            censored=censored[use],
            los=links.los[use],
            fold=_folds(links, np.random.default_rng(seed))[use],
        )
        self.weights, unseen = train(data, seed)
        mean_db = law_db.copy()
        mean_db[use] += unseen * law_sigma_db[use]
        for s, line in enumerate((self.law.nlos, self.law.los)):
            mask = segment == s
            if bent[s]:
                self.residual_db[s] = np.quantile(mean_db[mask] - law_db[mask], [TRIM, 1.0 - TRIM])
                self.sigma_db[s] = fit_sigma(level_db[mask], mean_db[mask], limit_db)
            else:
                self.residual_db[s], self.sigma_db[s] = 0.0, line.sigma_db
        self._tabulate()
        return self

    def predict(self, links: LinkGeometry) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation [dB], (n,) each."""
        segment = links.los.astype(np.intp)
        scale = (TABLE - 1) / np.maximum(self.high - self.low, 1e-9)
        index, weight = [], []
        for axis, value in enumerate(_place(links).T):
            position = (value - self.low[segment, axis]) * scale[segment, axis]
            position = np.clip(position, 0.0, TABLE - 1)
            index.append(np.minimum(position.astype(np.intp), TABLE - 2))
            weight.append(position - index[-1])
        corner = (segment * TABLE + index[0]) * TABLE + index[1]
        table, (u, v) = self._table.ravel(), weight
        near = table[corner] * (1.0 - v) + table[corner + 1] * v
        far = table[corner + TABLE] * (1.0 - v) + table[corner + TABLE + 1] * v
        return self.law.predict(links)[0] + near * (1.0 - u) + far * u, self.sigma_db[segment]

    def _inputs(self, place: np.ndarray, segment: np.ndarray) -> np.ndarray:
        """(n, 4) inputs of the network: log-distance, elevation, line of sight, and the height difference once more,
        because at a few altitudes the elevation hardly tells more than the distance; the first and last in [-1, 1].
        """
        place = np.clip(place, self.low[segment], self.high[segment])
        elevation_rad = np.arcsin(np.clip(place[:, 1] / 10.0 ** place[:, 0], -1.0, 1.0))
        low, high = self.low.min(axis=0), self.high.max(axis=0)
        scaled = (2.0 * place - low - high) / np.maximum(high - low, MIN_SPAN)
        return np.column_stack([scaled[:, 0], elevation_rad, 2.0 * segment - 1.0, scaled[:, 1]])

    def _tabulate(self) -> None:
        """The mean residual of the ensemble [dB] on a grid over each class's box, (2, TABLE, TABLE)."""
        weights = {name: torch.as_tensor(array) for name, array in self.weights.items()}
        self._table = np.zeros((2, TABLE, TABLE))
        for s, line in enumerate((self.law.nlos, self.law.los)):
            axes = np.linspace(self.low[s], self.high[s], TABLE).T
            grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
            inputs = torch.as_tensor(self._inputs(grid, np.full(len(grid), s)), dtype=torch.float32)
            with one_thread(), torch.no_grad():
                mean = forward(weights, inputs).mean(0).numpy().astype(float) * line.sigma_db
            self._table[s] = np.clip(mean, *self.residual_db[s]).reshape(TABLE, TABLE)

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """See ChannelModel.state."""
        arrays, settings = self.law.state()
        own = {"low": self.low, "high": self.high, "residual_db": self.residual_db, "sigma_db": self.sigma_db}
        return arrays | own | self.weights, settings

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], settings: dict[str, Any]) -> Self:
        """See ChannelModel.from_state."""
        model = cls()
        model.law = SegmentedLogDistance.from_state(arrays, settings)
        model.low, model.high = arrays["low"], arrays["high"]
        model.residual_db, model.sigma_db = arrays["residual_db"], arrays["sigma_db"]
        model.weights = {name: arrays[name] for name in WEIGHTS}
        model._tabulate()
        return model


def _place(links: LinkGeometry) -> np.ndarray:
    """(n, 2) log-distance and height of the receiver above the device [m]: with these as axes, unlike elevation, the
    box around the data of a few altitudes is full of data."""
    return np.column_stack([links.log_distance, links.receiver_m[:, 2] - links.device_m[:, 2]])


def _folds(links: LinkGeometry, rng: np.random.Generator) -> np.ndarray:
    """(n,) the member that holds a link out: whole blocks of one device and BLOCK_M of ground go together, because
    neighbouring links share their obstacles and would only tell a member what it has learned already."""
    cell = np.floor(links.receiver_m[:, :2] / BLOCK_M).astype(np.int64)
    blocks, block, count = np.unique(
        np.column_stack([links.device, cell]), axis=0, return_inverse=True, return_counts=True
    )
    fold = np.empty(len(blocks), np.int64)
    load = np.zeros(MEMBERS)
    for b in sorted(rng.permutation(len(blocks)), key=lambda b: -count[b]):
        fold[b] = load.argmin()
        load[fold[b]] += count[b]
    return fold[block.ravel()]
