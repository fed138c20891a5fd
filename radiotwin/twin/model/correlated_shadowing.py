"""`correlated_shadowing`, the last resort: an interpolation of what no named effect explains.

A Gaussian process over the position of the end that moves, one field for each of the ends that do
not (the exponential model of shadowing, Gudmundson 1991, Electronics Letters 27), and beside it an
error of each receiver in each field. What was measured of a device's relatives, on the same mast,
comes first: sectors of one mast look over the same city. It has no physical cause: it says that the
rest of the error has a position. It is no candidate among the effects, because it would fit part of
whatever they stand for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from radiotwin.links import Links
from radiotwin.links.sites import antenna_of, relatives_of
from radiotwin.propagation.laws.kriging import MIN_POINTS, ResidualField
from radiotwin.runtime.pieces import kept

MIN_SD = 1e-6  # of a residual that is nothing
LEAST_SHARED_SD = 0.1  # of what relatives say, in error scales: less is nearly nothing
PAIRS = 9e6  # of their points, see `ResidualField`: a quarter of those of the devices themselves
NAME = "correlated_shadowing"
MAX_Z = 6.0  # an outlier counts as this many scales


class FieldState(BaseModel):
    """An interpolated residual in a file; arrays are checked by the field."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    relative_sd: Annotated[float, Field(gt=0, le=1000)]
    settings: dict[str, Any]
    arrays: dict[str, list[float] | list[list[float]]]

    @property
    def field(self) -> ResidualField:
        """The field that `written_field` wrote."""
        arrays = {name: np.array(array, dtype=float) for name, array in self.arrays.items()}
        return ResidualField.from_state(arrays, self.settings)


class RelativesState(FieldState):
    """State of `Relatives` in a file."""

    passed_on: list[Annotated[float, Field(ge=0, le=1)]]


def _fitted_field(what: str, field: ResidualField, *points: Any) -> ResidualField:
    """Return an empty field after its fit to points (`ResidualField.fit`), or one that was kept."""
    return kept(what, points, lambda: field.fit(*points), ResidualField.state,
                ResidualField.from_state)


def written_field(field: ResidualField) -> dict[str, Any]:
    """Return what `FieldState` reads, without the standard deviation; positions to a decimetre."""
    arrays, settings = field.state()
    return {"settings": settings,
            "arrays": {name: array.round(1 if name.startswith("position") else 4).tolist()
                       for name, array in arrays.items()}}


