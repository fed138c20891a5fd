"""The commands demo and doctor."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from radiotwin.console import console, result, say


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to the app."""
    app.command("demo")(demo)
    app.command("doctor")(doctor)


def demo(
    scene: Annotated[str, typer.Option(
        help="preset:small, or any source of `build-scene`, of which a part of 300 x 300 m is "
             "taken.")] = "preset:small",
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of all results.")] = Path("demo"),
    seed: Annotated[int, typer.Option(
        min=0, help="Seed of placement, flights and fits.")] = 0,
) -> None:
    """Run the whole chain on a small scene, in minutes.

    The steps are build, trace, survey, fit and compare; an HTML page shows the result.
    """
    from radiotwin.cli.model import print_comparison
    from radiotwin.demo import run_demo

    comparison = run_demo(scene, out, seed=seed, on_progress=say)
    print_comparison(comparison)
    say(f"look at {out / 'report.html'}")


def doctor() -> None:
    """Check what works on this machine.

    Each problem comes with its remedy.
    """
    from radiotwin.doctor import print_diagnosis

    diagnosis = print_diagnosis(console)
    result("doctor", {"healthy": diagnosis.healthy, **asdict(diagnosis)})
    if not diagnosis.healthy:
        raise typer.Exit(1)
