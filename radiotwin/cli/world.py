"""Commands that make a world and measure in it: build-scene, trace, survey."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from radiotwin.cli.console import console, result, say, show_warnings_plainly
from radiotwin.errors import BadInput

SceneFolder = Annotated[Path, typer.Argument(metavar="SCENE", help="Scene folder, as `build-scene` makes it.")]


def add_commands(app: typer.Typer) -> None:
    app.command("build-scene")(build_scene)
    app.command("trace")(trace)
    app.command("survey")(survey)


def build_scene(
    source: Annotated[str, typer.Argument(
        metavar="CITY", help="A Mitsuba or Sionna RT XML file, or sionna:NAME (munich, etoile, …), or preset:NAME "
                             "(rbm, rdm, small).")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Scene folder to write [scenes/NAME].")] = None,
    check: Annotated[bool, typer.Option("--check", help="Report only; exit status 2 if tracing would fail.")] = False,
    frequency_hz: Annotated[float | None, typer.Option(help="Frequency of the scene's radio [2.4e9].")] = None,
    material: Annotated[list[str] | None, typer.Option(
        metavar="NAME=ITU", help="Take the file's material NAME for an ITU material; may be repeated.")] = None,
    scale: Annotated[float | None, typer.Option(help="Factor from the file's unit to metres (feet: 0.3048).")] = None,
    up: Annotated[str | None, typer.Option(help="Axis of the file that points up: x, y or z.")] = None,
    bbox: Annotated[str | None, typer.Option(
        metavar="XMIN,YMIN,XMAX,YMAX", help="Keep only this part of the city [m].")] = None,
    devices: Annotated[int | None, typer.Option(min=0, help="Devices to place on free ground [0].")] = None,
    uavs: Annotated[int | None, typer.Option(min=0, help="UAVs to place near the middle [3].")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Of the placement [0].")] = None,
) -> None:
    """Turn a city model into a scene folder, and report what is in it and what is wrong with it."""
    from radiotwin.scene.build import BuildOptions
    from radiotwin.scene.build import build_scene as build
    from radiotwin.scene.presets import build_preset_scene
    from radiotwin.scene.report import print_report
    from radiotwin.scene.sources import scene_name

    show_warnings_plainly()
    given: dict[str, Any] = {
             "frequency_hz": frequency_hz, "materials": _pairs(material or []) or None, "scale": scale, "up": up,
             "bbox": _box(bbox), "devices": devices, "uavs": uavs, "seed": seed}
    given = {name: value for name, value in given.items() if value is not None}
    if source.startswith("preset:"):
        if given:
            raise BadInput(f"{source} is built as it is published; the option for {', '.join(given)} cannot be used "
                           "with it. Build it without, then change scene.toml")
        name = source.removeprefix("preset:")
        report = build_preset_scene(name, out or Path("scenes") / name, check_only=check)
    else:
        report = build(source, out or Path("scenes") / scene_name(source), BuildOptions(**given), check_only=check)
    print_report(report, console)
    result("scene", asdict(report))
    if report.folder:
        say(f"wrote {report.folder}: scene.toml, city.xml, meshes/, preview.png")
    if report.tracing_would_fail:
        raise typer.Exit(2)


def trace(
    folder: SceneFolder,
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Radio map [SCENE/truth.nc, with --devices truth-A-B.nc]; with --points a CSV file "
                            "[gains.csv].")] = None,
    quality: Annotated[str, typer.Option(help="fast, default or high.")] = "default",
    solver: Annotated[str, typer.Option(help="paths (gain at points) or map (mean over lattice cells).")] = "paths",
    combining: Annotated[str, typer.Option(help="power (sum of the paths' powers) or coherent (of their fields).")
                         ] = "power",
    devices: Annotated[str | None, typer.Option(metavar="A,B,…", help="Only these devices.")] = None,
    points: Annotated[Path | None, typer.Option(
        help="CSV file with x_m, y_m, z_m: gains at these points, not over the lattice.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the rays.")] = 1,
) -> None:
    """Ray-trace the truth with Sionna RT. A killed run goes on where it was; a finished one is not done again."""
    from radiotwin.scene import Scene
    from radiotwin.trace import SolverSettings, read_points, trace_map, trace_points

    show_warnings_plainly()
    scene = Scene.load(folder)
    settings = SolverSettings.of_quality(quality, solver=solver, combining=combining, seed=seed)
    names = devices.split(",") if devices else None
    if points is not None:
        out = out or Path("gains.csv")
        table = trace_points(scene, read_points(points), settings, out, names)
        detected = int(table["gain_db"].notna().sum())
        say(f"wrote {out}: {len(table)} links, {detected} detected")
        return
    out = out or folder / ("-".join(["truth", *(names or [])])[:100] + ".nc")
    facts = trace_map(scene, settings, out, names).dataset.attrs
    say(f"wrote {out}: {facts['links']} links, {facts['links_detected']} detected, {facts['links_below_sensitivity']} "
        f"below sensitivity, {facts['links_without_path']} without a path, {facts['links_inside_building']} inside "
        "buildings")
    if "noise_floor_db" in facts:
        say(f"numerical noise: {facts['noise_floor_db']:.2f} dB RMS against ten times the rays; nine links in ten are "
            f"within {facts['noise_floor_p90_db']:.2f} dB")


def survey(
    folder: SceneFolder,
    out: Annotated[Path, typer.Option("--out", "-o", help="Measurements (.csv, .csv.gz, .parquet); devices.csv goes "
                                                          "beside it.")] = Path("survey/measurements.csv"),
    truth: Annotated[str, typer.Option(help="traced (SCENE/truth.nc), segmented (statistical), or a radio map.")
                     ] = "traced",
    flights: Annotated[int, typer.Option(help="Flights; every UAV flies each.")] = 5,
    pattern: Annotated[str, typer.Option(help="random-waypoint, lawnmower or random-walk.")] = "random-waypoint",
    noise_db: Annotated[float | None, typer.Option(
        help="Standard deviation of the receivers' error [1; 0 for --truth segmented, whose law has its own].")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of paths and noise.")] = 0,
) -> None:
    """Fly the scene's UAVs through a truth map and write what they measure."""
    from radiotwin.scene import Scene
    from radiotwin.survey import fly_survey

    scene = Scene.load(folder)
    if noise_db is None:
        noise_db = 0.0 if truth == "segmented" else 1.0
    measurements = fly_survey(scene, read_truth(scene, truth), flights=flights, pattern=pattern, seed=seed,
                              noise_db=noise_db)
    measurements.write(out)
    missed = int(measurements.table["gain_db"].isna().sum())
    say(f"wrote {out}: {len(measurements.flights)} flights, {len(measurements.table)} links to "
        f"{len(measurements.devices)} devices ({int(measurements.is_anchor.sum())} anchors), {missed} not detected")


def read_truth(scene, truth: str):
    """The radio map that `--truth` names."""
    from radiotwin.radiomap import RadioMap
    from radiotwin.survey import segmented_truth

    if truth == "segmented":
        return segmented_truth(scene)
    if truth == "traced":
        path = scene.folder / "truth.nc"
        if not path.is_file():
            raise BadInput(f"{path} does not exist; run `radiotwin trace {scene.folder}` first, or use "
                           "--truth segmented")
        return RadioMap.read(path)
    return RadioMap.read(truth)


def _pairs(texts: list[str]) -> dict[str, str]:
    pairs = {}
    for text in texts:
        name, equals, itu = text.partition("=")
        if not (name and equals and itu):
            raise BadInput(f"--material {text!r} is not NAME=ITU; for example --material Roof=itu_metal")
        pairs[name] = itu
    return pairs


def _box(text: str | None) -> tuple[float, float, float, float] | None:
    if text is None:
        return None
    try:
        x_min, y_min, x_max, y_max = (float(part) for part in text.split(","))
    except ValueError:
        raise BadInput(f"--bbox {text!r} is not four numbers; give XMIN,YMIN,XMAX,YMAX in metres") from None
    return x_min, y_min, x_max, y_max