@dataclass(frozen=True, eq=False)
class Relatives:
    """Prediction of devices by their relatives, see `radiotwin.links.sites.relatives_of`.

    Attributes:
        field: for each device of the residual of its relatives, never its own, in units of its
            standard deviation.
        relative_sd: that standard deviation, in units of the error scale.
        passed_on: device -> share of it that is the device's, too, in 0..1; one for all whose
            relatives are of their antenna, one for the others.
    """

    field: ResidualField
    relative_sd: float
    passed_on: dict[int, float]

    @classmethod
    def fit(cls, links: Links, z: np.ndarray, field: ResidualField | None,
            seed: int) -> Relatives | None:
        """Return what links with residuals (n,) say of their relatives; None if none has any.

        Args:
            links: n links, of which receivers move.
            z: (n,) residuals [error scales].
            field: whose correlation is taken; None: it is fitted.
            seed: of that.
        """
        heard = set(np.unique(links.device).tolist())
        devices = [(device, np.flatnonzero(np.isin(links.device, relatives)))
                   for device in sorted(links.anchors)
                   for relatives in [relatives_of(links, device, heard)] if relatives]
        rows = np.concatenate([np.zeros(0, dtype=int), *(each for _, each in devices)])
        if len(rows) < MIN_POINTS:
            return None
        series = np.concatenate([np.full(len(each), device) for device, each in devices])
        relative_sd = max(float(z[rows].std()), MIN_SD)
        points = series, links.receiver_m[rows], (z[rows] - z[rows].mean()) / relative_sd
        kind = links.receiver[rows]
        if field is None:
            field = _fitted_field("relatives", ResidualField(PAIRS), *points, seed, kind)
        else:
            field = field.with_points(*points, kind)
        mean = relative_sd * field.mean(links.device, links.receiver_m, links.receiver)
        near = [device for device in field.fields
                if set(antenna_of(links, device)) & (heard - {device})]
        passed_on: dict[int, float] = {}
        for alike in (near, sorted(set(field.fields) - set(near))):
            mine = np.isin(links.device, alike)
            # Where none of the kind was heard itself, as much as of all.
            share = _slope(mean[mine], z[mine]) if mine.any() else _slope(mean, z)
            passed_on |= dict.fromkeys(alike, share)
        return cls(field, relative_sd, passed_on)

    def mean(self, links: Links) -> np.ndarray:
        """Return what they say of links (n,) [error scales]; 0 where they say nothing."""
        return self._share(links) * self.relative_sd * self.field.mean(
            links.device, links.receiver_m, links.receiver)

    def at(self, links: Links) -> tuple[np.ndarray, np.ndarray]:
        """Return `mean`, and the share (n,) left of the error scale."""
        mean, sd = self.field.predict(links.device, links.receiver_m, links.receiver)
        share = self._share(links)
        return share * self.relative_sd * mean, np.sqrt(1 - share**2 * (1 - sd**2))

    def _share(self, links: Links) -> np.ndarray:
        """Return `passed_on` of the device of each link (n,); 0 of one without relatives."""
        share = np.zeros(len(links))
        for device, passed_on in self.passed_on.items():
            share[links.device == device] = passed_on
        return share

    def state(self) -> dict[str, Any]:
        """Return what JSON can hold and `of` reads."""
        passed_on = [self.passed_on[device] for device in self.field.fields]
        return {"relative_sd": self.relative_sd, "passed_on": passed_on,
                **written_field(self.field)}

    @classmethod
    def of(cls, record: RelativesState) -> Relatives:
        """Return what `state` described; raise ValueError where it is damaged."""
        field = record.field
        if len(record.passed_on) != len(field.fields):
            raise ValueError("passed_on is not of the devices")
        return cls(field, record.relative_sd,
                   dict(zip(field.fields, record.passed_on, strict=True)))


def _slope(mean: np.ndarray, z: np.ndarray) -> float:
    slope = float(mean @ z / (mean @ mean + len(z) * LEAST_SHARED_SD**2))
    return min(max(slope, 0.0), 1.0)


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
    def fit(cls, links: Links, train: np.ndarray, z: np.ndarray, seed: int,
            like: CorrelatedShadowing | None = None) -> CorrelatedShadowing:
        """Learn what a channel and effects leave over of links, see `Fit.rest`.

        Args:
            links: n links.
            train: (n,) bool, m links that are learnt from.
            z: (m,) their residuals [error scales].
            seed: of the samples that correlations are fitted to.
            like: another one, whose correlations are taken; None: they are fitted.
        """
        move = like.receivers_move if like else receivers_move(links)
        links, relatives = links.select(train), None
        if move:
            field = like.relatives.field if like and like.relatives else None
            relatives = Relatives.fit(links, z, field, seed)
        if relatives is not None:
            z = z - relatives.mean(links)
        relative_sd = max(float(z.std()), MIN_SD)
        series, position_m, kind = _points(links, move)
        points = series, position_m, (z - z.mean()) / relative_sd
        field = (like.field.with_points(*points, kind) if like
                 else _fitted_field("shadowing", ResidualField(), *points, seed, kind))
        return cls(field, relative_sd, move, like is None or like.certain, relatives)

    def at(self, links: Links) -> tuple[np.ndarray, np.ndarray]:
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


def _points(links: Links,
            receivers_move: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return series, position and kind of links.

    Where two receivers were at one position, their difference shows.
    """
    position_m, series = moving_ends(links, receivers_move)
    return series, position_m, links.receiver if receivers_move else None


def moving_ends(links: Links, receivers_move: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (n, 3) of the end that moves [m], and the row (n,) of the other end."""
    if receivers_move:
        return links.receiver_m, links.device
    return links.device_m[links.device], links.receiver


def receivers_move(links: Links) -> bool:
    """Return whether receivers have been at more positions than there are devices."""
    return len(np.unique(links.receiver_m[:, :2].round(), axis=0)) >= len(links.device_names)
