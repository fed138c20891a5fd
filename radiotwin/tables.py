"""Base classes of the tables in TOML files, which are validated when they are read."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, Strict

Number = Annotated[float, Strict()]
"""A finite number; an integer is accepted, `true` and texts are not."""


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
    altitude_m: Number = 0.0
