"""Run a command: the options `--quiet` and `--json`, one error message, and the exit status.

| status | |
|---|---|
| 0 | done |
| 1 | failed while running, also by an error in this program |
| 2 | input that cannot be used |
| 128 + signal | 129 terminal closed, 130 interrupted, 141 nobody reads the output, 143 ended |
"""

import errno
import functools
import inspect
import io
import json
import math
import os
import platform
import shlex
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Annotated, Any

import typer

from radiotwin import __version__
from radiotwin.errors import BadInput, RunFailed
from radiotwin.io import signals
from radiotwin.runtime import console as progress
from radiotwin.runtime.console import collected, complain, console, printable

TABLES = ("build-scene", "import", "fit", "compare", "coverage", "close-loop", "locate", "demo",
          "doctor", "cache")
"""Commands of `radiotwin` that print tables."""
QUIET = Annotated[bool, typer.Option(
    "--quiet", "-q", help="Print nothing but warnings and errors.")]
JSON = Annotated[bool, typer.Option(
    "--json", help="Print tables and messages as one JSON document.")]
NOBODY_READS = 141  # 128 + SIGPIPE, as shells report it
MAX_ERROR_CHARACTERS = 300
_ClickError: Any = typer.BadParameter.__mro__[2]  # Typer has no name of its own for it


def add_output_options(app: typer.Typer) -> None:
    """Add `--quiet` to every command of an app, and `--json` to those that print tables."""
    for command in app.registered_commands:
        if command.callback is not None:
            command.callback = with_output_options(command.callback, command.name in TABLES)


def with_output_options(command: Callable[..., Any], prints_tables: bool) -> Callable[..., Any]:
    """Wrap a command with the options `--quiet` and, if it prints tables, `--json`."""
    @functools.wraps(command)
    def run(*args: Any, quiet: bool = False, as_json: bool = False, **options: Any) -> None:
        with output(quiet, as_json):
            command(*args, **options)

    return with_options(
        run, inspect.signature(command),
        {"quiet": (QUIET, False)} | ({"as_json": (JSON, False)} if prints_tables else {}))


def with_options(command: Callable[..., Any], signature: inspect.Signature,
                 added: dict[str, tuple[Any, Any]]) -> Callable[..., Any]:
    """Declare further options of a command in its signature, which Typer reads; return the command.

    Args:
        command: takes all options as keywords; it is modified.
        signature: its present parameters.
        added: name -> annotation and default of each new option.
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
    """Let the block print as usual; or, if quiet, nothing; or its results as one JSON document.

    Quiet also hides progress. The document is `console.collected`; it is printed on success.
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
            document = json.dumps(_json_value(collected), indent=1, allow_nan=False, default=str)
            sys.stdout.write(document + "\n")


