"""`correlated_shadowing`, the last resort: an interpolation of what no named effect explains.

A Gaussian process over the position of the end that moves, one field for each of the ends that do
not (the exponential model of shadowing, Gudmundson 1991, Electronics Letters 27), and beside it an
error of each receiver in each field. What was measured of a device's relatives, on the same mast,
comes first: their signals pass the same buildings. It has no physical cause: it says that the rest
of the error has a position. It is no candidate among the effects, because it would fit part of
whatever they stand for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from radiotwin.channel.residual_field import ResidualField
from radiotwin.effects.fold_model import FoldModel
from radiotwin.effects.relatives import (
    MIN_SD,
    FieldState,
    Relatives,
    RelativesState,
    fitted_field,
    written_field,
)
from radiotwin.inference.censored_regression import FitResult
from radiotwin.links import LinkData

NAME = "correlated_shadowing"
MAX_Z = 6.0  # an outlier counts as this many scales


class _State(FieldState):
    """State of `CorrelatedShadowing` in a file."""

    receivers_move: bool
    certain: bool
    relatives: RelativesState | None = None


@dataclass(frozen=True, eq=False)
class CorrelatedShadowing:
    """A field of the residual for each end that does not move.

    Attributes:
        field: of the residual, without what relatives say, in units of its own standard deviation.
        relative_sd: that standard deviation, in units of the error scale.
        receivers_move: whether devices stand still and receivers move, or the other way round.
        certain: whether it lowers the error scale where it was measured.
        relatives: what relatives say; None: nobody has any.
    """

    field: ResidualField
    relative_sd: float
    receivers_move: bool
    certain: bool = True
    relatives: Relatives | None = None

    @classmethod
    def fit(cls, model: FoldModel, result: FitResult, seed: int) -> CorrelatedShadowing:
        """Learn from the training links of a model what its channel and effects leave over."""
        return cls._learnt(model, result, seed)

    def refit(self, model: FoldModel, result: FitResult) -> CorrelatedShadowing:
        """Return the same correlation with the residual of a model's training links."""
        return replace(self._learnt(model, result, 0, self), certain=self.certain)

    @classmethod
    def _learnt(cls, model: FoldModel, result: FitResult, seed: int,
                like: CorrelatedShadowing | None = None) -> CorrelatedShadowing:
        """Learn, with the correlations of another where one is given."""
        z = standardised_residual(model, result)
        links, relatives = model.links.select(model.train), None
        move = like.receivers_move if like else receivers_move(model.links)
        if move:
            field = like.relatives.field if like and like.relatives else None
            relatives = Relatives.fit(links, z, field, seed)
        if relatives is not None:
            z = z - relatives.mean(links)
        relative_sd = max(float(z.std()), MIN_SD)
        series, position_m, kind = _points(links, move)
        points = series, position_m, (z - z.mean()) / relative_sd
        field = (like.field.with_points(*points, kind) if like
                 else fitted_field("shadowing", ResidualField(), *points, seed, kind))
        return cls(field, relative_sd, move, relatives=relatives)

    def at(self, links: LinkData) -> tuple[np.ndarray, np.ndarray]:
        """Return what it adds (n,) [error scales], and the share (n,) left of the error scale."""
        mean, sd = self.field.predict(*_points(links, self.receivers_move))
        mean = self.relative_sd * mean
        if self.relatives is not None:
            said, left = self.relatives.at(links)
            mean, sd = mean + said, sd * left
        return mean, sd if self.certain else np.ones_like(sd)

    def state(self) -> dict[str, Any]:
        """Return what JSON can hold and `from_state` reads; positions to the decimetre."""
        state = {"relative_sd": self.relative_sd, "receivers_move": self.receivers_move,
                 "certain": self.certain, **written_field(self.field)}
        if self.relatives is not None:
            state["relatives"] = self.relatives.state()
        return state

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> CorrelatedShadowing:
        """Return what `state` described.

        Raises:
            ValueError: it is damaged.
            KeyError: a part is missing.
        """
        record = _State.model_validate(state)
        relatives = None if record.relatives is None else Relatives.of(record.relatives)
        return cls(record.field, record.relative_sd, record.receivers_move, record.certain,
                   relatives)


def _points(links: LinkData,
            receivers_move: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return series, position and kind of links.

    Where two receivers were at one position, their difference shows.
    """
    if receivers_move:
        return links.device, links.receiver_m, links.receiver
    return links.receiver, links.device_m[links.device], None


def standardised_residual(model: FoldModel, result: FitResult) -> np.ndarray:
    """Return the residuals of a model's training links (n,) [error scales]; outliers clipped."""
    residual_db = model.training.residual_db(result)
    return np.clip(residual_db / model.training.predict(result).scale_db, -MAX_Z, MAX_Z)


def receivers_move(links: LinkData) -> bool:
    """Return whether receivers have been at more positions than there are devices."""
    return len(np.unique(links.receiver_m[:, :2].round(), axis=0)) >= len(links.device_names)
