"""Base classes of the tables in TOML files, which are validated when they are read."""

import re
from collections.abc import Sequence
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError

from radiotwin.errors import BadInput

MAX_COORDINATE_M = 1e6
"""Of the local frame [m]: beyond, single precision is coarser than a decimetre."""
Number = Annotated[float, Strict()]
"""A finite number; an integer is accepted, `true` and texts are not."""
Metres = Annotated[Number, Field(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]
"""A coordinate of the local frame."""

MAX_NAME = 200  # characters
# Control characters, separators of lines and paragraphs, surrogates, and marks that change the
# direction of what follows: a name with them is shown as another one.
_NOT_IN_NAMES = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069"
                           "\ud800-\udfff\ufeff]")


def name_fault(name: str) -> str | None:
    """Return why a text cannot be a name of a device, a receiver or a flight; None if it can.

    Args:
        name: without spaces around it.
    """
    if not name:
        return "is empty; give a name"
    if len(name) > MAX_NAME:
        return f"is no name; it has {len(name):,} characters, allowed are {MAX_NAME}"
    if _NOT_IN_NAMES.search(name):
        return "is no name; it has control characters or marks of direction: leave them out"
    return None


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


def as_origin(value: Origin | Sequence[float] | None) -> Origin | None:
    """Return the origin of a frame from numbers.

    Args:
        value: (latitude, longitude) [degrees] and optionally the altitude of the ground [m]; an
            origin and None are returned as they are.

    Raises:
        BadInput: not two or three numbers, or a place that is not on the earth.
    """
    if value is None or isinstance(value, Origin):
        return value
    if len(value) not in (2, 3):
        raise BadInput(f"origin {value!r} is not two or three numbers; give LATITUDE,LONGITUDE or "
                       "LATITUDE,LONGITUDE,ALTITUDE in degrees and metres")
    try:
        return Origin.model_validate(dict(zip(Origin.model_fields, map(float, value))))
    except ValidationError as error:
        first = error.errors()[0]
        raise BadInput(f"origin {value!r}: {first['loc'][0]}: {first['msg']}") from None
