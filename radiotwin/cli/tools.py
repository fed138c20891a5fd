"""Commands that look after the user: demo, doctor."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from radiotwin.console import console, result, say, show_warnings_plainly


def add_commands(app: typer.Typer) -> None:
    app.command("demo")(demo)
    app.command("doctor")(doctor)


def demo(
    scene: Annotated[str, typer.Option(
        help="preset:small, or any source of `build-scene`, of which a part of 300 x 300 m is taken.")
        ] = "preset:small",
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for everything that is made.")] = Path("demo"),
    seed: Annotated[int, typer.Option(min=0, help="Of placement, flights and fits.")] = 0,
) -> None:
    """The whole chain on a small scene, in minutes: build, trace, survey, fit, compare, and an HTML page."""
    from radiotwin.cli.model import print_comparison
    from radiotwin.demo import run_demo

    show_warnings_plainly()
    comparison = run_demo(scene, out, seed=seed, say=say)
    print_comparison(comparison)
    say(f"look at {out / 'report.html'}")


def doctor() -> None:
    """Say what works on this machine, and what to do about what does not."""
    from radiotwin import doctor as checks

    diagnosis = checks.run(console)
    result("doctor", {"healthy": diagnosis.healthy, **asdict(diagnosis)})
    if not diagnosis.healthy:
        raise typer.Exit(1)
