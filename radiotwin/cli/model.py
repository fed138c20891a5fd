"""The commands that learn from measurements: fit, map, compare, close-loop, locate."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import radiotwin as rt
from radiotwin.cli.options import (
    MAX_SEED,
    Cluster,
    DeviceTable,
    FitSeed,
    Force,
    MeasurementFile,
    OnlyDevices,
    OptionalScene,
    SceneOption,
    Shift,
    Workers,
    in_frame_of,
    keep_scene_apart,
    open_model,
    parse_numbers,
    split_names,
)
from radiotwin.errors import BadInput
from radiotwin.io.files import atomic_path, require_suffix, require_writable
from radiotwin.io.inputs import keep_inputs, keep_others
from radiotwin.runtime.console import notice, print_rows, progress, result, say

if TYPE_CHECKING:
    from radiotwin.twin import TwinDevice


def fit(
    measurements: MeasurementFile,
    scene: SceneOption,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the twin.")] = Path("twin"),
    model: Annotated[str, typer.Option(
        help="auto: the one with the least held-out error of log_distance, "
             "segmented_log_distance, segmented_nn, kriging. Or paths: follows paths over the 3D "
             "map, also to find devices in narrow streets; takes minutes. "
             "path_kriging: the same over a map that may be wrong. Or a "
             "published law, which needs no anchor: tr36777_uma, tr36777_umi, al_hourani_urban "
             "(_suburban, _dense_urban, _high_rise), p1411, cost231_wi (_metropolitan).")
        ] = "auto",
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
    """Fit a twin: a channel model, and the positions of the unknown devices.

    The channel is learnt from the anchors, whose positions are known. With --model auto,
    segmented_nn locates the unknown devices, and the model with the least held-out error predicts
    levels; any other model does both.
    """
    from radiotwin.runtime.execution import open_executor
    from radiotwin.twin import check_twin_target

    check_twin_target(out)
    data, world = rt.read_measurements(measurements, devices), rt.Scene.load(scene)
    data = in_frame_of(world, data, shift)
    earlier = rt.Twin.load(start) if start else None
    with rt.keep_pieces() as pieces, open_executor(workers, cluster, notice) as executor:
        twin = rt.fit_twin(data, world, model, seed=seed, start=earlier, allow_indoor=allow_indoor,
                        executor=executor, compare=True)
    notice(pieces.progress)
    twin.save(out)
    _print_twin(twin, f"Twin {out} ({twin.channel.name})")


def _print_twin(twin: "rt.Twin", title: str) -> None:
    """Print a twin's device positions, fitted law, and held-out errors of the channel models."""
    from radiotwin.twin.selection import LOCATED_BY, HeldOut

    table, columns = twin.positions, {"device": "left", "role": "left", "x [m]": "right",
                                      "y [m]": "right", "90 % radius [m]": "right"}
    cells = [table[name] for name in ("device", "role", "x_m", "y_m", "radius_m")]
    if twin.origin is not None:
        columns |= {"latitude": "right", "longitude": "right"}
        cells += [table[name].map("{:.6f}".format) for name in ("latitude_deg", "longitude_deg")]
    notes = [_note(each) for each in twin.devices]
    print_rows(title, columns | {"note": "left"}, [list(row) for row in zip(*cells, notes)])
    law = twin.params
    if len(law):
        print_rows("Law of the channel, with 90 % intervals",
                   {"links": "left", "parameter": "left", "value": "right", "low": "right",
                    "high": "right", "unit": "left"}, law.to_numpy(dtype=object).tolist())
    model, located_by = twin.channel.name, twin.provenance.get(LOCATED_BY, "")
    held_out = HeldOut.from_provenance(twin.provenance)
    say(f"{model} was not compared with others: too few links of anchors to hold any out"
        if held_out is None else held_out.sentence(model))
    if located_by not in ("", model):
        say(f"The unknown devices were located with {located_by}, and levels are predicted with "
            f"{model}")


