"""The commands that build scenes and export them: build-scene, export-scene."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from radiotwin.cli.options import SceneFolder, parse_origin
from radiotwin.console import console, result, say
from radiotwin.errors import BadInput

if TYPE_CHECKING:
    from radiotwin.footprints.height_columns import HeightColumn
    from radiotwin.scene.report import BuildReport

Bounds = tuple[float, float, float, float]


def add_commands(app: typer.Typer) -> None:
    """Add the commands of this module to the app."""
    app.command("build-scene")(build_scene)
    app.command("export-scene")(export_scene)


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
    overpass: Annotated[bool, typer.Option(
        "--overpass", help="Download CITY, an .osm file that does not exist yet, for --bbox first; "
                           "needs a network.")] = False,
    devices: Annotated[int | None, typer.Option(
        min=0, help="Devices to place on free ground [0].")] = None,
    uavs: Annotated[int | None, typer.Option(
        min=0, help="UAVs to place near the middle [3].")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the placement [0].")] = None,
    origin: Annotated[str | None, typer.Option(
        metavar="LAT,LON[,ALT]", help="Where on the earth x = y = 0 is; ALT is the ground's "
                                      "altitude [m] [of a map its middle, of a city model "
                                      "unknown].")] = None,
) -> None:
    """Build a scene folder from a map or a city model.

    A report lists its contents and all problems that were found.
    """
    from radiotwin.footprints import map_suffix
    from radiotwin.scene.report import print_report
    from radiotwin.scene.sources import MAP_SUFFIXES

    common = _given(frequency_hz=frequency_hz, devices=devices, uavs=uavs, seed=seed,
                    origin=parse_origin(origin))
    of_cities = _given(scale=scale, up=up)
    of_maps = _given(height_default=height_default, height_column=height_column,
                     ground_column=ground_column, material_table=material_table,
                     overpass=overpass or None)
    pairs, bounds = _pairs(material or []), _bounds(bbox)
    if map_suffix(source):
        _refuse(of_cities, f"{source} is a map")
        report = _build_from_map(source, out, common, pairs, bounds, of_maps, check)
    else:
        _refuse(of_maps, f"{source} is not a map ({MAP_SUFFIXES})")
        options = common | of_cities | _given(materials=pairs or None, bbox=bounds)
        report = _build_from_city(source, out, options, check)
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


def _build_from_city(source: str, out: Path | None, options: dict[str, Any],
                     check: bool) -> "BuildReport":
    from radiotwin.scene.build import BuildOptions
    from radiotwin.scene.build import build_scene as build
    from radiotwin.scene.presets import build_preset_scene
    from radiotwin.scene.sources import scene_name

    if source.startswith("preset:"):
        if options:
            raise BadInput(f"{source} is built as it is published; the option for "
                           f"{', '.join(options)} cannot be used with it. Build it without, then "
                           "change scene.toml")
        name = source.removeprefix("preset:")
        return build_preset_scene(name, out or Path("scenes") / name, check_only=check)
    out = out or Path("scenes") / scene_name(source)
    return build(source, out, BuildOptions(**options), check_only=check)


def _build_from_map(source: str, out: Path | None, common: dict[str, Any], pairs: dict[str, str],
                    bbox_deg: Bounds | None, of_maps: dict[str, Any], check: bool) -> "BuildReport":
    from radiotwin.footprints import (
        MapOptions,
        build_scene_from_map,
        map_name,
        read_material_table,
        with_pairs,
    )
    from radiotwin.footprints.material_table import STANDARD
    from radiotwin.footprints.overpass import download_osm
    from radiotwin.scene.build import BuildOptions

    table = STANDARD
    if "material_table" in of_maps:
        table = read_material_table(of_maps["material_table"])
    options = MapOptions(bbox_deg, of_maps.get("height_default"), with_pairs(table, pairs),
                         _height_column(of_maps))
    options.check()
    if "overpass" in of_maps:
        if bbox_deg is None:
            raise BadInput("--overpass downloads an area; give it with --bbox "
                           "SOUTH,WEST,NORTH,EAST")
        download_osm(Path(source), bbox_deg)
        say(f"wrote {source} (© OpenStreetMap contributors, ODbL)")
    out = out or Path("scenes") / map_name(source)
    return build_scene_from_map(source, out, options, BuildOptions(**common), check)


def _height_column(of_maps: dict[str, Any]) -> "HeightColumn | None":
    from radiotwin.footprints.height_columns import declared_column

    if "height_column" in of_maps:
        return declared_column(of_maps["height_column"], of_maps.get("ground_column"))
    if "ground_column" in of_maps:
        raise BadInput("--ground-column is subtracted from the column of roofs; name that with "
                       "--height-column, too")
    return None


def _given(**options: Any) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def _refuse(options: dict[str, Any], reason: str) -> None:
    if options:
        names = ", ".join("--" + name.replace("_", "-") for name in options)
        raise BadInput(f"{reason}: {names} cannot be used with it; leave it out")


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
