"""`correlated_shadowing`, the last resort: an interpolation of what no named effect explains.

A Gaussian process over the position of the end that moves, one field for each of the ends that do
not (the exponential model of shadowing, Gudmundson 1991, Electronics Letters 27), and beside it an
error of each receiver in each field. It has no physical cause: it says that the rest of the error
has a position. It is no candidate among the effects, because it would fit part of whatever they
stand for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from radiotwin.channel.residual_field import ResidualField
from radiotwin.effects.fold_model import FoldModel
from radiotwin.inference.censored_regression import FitResult
from radiotwin.links import LinkData
from radiotwin.pieces import kept

NAME = "correlated_shadowing"
MAX_Z = 6.0  # an outlier counts as this many scales


class _State(BaseModel):
    """State of `CorrelatedShadowing` in a file; arrays are checked by the field."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    relative_sd: Annotated[float, Field(gt=0, le=1000)]
    receivers_move: bool
    certain: bool
    settings: dict[str, Any]
    arrays: dict[str, list[float] | list[list[float]]]


@dataclass(frozen=True, eq=False)
class CorrelatedShadowing:
    """A field of the residual for each end that does not move.

    Attributes:
        field: of the residual in units of its own standard deviation.
        relative_sd: that standard deviation, in units of the error scale.
        receivers_move: whether devices stand still and receivers move, or the other way round.
        certain: whether it lowers the error scale where it was measured.
    """

    field: ResidualField
    relative_sd: float
    receivers_move: bool
    certain: bool = True

    @classmethod
    def fit(cls, model: FoldModel, result: FitResult, seed: int) -> CorrelatedShadowing:
        """Learn from the training links of a model what its channel and effects leave over."""
        z = standardised_residual(model, result)
        relative_sd = max(float(z.std()), 1e-6)
        shadowing = cls(ResidualField(), relative_sd, receivers_move(model.links))
        series, position_m, kind = shadowing._points(model.links.select(model.train))
        points = series, position_m, (z - z.mean()) / relative_sd, seed, kind
        field = kept("shadowing", points, lambda: shadowing.field.fit(*points),
                     ResidualField.state, ResidualField.from_state)
        return replace(shadowing, field=field)

    def refit(self, model: FoldModel, result: FitResult) -> CorrelatedShadowing:
        """Return the same correlation with the residual of a model's training links."""
        z = standardised_residual(model, result)
        series, position_m, kind = self._points(model.links.select(model.train))
        field = self.field.with_points(series, position_m, (z - z.mean()) / self.relative_sd, kind)
        return replace(self, field=field)

    def at(self, links: LinkData) -> tuple[np.ndarray, np.ndarray]:
        """Return what it adds (n,) [error scales], and the share (n,) left of the error scale."""
        mean, sd = self.field.predict(*self._points(links))
        return self.relative_sd * mean, sd if self.certain else np.ones_like(sd)

    def state(self) -> dict[str, Any]:
        """Return what JSON can hold and `from_state` reads; positions to the decimetre."""
        arrays, settings = self.field.state()
        return {"relative_sd": self.relative_sd, "receivers_move": self.receivers_move,
                "certain": self.certain, "settings": settings,
                "arrays": {name: array.round(1 if name.startswith("position") else 4).tolist()
                           for name, array in arrays.items()}}

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> CorrelatedShadowing:
        """Return what `state` described.

        Raises:
            ValueError: it is damaged.
            KeyError: a part is missing.
        """
        record = _State.model_validate(state)
        arrays = {name: np.array(array, dtype=float) for name, array in record.arrays.items()}
        field = ResidualField.from_state(arrays, record.settings)
        return cls(field, record.relative_sd, record.receivers_move, record.certain)

    def _points(self, links: LinkData) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Return series, position and kind of links.

        Where two receivers were at one position, their difference shows.
        """
        if self.receivers_move:
            return links.device, links.receiver_m, links.receiver
        return links.receiver, links.device_m[links.device], None


def standardised_residual(model: FoldModel, result: FitResult) -> np.ndarray:
    """Return the residuals of a model's training links (n,) [error scales]; outliers clipped."""
    residual_db = model.training.residual_db(result)
    return np.clip(residual_db / model.training.predict(result).scale_db, -MAX_Z, MAX_Z)


def receivers_move(links: LinkData) -> bool:
    """Return whether receivers have been at more positions than there are devices."""
    return len(np.unique(links.receiver_m[:, :2].round(), axis=0)) >= len(links.device_names)
