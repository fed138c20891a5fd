"""Choose a channel model by its error on held-out links of the anchors."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from radiotwin.inference.gaussian import Limit, limits_of, mean_if_detected
from radiotwin.inference.held_out import deal_groups
from radiotwin.links import LinkGeometry
from radiotwin.links.variables import ground_squares
from radiotwin.propagation.laws import channel_named, fit_once
from radiotwin.propagation.laws.base import BLOCK_M, MIN_DETECTED, ground_blocks

AUTO = "auto"
HELD_OUT, LOCATED_BY = "held_out", "located_by"  # in the provenance of a twin
CHEAP = ("log_distance", "segmented_log_distance", "segmented_nn", "kriging")
UNTRIED = "segmented_log_distance"  # taken where too few links are there to hold any out
FOLDS, MIN_FLIGHTS = 3, 3
ALIKE = 0.04  # of the mean squared error, 2 % of the RMSE: too little to prefer a complex model
MAX_LINKS = 5_000  # that models are judged on; kriging of more takes minutes


@dataclass(frozen=True)
class HeldOut:
    """Errors of channel models on anchors' links that took no part in their fits.

    Attributes:
        by: what was held out together: `flight`, or `block` of ground.
        rmse_db: of detected links, by the name of the model, simple ones first [dB].
        as_good: models whose mean squared error is within one standard error, or `ALIKE`, of the
            least; simple ones first.
    """

    by: str
    rmse_db: dict[str, float]
    as_good: tuple[str, ...]

    @classmethod
    def of(cls, links: LinkGeometry, flight: np.ndarray, level_db: np.ndarray, limit_db: Limit,
           seed: int, models: tuple[str, ...] = CHEAP) -> HeldOut | None:
        """Compute the errors of channel models on links of the anchors that their fits left out.

        Each model is fitted once without each fold of flights (n,) or, with few flights, of ground
        blocks; one that leaves a detected level unpredicted is left out. Levels and limits (n,) are
        as of `ChannelModel.fit`. At most `MAX_LINKS` are drawn; None: too few to learn from.
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
            by, group = "block", ground_squares(links.receiver_m, BLOCK_M)
        fold = deal_groups(group, FOLDS, rng)
        detected, limits_db = np.isfinite(level_db), limits_of(limit_db, len(level_db))
        if len(np.unique(fold)) < 2 or min(
                int(detected[fold != each].sum()) for each in np.unique(fold)) < MIN_DETECTED:
            return None
        square_db2 = {}
        for name in models:
            error_db = np.full(len(level_db), np.nan)
            for each in np.unique(fold):
                train, test = fold != each, fold == each
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # the fit to all links warns of the same
                    model = fit_once(channel_named(name), links.select(train), level_db[train],
                                     limits_db[train], seed)
                expected_db = mean_if_detected(*model.predict(links.select(test)), limits_db[test])
                error_db[test] = level_db[test] - expected_db
            if np.isfinite(error_db[detected]).all():  # a model without some levels is no choice
                square_db2[name] = error_db[detected]**2
        if not square_db2:
            return None
        least = min(square_db2.values(), key=lambda square: float(square.mean()))
        block = ground_blocks(links.select(detected))
        as_good = tuple(name for name, square in square_db2.items() if np.mean(square - least)
                        <= max(standard_error(square - least, block), ALIKE * np.mean(least)))
        return cls(by, {name: float(np.sqrt(square.mean())) for name, square in square_db2.items()},
                   as_good)

    @classmethod
    def from_provenance(cls, provenance: dict[str, Any]) -> HeldOut | None:
        """Restore the held-out errors from a twin's provenance; None: models were not compared."""
        rows = provenance.get(HELD_OUT)
        if not rows:
            return None
        return cls(rows[0]["by"], {row["model"]: row["rmse_db"] for row in rows},
                   tuple(row["model"] for row in rows if row["as_good"]))

    @property
    def record(self) -> list[dict[str, Any]]:
        """Return the errors as rows for the provenance of a twin."""
        return [{"model": name, "rmse_db": rmse_db, "by": self.by, "as_good": name in self.as_good}
                for name, rmse_db in self.rmse_db.items()]

    @property
    def best(self) -> str:
        """Return the simplest of the models with about the least error."""
        return self.as_good[0]

    def sentence(self, model: str) -> str:
        """Say in a sentence how the held-out error of a model compares with those of the others."""
        errors = ", ".join(f"{name} {rmse_db:.2f}" for name, rmse_db in self.rmse_db.items())
        text = f"RMSE on anchors' links held out by {self.by} [dB]: {errors}."
        if model not in self.rmse_db:
            return f"{text} {model} was not compared with them"
        if self.rmse_db[model] == min(self.rmse_db.values()):
            return f"{text} {model} has the least"
        if model in self.as_good:
            simplest = ", and the simplest such model" if model == self.best else ""
            return f"{text} {model} is as good as the best{simplest}"
        return (f"{text} {self.best} would be better: {self.rmse_db[self.best]:.2f} dB, where "
                f"{model} has {self.rmse_db[model]:.2f} dB; take --model {self.best}, or --model "
                f"{AUTO}")


def standard_error(value: np.ndarray, block: np.ndarray) -> float:
    """Return the standard error of the mean of values (n,) that are correlated within blocks (n,).

    From the sums over blocks (Cochran 1977, 'Sampling Techniques', chapter 6): links to one device
    from receivers close together have similar errors.
    """
    deviation = np.bincount(block, value - value.mean())
    blocks = len(deviation)
    return float(np.sqrt(np.square(deviation).sum() * blocks / max(blocks - 1, 1)) / len(value))
