"""TwinDevice: a device with its declared or estimated position, and as JSON."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import ConfigDict, Field, StrictBool, StrictStr, TypeAdapter, WrapValidator

from radiotwin.io.forms import MAX_POSITION_M, Number

CREDIBLE = 0.9  # posterior probability within a credible radius
Name = Annotated[StrictStr, Field(min_length=1, max_length=1000)]
_Coordinate = Annotated[Number, Field(ge=-MAX_POSITION_M, le=MAX_POSITION_M)]


def _null_as(number: float) -> WrapValidator:
    """Return a validator that reads null as NaN or infinity, which JSON cannot hold."""
    return WrapValidator(lambda value, check: number if value is None else check(value))


@dataclass(frozen=True)
class TwinDevice:
    """A device with its position, in a twin and in its file.

    The bounds of types are checked when a record is read from a file.

    Attributes:
        device: its name.
        x_m, y_m: declared position of an anchor; for an unknown device the mean of the heaviest
            mode of the posterior, or the position of least expected distance [m]; NaN if unknown.
        z_m: declared height [m].
        role: `anchor` or `unknown`.
        located: True if the position is reliable, always so for anchors. False if the device was
            never detected, or 90 % of the posterior cover half the map or more; position and radius
            are then estimates from links without detection.
        credible_radius_m: radius around the position that holds 90 % of the posterior, including
            second modes [m]; 0 for anchors, infinite if nothing is known.
        second_mode: (x_m, y_m, weight) of another mode at least 20 m away with at least 5 % of the
            posterior; None: no such mode.
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
        """Make a device with a declared position [m]."""
        return cls(device, float(x_m), float(y_m), float(z_m), "anchor", True, 0.0, None)

    @classmethod
    def from_record(cls, record: Any) -> TwinDevice:
        """Restore a device from its `record`; raise ValueError if it is damaged."""
        return _RECORD.validate_python(record)

    @property
    def record(self) -> dict[str, Any]:
        """Return the attributes for JSON, with null for NaN and infinity."""
        return {name: None if isinstance(value, float) and not np.isfinite(value) else value
                for name, value in vars(self).items()}

    @property
    def position_m(self) -> tuple[float, float, float]:
        """Return x, y and z [m]."""
        return self.x_m, self.y_m, self.z_m


_RECORD = TypeAdapter(TwinDevice)
