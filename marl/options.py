"""Command-line options from settings: a name, a type, help and the default for each field."""

import functools
import inspect
from collections.abc import Callable, Collection, Mapping
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin

import typer
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from marl.settings import PRESETS, RUNS, Choices, LearnerSettings, RunSettings, check_together
from radiotwin.errors import BadInput
from radiotwin.runtime.command import with_options

Settings = TypeVar("Settings", bound=BaseModel)


def with_settings(*models: type[BaseModel], without: Collection[str] = (),
                  ) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorate a command: one option for each field of some settings.

    The command gets them as one keyword `given`: field -> text, as `checked` takes it.

    Args:
        models: classes of settings.
        without: fields that get no option.
    """
    fields = {name: field for model in models for name, field in model.model_fields.items()
              if name not in without}

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(command)
        def run(**options: Any) -> None:
            given = {name: options.pop(name) for name in fields}
            command(given={name: text for name, text in given.items() if text is not None},
                    **options)

        signature = inspect.signature(command)
        own = [each for each in signature.parameters.values() if each.name != "given"]
        return with_options(run, signature.replace(parameters=own),
                            {name: (_option(name, field), None) for name, field in fields.items()})
    return decorate


def checked(given: Mapping[str, str], defaults: Settings) -> Settings:
    """Return settings with the given values in place of the defaults.

    Args:
        given: field -> text from the command line; fields of other settings are ignored.
        defaults: values of the fields that are not given.

    Raises:
        BadInput: with the option, the given value, and what is allowed.
    """
    values = {name: given[name] for name in type(defaults).model_fields if name in given}
    try:
        return type(defaults).model_validate(defaults.model_dump() | values)
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][0])
        allowed = _allowed(type(defaults).model_fields[name])
        raise BadInput(f"{_flag(name)} {str(first['input'])[:60]}: {first['msg']}; "
                       f"allowed: {allowed}") from None


def settings_of(given: Mapping[str, str]) -> tuple[RunSettings, LearnerSettings]:
    """Return the settings of a command line: a preset, and what was given besides.

    Raises:
        BadInput: an impossible value, or values that do not go together.
    """
    preset = checked(given, RunSettings()).preset
    run = checked(given, RunSettings(**RUNS[preset]))
    learner = checked(given, PRESETS[preset])
    check_together(run, learner)
    return run, learner


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _option(name: str, field: FieldInfo) -> Any:
    default = str(field.default).lower() if isinstance(field.default, bool) else field.default
    text = field.description or ""
    return Annotated[str | None, typer.Option(
        _flag(name), metavar=_metavar(field), show_default=False,
        help=f"{text[:1].upper()}{text[1:]} [{default}].")]


def _metavar(field: FieldInfo) -> str:
    if get_origin(field.annotation) is Literal:
        return "|".join(get_args(field.annotation))
    for choices in field.metadata:
        if isinstance(choices, Choices):
            return "|".join(choices.values())
    names: dict[Any, str] = {bool: "true|false", int: "INTEGER", float: "NUMBER"}
    return names.get(field.annotation, "PATH")


def _allowed(field: FieldInfo) -> str:
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    bounds = [f"{signs[name]} {limit:g}" for bound in field.metadata for name in signs
              if (limit := getattr(bound, name, None)) is not None]
    kinds = {"INTEGER": "a whole number", "NUMBER": "a number", "PATH": "a path"}
    kind = kinds.get(_metavar(field), _metavar(field))
    return " ".join([kind, ", ".join(bounds)]).strip()
