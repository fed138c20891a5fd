"""The commands of a scene: build and export it, and trace, list paths and measure in it."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import radiotwin as rt
from radiotwin.cli.options import (
    MAX_SEED,
    Cluster,
    Combining,
    ComputeDevice,
    Diffraction,
    Force,
    OnlyDevices,
    PointsFile,
    Quality,
    Radius,
    RaySeed,
    SceneFolder,
    SceneOption,
    TargetDb,
    Workers,
    open_model,
    parse_extent,
    parse_numbers,
    parse_origin,
    split_names,
)
from radiotwin.errors import BadInput
from radiotwin.io.inputs import keep_inputs, keep_others
from radiotwin.runtime.console import console, notice, print_rows, result, say

if TYPE_CHECKING:
    import numpy as np

SAME_HEIGHT_M = 5.0  # receivers' heights within this span get one altitude of the lattice
MAX_BUSY = 1.3  # ratio to the time of an idle machine from which on a plan reports it as busy


def build_scene(
    source: Annotated[str, typer.Argument(
        metavar="CITY", help="A map (.osm, .osm.pbf, .geojson, .gpkg, .shp, or a .zip of it, .json "
                             "of Overpass), a 3D city model (.city.json, .gml), a Mitsuba or "
                             "Sionna RT XML file, a model (.obj, .glb, .gltf, .stl, .ply), "
                             "sionna:NAME (munich, etoile, …), or preset:NAME (rbm, rdm, small).")],
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Scene folder to write [scenes/NAME].")] = None,
    check: Annotated[bool, typer.Option(
        "--check", help="Report only; exit status 2 if tracing would fail.")] = False,
    frequency_hz: Annotated[float | None, typer.Option(
        help="Frequency of the scene's radio [that of --measurements, or 2.4e9].")] = None,
    measurements: Annotated[Path | None, typer.Option(
        metavar="FILE", help="Measurements that the scene is for: their devices' frequency and "
                             "their receivers' heights are its own, unless options say others.")
        ] = None,
    material: Annotated[list[str] | None, typer.Option(
        metavar="NAME=ITU", help="Use an ITU material for the file's material NAME; of a map, for "
                                 "the value NAME of building:material, or default, ground or roof. "
                                 "May be repeated.")] = None,
    scale: Annotated[float | None, typer.Option(
        help="Factor from the file's unit to metres (feet: 0.3048).")] = None,
    up: Annotated[str | None, typer.Option(
        help="Axis of the file that points up: x, y or z [z; of glTF y].")] = None,
    bbox: Annotated[str | None, typer.Option(
        metavar="A,B,C,D", help="Keep only this part: XMIN,YMIN,XMAX,YMAX [m]; of a map S,W,N,E "
                                "[degrees].")] = None,
    height_default: Annotated[float | None, typer.Option(
        metavar="M", help="Height of buildings without one in a map [10].")] = None,
    height_column: Annotated[str | None, typer.Option(
        metavar="NAME[:UNIT]", help="Column of a map with the buildings' heights above ground; "
                                    "UNIT is m [default], ft, cm, mm or storeys.")] = None,
    ground_column: Annotated[str | None, typer.Option(
        metavar="NAME", help="Column with the elevation of the ground, where that of "
                             "--height-column is an elevation, too.")] = None,
    material_table: Annotated[Path | None, typer.Option(
        metavar="FILE.toml", help="Materials of a map's tags, where they differ from the standard "
                                  "table.")] = None,
    terrain: Annotated[Path | None, typer.Option(
        metavar="FILE.tif", help="Heights of a map's ground, a GeoTIFF; buildings stand on it "
                                 "[flat ground].")] = None,
    terrain_unit: Annotated[str | None, typer.Option(
        metavar="m|ft", help="Unit of the heights in a --terrain that names none [m; one whose "
                             "plan is in feet is refused].")] = None,
    layer: Annotated[list[str] | None, typer.Option(
        metavar="NAME", help="Layer of a GeoPackage, or Shapefile of an archive, with the "
                             "buildings [chosen by names and columns]. May be repeated.")] = None,
    crs: Annotated[str | None, typer.Option(
        metavar="EPSG:N", help="Coordinate reference system of a map that names none.")] = None,
    overpass: Annotated[bool, typer.Option(
        "--overpass", help="Download CITY, an .osm file that does not exist yet, for --bbox first; "
                           "needs a network.")] = False,
    devices: Annotated[int | None, typer.Option(
        min=0, help="Devices to place on free ground [0].")] = None,
    uavs: Annotated[int | None, typer.Option(
        min=0, help="UAVs to place near the middle [3].")] = None,
    seed: Annotated[int | None, typer.Option(
        min=0, max=MAX_SEED, help="Seed of the placement [0].")] = None,
    altitudes: Annotated[str | None, typer.Option(
        metavar="Z,…", help="Altitudes of the lattice [m], such as 1.5 for streets [three above "
                            "the roofs].")] = None,
    step: Annotated[float | None, typer.Option(
        help="Step of the lattice [m] [20, or less where the extent is small].")] = None,
    extent: Annotated[str | None, typer.Option(
        metavar="A,B,C,D", help="Extent of the lattice: XMIN,YMIN,XMAX,YMAX [m], of a map from its "
                                "origin [around the buildings].")] = None,
    origin: Annotated[str | None, typer.Option(
        metavar="LAT,LON[,ALT]", help="Where on the earth x = y = 0 is; ALT is the ground's "
                                      "altitude [m] [of a map its middle, of a city model "
                                      "unknown].")] = None,
) -> None:
    """Build a scene folder from a map or a city model.

    A report lists its contents and all problems that were found.
    """
    from radiotwin.scene.build import print_report

    heights_m = None if altitudes is None else parse_numbers("--altitudes", altitudes)
    if measurements is not None:
        measured_hz, measured_m = _measured(measurements, terrain is not None)
        frequency_hz, heights_m = frequency_hz or measured_hz, heights_m or measured_m
    report = rt.build_scene(
        source, out, frequency_hz=frequency_hz, materials=_pairs(material or []),
        bbox=_bounds(bbox), devices=devices, uavs=uavs, seed=seed, origin=parse_origin(origin),
        scale=scale, up=up, default_height_m=height_default, height_column=height_column,
        ground_column=ground_column, material_table=material_table, terrain=terrain,
        terrain_unit=terrain_unit, crs=crs, layers=layer or (), overpass=overpass, step_m=step,
        altitudes_m=heights_m, extent_m=parse_extent(extent), check_only=check)
    if overpass:
        say(f"wrote {source} (© OpenStreetMap contributors, ODbL)")
    print_report(report, console)
    result("scene", asdict(report))
    if report.folder:
        say(f"wrote {report.folder}: {', '.join(_content(report.folder))}")
    if report.tracing_would_fail:
        raise typer.Exit(2)


def _measured(path: Path, on_terrain: bool) -> tuple[float | None, list[float] | None]:
    """Return the devices' median frequency [Hz], and altitudes for the lattice [m] as measured.

    None, with a note, where unknown, or where heights are above the datum and there is terrain.
    """
    import numpy as np

    data = rt.read_measurements(path)
    frequency_hz = None
    if "frequency_hz" in data.devices and data.devices["frequency_hz"].notna().any():
        frequency_hz = float(data.devices["frequency_hz"].median())
    above = "receiver_above_ground_m" in data.table
    height_m = data.table["receiver_above_ground_m" if above else "receiver_z_m"].dropna()
    height_m = height_m[height_m > 0]
    altitudes_m = None
    if len(height_m) and (above or not on_terrain):
        few_m = np.quantile(height_m, (0.1, 0.5, 0.9)).round(1)
        altitudes_m = np.unique(few_m if np.ptp(few_m) > SAME_HEIGHT_M else few_m[1]).tolist()
    for what, value in (("frequency", frequency_hz), ("height that counts from the ground",
                                                      altitudes_m)):
        if value is None:
            say(f"note: {path} has no {what}: that of the scene is the default")
    return frequency_hz, altitudes_m


def export_scene(
    folder: SceneFolder,
    out: Annotated[Path, typer.Option(
        "--out", "-o", help="A folder (city.xml and meshes/*.ply for sionna.rt.load_scene, "
                            "devices.csv), or NAME.glb, NAME.gltf (y up), NAME.obj (z up).")],
    force: Force = False,
) -> None:
    """Write a scene's city in a format of other programs."""
    scene = rt.Scene.load(folder)
    for written in (out, *[out.with_suffix(".mtl")] * (out.suffix.lower() == ".obj")):
        keep_others(written, force)
    rt.export_scene(scene, out)
    say(f"wrote {out}" + (f": {', '.join(_content(out))}" if out.is_dir() else ""))


