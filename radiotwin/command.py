"""`--quiet` on every command, and `--json` on those that print tables: one JSON document instead of text."""

import functools
import inspect
import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer

from radiotwin import progress
from radiotwin.console import collected, console

TABLES = ("build-scene", "import", "fit", "compare", "close-loop", "locate", "demo", "doctor")
"""Commands that print tables."""
QUIET = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but warnings and errors.")]
JSON = Annotated[bool, typer.Option("--json", help="Print tables and messages as one JSON document.")]


def add_output_options(app: typer.Typer) -> None:
    """Give the commands of an app their options; the commands themselves know nothing of them."""
    for command in app.registered_commands:
        if command.callback is not None:
            command.callback = _with_options(command.callback, command.name in TABLES)


@contextmanager
def output(quiet: bool, as_json: bool) -> Iterator[None]:
    """Text as ever; nothing of it; or, once it is done, all that would have been text as JSON on standard output."""
    before = console.quiet, progress.silent
    console.quiet, progress.silent = quiet or as_json, quiet or progress.silent
    collected.clear()
    done = False
    try:
        yield
        done = True
    except typer.Exit:  # a finding, such as a scene that cannot be traced, and no failure
        done = True
        raise
    finally:
        console.quiet, progress.silent = before
        if done and as_json:
            json.dump(_plain(collected), sys.stdout, indent=1, allow_nan=False, default=str)
            sys.stdout.write("\n")


def _with_options(command: Callable[..., Any], prints_tables: bool) -> Callable[..., Any]:
    @functools.wraps(command)
    def run(*args: Any, quiet: bool = False, as_json: bool = False, **options: Any) -> None:
        with output(quiet, as_json):
            command(*args, **options)

    # Typer reads a command's options from its signature and its annotations.
    added = {"quiet": QUIET} | ({"as_json": JSON} if prints_tables else {})
    signature = inspect.signature(command)
    parameters = [inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=kind)
                  for name, kind in added.items()]
    setattr(run, "__signature__", signature.replace(parameters=[*signature.parameters.values(), *parameters]))
    run.__annotations__ = {**command.__annotations__, **added}
    return run


def _plain(value: Any) -> Any:
    """For JSON: NaN and infinity as null, numpy's numbers as Python's."""
    if isinstance(value, dict):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if hasattr(value, "item") and not isinstance(value, str):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
