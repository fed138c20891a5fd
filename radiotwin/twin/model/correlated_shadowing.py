"""`correlated_shadowing`: interpolate the residuals that no named effect explains.

A Gaussian process over the position of the moving end, one field for each fixed end (exponential
model of shadowing, Gudmundson 1991, Electronics Letters 27), plus an error of each receiver in each
field. Before it, residuals of a device's relatives on the same mast predict part of the device's
residual: sectors of one mast look over the same city. It has no physical cause, and is not among
the candidate effects, because it would absorb part of any effect.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from radiotwin.links import Links
from radiotwin.links.sites import antenna_of, relatives_of
from radiotwin.propagation.laws.kriging import MIN_POINTS, ResidualField
from radiotwin.runtime.pieces import cached

MIN_SD = 1e-6  # least standard deviation of residuals, against division by zero
LEAST_SHARED_SD = 0.1  # prior sd of relatives' residuals [error scales], shrinks their slope
PAIRS = 9e6  # `max_pairs` of the field of relatives: a quarter of that of the devices
NAME = "correlated_shadowing"
MAX_Z = 6.0  # residuals are clipped to so many error scales


class FieldState(BaseModel):
    """A residual field in a file; the field itself checks the arrays."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    relative_sd: Annotated[float, Field(gt=0, le=1000)]
    settings: dict[str, Any]
    arrays: dict[str, list[float] | list[list[float]]]

    @property
    def field(self) -> ResidualField:
        """Restore the field that `written_field` wrote."""
        arrays = {name: np.array(array, dtype=float) for name, array in self.arrays.items()}
        return ResidualField.from_state(arrays, self.settings)


class RelativesState(FieldState):
    """State of `Relatives` in a file."""

    passed_on: list[Annotated[float, Field(ge=0, le=1)]]


def _fitted_field(what: str, field: ResidualField, *points: Any) -> ResidualField:
    """Fit an empty field to points (`ResidualField.fit`), or load the result of an earlier run."""
    return cached(what, points, lambda: field.fit(*points), ResidualField.state,
                  ResidualField.from_state)


def written_field(field: ResidualField) -> dict[str, Any]:
    """Return a field of residuals as settings and lists for JSON; positions to a decimetre."""
    arrays, settings = field.state()
    return {"settings": settings,
            "arrays": {name: array.round(1 if name.startswith("position") else 4).tolist()
                       for name, array in arrays.items()}}


@dataclass(frozen=True, eq=False)
class Relatives:
    """Prediction of a device's residuals from those of its relatives on the same mast.

    See `radiotwin.links.sites.relatives_of`.

    Attributes:
        field: field of the relatives' standardised residuals, one series for each device.
        relative_sd: standard deviation of the relatives' residuals [error scales].
        passed_on: device -> share of the relatives' residual that it has, too, in 0..1; one share
            for devices with relatives of the same antenna, one for the others.
    """

    field: ResidualField
    relative_sd: float
    passed_on: dict[int, float]

    @classmethod
    def fit(cls, links: Links, z: np.ndarray, field: ResidualField | None,
            seed: int) -> Relatives | None:
        """Fit how residuals (n,) follow those of relatives (devices on one mast); None: too few.

        The correlation is that of `field`; None: it is fitted. Residuals are in error scales.
        """
        measured = set(np.unique(links.device).tolist())
        devices = [(device, np.flatnonzero(np.isin(links.device, relatives)))
                   for device in sorted(links.anchors)
                   for relatives in [relatives_of(links, device, measured)] if relatives]
        rows = np.concatenate([np.zeros(0, dtype=int), *(rows for _, rows in devices)])
        if len(rows) < MIN_POINTS:
            return None
        series = np.concatenate([np.full(len(rows), device) for device, rows in devices])
        relative_sd = max(float(z[rows].std()), MIN_SD)
        points = series, links.receiver_m[rows], (z[rows] - z[rows].mean()) / relative_sd
        kind = links.receiver[rows]
        if field is None:
            field = _fitted_field("relatives", ResidualField(PAIRS), *points, seed, kind)
        else:
            field = field.with_points(*points, kind)
        mean = relative_sd * field.mean(links.device, links.receiver_m, links.receiver)
        near = [device for device in field.fields
                if set(antenna_of(links, device)) & (measured - {device})]
        passed_on: dict[int, float] = {}
        for group in (near, sorted(set(field.fields) - set(near))):
            group_links = np.isin(links.device, group)
            # If no device of the group was heard itself, use the slope of all links.
            share = _slope(mean[group_links], z[group_links]) if group_links.any() \
                else _slope(mean, z)
            passed_on |= dict.fromkeys(group, share)
        return cls(field, relative_sd, passed_on)

    def mean(self, links: Links) -> np.ndarray:
        """Predict residuals (n,) from those of relatives [error scales]; 0 without relatives."""
        return self._share(links) * self.relative_sd * self.field.mean(
            links.device, links.receiver_m, links.receiver)

    def at(self, links: Links) -> tuple[np.ndarray, np.ndarray]:
        """Return `mean`, and the share (n,) of the error scale that remains after it, 0 to 1."""
        mean, sd = self.field.predict(links.device, links.receiver_m, links.receiver)
        share = self._share(links)
        return share * self.relative_sd * mean, np.sqrt(1 - share**2 * (1 - sd**2))

    def _share(self, links: Links) -> np.ndarray:
        """Return the share `passed_on` (n,) of relatives' residuals, 0..1; 0 without relatives."""
        share = np.zeros(len(links))
        for device, passed_on in self.passed_on.items():
            share[links.device == device] = passed_on
        return share

    def state(self) -> dict[str, Any]:
        """Return shares, settings and arrays for JSON, which `of` reads."""
        passed_on = [self.passed_on[device] for device in self.field.fields]
        return {"relative_sd": self.relative_sd, "passed_on": passed_on,
                **written_field(self.field)}

    @classmethod
    def of(cls, record: RelativesState) -> Relatives:
        """Restore the relatives' prediction from its `state`; raise ValueError if it is damaged."""
        field = record.field
        if len(record.passed_on) != len(field.fields):
            raise ValueError("passed_on is not of the devices")
        return cls(field, record.relative_sd,
                   dict(zip(field.fields, record.passed_on, strict=True)))


