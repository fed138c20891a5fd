"""The commands that measure in a scene: trace, gains, paths, survey."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from radiotwin.cli.options import (
    MAX_SEED,
    Cluster,
    Combining,
    ComputeDevice,
    OnlyDevices,
    PointsFile,
    Quality,
    Radius,
    RaySeed,
    SceneFolder,
    TargetDb,
    Workers,
    split_names,
)
from radiotwin.errors import BadInput
from radiotwin.runtime.console import notice, print_rows, say

if TYPE_CHECKING:
    import numpy as np

    from radiotwin.scene import Scene
    from radiotwin.trace import SolverSettings

MAX_BUSY = 1.3  # times the time of an idle machine, from which on a plan says so


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to the app."""
    app.command("trace")(trace)
    app.command("gains")(gains)
    app.command("paths")(paths)
    app.command("survey")(survey)


def trace(
    folder: SceneFolder,
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Radio map [SCENE/truth.nc, with --devices truth-A-B.nc].")] = None,
    quality: Quality = None,
    target_db: TargetDb = None,
    solver: Annotated[str, typer.Option(
        help="paths (gain at points) or map (mean over lattice cells).")] = "paths",
    combining: Combining = "power",
    devices: OnlyDevices = None,
    radius: Radius = None,
    seed: RaySeed = 1,
    workers: Workers = "auto",
    cluster: Cluster = None,
    device: ComputeDevice = "auto",
    plan: Annotated[bool, typer.Option(
        "--plan", help="Only estimate time and memory, from a few batches: takes some seconds, and "
                       "the batches are kept for the run.")] = False,
) -> None:
    """Ray-trace the truth with Sionna RT.

    A killed run is resumed, a finished one is reused.
    """
    from radiotwin.io.inputs import keep_inputs
    from radiotwin.runtime.cuda import tracing_device
    from radiotwin.runtime.execution import open_executor, worker_count
    from radiotwin.scene import Scene
    from radiotwin.scene.folder import files_of
    from radiotwin.trace import trace_map, truth_path

    used = tracing_device(device)
    scene, names = Scene.load(folder), split_names(devices)
    out = out or truth_path(scene, names)
    keep_inputs(out, *files_of(scene))
    settings = _settings(scene, scene.lattice.positions_m, names, quality, target_db, solver=solver,
                         combining=combining, seed=seed, radius_m=radius,
                         compute_device=used)
    worker_count(workers)  # a plan needs none, but a mistake is one
    if plan:
        _print_plan(scene, settings, names)
        return
    with open_executor(workers, cluster, notice) as executor:
        facts = trace_map(scene, settings, out, names, executor).dataset.attrs
    say(f"wrote {out}: {facts['links']} links, {facts['links_detected']} detected, "
        f"{facts['links_below_sensitivity']} below sensitivity, {facts['links_without_path']} "
        f"without a path, {facts['links_inside_building']} inside buildings"
        + f", {facts['links_impossible']} impossible" * bool(facts["links_impossible"]))
    if "noise_floor_db" in facts:
        say(f"numerical noise: {facts['noise_floor_db']:.2f} dB RMS against ten times the rays; "
            f"nine links in ten are within {facts['noise_floor_p90_db']:.2f} dB")


def _print_plan(scene: "Scene", settings: "SolverSettings", devices: list[str] | None) -> None:
    from radiotwin.trace.plan import plan_trace

    plan = plan_trace(scene, settings, devices)
    say(f"{plan.links:,} links in {plan.batches:,} batches, {plan.finished:,} of them finished; "
        f"{plan.batch_s:.2f} s a batch on one core (nine in ten within {plan.batch_p90_s:.2f} s), "
        f"after {plan.start_s:.0f} s to start")
    say(f"memory: a worker took {plan.peak_bytes / 2**30:.1f} GiB, and may take "
        f"{plan.memory_bytes / 2**30:.1f} GiB; this machine has room for {plan.workers}")
    if plan.busy > MAX_BUSY:
        say(f"this machine is busy: the batches took {plan.busy:.1f} times as long as on a core of "
            "their own")
    print_rows("What is left, each worker on a core of its own",
               {"workers": "right", "minutes": "right", "memory [GiB]": "right", "": "left"},
               [[count, seconds / 60, memory / 2**30,
                 "this machine" if count == plan.workers else ""]
                for count, seconds, memory in plan.rows()])


def gains(
    folder: SceneFolder,
    points: PointsFile,
    out: Annotated[Path, typer.Option(
        "--out", "-o", help="Table (.csv, .csv.gz) with a row per link.")] = Path("gains.csv"),
    devices: OnlyDevices = None,
    combining: Annotated[str, typer.Option(
        "--sum", help="power (of the paths' powers) or coherent (of their fields).")] = "power",
    quality: Quality = None,
    target_db: TargetDb = None,
    radius: Radius = None,
    seed: RaySeed = 1,
    workers: Workers = "auto",
    cluster: Cluster = None,
    device: ComputeDevice = "auto",
) -> None:
    """Ray-trace gains at any points.

    An empty gain has a reason, such as no path.
    """
    from radiotwin.io.inputs import keep_inputs
    from radiotwin.runtime.cuda import tracing_device
    from radiotwin.runtime.execution import open_executor
    from radiotwin.runtime.pieces import keep_pieces
    from radiotwin.scene import Scene
    from radiotwin.scene.folder import files_of
    from radiotwin.trace import read_points, trace_points

    used = tracing_device(device)
    scene, names = Scene.load(folder), split_names(devices)
    keep_inputs(out, points, *files_of(scene))
    points_m = read_points(points, scene.config.origin, scene.city)
    settings = _settings(scene, points_m, names, quality, target_db, combining=combining, seed=seed,
                         radius_m=radius, compute_device=used)
    with keep_pieces() as pieces, open_executor(workers, cluster, notice) as executor:
        table = trace_points(scene, points_m, settings, out, names, executor)
    notice(pieces.progress)
    reasons = table.loc[table["reason"] != "", "reason"].value_counts()
    say(f"wrote {out}: {len(table)} links, {len(table) - reasons.sum()} with a gain"
        + "".join(f", {count} {reason}" for reason, count in reasons.items()))


