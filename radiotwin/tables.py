"""Base classes of the tables in TOML files, which are validated when they are read."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, Strict

MAX_COORDINATE_M = 1e6
"""Of the local frame [m]: beyond, single precision is coarser than a decimetre."""
Number = Annotated[float, Strict()]
"""A finite number; an integer is accepted, `true` and texts are not."""
Metres = Annotated[Number, Field(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]
"""A coordinate of the local frame."""


class Table(BaseModel):
    """An immutable table that accepts no unknown field and no infinity."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Origin(Table):
    """Origin of the local frame on the WGS84 ellipsoid.

    Attributes:
        latitude_deg: [degrees], positive to the north.
        longitude_deg: [degrees], positive to the east.
        altitude_m: altitude of the scene's ground datum [m].
    """

    latitude_deg: Number = Field(ge=-90, le=90)
    longitude_deg: Number = Field(ge=-180, le=180)
    altitude_m: Number = Field(0.0, ge=-12_000, le=100_000)
