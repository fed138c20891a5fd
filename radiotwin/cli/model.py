"""The commands that learn from measurements and judge the result: fit, map, compare."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from radiotwin.cli.options import (
    Cluster,
    DeviceTable,
    FitSeed,
    MeasurementFile,
    OnlyDevices,
    SceneOption,
    Shift,
    Workers,
    in_frame_of,
    keep_scene_apart,
    open_model,
    split_names,
)
from radiotwin.errors import BadInput
from radiotwin.runtime.console import notice, print_rows, result, say

if TYPE_CHECKING:
    from radiotwin.twin import TwinDevice
    from radiotwin.twin.compare import Comparison


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to the app."""
    app.command("fit")(fit)
    app.command("map")(map_)
    app.command("compare")(compare)


def fit(
    measurements: MeasurementFile,
    scene: SceneOption,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the twin.")] = Path("twin"),
    model: Annotated[str, typer.Option(
        help="segmented_nn, segmented_log_distance, log_distance, regression_kriging, or raytrace: "
             "paths over the 3D map, also to find devices in narrow streets; takes minutes. "
             "path_kriging: the same over a map that may be wrong. Or a "
             "published law, which needs no anchor: tr36777_uma, tr36777_umi, al_hourani_urban "
             "(_suburban, _dense_urban, _high_rise), p1411, cost231_wi (_metropolitan).")
        ] = "segmented_nn",
    devices: DeviceTable = None,
    start: Annotated[Path | None, typer.Option(
        help="An earlier twin, to start the search from.")] = None,
    allow_indoor: Annotated[bool, typer.Option(
        "--allow-indoor", help="Unknown devices may be inside buildings.")] = False,
    shift: Shift = None,
    seed: FitSeed = 0,
    workers: Workers = "auto",
    cluster: Cluster = None,
) -> None:
    """Fit a twin: the channel and the unknown devices.

    The channel is learnt from the anchors; then the unknown devices are located with it.
    """
    from radiotwin.links.measurements import read_measurements
    from radiotwin.runtime.execution import open_executor
    from radiotwin.runtime.pieces import keep_pieces
    from radiotwin.scene import Scene
    from radiotwin.twin import Twin, check_twin_target, fit_twin

    check_twin_target(out)
    data, world = read_measurements(measurements, devices), Scene.load(scene)
    data = in_frame_of(world, data, shift)
    earlier = Twin.load(start) if start else None
    with keep_pieces() as pieces, open_executor(workers, cluster, notice) as executor:
        twin = fit_twin(data, world, model=model, seed=seed, start=earlier,
                        allow_indoor=allow_indoor, executor=executor)
    notice(pieces.progress)
    twin.save(out)
    print_rows(f"Twin {out} ({model})",
               {"device": "left", "role": "left", "x [m]": "right", "y [m]": "right",
                "90 % radius [m]": "right", "note": "left"},
               [[d.device, d.role, d.x_m, d.y_m, d.credible_radius_m, _note(d)]
                for d in twin.devices])


def _note(device: "TwinDevice") -> str:
    if not device.located:
        return "not located: the data do not say where it is"
    if device.second_mode:
        x_m, y_m, weight = device.second_mode
        return f"perhaps at ({x_m:.0f}, {y_m:.0f}), {weight:.0%}"
    return ""


def map_(
    twin: Annotated[Path, typer.Argument(
        metavar="TWIN", help="Folder of a twin, as `fit` makes it, or a radio map (.nc, "
                             ".zarr), as `trace` makes it.")],
    scene: SceneOption,
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Radio map: .nc or .zarr (all), .csv (a row per link), .npz (NumPy), "
                            ".tif (GeoTIFF), .kmz (Google Earth) or .png (a picture of the lowest "
                            "altitude) [TWIN.nc].")] = None,
    devices: OnlyDevices = None,
    altitudes: Annotated[str | None, typer.Option(
        metavar="Z,…", help="Only these of the lattice's altitudes [m].")] = None,
) -> None:
    """Predict a radio map, or convert one.

    It holds the gain of every device over the scene's lattice.
    """
    from radiotwin.io.inputs import keep_inputs
    from radiotwin.maps.form import is_map
    from radiotwin.report import check_map_target, export_map
    from radiotwin.scene import Scene
    from radiotwin.scene.folder import files_of

    if out is None and is_map(twin):
        raise BadInput(f"{twin} is a radio map already; give the file to write with --out")
    place = Path(os.path.realpath(twin))  # unlike resolve, it takes links in a circle
    out = out or place.with_name(f"{place.name}.nc")
    world = Scene.load(scene)
    check_map_target(out, world)
    keep_inputs(out, twin, *files_of(world))
    with open_model(twin) as source:
        written = export_map(source, world, out, devices=split_names(devices),
                             altitudes_m=_altitudes(altitudes), name=str(twin), tell=notice)
    say(f"wrote {out}: {len(written.devices)} devices on {written.lattice.shape} positions "
        "(z, y, x)")


def _altitudes(text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise BadInput(f"--altitudes {text!r} are not numbers; give metres, as 50,60") from None


def compare(
    measurements: MeasurementFile,
    scene: SceneOption,
    out: Annotated[Path, typer.Option(
        "--out", "-o", help="Folder for the tables and figures.")] = Path("comparison"),
    truth: Annotated[str | None, typer.Option(
        help="Judge on a whole map, too: traced (SCENE/truth.nc), segmented, or a radio map.")
        ] = None,
    held_out: Annotated[int, typer.Option(
        help="Number of the last flights that are held out of the fits.")] = 1,
    devices: DeviceTable = None,
    raytrace: Annotated[bool, typer.Option(
        "--raytrace", help="Compare the model raytrace, too: paths over the 3D map. Takes minutes.")
        ] = False,
    also: Annotated[list[Path] | None, typer.Option(
        help="A twin's folder, or (with --truth) a radio map, to compare with the models; may be "
             "repeated.")] = None,
    shift: Shift = None,
    seed: FitSeed = 0,
    workers: Workers = "auto",
    cluster: Cluster = None,
) -> None:
    """Compare all channel models on held-out flights.

    Published laws that hold at the scene's frequency are among them, fitted to nothing.
    With --truth they are compared with the truth map, too.
    """
    from radiotwin.io.files import require_writable
    from radiotwin.links.measurements import read_measurements
    from radiotwin.maps.survey import read_truth
    from radiotwin.report import write_comparison_folder
    from radiotwin.report.comparison import compare_held_out
    from radiotwin.runtime.execution import open_executor
    from radiotwin.runtime.pieces import keep_pieces
    from radiotwin.scene import Scene
    from radiotwin.twin.compare import split_flights

    require_writable(out / "compare.json")
    world = Scene.load(scene)
    keep_scene_apart(out, world)
    data = in_frame_of(world, read_measurements(measurements, devices), shift)
    split_flights(data, held_out)  # refuses before a map is read
    truth_map = read_truth(world, truth) if truth else None
    with keep_pieces() as pieces, open_executor(workers, cluster, notice) as executor:
        comparison = compare_held_out(data, world, truth_map, held_out=held_out, raytrace=raytrace,
                                      also=also or [], seed=seed, executor=executor)
    notice(pieces.progress)
    write_comparison_folder(comparison, world, out, truth_map)
    print_comparison(comparison)
    say(f"wrote {out}")


def print_comparison(comparison: "Comparison") -> None:
    """Print the tables of a comparison.

    Args:
        comparison: of models.
    """
    result("scores", comparison.scores.to_dict("records"))
    result("locations", comparison.locations.to_dict("records"))
    for title, columns, rows in comparison.tables():
        print_rows(title, columns, rows)