def export(
    source: Annotated[Path, typer.Argument(
        metavar="TWIN", help="Folder of a twin, or a radio map (.nc, .zarr) whose lattice "
                             "has the points.")],
    scene: SceneOption,
    points: PointsFile,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for nodes.csv and losses.csv.")],
    to: Annotated[str, typer.Option("--to", help="Program to write for: ns3.")] = "ns3",
    devices: OnlyDevices = None,
    force: Force = False,
) -> None:
    """Write the losses between devices and points for a network simulator.

    One loss for each pair: nothing moves.
    """
    if to != "ns3":
        raise BadInput(f"--to {to!r} is unknown; allowed is ns3")
    world = rt.Scene.load(scene)
    for name, mark in (("nodes.csv", "node"), ("losses.csv", "loss_db")):
        keep_inputs(out / name, points, *world.files)
        keep_others(out / name, force, mark)
    ends_m = rt.read_points(points, world.config.origin, world.city)
    with open_model(source) as model:
        pairs = rt.export_ns3(model, world, ends_m, out, devices=split_names(devices))
    say(f"wrote {out / 'nodes.csv'}, {out / 'losses.csv'}: {pairs:,} pairs of a device and a point")


def _content(folder: Path) -> list[str]:
    """Return the sorted names in a folder, those of folders with a slash."""
    return sorted(f"{path.name}/" if path.is_dir() else path.name for path in folder.iterdir())