def _note(device: "TwinDevice") -> str:
    """Return whether a device was not located, or has a second likely place; else nothing."""
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
    force: Force = False,
) -> None:
    """Predict a radio map, or convert one.

    It holds the gain of every device over the scene's lattice.
    """
    from radiotwin.display import count
    from radiotwin.maps.file import is_map
    from radiotwin.report import check_map_target

    if out is None and is_map(twin):
        raise BadInput(f"{twin} is a radio map already; give the file to write with --out")
    place = Path(os.path.realpath(twin))  # unlike resolve, it accepts circular links
    out = out or place.with_name(f"{place.name}.nc")
    heights_m = None if altitudes is None else parse_numbers("--altitudes", altitudes)
    world = rt.Scene.load(scene)
    check_map_target(out, world)
    keep_inputs(out, twin, *world.files)
    keep_others(out, force, "device", "x_m", "y_m", "z_m", "gain_db", "los")
    with open_model(twin) as source:
        written = rt.export_map(source, world, out, devices=split_names(devices),
                                altitudes_m=heights_m, name=str(twin), tell=notice)
    z, y, x = written.lattice.shape
    say(f"wrote {out}: {count(len(written.devices), 'device')}, {count(z, 'altitude')} of {x} by "
        f"{y} positions")


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
    paths: Annotated[bool, typer.Option(
        "--paths", help="Also compare the model `paths` (paths followed over the 3D map). Takes "
                        "minutes.")] = False,
    also: Annotated[list[Path] | None, typer.Option(
        help="A twin's folder, or (with --truth) a radio map, to compare with the models; may be "
             "repeated.")] = None,
    shift: Shift = None,
    seed: FitSeed = 0,
    workers: Workers = "auto",
    cluster: Cluster = None,
) -> None:
    """Compare all channel models on held-out flights.

    Published laws that are valid at the scene's frequency are among them, without a fit.
    With --truth they are compared with the truth map, too.
    """
    from radiotwin.report import check_comparison_folder
    from radiotwin.runtime.execution import open_executor

    world = rt.Scene.load(scene)
    keep_scene_apart(out, world)
    check_comparison_folder(out)
    data = in_frame_of(world, rt.read_measurements(measurements, devices), shift)
    rt.split_flights(data, held_out)  # refuses before a map is read
    truth_map = rt.read_truth(world, truth) if truth else None
    with rt.keep_pieces() as pieces, open_executor(workers, cluster, notice) as executor:
        comparison = rt.compare_held_out(data, world, truth_map, held_out=held_out, paths=paths,
                                         also=also or [], seed=seed, executor=executor)
    notice(pieces.progress)
    rt.write_comparison_folder(comparison, world, out, truth_map)
    print_comparison(comparison)
    say(f"wrote {out}")


def print_comparison(comparison: "rt.Comparison") -> None:
    """Print the tables of a comparison of models."""
    result("scores", comparison.scores.to_dict("records"))
    result("locations", comparison.locations.to_dict("records"))
    for title, columns, rows in comparison.tables():
        print_rows(title, columns, rows)


def close_loop(
    measurements: MeasurementFile,
    scene: OptionalScene = None,
    devices: DeviceTable = None,
    base: Annotated[str, typer.Option(
        help="Model whose residual is explained: twin, log-distance, or raytrace, which follows "
             "paths over the 3D map; auto: the best of them.")] = "auto",
    hold_out: Annotated[str, typer.Option(
        help="Unit of cross-validation: flight, block, quadrant, device; auto: flight if there are "
             "enough, else block.")] = "auto",
    out: Annotated[Path, typer.Option(
        "--out", "-o", help="Folder for closeloop.json, closeloop.html and figures.")
        ] = Path("closeloop"),
    write_scene: Annotated[Path | None, typer.Option(
        metavar="DIR", help="Scene folder to write: SCENE with the missing obstacles and the "
                            "antennas that were found, without the buildings that are gone, with "
                            "roofs as high and anchors where they were found.")] = None,
    shift: Shift = None,
    seed: Annotated[int, typer.Option(
        min=0, max=MAX_SEED, help="Seed of folds, fits and permutations.")] = 0,
    workers: Workers = "auto",
    cluster: Cluster = None,
) -> None:
    """Find physical effects that a channel model lacks, such as a missing building.

    They are added to the model, and its error on held-out links before and after is reported.
    """
    from radiotwin.closeloop.output.corrected_scene import check_corrected_target
    from radiotwin.closeloop.run import BASE_FITTED, expected_cpu_s
    from radiotwin.report import check_closeloop_folder, closeloop_summary
    from radiotwin.runtime.execution import AUTO, open_executor
    from radiotwin.twin.locate import NOT_BY_PATHS

    data = rt.read_measurements(measurements, devices)
    world = rt.Scene.load(scene) if scene else None
    data = in_frame_of(world, data, shift)
    keep_scene_apart(out, world)
    check_closeloop_folder(out)
    if write_scene is not None:
        check_corrected_target(write_scene, world, out)
    if base == "raytrace":
        notice(f"the twin will follow paths, {NOT_BY_PATHS}")
    minutes = expected_cpu_s(len(data), world is not None) / 60
    expected = (f"{len(data):,} links: usually {minutes / 2:.1f} to {2 * minutes:.1f} min of "
                "processor time, more where other work runs")
    inputs = {"measurements": str(measurements), "scene": scene and str(scene)}
    # Two workers are no faster than the threads of one process: only on request.
    wanted = "1" if workers == AUTO and cluster is None else workers
    with rt.keep_pieces() as pieces, open_executor(wanted, cluster, notice) as executor, \
            progress("closing the loop", total=None, lines=True) as advance:
        def show(text: str) -> None:
            if text == BASE_FITTED:
                notice(expected)
            advance(1, "; ".join(filter(None, [text, pieces.progress])))

        loop = rt.close_loop(data, world, base, seed, show, hold_out, executor=executor)
        advance(1, "other models, and the combination of all")
        report = rt.write_closeloop_folder(loop, world, out, inputs=inputs,
                                           title=f"Close-loop report of {measurements.name}")
    notice(pieces.progress)
    _print(report)
    if base == "auto" and loop.base == "raytrace":
        say(f"note: the twin's base is 'raytrace', {NOT_BY_PATHS}")
    say(closeloop_summary(report))
    say(f"wrote {out / 'closeloop.html'}")
    if write_scene is not None and world is not None:
        changes = rt.write_corrected_scene(loop, world, write_scene)
        say(f"wrote {write_scene}: {'; '.join(changes)}" if changes else
            f"{write_scene} is not written: no building, roof, anchor or antenna was found to "
            f"be wrong in {scene}")


