"""Command-line options made of settings: a name, a type, a line of help and the default for each field."""

import argparse
from typing import Any, Literal, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from radiotwin.errors import BadInput

Model = TypeVar("Model", bound=BaseModel)


def add_options(parser: argparse.ArgumentParser, model: type[BaseModel], title: str, without: set[str]) -> None:
    """One option for every field of `model`; its text is converted and checked by `checked`."""
    group = parser.add_argument_group(title)
    for name, field in model.model_fields.items():
        if name not in without:
            group.add_argument(f"--{name.replace('_', '-')}", metavar=_metavar(field), default=None,
                               help=f"{field.description} [{_shown(field.default)}]".replace("%", "%%"))


def checked(given: argparse.Namespace, defaults: Model) -> Model:
    """The settings with what was given on the command line in the place of the defaults.

    Raises:
        BadInput: names the option, what was given and what is allowed.
    """
    values = {name: value for name in type(defaults).model_fields if (value := getattr(given, name, None)) is not None}
    try:
        return type(defaults).model_validate(defaults.model_dump() | values)
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][0])
        allowed = _allowed(type(defaults).model_fields[name])
        raise BadInput(f"--{name.replace('_', '-')} {first['input']}: {first['msg']}; allowed: {allowed}") from None


def _metavar(field: FieldInfo) -> str:
    if get_origin(field.annotation) is Literal:
        return "|".join(get_args(field.annotation))
    words: dict[Any, str] = {bool: "true|false", int: "INTEGER", float: "NUMBER"}
    return words.get(field.annotation, "PATH")


def _shown(value) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def _allowed(field: FieldInfo) -> str:
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    bounds = [f"{signs[name]} {limit:g}" for bound in field.metadata for name in signs
              if (limit := getattr(bound, name, None)) is not None]
    kind = {"INTEGER": "a whole number", "NUMBER": "a number", "PATH": "a path"}.get(_metavar(field), _metavar(field))
    return " ".join([kind, ", ".join(bounds)]).strip()
