"""The commands that build scenes and export: build-scene, export-scene, export."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from radiotwin.cli.options import (
    MAX_SEED,
    OnlyDevices,
    PointsFile,
    SceneFolder,
    SceneOption,
    open_model,
    parse_bounds,
    parse_numbers,
    parse_origin,
    split_names,
)
from radiotwin.errors import BadInput
from radiotwin.runtime.console import console, result, say

Bounds = tuple[float, float, float, float]


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to the app."""
    app.command("build-scene")(build_scene)
    app.command("export-scene")(export_scene)
    app.command("export")(export)


def build_scene(
    source: Annotated[str, typer.Argument(
        metavar="CITY", help="A map (.osm, .osm.pbf, .geojson, .gpkg, .shp, or a .zip of it), a 3D "
                             "city model (.city.json, .gml), a Mitsuba or Sionna RT XML file, a "
                             "model (.obj, .glb, .gltf, .stl, .ply), sionna:NAME (munich, etoile, "
                             "…), or preset:NAME (rbm, rdm, small).")],
    out: Annotated[Path | None, typer.Option(
        "--out", "-o", help="Scene folder to write [scenes/NAME].")] = None,
    check: Annotated[bool, typer.Option(
        "--check", help="Report only; exit status 2 if tracing would fail.")] = False,
    frequency_hz: Annotated[float | None, typer.Option(
        help="Frequency of the scene's radio [2.4e9].")] = None,
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
                                    "UNIT is m [default], ft, cm or storeys.")] = None,
    ground_column: Annotated[str | None, typer.Option(
        metavar="NAME", help="Column with the elevation of the ground, where that of "
                             "--height-column is an elevation, too.")] = None,
    material_table: Annotated[Path | None, typer.Option(
        metavar="FILE.toml", help="Materials of a map's tags, where they differ from the standard "
                                  "table.")] = None,
    terrain: Annotated[Path | None, typer.Option(
        metavar="FILE.tif", help="Heights of a map's ground, a GeoTIFF; buildings stand on it "
                                 "[flat ground].")] = None,
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
    from radiotwin.scene.readers import build_scene as build

    report = build(source, out, frequency_hz=frequency_hz, materials=_pairs(material or []),
                   bbox=_bounds(bbox), devices=devices, uavs=uavs, seed=seed,
                   origin=parse_origin(origin), scale=scale, up=up,
                   default_height_m=height_default, height_column=height_column,
                   ground_column=ground_column, material_table=material_table,
                   terrain=terrain, crs=crs, overpass=overpass, step_m=step,
                   altitudes_m=None if altitudes is None else
                   parse_numbers("--altitudes", altitudes),
                   extent_m=None if extent is None else parse_bounds("--extent", extent),
                   check_only=check)
    if overpass:
        say(f"wrote {source} (© OpenStreetMap contributors, ODbL)")
    print_report(report, console)
    result("scene", asdict(report))
    if report.folder:
        say(f"wrote {report.folder}: {', '.join(_content(report.folder))}")
    if report.tracing_would_fail:
        raise typer.Exit(2)


def export_scene(
    folder: SceneFolder,
    out: Annotated[Path, typer.Option(
        "--out", "-o", help="A folder (city.xml and meshes/*.ply for sionna.rt.load_scene, "
                            "devices.csv), or NAME.glb, NAME.gltf (y up), NAME.obj (z up).")],
) -> None:
    """Write a scene's city in a format of other programs."""
    from radiotwin.scene import Scene
    from radiotwin.scene.export import export_scene as export

    scene = Scene.load(folder)
    export(scene, out)
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
) -> None:
    """Write the losses between devices and points for a network simulator.

    One loss for each pair: nothing moves.
    """
    from radiotwin.io.inputs import keep_inputs
    from radiotwin.scene import Scene
    from radiotwin.scene.folder import files_of
    from radiotwin.trace import read_points
    from radiotwin.twin.point_gains import export_ns3

    if to != "ns3":
        raise BadInput(f"--to {to!r} is unknown; allowed is ns3")
    world = Scene.load(scene)
    for name in ("nodes.csv", "losses.csv"):
        keep_inputs(out / name, points, *files_of(world))
    ends_m = read_points(points, world.config.origin, world.city)
    with open_model(source) as model:
        pairs = export_ns3(model, world, ends_m, out, devices=split_names(devices))
    say(f"wrote {out / 'nodes.csv'}, {out / 'losses.csv'}: {pairs:,} pairs of a device and a point")


def _content(folder: Path) -> list[str]:
    return sorted(f"{path.name}/" if path.is_dir() else path.name for path in folder.iterdir())


def _pairs(texts: list[str]) -> dict[str, str]:
    pairs = {}
    for text in texts:
        name, equals, itu = text.partition("=")
        if not (name and equals and itu):
            raise BadInput(f"--material {text!r} is not NAME=ITU; for example --material "
                           "Roof=itu_metal")
        pairs[name] = itu
    return pairs


def _bounds(text: str | None) -> Bounds | None:
    if text is None:
        return None
    try:
        first, second, third, fourth = (float(part) for part in text.split(","))
    except ValueError:
        raise BadInput(f"--bbox {text!r} is not four numbers; give XMIN,YMIN,XMAX,YMAX in metres, "
                       "or of a map SOUTH,WEST,NORTH,EAST in degrees") from None
    return first, second, third, fourth
