"""Check the fields of TOML and JSON files against schemas before anything uses them."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, PlainValidator, Strict, ValidationError

from radiotwin.errors import BadInput
from radiotwin.io.budgets import ENTRIES, NESTING, RECORD_BYTES
from radiotwin.io.inputs import parse_json, read_text

MAX_COORDINATE_M = 1e6
"""Largest declared coordinate of the local frame: beyond, float32 is coarser than a decimetre."""
MAX_POSITION_M = 1e7  # largest measured coordinate: a quarter of a meridian
Number = Annotated[float, Strict()]
"""A finite number; an integer is accepted, `true` and texts are not."""
Metres = Annotated[Number, Field(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]
"""A coordinate of the local frame."""
MAX_NAME = 200  # characters
# Control characters, separators of lines and paragraphs, surrogates, and marks that change the
# direction of what follows: a name with them is shown as another one.
_NOT_IN_NAMES = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069"
                           "\ud800-\udfff\ufeff]")
MAX_NUMBER = 1e15  # no quantity of a run is larger, in any unit


def name_fault(name: str) -> str | None:
    """Return why a text cannot name a device, a receiver or a flight; None if it can."""
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
    """Convert (latitude, longitude) [deg], or these and an altitude [m], to an origin.

    An origin, and None, are returned unchanged.

    Raises:
        BadInput: not two or three numbers, or no place on the earth.
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


class Record(BaseModel):
    """Base of schemas for JSON records; unknown fields are dropped, so that all are checked."""

    model_config = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)


def _number(value: object) -> int | float:
    if isinstance(value, bool) or not isinstance(value, int | float) \
            or not abs(value) <= MAX_NUMBER:
        raise ValueError(f"is not a number within ±{MAX_NUMBER:g}")
    return value


def _whole(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_NUMBER:
        raise ValueError(f"is not a whole number from 0 to {MAX_NUMBER:g}")
    return value


Real = Annotated[int | float, PlainValidator(_number)]
"""A finite number; a whole one stays an integer, `true` and texts are refused."""
Whole = Annotated[int, PlainValidator(_whole)]
"""A whole number from 0."""


def read_record(path: Path | str, what: str) -> dict[str, Any]:
    """Read a JSON object; BadInput if it is no JSON object, or too large or too deeply nested."""
    record = parse_json(read_text(path, what, RECORD_BYTES), path)
    if not isinstance(record, dict):
        raise BadInput(f"{path} is no JSON object; make the run again")
    check_size(record, path)
    return record


def check_size(record: object, source: object) -> None:
    """Raise BadInput if a list or object of a JSON record is too long, or nested too deeply."""
    depth, level = 0, [record]
    while level:
        depth += 1
        if depth > NESTING.limit:
            NESTING.refuse(source, f"more than {NESTING.limit} levels of nesting")
        parts = [part for part in level if isinstance(part, dict | list)]
        for part in parts:
            ENTRIES.check(len(part), f"{source}: a list or an object")
        level = [each for part in parts
                 for each in (part.values() if isinstance(part, dict) else part)]


def validated(schema: type[BaseModel], record: object, source: object,
              remedy: str) -> dict[str, Any]:
    """Check a record against a schema, and return its known fields that were given.

    Raises:
        BadInput: a field is missing or has another type; the message begins with `source` and ends
            with the remedy, such as "run `radiotwin close-loop` again".
    """
    try:
        return schema.model_validate(record).model_dump(by_alias=True, exclude_unset=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False)[0]
        place = ".".join(str(part) for part in first["loc"])[:200] or "its content"
        whole = first["type"] == "missing" or not first["loc"]
        given = "" if whole else f", not {repr(first['input'])[:60]}"
        reason = first["msg"].removeprefix("Value error, ")
        raise BadInput(f"{source} is damaged ({place}: {reason}{given}); {remedy}") from None
