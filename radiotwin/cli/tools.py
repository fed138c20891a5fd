"""The commands report, demo, doctor and cache."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

import radiotwin as rt
from radiotwin.cli.model import print_comparison
from radiotwin.cli.options import MAX_SEED, ComputeDevice, Force
from radiotwin.io.files import require_suffix, require_writable
from radiotwin.io.inputs import keep_others
from radiotwin.runtime.console import console, notice, print_rows, result, say


def demo(
    scene: Annotated[str, typer.Option(
        help="preset:small, or any source of `build-scene`, of which a part of 300 x 300 m is "
             "taken.")] = "preset:small",
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of all results.")] = Path("demo"),
    seed: Annotated[int, typer.Option(
        min=0, max=MAX_SEED, help="Seed of placement, flights and fits.")] = 0,
    device: ComputeDevice = "auto",
) -> None:
    """Run the whole chain on a small scene, in minutes.

    The steps are build, trace, survey, fit and compare; an HTML page shows the result.
    """
    from radiotwin.runtime.cuda import tracing_device

    used = tracing_device(device)
    with rt.keep_pieces() as pieces:
        comparison = rt.run_demo(scene, out, seed=seed, device=used, on_progress=say)
    notice(pieces.progress)
    print_comparison(comparison)
    say(f"look at {out / 'report.html'}")


def doctor() -> None:
    """Check what works on this machine.

    Each problem comes with its remedy.
    """
    from radiotwin.cli.doctor import print_diagnosis

    with console.status("checking this machine"):
        diagnosis = rt.diagnose()
    print_diagnosis(diagnosis, console)
    result("doctor", {"healthy": diagnosis.healthy, **asdict(diagnosis)})
    if not diagnosis.healthy:
        raise typer.Exit(1)


def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all of it.")] = False,
) -> None:
    """Show the cache of finished parts of runs.

    close-loop, fit, compare, gains and demo keep finished parts there, so that a killed run can be
    resumed. The environment variable RADIOTWIN_CACHE names the folder. The oldest parts are removed
    when the cache exceeds RADIOTWIN_MAX_CACHE_BYTES.
    """
    content = rt.cache_content()
    parts = content["parts"]
    result("cache", content | {"parts": {kind: each["parts"] for kind, each in parts.items()}})
    if parts:
        rows = [[kind, each["parts"], each["bytes"] / 1e6] for kind, each in parts.items()]
        print_rows("Finished parts", {"of": "left", "parts": "right", "size [MB]": "right"}, rows)
    say(f"{content['folder']}: {content['bytes'] / 1e6:.1f} MB of at most "
        f"{content['limit_bytes'] / 1e6:,.0f} MB")
    if clear:
        say(f"removed {rt.clear_cache():,} parts")


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
    force: Force = False,
) -> None:
    """Write one HTML page of a run.

    It shows the city in 3D with maps, flights and devices, and tables, and needs no network.
    """
    out = out or run / "report.html"
    require_suffix(out, ".html", ".htm")
    keep_others(out, force)
    found = rt.read_run(run, scene, truth, measurements)
    require_writable(out)
    rt.write_report(found, out)
    for note in found.notes:
        say(f"note: {note}")
    say(f"wrote {out}: {out.stat().st_size / 1e6:.1f} MB")
