"""Read JSON records of a run by a schema: each field has its type before anything uses it."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, PlainValidator, ValidationError

from radiotwin.budgets import ENTRIES, NESTING, RECORD_BYTES
from radiotwin.errors import BadInput
from radiotwin.inputs import parse_json, read_text

MAX_NUMBER = 1e15  # no quantity of a run is larger, in any unit


class Record(BaseModel):
    """Part of a record; fields that it does not name are dropped, so that all are checked."""

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
    """Read a JSON object within the limits of size, entries and nesting.

    Args:
        path: of the file.
        what: it should be, for the message.

    Raises:
        BadInput: it cannot be read, it is not JSON or no object, or it is too large.
    """
    record = parse_json(read_text(path, what, RECORD_BYTES), path)
    if not isinstance(record, dict):
        raise BadInput(f"{path} is no JSON object; make the run again")
    check_size(record, path)
    return record


def check_size(record: object, source: object) -> None:
    """Check the number of entries of each list and object, and how deep they are nested.

    Args:
        record: as JSON has it.
        source: it is from; the message begins with it.

    Raises:
        BadInput: too many, or too deep.
    """
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
    """Return the fields of a record that a schema names, and that were given.

    Args:
        schema: of the record.
        record: as JSON has it.
        source: it is from; the message begins with it.
        remedy: end of the message, such as "run `radiotwin close-loop` again".

    Raises:
        BadInput: a field is missing or has another type; the message names the first one.
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
