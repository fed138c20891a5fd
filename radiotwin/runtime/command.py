"""Options that the commands of both packages share."""

import functools
import inspect
import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer

from radiotwin.runtime import console as progress
from radiotwin.runtime.console import collected, console

TABLES = ("build-scene", "import", "fit", "compare", "coverage", "close-loop", "locate", "demo",
          "doctor", "cache")
"""Commands of `radiotwin` that print tables."""
QUIET = Annotated[bool, typer.Option(
    "--quiet", "-q", help="Print nothing but warnings and errors.")]
JSON = Annotated[bool, typer.Option(
    "--json", help="Print tables and messages as one JSON document.")]


def add_output_options(app: typer.Typer) -> None:
    """Add `--quiet`, and `--json` where there are tables, to every command of an app."""
    for command in app.registered_commands:
        if command.callback is not None:
            command.callback = with_output_options(command.callback, command.name in TABLES)


def with_output_options(command: Callable[..., Any], prints_tables: bool) -> Callable[..., Any]:
    """Return a command with the options `--quiet` and, where it prints tables, `--json`."""
    @functools.wraps(command)
    def run(*args: Any, quiet: bool = False, as_json: bool = False, **options: Any) -> None:
        with output(quiet, as_json):
            command(*args, **options)

    return with_options(
        run, inspect.signature(command),
        {"quiet": (QUIET, False)} | ({"as_json": (JSON, False)} if prints_tables else {}))


def with_options(command: Callable[..., Any], signature: inspect.Signature,
                 added: dict[str, tuple[Any, Any]]) -> Callable[..., Any]:
    """Declare the options of a command; Typer reads them from its signature and annotations.

    Args:
        command: function to be called; it takes all options as keywords.
        signature: its parameters so far.
        added: name -> annotation and default of the options to add.

    Returns:
        `command`, changed.
    """
    parameters = [*signature.parameters.values()] + [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
        for name, (kind, default) in added.items()]
    setattr(command, "__signature__", signature.replace(parameters=parameters))  # noqa: B010  mypy
    command.__annotations__ = {each.name: each.annotation for each in parameters
                               if each.annotation is not inspect.Parameter.empty}
    return command


@contextmanager
def output(quiet: bool, as_json: bool) -> Iterator[None]:
    """Print text as usual, or nothing, or all of it as one JSON document at the end.

    Args:
        quiet: print no text and show no progress.
        as_json: print no text; on success, write `console.collected` to standard output.
    """
    before = console.quiet, progress.silent
    console.quiet, progress.silent = quiet or as_json, quiet or progress.silent
    collected.clear()
    done = False
    try:
        yield
        done = True
    except typer.Exit:  # a finding, such as a scene that cannot be traced, is not a failure
        done = True
        raise
    finally:
        console.quiet, progress.silent = before
        if done and as_json:
            document = json.dumps(_plain(collected), indent=1, allow_nan=False, default=str)
            sys.stdout.write(document + "\n")


def _plain(value: Any) -> Any:
    """Return a value as JSON has it: NaN and infinity as null, numpy's numbers as Python's."""
    if isinstance(value, dict):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if hasattr(value, "item") and not isinstance(value, str):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