def _pairs(texts: list[str]) -> dict[str, str]:
    """Parse values `NAME=ITU` of --material into ITU materials by name in the file."""
    pairs = {}
    for text in texts:
        name, equals, itu = text.partition("=")
        if not (name and equals and itu):
            raise BadInput(f"--material {text!r} is not NAME=ITU; for example --material "
                           "Roof=itu_metal")
        pairs[name] = itu
    return pairs


def _bounds(text: str | None) -> tuple[float, float, float, float] | None:
    """Parse the four numbers of --bbox; None for None."""
    if text is None:
        return None
    first, second, third, fourth = parse_numbers(
        "--bbox", text, 4, "XMIN,YMIN,XMAX,YMAX in metres, or of a map SOUTH,WEST,NORTH,EAST in "
        "degrees")
    return first, second, third, fourth


def trace(
    folder: SceneFolder,
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Radio map [SCENE/truth.nc, with --devices truth-A-B.nc].")] = None,
    quality: Quality = None,
    target_db: TargetDb = None,
    solver: Annotated[str, typer.Option(
        help="paths (gain at points) or map (mean over lattice cells).")] = "paths",
    combining: Combining = "power",
    diffraction: Diffraction = None,
    devices: OnlyDevices = None,
    radius: Radius = None,
    seed: RaySeed = 1,
    workers: Workers = "auto",
    cluster: Cluster = None,
    device: ComputeDevice = "auto",
    plan: Annotated[bool, typer.Option(
        "--plan", help="Only estimate time and memory, from a few batches: takes some seconds, and "
                       "the batches are kept for the run.")] = False,
    force: Force = False,
) -> None:
    """Ray-trace a scene's radio map, the truth, with Sionna RT.

    A killed run is resumed, a finished one is reused.
    """
    from radiotwin.runtime.cuda import tracing_device
    from radiotwin.runtime.execution import open_executor, worker_count
    from radiotwin.trace import truth_path

    used = tracing_device(device)
    scene, names = rt.Scene.load(folder), split_names(devices)
    out = out or truth_path(scene, names)
    keep_inputs(out, *scene.files)
    keep_others(out, force)
    settings = _settings(scene, scene.lattice.positions_m, names, quality, target_db, solver=solver,
                         combining=combining, diffraction=diffraction, seed=seed,
                         radius_m=radius, compute_device=used)
    worker_count(workers)  # a plan needs none, but a mistake is one
    if plan:
        _print_plan(scene, settings, names)
        return
    with open_executor(workers, cluster, notice) as executor:
        facts = rt.trace_map(scene, settings, out, names, executor).dataset.attrs
    say(f"wrote {out}: {facts['links']} links, {facts['links_detected']} detected, "
        f"{facts['links_below_sensitivity']} below sensitivity, {facts['links_without_path']} "
        f"without a path, {facts['links_inside_building']} inside buildings"
        + f", {facts['links_impossible']} impossible" * bool(facts["links_impossible"]))
    if "noise_floor_db" in facts:
        say(f"numerical noise: {facts['noise_floor_db']:.2f} dB RMS against ten times the rays; "
            f"nine links in ten are within {facts['noise_floor_p90_db']:.2f} dB")
    if "exchanged_nlos_db" in facts:
        say(f"ends exchanged, on {facts['exchanged_links']} links: {facts['exchanged_los_db']:.2f} "
            f"dB RMS in line of sight, {facts['exchanged_nlos_db']:.2f} dB without; without it "
            f"{100 * facts['exchanged_nlos_doubtful_share']:.0f} % differ by more than 6 dB")


