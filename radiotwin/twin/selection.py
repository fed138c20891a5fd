"""Which of the cheap channel models predicts links best that it has not seen."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from radiotwin.inference.gaussian import Limit, limits_of, mean_if_detected
from radiotwin.inference.held_out import deal_groups
from radiotwin.links import LinkGeometry
from radiotwin.propagation.laws import channel_named, fit_once
from radiotwin.propagation.laws.base import MIN_DETECTED
from radiotwin.propagation.laws.segmented_nn import BLOCK_M

AUTO = "auto"
HELD_OUT = "held_out"  # in the provenance of a twin
CHEAP = ("log_distance", "segmented_log_distance", "segmented_nn", "regression_kriging")
FOLDS, MIN_FLIGHTS = 3, 3
MAX_LINKS = 5_000  # that models are judged on; kriging of more takes minutes
AS_GOOD = 1.02  # ratio of errors up to which a simpler model is as good


@dataclass(frozen=True)
class HeldOut:
    """Errors of models on anchors' links that took no part in their fits.

    Attributes:
        by: what was held out together: `flight`, or `block` of ground.
        rmse_db: of detected links, by the name of the model, simple ones first [dB].
    """

    by: str
    rmse_db: dict[str, float]

    @classmethod
    def of(cls, links: LinkGeometry, flight: np.ndarray, level_db: np.ndarray, limit_db: Limit,
           seed: int, models: tuple[str, ...] = CHEAP) -> HeldOut | None:
        """Judge models.

        Args:
            links: n links of the anchors.
            flight: (n,) index.
            level_db: (n,) as of `ChannelModel.fit`.
            limit_db: as of `ChannelModel.fit`.
            seed: of the parts that are held out, and of the fits.
            models: names.

        Returns:
            None where too few links would be left to learn from.
        """
        if not len(flight):
            return None
        rng = np.random.default_rng(seed)
        if len(flight) > MAX_LINKS:
            rows = np.sort(rng.choice(len(flight), MAX_LINKS, replace=False))
            links, flight, level_db = links.select(rows), flight[rows], level_db[rows]
            limit_db = limit_db[rows] if isinstance(limit_db, np.ndarray) else limit_db
        by, group = "flight", flight
        if len(np.unique(flight)) < MIN_FLIGHTS:
            cell = np.floor(links.receiver_m[:, :2] / BLOCK_M).astype(np.int64)
            by, group = "block", np.unique(cell, axis=0, return_inverse=True)[1].ravel()
        fold = deal_groups(group, FOLDS, rng)
        seen, limits_db = np.isfinite(level_db), limits_of(limit_db, len(level_db))
        if len(np.unique(fold)) < 2 or min(
                int(seen[fold != each].sum()) for each in np.unique(fold)) < MIN_DETECTED:
            return None
        rmse_db = {}
        for name in models:
            error_db = np.full(len(level_db), np.nan)
            for each in np.unique(fold):
                train, test = fold != each, fold == each
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # that of all links is said
                    model = fit_once(channel_named(name), links.select(train), level_db[train],
                                     limits_db[train], seed)
                expected_db = mean_if_detected(*model.predict(links.select(test)), limits_db[test])
                error_db[test] = level_db[test] - expected_db
            rmse_db[name] = float(np.sqrt(np.nanmean(error_db**2)))
        return cls(by, rmse_db)

    @classmethod
    def kept(cls, provenance: dict[str, Any]) -> HeldOut | None:
        """Return what a twin's provenance holds; None if nothing."""
        found = provenance.get(HELD_OUT)
        if found is None:
            return None
        return cls(found["by"], {name: value for name, value in found.items() if name != "by"})

    @property
    def record(self) -> dict[str, Any]:
        """For the provenance of a twin."""
        return {"by": self.by, **self.rmse_db}

    @property
    def best(self) -> str:
        """The simplest model whose error is within 2 % of the least."""
        least_db = min(self.rmse_db.values())
        return next(name for name, each in self.rmse_db.items() if each <= AS_GOOD * least_db)

    def sentence(self, model: str) -> str:
        """Say how good a model is beside the others."""
        tried = ", ".join(f"{name} {each:.2f}" for name, each in self.rmse_db.items())
        text = f"RMSE on anchors' links held out by {self.by} [dB]: {tried}."
        if model not in self.rmse_db:
            return f"{text} {model} was not tried: it takes too long"
        if self.rmse_db[model] <= AS_GOOD * self.rmse_db[self.best]:
            return f"{text} {model} is the best of them, or as good"
        return (f"{text} {self.best} would be better: {self.rmse_db[self.best]:.2f} dB, where "
                f"{model} has {self.rmse_db[model]:.2f} dB; take --model {self.best}, or --model "
                f"{AUTO}")
