"""The command that shows a run."""

from pathlib import Path
from typing import Annotated

import typer

from radiotwin.runtime.console import say


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to the app."""
    app.command("report")(report)


def report(
    run: Annotated[Path, typer.Argument(
        metavar="RUN", help="Folder that demo, fit, compare, close-loop or marl.fedqmix wrote, or "
                            "a scene.")],
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="The page [RUN/report.html].")] = None,
    scene: Annotated[Path | None, typer.Option(
        help="Scene folder, where the run does not hold or name one.")] = None,
    truth: Annotated[str | None, typer.Option(
        help="segmented, or the file of a radio map [SCENE/truth.nc, if it exists].")] = None,
    measurements: Annotated[Path | None, typer.Option(
        help="Measurements of the flights to show, where the run does not hold them.")] = None,
) -> None:
    """Write one HTML page of a run.

    It shows the city in 3D with maps, flights and devices, and tables, and needs no network.
    """
    from radiotwin.io.files import require_suffix, require_writable
    from radiotwin.report import read_run, write_report

    out = out or run / "report.html"
    require_suffix(out, ".html", ".htm")
    found = read_run(run, scene, truth, measurements)
    require_writable(out)
    write_report(found, out)
    for note in found.notes:
        say(f"note: {note}")
    say(f"wrote {out}: {out.stat().st_size / 1e6:.1f} MB")
