"""The command `radiotwin`: options in, one function of the library called, its result shown.

Whatever is heavy is imported inside the commands, so that `--help` answers at once.
"""

import sys

import typer

from radiotwin import __version__
from radiotwin.cli import importing, loop, model, report, scenes, tools, world
from radiotwin.command import add_output_options, exit_status

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


def main() -> None:
    """Run the command line and end the process; see `exit_status`."""
    sys.exit(exit_status(app, "what was finished is kept, run the same command again to go on"))
