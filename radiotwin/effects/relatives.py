"""What the residual of a device's relatives says of it: sectors of one mast, see the same city."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from radiotwin.channel.residual_field import MIN_POINTS, ResidualField
from radiotwin.links import LinkData
from radiotwin.links.sites import relatives_of
from radiotwin.pieces import kept

MIN_SD = 1e-6  # of a residual that is nothing


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

    passed_on: Annotated[float, Field(ge=0, le=1)]


def fitted_field(what: str, *points: Any) -> ResidualField:
    """Return a field that is fitted to points, or was already, see `radiotwin.pieces.kept`."""
    return kept(what, points, lambda: ResidualField().fit(*points), ResidualField.state,
                ResidualField.from_state)


def written_field(field: ResidualField) -> dict[str, Any]:
    """Return what `FieldState` reads, without the standard deviation; positions to a decimetre."""
    arrays, settings = field.state()
    return {"settings": settings,
            "arrays": {name: array.round(1 if name.startswith("position") else 4).tolist()
                       for name, array in arrays.items()}}


@dataclass(frozen=True, eq=False)
class Relatives:
    """What devices' relatives say of them, see `radiotwin.links.sites.relatives_of`.

    Attributes:
        field: for each device of the residual of its relatives, never its own, in units of its
            standard deviation.
        relative_sd: that standard deviation, in units of the error scale.
        passed_on: share of it that is the device's, too, in 0..1.
    """

    field: ResidualField
    relative_sd: float
    passed_on: float

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
        devices = [(device, np.flatnonzero(np.isin(links.device, relatives)))
                   for device in sorted(links.anchors)
                   for relatives in [relatives_of(links, device)] if relatives]
        rows = np.concatenate([np.zeros(0, dtype=int), *(each for _, each in devices)])
        if len(rows) < MIN_POINTS:
            return None
        series = np.concatenate([np.full(len(each), device) for device, each in devices])
        relative_sd = max(float(z[rows].std()), MIN_SD)
        points = series, links.receiver_m[rows], (z[rows] - z[rows].mean()) / relative_sd
        kind = links.receiver[rows]
        if field is None:
            field = fitted_field("relatives", *points, seed, kind)
        else:
            field = field.with_points(*points, kind)
        mean = relative_sd * field.mean(links.device, links.receiver_m, links.receiver)
        slope = float(mean @ z / max(mean @ mean, 1e-12))
        return cls(field, relative_sd, min(max(slope, 0.0), 1.0))

    def mean(self, links: LinkData) -> np.ndarray:
        """Return what they say of links (n,) [error scales]; 0 where they say nothing."""
        return self.passed_on * self.relative_sd * self.field.mean(links.device, links.receiver_m,
                                                                   links.receiver)

    def at(self, links: LinkData) -> tuple[np.ndarray, np.ndarray]:
        """Return `mean`, and the share (n,) left of the error scale."""
        mean, sd = self.field.predict(links.device, links.receiver_m, links.receiver)
        left = np.sqrt(1 - self.passed_on**2 * (1 - sd**2))
        return self.passed_on * self.relative_sd * mean, left

    def state(self) -> dict[str, Any]:
        """Return what JSON can hold and `of` reads."""
        return {"relative_sd": self.relative_sd, "passed_on": self.passed_on,
                **written_field(self.field)}

    @classmethod
    def of(cls, record: RelativesState) -> Relatives:
        """Return what `state` described."""
        return cls(record.field, record.relative_sd, record.passed_on)