def _print(report: dict[str, Any]) -> None:
    """Print anomalies, held-out errors before and after, and effects of a close-loop report."""
    from radiotwin.report import anomaly_words
    from radiotwin.report.closeloop_words import errors_in_turn
    from radiotwin.report.labels import name_label, number

    for note in report["notes"]:
        say(f"note: {note}")
    anomalies = anomaly_words.rows(report)
    if anomalies:
        print_rows("What stands out", dict(zip(
            anomaly_words.COLUMNS, ("left", "left", "left", "right", "right", "right", "right"),
            strict=True)), anomalies)
    error = report["error"]
    groups = [(name, both) for name, both in (("all", error), *error["by_los"].items())
              if both["before"]["n"]]
    scores = ("rmse_db", "mae_db", "bias_db")
    rows = [[name, when, number(values["n"]), *(_number(values[key]) for key in scores)]
            for name, both in groups for when, values in errors_in_turn(both, report)]
    rows += [[name_label(name), "", number(value.get("n")), value["rmse_db"], float("nan"),
              float("nan")]
             for name, value in report["baselines"].items()]
    print_rows(
        f"Error on held-out links (by {report['heldout']['by']}) [dB], base {report['base']}",
        {"of": "left", "": "left", "links": "right", "RMSE": "right", "MAE": "right",
         "bias": "right"}, rows)
    for title, is_declared in (("Parts of the base", True), ("Added to the base", False)):
        rows = [[effect["name"], name, *_estimate(estimate), estimate["unit"]]
                for effect in report["effects"] if effect.get("is_declared", False) == is_declared
                for name, estimate in effect["parameters"].items()]
        if rows:
            print_rows(title, {
                "effect": "left", "parameter": "left", "value": "right", "low": "right",
                "high": "right", "unit": "left"}, rows)


def _estimate(estimate: dict[str, Any]) -> list[float | str]:
    """Return value and 90 % interval of a parameter; a word and two NaN if it has no estimate."""
    from radiotwin.report.closeloop_words import is_reference

    if is_reference(estimate):  # an offset that is fixed at 0 dB
        return ["reference", float("nan"), float("nan")]
    if not estimate.get("determined", True):
        return ["not determined", float("nan"), float("nan")]
    return [_number(estimate[key]) for key in ("value", "low", "high")]


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def locate(
    measurements: MeasurementFile,
    twin: Annotated[Path, typer.Option(
        help="Corrected twin: the folder twin of what close-loop wrote.")],
    scene: OptionalScene = None,
    devices: DeviceTable = None,
    truth: Annotated[Path | None, typer.Option(
        help="Table with columns device and x_m, y_m or latitude, longitude: true positions, "
             "to report the errors.")] = None,
    shift: Shift = None,
    out: Annotated[Path, typer.Option(
        "--out", "-o", help="Table of the positions.")] = Path("located.csv"),
    force: Force = False,
) -> None:
    """Locate unknown devices with a twin of close-loop, or of fit.

    It works with or without a 3D map.
    """
    from radiotwin.io.cells import write_csv
    from radiotwin.twin.localize.without_map import MIN_LINKS
    from radiotwin.twin.locate import read_truth

    require_suffix(out, ".csv", ".csv.gz")
    keep_inputs(out, measurements, devices or measurements.parent / "devices.csv", truth)
    keep_others(out, force, "device", "x_m", "y_m", "radius_m")
    known, world = rt.Twin.load(twin), rt.Scene.load(scene) if scene else None
    keep_inputs(out, *(world.files if world else []))
    known.require_map(world)  # before a file is read that may be large
    data = in_frame_of(world, rt.read_measurements(measurements, devices), shift)
    true = read_truth(truth, known.origin or data.origin) if truth else None
    require_writable(out)
    unknown = int((data.devices["role"] == "unknown").sum())
    positions, notes = rt.locate_devices(data, known, world)
    for note in notes:
        say(f"note: {note}")
    with atomic_path(out) as temporary:
        write_csv(positions, temporary)
    if true is not None:
        error = rt.position_errors(positions, true)
        print_rows("How far off [m]", {"devices": "right", "median": "right", "90 %": "right",
                                       "within the 90 % radius": "right"},
                   [[error["devices"], error["median_m"], error["ninety_m"],
                     f"{error['within']:.0%}"]])
    radii = f"half of the 90 % radii are below {positions['radius_m'].median():.0f} m" \
        if len(positions) else f"each needs {MIN_LINKS} links and more"
    say(f"wrote {out}: {len(positions)} of {unknown} unknown devices; {radii}")
