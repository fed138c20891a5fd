"""The result of a localisation: a device with an estimated position."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import ConfigDict, Field, StrictBool, StrictStr, TypeAdapter, WrapValidator

from radiotwin.io.forms import MAX_POSITION_M, Number

Name = Annotated[StrictStr, Field(min_length=1, max_length=1000)]
_Coordinate = Annotated[Number, Field(ge=-MAX_POSITION_M, le=MAX_POSITION_M)]


def _null_as(number: float) -> WrapValidator:
    """Return what reads null as a number that JSON has no other form for."""
    return WrapValidator(lambda value, check: number if value is None else check(value))


@dataclass(frozen=True)
class TwinDevice:
    """A device, and where it is: as localisation found it, as a twin holds it, and as JSON.

    The types' bounds are those of files; they are checked when a record is read.

    Attributes:
        device: its name.
        x_m, y_m: declared position of an anchor; of an unknown device the mean over the heaviest
            mode of the posterior, or the position of least expected distance [m]; NaN where nothing
            is known of it.
        z_m: height, as given [m].
        role: `anchor` or `unknown`.
        located: whether the position may be relied on; always so for anchors. It is not where the
            device was never detected, or 90 % of the posterior cover half the map or more: position
            and radius are then the best estimate from the links that were not detected.
        credible_radius_m: radius about the position that holds 90 % of the posterior, second modes
            included [m]; 0 for anchors, infinite where nothing is known.
        second_mode: (x_m, y_m, weight) of another mode at least 20 m away with at least 5 % of the
            posterior; None: there is none.
    """

    device: Name
    x_m: Annotated[_Coordinate, _null_as(np.nan)]
    y_m: Annotated[_Coordinate, _null_as(np.nan)]
    z_m: Annotated[_Coordinate, _null_as(np.nan)]
    role: Literal["anchor", "unknown"]
    located: StrictBool
    credible_radius_m: Annotated[Number, Field(ge=0, le=MAX_POSITION_M), _null_as(np.inf)]
    second_mode: tuple[_Coordinate, _Coordinate, _Coordinate] | None

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid", allow_inf_nan=False)

    @classmethod
    def anchor(cls, device: str, x_m: float, y_m: float, z_m: float) -> TwinDevice:
        """Return a device of declared position [m]."""
        return cls(device, float(x_m), float(y_m), float(z_m), "anchor", True, 0.0, None)

    @classmethod
    def from_record(cls, record: Any) -> TwinDevice:
        """Return the device of a record; raises ValueError where it is no such record."""
        return _RECORD.validate_python(record)

    @property
    def record(self) -> dict[str, Any]:
        """The attributes for JSON, which has neither NaN nor infinity: they are null."""
        return {name: None if isinstance(value, float) and not np.isfinite(value) else value
                for name, value in vars(self).items()}

    @property
    def position_m(self) -> tuple[float, float, float]:
        """Its coordinates x, y and z [m]."""
        return self.x_m, self.y_m, self.z_m


_RECORD = TypeAdapter(TwinDevice)