def paths(
    folder: SceneFolder,
    points: PointsFile,
    out: Annotated[Path, typer.Option(
        "--out", "-o", help="NetCDF file (.nc).")] = Path("paths.nc"),
    devices: OnlyDevices = None,
    velocity: Annotated[str | None, typer.Option(
        metavar="VX,VY,VZ", help="Velocity of the receiver east, north and up [m/s], for Doppler "
                                 "shifts.")] = None,
    bandwidth_hz: Annotated[float | None, typer.Option(
        help="Add impulse responses of this bandwidth.")] = None,
) -> None:
    """List the paths to any points: powers, delays, angles, interactions.

    Each link gets its delay spread, K factor and angular spreads. No ray tracer is needed.
    """
    from radiotwin.io.inputs import keep_inputs
    from radiotwin.propagation.paths.listing import list_paths
    from radiotwin.scene import Scene
    from radiotwin.scene.folder import files_of
    from radiotwin.trace import read_points

    scene = Scene.load(folder)
    keep_inputs(out, points, *files_of(scene))
    points_m = read_points(points, scene.config.origin, scene.city)
    found = list_paths(scene, points_m, out, split_names(devices),
                       None if velocity is None else _speeds(velocity), bandwidth_hz)
    reasons = found["reason"].to_series().value_counts()
    if scene.city.terrain is not None:
        say("the ground is a terrain: paths reflect off its triangles and diffract where it folds "
            "by more than 6 degrees; links behind rounded hills have fewer paths than in reality")
    say(f"wrote {out}: {found.sizes['path']} paths of {found.sizes['link']} links"
        + "".join(f", {count} {reason}" for reason, count in reasons.items() if reason))


def _speeds(text: str) -> list[float]:
    try:
        east, north, up = (float(part) for part in text.split(","))
    except ValueError:
        raise BadInput(f"--velocity {text!r} is not three numbers; give VX,VY,VZ [m/s], such as "
                       "10,0,0 for eastwards") from None
    return [east, north, up]


def _settings(scene: "Scene", points_m: "np.ndarray", devices: list[str] | None,
              quality: str | None, target_db: float | None, **others: str | int | float | None
              ) -> "SolverSettings":
    """Return the settings of a quality, or those that reach a target, with what they cost."""
    from radiotwin.runtime.pieces import keep_pieces
    from radiotwin.trace import SolverSettings, choose_quality

    if target_db is None:
        return SolverSettings.of_quality(quality or "default", **others)
    if quality is not None:
        raise BadInput("--quality and --target-db both say how many rays there are; give one")
    with keep_pieces():
        tried = choose_quality(scene, points_m, target_db, devices, **others)
    links = len(points_m) * len(devices or scene.config.devices)
    print_rows(f"numerical error against ten times the rays, {tried[-1].links} links",
               {"quality": "left", "RMS [dB]": "right", "9 of 10 within [dB]": "right",
                "bias [dB]": "right", f"minutes for {links} links": "right"},
               [[rung.quality, rung.rms_db, rung.p90_db, rung.bias_db,
                 links * rung.seconds_per_link / 60] for rung in tried])
    say(f"--target-db {target_db:g}: quality {tried[-1].quality} "
        f"({tried[-1].settings.samples_per_src} rays a device)")
    return tried[-1].settings


def survey(
    folder: SceneFolder,
    out: Annotated[Path, typer.Option(
        "--out", "-o", help="Measurements (.csv, .csv.gz, .parquet); devices.csv is written to "
                            "the same folder.")] = Path("survey/measurements.csv"),
    truth: Annotated[str, typer.Option(
        help="traced (SCENE/truth.nc), segmented (statistical), or a radio map.")] = "traced",
    flights: Annotated[int, typer.Option(help="Flights; every UAV flies each.")] = 5,
    pattern: Annotated[str, typer.Option(
        help="random-waypoint, lawnmower or random-walk.")] = "random-waypoint",
    noise_db: Annotated[float | None, typer.Option(
        help="Standard deviation of the receivers' error [1; 0 where the truth has "
             "shadowing of its own, as segmented has].")] = None,
    seed: Annotated[int, typer.Option(
        min=0, max=MAX_SEED, help="Seed of paths and noise.")] = 0,
) -> None:
    """Fly the scene's UAVs through a truth map.

    Their measurements are written, with a table of the devices.
    """
    from radiotwin.io.inputs import keep_inputs
    from radiotwin.maps.survey import fly_survey, read_truth
    from radiotwin.scene import Scene
    from radiotwin.scene.folder import files_of

    scene = Scene.load(folder)
    for written in (out, out.parent / "devices.csv"):
        keep_inputs(written, *files_of(scene))
    measurements = fly_survey(scene, read_truth(scene, truth), flights=flights, pattern=pattern,
                              seed=seed, noise_db=noise_db)
    measurements.write(out)
    missed = int(measurements.table["gain_db"].isna().sum())
    say(f"wrote {out}: {len(measurements.flights)} flights, {len(measurements.table)} links to "
        f"{len(measurements.devices)} devices ({int(measurements.is_anchor.sum())} anchors), "
        f"{missed} not detected")
