"""What the tables of TOML files that are checked when they are read have in common."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, Strict

Number = Annotated[float, Strict()]
"""An integer will do, too, but not `true` or a text."""


class Table(BaseModel):
    """Nothing but its own fields, no infinity, and no change once it is read."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Origin(Table):
    """WGS84 position of the local frame's origin; `altitude_m` is the altitude of the scene's ground datum."""

    latitude_deg: Number = Field(ge=-90, le=90)
    longitude_deg: Number = Field(ge=-180, le=180)
    altitude_m: Number = 0.0
