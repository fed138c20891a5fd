"""The command that closes the loop."""

from pathlib import Path
from typing import Annotated

import typer

from radiotwin.cli.console import print_rows, say, show_warnings_plainly
from radiotwin.cli.model import MeasurementFile


def add_commands(app: typer.Typer) -> None:
    app.command("close-loop")(close_loop)


def close_loop(
    measurements: MeasurementFile,
    scene: Annotated[Path | None, typer.Option(help="Scene folder; without one every link has line of sight.")] = None,
    devices: Annotated[Path | None, typer.Option(help="Table of devices [devices.csv beside the file].")] = None,
    base: Annotated[str, typer.Option(help="Whose residual: twin, raytrace, log-distance; auto: the best of them.")
                    ] = "auto",
    hold_out: Annotated[str, typer.Option(help="What is held out together: flight, block, device; auto: by flight if "
                                               "there are enough.")] = "auto",
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for closeloop.json, closeloop.html and figures.")
                   ] = Path("closeloop"),
    write_scene: Annotated[Path | None, typer.Option(
        metavar="DIR", help="Scene folder to write: SCENE with traced boxes, without buildings that are gone, anchors "
                            "where they were found.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of folds, fits and permutations.")] = 0,
) -> None:
    """Find what the model lacks, add it, and say by how much the error falls."""
    from radiotwin.closeloop.corrected import corrected_twin
    from radiotwin.closeloop.corrected_scene import check_corrected_target, write_corrected_scene
    from radiotwin.closeloop.figures import draw_figures
    from radiotwin.closeloop.page import lead, write_page
    from radiotwin.closeloop.report import make_report, write_report
    from radiotwin.closeloop.run import close_loop as run
    from radiotwin.files import require_writable
    from radiotwin.measurements import read_measurements
    from radiotwin.progress import progress
    from radiotwin.scene import Scene
    from radiotwin.twin import check_twin_target

    show_warnings_plainly()
    data = read_measurements(measurements, devices)
    world = Scene.load(scene) if scene else None
    require_writable(out / "closeloop.json")
    check_twin_target(out / "twin")
    if write_scene is not None:
        check_corrected_target(write_scene, world, out)
    with progress("closing the loop", total=None) as advance:
        loop = run(data, world, base, seed, lambda text: advance(1, text), hold_out)
    report = make_report(loop)
    draw_figures(loop, world, report, out)
    write_report(report, out / "closeloop.json")
    if world is not None:
        corrected_twin(loop, world).save(out / "twin")
    write_page(report, out, f"What the model of {measurements.name} lacks")
    for remark in report["remarks"]:
        say(f"note: {remark}")
    error = report["error"]
    rows = [[name, when, float(both[when]["rmse_db"] or "nan"), float(both[when]["mae_db"] or "nan"),
             float(both[when]["bias_db"] if both[when]["bias_db"] is not None else "nan")]
            for name, both in (("all", error), *error["by_los"].items()) if both["before"]["n"]
            for when in ("before", "after")]
    rows += [[name.replace("_", " "), "", value["rmse_db"], float("nan"), float("nan")]
             for name, value in report["baselines"].items()]
    print_rows(f"Error on held-out links (by {report['heldout']['by']}) [dB], base {report['base']}",
               {"links": "left", "": "left", "RMSE": "right", "MAE": "right", "mean": "right"}, rows)
    print_rows("What was missing", {"effect": "left", "parameter": "left", "value": "right", "low": "right",
                                    "high": "right", "unit": "left"},
               [[effect["name"], name, *(float("nan") if p[k] is None else p[k] for k in ("value", "low", "high")),
                 p["unit"]] for effect in report["effects"] for name, p in effect["parameters"].items()])
    say(lead(report))
    say(f"wrote {out / 'closeloop.html'}")
    if write_scene is not None:
        changes = write_corrected_scene(loop, world, write_scene)
        say(f"wrote {write_scene}: {'; '.join(changes)}" if changes else
            f"{write_scene} is not written: no building and no anchor was found to be wrong in {scene}")
