"""All commands of `radiotwin`: parse options, call one function of the library, show its result.

Heavy packages are imported inside the commands, so that `--help` answers at once.
"""

from collections.abc import Callable

import typer

from radiotwin import __version__
from radiotwin.cli import coverage, importing, model, planning, scenes, tools
from radiotwin.runtime.command import add_output_options
from radiotwin.runtime.console import show_warnings_plainly

app = typer.Typer(
    name="radiotwin", no_args_is_help=True, pretty_exceptions_enable=False,
    rich_markup_mode=None,  # or every [default] in a help text is taken for markup
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Radio digital twins of cities, learnt from measurements. Build, trace and survey a "
         "scene; fit a twin to the measurements; map and compare it.")

COMMANDS: dict[str, Callable[..., None]] = {  # in the order of the help text
    "build-scene": scenes.build_scene, "export-scene": scenes.export_scene,
    "export": scenes.export, "trace": scenes.trace, "gains": scenes.gains, "paths": scenes.paths,
    "survey": scenes.survey, "import": importing.import_, "fit": model.fit, "map": model.map_,
    "compare": model.compare, "coverage": coverage.coverage, "close-loop": model.close_loop,
    "locate": model.locate, "plan": planning.plan, "report": tools.report,
    "demo": tools.demo, "doctor": tools.doctor, "cache": tools.cache}
for name, command in COMMANDS.items():
    app.command(name)(command)
add_output_options(app)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"radiotwin {__version__}")
        raise typer.Exit


@app.callback()
def _options(version: bool = typer.Option(False, "--version", callback=_show_version, is_eager=True,
                                          help="Print the version and exit.")) -> None:
    show_warnings_plainly()
