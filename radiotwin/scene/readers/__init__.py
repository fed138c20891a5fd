"""`build_scene`: a scene folder from any source (map, city model, published scene)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from radiotwin.errors import BadInput
from radiotwin.io.forms import Origin, as_origin
from radiotwin.scene.build import BuildOptions, BuildReport
from radiotwin.scene.build import build_scene as build_from_city
from radiotwin.scene.folder import MAP_SUFFIXES, scene_name
from radiotwin.scene.materials import MaterialTable, read_material_table
from radiotwin.scene.presets import build_preset_scene
from radiotwin.scene.readers.build import (
    build_scene_from_map,
    check_map_options,
    map_name,
    map_suffix,
)
from radiotwin.scene.readers.overpass import download_osm

PRESET = "preset:"
# Options of the command whose names differ from the arguments'
_OPTION = {"default_height_m": "height-default", "materials": "material", "layers": "layer"}


def build_scene(
    source: Path | str, folder: Path | str | None = None, *,
    frequency_hz: float | None = None, materials: Mapping[str, str] | None = None,
    bbox: tuple[float, float, float, float] | None = None, devices: int | None = None,
    uavs: int | None = None, seed: int | None = None,
    origin: Origin | Sequence[float] | None = None, step_m: float | None = None,
    altitudes_m: Sequence[float] | None = None,
    extent_m: tuple[float, float, float, float] | None = None, scale: float | None = None,
    up: str | None = None, default_height_m: float | None = None,
    height_column: str | None = None, ground_column: str | None = None,
    material_table: MaterialTable | Path | str | None = None,
    terrain: Path | str | None = None, terrain_unit: str | None = None, crs: str | None = None,
    layers: Sequence[str] = (), overpass: bool = False, check_only: bool = False,
) -> BuildReport:
    """Build a scene folder from a map or a city model, and report on it.

    Args:
        source: map (`.osm`, `.osm.pbf`, `.geojson`, `.gpkg`, `.parquet`, `.shp`, `.city.json`,
            `.gml`), model (`.obj`, `.glb`, `.gltf`, `.stl`, `.ply`), Mitsuba or Sionna RT XML file,
            `sionna:NAME`, or `preset:NAME`, which takes no option but `check_only`.
        folder: scene folder to write; a scene that is already in it is replaced. None:
            `scenes/NAME`.
        frequency_hz: frequency of the scene's radio [Hz]; None: 2.4 GHz.
        materials: name of a material in the file -> ITU material. For a map: `default`, `ground`,
            `roof` or a value of `building:material` -> ITU material.
        bbox: part to keep: (x_min, y_min, x_max, y_max) [m]; of a map (south, west, north, east)
            [degrees].
        devices: number of devices to place on free ground; None: 0.
        uavs: number of UAVs to place near the middle; None: 3.
        seed: seed of the placement; None: 0.
        origin: WGS84 position of x = y = 0: (latitude, longitude) [degrees] and optionally the
            ground's altitude [m]. None: the middle of a map, unknown for a city model.
        step_m: step of the lattice [m]; None: 20, or less if the extent is small.
        altitudes_m: altitudes of the lattice [m]; None: three above the roofs.
        extent_m: (x_min, x_max, y_min, y_max) of the lattice [m]; None: around the buildings.
        scale: city model: factor from the file's unit to metres.
        up: city model: axis of the file that points up, `x`, `y` or `z`.
        default_height_m: map: height of buildings without one [m]; None: 10, with a warning.
        height_column: map: column of heights, with its unit, such as `Hoehe:m` or
            `floors:storeys`; None: columns that are known by name.
        ground_column: map: column of the ground's elevation, which is subtracted from
            `height_column`.
        material_table: map: materials by tag, or the TOML file that declares them.
        terrain: map: GeoTIFF of the ground's heights; None: flat ground.
        terrain_unit: map: unit of the heights in a terrain that names none, `m` or `ft`.
        crs: map: coordinate reference system of a file that names none, such as `EPSG:25832`.
        layers: map: layers to read of a GeoPackage or an archive of Shapefiles; empty: those with
            buildings.
        overpass: first download the map `source`, an .osm file that does not exist, for `bbox`.
        check_only: write nothing, and return errors in the report instead of raising them.

    Returns:
        The report; `load_scene` of it returns the scene.

    Raises:
        BadInput: the source cannot be read, an option is impossible or not for this kind of source,
            or tracing would fail.
    """
    for_all = _given(frequency_hz=frequency_hz, devices=devices, uavs=uavs, seed=seed,
                     origin=as_origin(origin), step_m=step_m,
                     altitudes_m=None if altitudes_m is None else tuple(altitudes_m),
                     extent_m=extent_m, bbox=bbox, materials=materials or None)
    for_cities = _given(scale=scale, up=up)
    for_maps = _given(default_height_m=default_height_m, height_column=height_column,
                      ground_column=ground_column, material_table=material_table,
                      terrain=terrain, terrain_unit=terrain_unit, crs=crs,
                      layers=tuple(layers) or None)
    if map_suffix(source):
        _refuse(for_cities, f"{source} is a map")
        if material_table is not None and not isinstance(material_table, MaterialTable):
            for_maps["material_table"] = read_material_table(material_table)
        options = BuildOptions(**for_all, **for_maps)
        if overpass:
            check_map_options(options)
            if bbox is None:
                raise BadInput("--overpass downloads an area; give it with --bbox "
                               "SOUTH,WEST,NORTH,EAST")
            download_osm(Path(source), bbox)
        return build_scene_from_map(source, folder or Path("scenes") / map_name(source), options,
                                    check_only)
    _refuse(for_maps | _given(overpass=overpass or None),
            f"{source} is not a map ({MAP_SUFFIXES})")
    if not str(source).startswith(PRESET):
        return build_from_city(source, folder or Path("scenes") / scene_name(source),
                               BuildOptions(**for_all, **for_cities), check_only)
    if given := for_all | for_cities:
        raise BadInput(f"{source} is built as it is published; the option for {', '.join(given)} "
                       "cannot be used with it. Build it without, then change scene.toml")
    name = str(source).removeprefix(PRESET)
    return build_preset_scene(name, folder or Path("scenes") / name, check_only=check_only)


def _given(**options: Any) -> dict[str, Any]:
    """Return the options that are not None."""
    return {name: value for name, value in options.items() if value is not None}


def _refuse(options: dict[str, Any], reason: str) -> None:
    """Raise BadInput if any option was given; all do not apply to the source."""
    if options:
        names = ", ".join("--" + _OPTION.get(name, name).replace("_", "-") for name in options)
        raise BadInput(f"{reason}: {names} cannot be used with it; leave it out")
