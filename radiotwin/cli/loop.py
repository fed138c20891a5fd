"""The command that closes the loop."""

from pathlib import Path
from typing import Annotated

import typer

from radiotwin.cli.model import MeasurementFile
from radiotwin.console import print_rows, say, show_warnings_plainly


def add_commands(app: typer.Typer) -> None:
    app.command("close-loop")(close_loop)
    app.command("locate")(locate)


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
    from radiotwin.closeloop.residual_table import write_residuals
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
    report = make_report(loop) | {"inputs": {"measurements": str(measurements), "scene": scene and str(scene)}}
    draw_figures(loop, world, report, out)
    write_report(report, out / "closeloop.json")
    write_residuals(loop, out / "residuals.csv.gz")
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
    if write_scene is not None and world is not None:
        changes = write_corrected_scene(loop, world, write_scene)
        say(f"wrote {write_scene}: {'; '.join(changes)}" if changes else
            f"{write_scene} is not written: no building and no anchor was found to be wrong in {scene}")


def locate(
    measurements: MeasurementFile,
    twin: Annotated[Path, typer.Option(help="Corrected twin: the folder twin of what close-loop wrote.")],
    scene: Annotated[Path | None, typer.Option(help="Scene folder; without one every link has line of sight.")] = None,
    devices: Annotated[Path | None, typer.Option(help="Table of devices [devices.csv beside the file].")] = None,
    truth: Annotated[Path | None, typer.Option(help="Table of devices with their true positions, to say how far off "
                                                    "the places are.")] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Table of the places.")] = Path("located.csv"),
) -> None:
    """Find devices of role unknown by a corrected model, with or without a 3D map."""
    from radiotwin.closeloop.corrected import corrected_model
    from radiotwin.closeloop.locate_file import locate_file, off_by
    from radiotwin.files import atomic_path, require_writable
    from radiotwin.measurements import read_devices, read_measurements
    from radiotwin.progress import progress
    from radiotwin.scene import Scene
    from radiotwin.twin import Twin

    show_warnings_plainly()
    data, known = read_measurements(measurements, devices), Twin.load(twin)
    true = read_devices(truth) if truth else None
    require_writable(out)
    unknown = int((data.devices["role"] == "unknown").sum())
    with progress("locating", total=unknown) as advance:
        world = Scene.load(scene) if scene else None
        places, remarks = locate_file(data, known, corrected_model(known, world), world, lambda: advance(1))
    for remark in remarks:
        say(f"note: {remark}")
    with atomic_path(out) as temporary:
        places.to_csv(temporary, index=False)
    if true is not None:
        error = off_by(places, true)
        print_rows("How far off [m]", {"devices": "right", "median": "right", "90 %": "right",
                                       "within the 90 % radius": "right"},
                   [[error["devices"], error["median_m"], error["ninety_m"], f"{error['within']:.0%}"]])
    say(f"wrote {out}: {len(places)} of {unknown} unknown devices; half of the 90 % radii are below "
        f"{places['radius_m'].median():.0f} m")
