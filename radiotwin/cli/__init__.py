"""The command `radiotwin`: options in, one function of the library called, its result shown.

Whatever is heavy is imported inside the commands, so that `--help` answers at once.
"""

import os
import signal
import sys

import typer

from radiotwin import __version__
from radiotwin.cli import importing, loop, model, report, scenes, tools, world
from radiotwin.command import add_output_options
from radiotwin.console import complain
from radiotwin.errors import BadInput, RunFailed

app = typer.Typer(
    name="radiotwin", no_args_is_help=True, pretty_exceptions_enable=False,
    rich_markup_mode=None,  # else every [default] in a help text is taken for markup

    context_settings={"help_option_names": ["-h", "--help"]},
    help="Radio digital twins of cities, learnt from measurements. A scene is built, traced and surveyed; a twin is "
         "fitted to the measurements, mapped and compared.")

for module in (scenes, world, importing, model, loop, report, tools):
    module.add_commands(app)
add_output_options(app)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"radiotwin {__version__}")
        raise typer.Exit


@app.callback()
def _options(version: bool = typer.Option(False, "--version", callback=_show_version, is_eager=True,
                                          help="Print the version and exit.")) -> None:
    """Options before the command."""


class _Interrupted(BaseException):
    """Ctrl-C. Typer would swallow a KeyboardInterrupt without a word."""


def _interrupt(*_) -> None:
    raise _Interrupted


def main() -> None:
    """Run the command line; exit status 0 done, 1 failed while running, 2 bad input, 130 interrupted."""
    signal.signal(signal.SIGINT, _interrupt)
    try:
        app()
    except BadInput as error:
        complain(str(error))
        sys.exit(2)
    except RunFailed as error:
        complain(str(error))
        sys.exit(1)
    except _Interrupted:
        complain("interrupted; what was finished is kept, run the same command again to go on")
        sys.exit(130)
    except BrokenPipeError:  # the reader of a pipe has gone, as `head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