def _print_plan(scene: "rt.Scene", settings: "rt.SolverSettings",
                devices: list[str] | None) -> None:
    """Print how much remains to be traced: batches, memory, and time by the number of workers."""
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
    diffraction: Diffraction = None,
    quality: Quality = None,
    target_db: TargetDb = None,
    radius: Radius = None,
    seed: RaySeed = 1,
    workers: Workers = "auto",
    cluster: Cluster = None,
    device: ComputeDevice = "auto",
    force: Force = False,
) -> None:
    """Ray-trace gains at any points.

    An empty gain has a reason, such as no path.
    """
    from radiotwin.runtime.cuda import tracing_device
    from radiotwin.runtime.execution import open_executor

    used = tracing_device(device)
    scene, names = rt.Scene.load(folder), split_names(devices)
    keep_inputs(out, points, *scene.files)
    keep_others(out, force, "device", "gain_db", "reason")
    points_m = rt.read_points(points, scene.config.origin, scene.city)
    settings = _settings(scene, points_m, names, quality, target_db, combining=combining,
                         diffraction=diffraction, seed=seed, radius_m=radius, compute_device=used)
    with rt.keep_pieces() as pieces, open_executor(workers, cluster, notice) as executor:
        table = rt.trace_points(scene, points_m, settings, out, names, executor)
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
    force: Force = False,
) -> None:
    """List the paths to any points: powers, delays, angles, interactions.

    Each link gets its delay spread, K factor and angular spreads. No ray tracer is needed.
    """
    scene = rt.Scene.load(folder)
    keep_inputs(out, points, *scene.files)
    keep_others(out, force)
    points_m = rt.read_points(points, scene.config.origin, scene.city)
    velocity_m_s = None if velocity is None else parse_numbers(
        "--velocity", velocity, 3, "VX,VY,VZ [m/s], such as 10,0,0 for eastwards")
    found = rt.list_paths(scene, points_m, out, split_names(devices), velocity_m_s, bandwidth_hz)
    reasons = found["reason"].to_series().value_counts()
    if scene.city.terrain is not None:
        say("the ground is a terrain: paths reflect off its triangles and diffract where it folds "
            "by more than 6 degrees; where it hides a point and there is none, the loss "
            "along its profile is listed as one (ITU-R P.526)")
    say(f"wrote {out}: {found.sizes['path']} paths of {found.sizes['link']} links"
        + "".join(f", {count} {reason}" for reason, count in reasons.items() if reason)
        + ("; gains include the antennas of scene.toml" if scene.has_antennas else ""))


def _settings(scene: "rt.Scene", points_m: "np.ndarray", devices: list[str] | None,
              quality: str | None, target_db: float | None, **others: str | int | float | None
              ) -> "rt.SolverSettings":
    """Return solver settings of a quality, or of the cheapest that reaches a target [dB].

    Error and time of each quality that was tried are printed.
    """
    if others["diffraction"] is None:
        del others["diffraction"]
    if target_db is None:
        return rt.SolverSettings.of_quality(quality or "default", **others)
    if quality is not None:
        raise BadInput("--quality and --target-db both say how many rays there are; give one")
    with rt.keep_pieces():
        tried = rt.choose_quality(scene, points_m, target_db, devices, **others)
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
    force: Force = False,
) -> None:
    """Fly the scene's UAVs through a truth map.

    Their measurements are written, with a table of the devices.
    """
    scene = rt.Scene.load(folder)
    for written in (out, out.parent / "devices.csv"):
        keep_inputs(written, *scene.files)
    keep_others(out, force, "flight", "receiver", "receiver_x_m", "device", "gain_db")
    measurements = rt.fly_survey(scene, rt.read_truth(scene, truth), flights=flights,
                                 pattern=pattern, seed=seed, noise_db=noise_db)
    measurements.save(out)
    missed = int(measurements.table["gain_db"].isna().sum())
    say(f"wrote {out}: {len(measurements.flights)} flights, {len(measurements.table)} links to "
        f"{len(measurements.devices)} devices ({int(measurements.is_anchor.sum())} anchors), "
        f"{missed} not detected")