def _slope(mean: np.ndarray, z: np.ndarray) -> float:
    """Regress residuals (n,) on those of relatives (n,), shrunk towards 0, and clip to 0..1."""
    slope = float(mean @ z / (mean @ mean + len(z) * LEAST_SHARED_SD**2))
    return min(max(slope, 0.0), 1.0)


class _State(FieldState):
    """State of `CorrelatedShadowing` in a file."""

    receivers_move: bool
    certain: bool
    relatives: RelativesState | None = None


@dataclass(frozen=True, eq=False)
class CorrelatedShadowing:
    """Interpolated residuals: one field for each fixed end, plus the prediction by relatives.

    Attributes:
        field: field of the standardised residuals, after subtracting the relatives' prediction.
        relative_sd: standard deviation of these residuals [error scales].
        receivers_move: True: receivers move and devices are fixed; False: the other way round.
        certain: True if the error scale is smaller near measurements.
        relatives: prediction by relatives; None: no device has relatives.
    """

    field: ResidualField
    relative_sd: float
    receivers_move: bool
    certain: bool = True
    relatives: Relatives | None = None

    @classmethod
    def fit(cls, links: Links, train: np.ndarray, z: np.ndarray, seed: int,
            like: CorrelatedShadowing | None = None) -> CorrelatedShadowing:
        """Fit the interpolation over space to the residuals (m,) of a model's training links.

        The mask `train` (n,) is of all links. The correlations are those of `like`, if given.
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
        """Return interpolated residual [error scales], remaining share of the error scale, (n,).

        The share is 1 far from measurements, or if not `certain`.
        """
        mean, sd = self.field.predict(*_points(links, self.receivers_move))
        mean = self.relative_sd * mean
        if self.relatives is not None:
            by_relatives, remaining = self.relatives.at(links)
            mean, sd = mean + by_relatives, sd * remaining
        return mean, sd if self.certain else np.ones_like(sd)

    def state(self) -> dict[str, Any]:
        """Return settings and arrays for JSON, which `from_state` reads."""
        state = {"relative_sd": self.relative_sd, "receivers_move": self.receivers_move,
                 "certain": self.certain, **written_field(self.field)}
        if self.relatives is not None:
            state["relatives"] = self.relatives.state()
        return state

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> CorrelatedShadowing:
        """Restore the interpolation from its `state`; ValueError or KeyError if it is damaged."""
        record = _State.model_validate(state)
        relatives = None if record.relatives is None else Relatives.of(record.relatives)
        return cls(record.field, record.relative_sd, record.receivers_move, record.certain,
                   relatives)


def _points(links: Links,
            receivers_move: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return series, position (n, 3) [m] and kind (n,) of links, as `ResidualField.fit` takes them.

    If receivers move, the kind is the receiver, so that each has an error of its own.
    """
    position_m, series = moving_ends(links, receivers_move)
    return series, position_m, links.receiver if receivers_move else None


def moving_ends(links: Links, receivers_move: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (n, 3) of the moving end [m], and rows (n,) of the fixed end."""
    if receivers_move:
        return links.receiver_m, links.device
    return links.device_m[links.device], links.receiver


def receivers_move(links: Links) -> bool:
    """Return True if receivers were at as many positions as there are devices, or more."""
    return len(np.unique(links.receiver_m[:, :2].round(), axis=0)) >= len(links.device_names)
