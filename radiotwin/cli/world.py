"""Commands that measure in a world: trace, gains, survey."""

from pathlib import Path
from typing import Annotated

import typer

from radiotwin.cli.scenes import SceneFolder
from radiotwin.console import say, show_warnings_plainly


def add_commands(app: typer.Typer) -> None:
    app.command("trace")(trace)
    app.command("gains")(gains)
    app.command("survey")(survey)


def trace(
    folder: SceneFolder,
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Radio map [SCENE/truth.nc, with --devices truth-A-B.nc].")] = None,
    quality: Annotated[str, typer.Option(help="fast, default or high.")] = "default",
    solver: Annotated[str, typer.Option(help="paths (gain at points) or map (mean over lattice cells).")] = "paths",
    combining: Annotated[str, typer.Option(help="power (sum of the paths' powers) or coherent (of their fields).")
                         ] = "power",
    devices: Annotated[str | None, typer.Option(metavar="A,B,…", help="Only these devices.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the rays.")] = 1,
) -> None:
    """Ray-trace the truth with Sionna RT. A killed run goes on where it was; a finished one is not done again."""
    from radiotwin.scene import Scene
    from radiotwin.trace import SolverSettings, trace_map

    show_warnings_plainly()
    scene = Scene.load(folder)
    settings = SolverSettings.of_quality(quality, solver=solver, combining=combining, seed=seed)
    names = devices.split(",") if devices else None
    out = out or folder / ("-".join(["truth", *(names or [])])[:100] + ".nc")
    facts = trace_map(scene, settings, out, names).dataset.attrs
    say(f"wrote {out}: {facts['links']} links, {facts['links_detected']} detected, {facts['links_below_sensitivity']} "
        f"below sensitivity, {facts['links_without_path']} without a path, {facts['links_inside_building']} inside "
        "buildings")
    if "noise_floor_db" in facts:
        say(f"numerical noise: {facts['noise_floor_db']:.2f} dB RMS against ten times the rays; nine links in ten are "
            f"within {facts['noise_floor_p90_db']:.2f} dB")


def gains(
    folder: SceneFolder,
    points: Annotated[Path, typer.Option(
        help="CSV file with x_m, y_m, z_m; or latitude_deg, longitude_deg, z_m, where the scene has an origin.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Table (.csv, .csv.gz), a row a link.")] = Path("gains.csv"),
    devices: Annotated[str | None, typer.Option(metavar="A,B,…", help="Only these devices.")] = None,
    combining: Annotated[str, typer.Option("--sum", help="power (of the paths' powers) or coherent (of their fields).")
                         ] = "power",
    quality: Annotated[str, typer.Option(help="fast, default or high.")] = "default",
    seed: Annotated[int, typer.Option(min=0, help="Of the rays.")] = 1,
) -> None:
    """Ray-trace gains at any points; an empty gain has a reason: no path, below sensitivity, …."""
    from radiotwin.scene import Scene
    from radiotwin.trace import SolverSettings, read_points, trace_points

    show_warnings_plainly()
    scene = Scene.load(folder)
    settings = SolverSettings.of_quality(quality, combining=combining, seed=seed)
    points_m = read_points(points, scene.config.origin)
    table = trace_points(scene, points_m, settings, out, devices.split(",") if devices else None)
    reasons = table.loc[table["reason"] != "", "reason"].value_counts()
    say(f"wrote {out}: {len(table)} links, {len(table) - reasons.sum()} with a gain"
        + "".join(f", {count} {reason}" for reason, count in reasons.items()))


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
    from radiotwin.survey import fly_survey, read_truth

    scene = Scene.load(folder)
    if noise_db is None:
        noise_db = 0.0 if truth == "segmented" else 1.0
    measurements = fly_survey(scene, read_truth(scene, truth), flights=flights, pattern=pattern, seed=seed,
                              noise_db=noise_db)
    measurements.write(out)
    missed = int(measurements.table["gain_db"].isna().sum())
    say(f"wrote {out}: {len(measurements.flights)} flights, {len(measurements.table)} links to "
        f"{len(measurements.devices)} devices ({int(measurements.is_anchor.sum())} anchors), {missed} not detected")
