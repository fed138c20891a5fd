"""Scenes from any source: a map, a city model, or a published scene."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from radiotwin.errors import BadInput
from radiotwin.io.forms import Origin, as_origin
from radiotwin.scene.build import BuildOptions, BuildReport
from radiotwin.scene.build import build_scene as build_from_city
from radiotwin.scene.folder import MAP_SUFFIXES, scene_name
from radiotwin.scene.materials import STANDARD, MaterialTable, read_material_table, with_materials
from radiotwin.scene.presets import build_preset_scene
from radiotwin.scene.readers.build import MapOptions, build_scene_from_map, map_name, map_suffix
from radiotwin.scene.readers.heights import HeightColumn, declared_column
from radiotwin.scene.readers.overpass import download_osm

PRESET = "preset:"
_OPTION = {"default_height_m": "height-default", "materials": "material"}


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
        frequency_hz: of the scene's radio [Hz]; None: 2.4 GHz.
        materials: name of a material in the file -> ITU material; of a map, value of
            `building:material`, `default` or `ground` -> ITU material.
        bbox: part to keep: (x_min, y_min, x_max, y_max) [m], or of a map (south, west, north, east)
            [degrees].
        devices: to place on free ground; None: 0.
        uavs: to place near the middle; None: 3.
        seed: of the placement; None: 0.
        origin: where on the earth x = y = 0 is: (latitude, longitude) [degrees] and optionally the
            ground's altitude [m]. None: of a map its middle, of a city model unknown.
        step_m: of the lattice [m]; None: 20, or less where the extent is small.
        altitudes_m: of the lattice [m]; None: three above the roofs.
        extent_m: of the lattice: (x_min, x_max, y_min, y_max) [m]; None: around the buildings.
        scale: of a city model: factor from the file's unit to metres.
        up: of a city model: axis of the file that points up, `x`, `y` or `z`.
        default_height_m: of a map: height of buildings without one [m]; None: 10, with a warning.
        height_column: of a map: column of heights, with its unit, such as `Hoehe:m` or
            `floors:storeys`; None: the columns that are known by name.
        ground_column: of a map: column of the ground's elevation, which is subtracted.
        material_table: of a map: materials of its tags, or the file that declares them.
        terrain: of a map: GeoTIFF of the ground's heights; None: flat ground.
        terrain_unit: of heights in a terrain that names none, `m` or `ft`.
        crs: of a map: coordinate reference system of a file that names none, as `EPSG:25832`.
        layers: of a map: those to read of a GeoPackage or an archive of Shapefiles; none: those
            that hold buildings.
        overpass: download the map `source`, an .osm file that does not exist yet, for `bbox`.
        check_only: write nothing, and return errors in the report instead of raising them.

    Returns:
        The report; `load_scene` of it returns the scene.

    Raises:
        BadInput: the source cannot be read, an option is impossible or not for this kind of source,
            or tracing would fail.
    """
    common = _given(frequency_hz=frequency_hz, devices=devices, uavs=uavs, seed=seed,
                    origin=as_origin(origin), step_m=step_m,
                    altitudes_m=None if altitudes_m is None else tuple(altitudes_m),
                    extent_m=extent_m)
    of_cities = _given(scale=scale, up=up)
    of_maps = _given(default_height_m=default_height_m, height_column=height_column,
                     ground_column=ground_column, material_table=material_table,
                     terrain=terrain, terrain_unit=terrain_unit, crs=crs,
                     layer=tuple(layers) or None, overpass=overpass or None)
    text = str(source)
    if map_suffix(source):
        _refuse(of_cities, f"{source} is a map")
        table = _material_table(material_table, materials or {})
        options = MapOptions(bbox, default_height_m, table,
                             _height_column(height_column, ground_column),
                             None if terrain is None else Path(terrain), crs, tuple(layers),
                             terrain_unit)
        options.check()
        if overpass:
            _download(source, bbox)
        return build_scene_from_map(source, folder or Path("scenes") / map_name(source), options,
                                    BuildOptions(**common), check_only)
    _refuse(of_maps, f"{source} is not a map ({MAP_SUFFIXES})")
    given = common | of_cities | _given(materials=materials or None, bbox=bbox)
    if not text.startswith(PRESET):
        return build_from_city(source, folder or Path("scenes") / scene_name(source),
                               BuildOptions(**given), check_only)
    if given:
        raise BadInput(f"{source} is built as it is published; the option for {', '.join(given)} "
                       "cannot be used with it. Build it without, then change scene.toml")
    name = text.removeprefix(PRESET)
    return build_preset_scene(name, folder or Path("scenes") / name, check_only=check_only)


def _height_column(column: str | None, ground: str | None) -> HeightColumn | None:
    if column is not None:
        return declared_column(column, ground)
    if ground is not None:
        raise BadInput("--ground-column is subtracted from the column of roofs; name that with "
                       "--height-column, too")
    return None


def _material_table(table: MaterialTable | Path | str | None,
                    pairs: Mapping[str, str]) -> MaterialTable:
    if not isinstance(table, MaterialTable):
        table = STANDARD if table is None else read_material_table(Path(table))
    return with_materials(table, dict(pairs))


def _download(path: Path | str, bbox_deg: tuple[float, float, float, float] | None) -> None:
    if bbox_deg is None:
        raise BadInput("--overpass downloads an area; give it with --bbox SOUTH,WEST,NORTH,EAST")
    download_osm(Path(path), bbox_deg)


def _given(**options: Any) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def _refuse(options: dict[str, Any], reason: str) -> None:
    if options:
        names = ", ".join("--" + _OPTION.get(name, name).replace("_", "-") for name in options)
        raise BadInput(f"{reason}: {names} cannot be used with it; leave it out")
