"""The command that shows a run."""

from pathlib import Path
from typing import Annotated

import typer

from radiotwin.console import say, show_warnings_plainly


def add_commands(app: typer.Typer) -> None:
    app.command("report")(report)


def report(
    run: Annotated[Path, typer.Argument(
        metavar="RUN", help="Folder that demo, fit, compare, close-loop or marl.fedqmix wrote, or a scene.")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="The page [RUN/report.html].")] = None,
    scene: Annotated[Path | None, typer.Option(help="Scene folder, where the run does not hold or name one.")] = None,
    truth: Annotated[str | None, typer.Option(
        help="segmented, or the file of a radio map [SCENE/truth.nc, if it is there].")] = None,
    measurements: Annotated[Path | None, typer.Option(
        help="Measurements whose flights are shown, where the run does not hold them.")] = None,
) -> None:
    """One HTML page of a run, which opens without a network: the city in 3D with maps, flights and devices; tables."""
    from radiotwin.files import require_writable
    from radiotwin.report import read_run, write_report

    show_warnings_plainly()
    found = read_run(run, scene, truth, measurements)
    out = out or run / "report.html"
    require_writable(out)
    write_report(found, out)
    for note in found.notes:
        say(f"note: {note}")
    say(f"wrote {out}: {out.stat().st_size / 1e6:.1f} MB")