def _json_value(value: Any) -> Any:
    """Convert a value for JSON: NaN and infinity to null, numpy's numbers to Python's."""
    if isinstance(value, dict):
        return {str(name): _json_value(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_json_value(each) for each in value]
    if hasattr(value, "item") and not isinstance(value, str):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


class _OutputLost(Exception):
    """Raised if standard output cannot be written; an OSError would be handled by Typer or Rich."""


class _Output:
    """A text stream whose OSErrors are distinguished from those of the work."""

    def __init__(self, stream: Any) -> None:
        self.stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        try:
            return self.stream.write(text)
        except OSError as error:
            raise _OutputLost from error

    def flush(self) -> None:
        try:
            self.stream.flush()
        except OSError as error:
            raise _OutputLost from error


def exit_status(work: Callable[[], Any], kept: str | Callable[[], str]) -> int:
    """Run a command, print one message about an error, and return the process's exit status.

    It is 0 (done), 1 (failed), 2 (bad input), 128 + the signal that ended it, or the work's
    integer.

    With `--json` on the command line the message is also on standard output:
    `{"error": {"message": "...", "status": 2}}`.

    Args:
        work: a Typer app, or any function; it may end the process itself.
        kept: part of the message after a signal, that says which results are kept and how to go on;
            or a function that returns it.
    """
    _open_standard_streams()
    signals.handle()
    signals.begin()
    before, sys.stdout = sys.stdout, _Output(sys.stdout)  # type: ignore[assignment]
    try:
        try:
            done = work(standalone_mode=False) if isinstance(work, typer.Typer) else work()
            sys.stdout.flush()
        finally:
            signals.end()
        status, message = done if isinstance(done, int) else 0, ""
    except BaseException as error:  # noqa: BLE001  # the one place that knows what to say
        status, message = _status_and_message(error, kept if isinstance(kept, str) else kept())
    finally:
        signals.end()
        sys.stdout = before
    if message:
        complain(message)
        if "--json" in sys.argv[1:] and status != NOBODY_READS:
            document = {"error": {"message": message, "status": status}}
            with suppress(OSError):
                print(json.dumps(document, indent=1), flush=True)
    _close_lost_output()
    signals.finish(status)
    return status


def _status_and_message(error: BaseException, kept: str) -> tuple[int, str]:
    """Return the exit status for an exception, and the message to print; `""`: print nothing."""
    if isinstance(error, SystemExit) and not error.code:
        return 0, ""
    number = signals.received()
    if number is not None:  # libraries may have turned the signal into another error
        return 128 + number, f"{signals.word(number)}; {kept}"
    if isinstance(error, SystemExit):
        return (error.code, "") if isinstance(error.code, int) else (1, str(error.code))
    if isinstance(error, _ClickError):
        return error.exit_code, _usage(error)
    if isinstance(error, BadInput):
        return 2, str(error)
    if isinstance(error, RunFailed):
        return 1, str(error)
    if isinstance(error, _OutputLost):
        if isinstance(error.__cause__, BrokenPipeError):
            return NOBODY_READS, ""
        return 1, f"standard output cannot be written: {error.__cause__}; send it elsewhere"
    if isinstance(error, MemoryError):
        return 1, (f"out of memory while running {_command()}{_first_line(error)}; use a smaller "
                   "input, fewer processes, or a machine with more memory")
    if isinstance(error, OSError) and _folder_is_gone():
        return 2, "the working folder does not exist any more; change to another one"
    if isinstance(error, OSError) and error.errno in (errno.ENAMETOOLONG, errno.ELOOP):
        return 2, (f"{str(error.filename)[:60]}… cannot be a path ({error.strerror}); give the "
                   "path of a file or folder that exists")
    return 1, _unexpected(error)


def _usage(error: Any) -> str:
    """Return a one-line message about wrong options; `""` if the help was shown instead."""
    message = error.format_message()
    if message.startswith("Usage:"):  # a command without the arguments that it needs
        error.show()
        return ""
    command = error.ctx.command_path if getattr(error, "ctx", None) else "the command"
    return f"{message.rstrip('.')}; {command} --help shows what is allowed"


def _unexpected(error: BaseException) -> str:
    """Save an unexpected error's traceback to a temporary file; return a message that names it."""
    name = type(error).__name__
    said = f"unexpected error while running {_command()}: {name}{_first_line(error)}"
    try:
        handle, path = tempfile.mkstemp(prefix="radiotwin-error-", suffix=".txt")
        with open(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(f"radiotwin {__version__}, Python {platform.python_version()}, "
                       f"{platform.platform()}\n{_command()}\n\n")
            file.write("".join(traceback.format_exception(error)))
    except Exception as again:  # noqa: BLE001  # a full disk, no memory, no folder
        return f"{said}; the details could not be saved ({type(again).__name__})"
    return f"{said}; this is a mistake in radiotwin: please report it with {path}"


def _first_line(error: BaseException) -> str:
    """Return the first line of an error's message, after a colon."""
    try:
        lines = str(error).strip().splitlines()
    except Exception:  # noqa: BLE001  # of a library
        return ""
    return f": {lines[0][:MAX_ERROR_CHARACTERS]}" if lines else ""


def _command() -> str:
    """Return the command line, for messages."""
    name = "radiotwin" if "marl" not in sys.argv[0] else "python -m marl.fedqmix"
    return printable(shlex.join([name, *sys.argv[1:]]))[:MAX_ERROR_CHARACTERS]


def _folder_is_gone() -> bool:
    """Return whether the working folder does not exist any more."""
    try:
        os.getcwd()
    except OSError:
        return True
    return False


def _open_standard_streams() -> None:
    """Open closed standard streams: else the next opened file would become one of them."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
    sys.stdout = sys.stdout or open(os.devnull, "w", encoding="utf-8")
    sys.stderr = sys.stderr or open(os.devnull, "w", encoding="utf-8")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal may lack our × and –
            stream.reconfigure(errors="backslashreplace")


def _close_lost_output() -> None:
    """Redirect streams that cannot be written, so that Python's exit does not complain."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
