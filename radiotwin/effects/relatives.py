"""The residual of a device's relatives: sectors of one mast look over the same city."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from radiotwin.channel.residual_field import MIN_POINTS, ResidualField
from radiotwin.links import LinkData
from radiotwin.links.sites import antenna_of, relatives_of
from radiotwin.pieces import kept

MIN_SD = 1e-6  # of a residual that is nothing
LEAST_SHARED_SD = 0.1  # of what relatives say, in error scales: less is nearly nothing
PAIRS = 9e6  # of their points, see `ResidualField`: a quarter of those of the devices themselves


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


def fitted_field(what: str, field: ResidualField, *points: Any) -> ResidualField:
    """Return a field after its fit to points, or one that was, see `radiotwin.pieces.kept`.

    Args:
        what: name of the finished parts.
        field: empty.
        points: arguments of `ResidualField.fit`.
    """
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
    def fit(cls, links: LinkData, z: np.ndarray, field: ResidualField | None,
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
            field = fitted_field("relatives", ResidualField(PAIRS), *points, seed, kind)
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

    def mean(self, links: LinkData) -> np.ndarray:
        """Return what they say of links (n,) [error scales]; 0 where they say nothing."""
        return self._share(links) * self.relative_sd * self.field.mean(
            links.device, links.receiver_m, links.receiver)

    def at(self, links: LinkData) -> tuple[np.ndarray, np.ndarray]:
        """Return `mean`, and the share (n,) left of the error scale."""
        mean, sd = self.field.predict(links.device, links.receiver_m, links.receiver)
        share = self._share(links)
        return share * self.relative_sd * mean, np.sqrt(1 - share**2 * (1 - sd**2))

    def _share(self, links: LinkData) -> np.ndarray:
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
