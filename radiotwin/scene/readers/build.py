"""Build a scene folder from a map, with a table of all buildings (`buildings.csv`)."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import shapely

from radiotwin.errors import BadInput
from radiotwin.geo import to_local
from radiotwin.io.budgets import FEATURES, SHAPES
from radiotwin.io.forms import Origin
from radiotwin.io.inputs import check_input
from radiotwin.scene import checks
from radiotwin.scene.build import BuildOptions, BuildReport, Declared, check_target, finish_scene
from radiotwin.scene.checks import Problem
from radiotwin.scene.folder import scene_name, source_text
from radiotwin.scene.importer import ImportedCity
from radiotwin.scene.materials import (
    RESERVED_NAMES,
    Material,
    MaterialTable,
    Names,
    itu_material,
    safe_name,
    with_materials,
)
from radiotwin.scene.placement import choose_extent, make_extent
from radiotwin.scene.readers.citygml import read_citygml
from radiotwin.scene.readers.extrude import make_blocks, split_roof
from radiotwin.scene.readers.features import (
    READ_TAGS,
    Feature,
    MapFile,
    OutlineBudget,
    check_crowding,
    left_out_problems,
    problems_of,
)
from radiotwin.scene.readers.gis_files import (
    LINES,
    read_geojson,
    read_geopackage,
    read_geoparquet,
    read_json_map,
)
from radiotwin.scene.readers.heights import (
    KNOWN,
    MAX_HEIGHT_M,
    READ_COLUMNS,
    HeightColumn,
    check_declared,
    column_name,
    declared_column,
    height_sds_m,
    listed_names,
    no_height_text,
)
from radiotwin.scene.readers.heights import source_text as height_text
from radiotwin.scene.readers.osm import assemble, read_osm_pbf, read_osm_xml
from radiotwin.scene.readers.plausible import implausible_heights
from radiotwin.scene.readers.shapefiles import read_shapefile
from radiotwin.scene.readers.solids import (
    Contacts,
    Prism,
    elevation_fact,
    find_contacts,
    make_prisms,
    make_shell_prisms,
    overlap_problems,
)
from radiotwin.scene.readers.systems import check_declared_system
from radiotwin.scene.readers.terrain import Ground, make_ground, raise_to_terrain
from radiotwin.scene.readers.vegetation import make_vegetation, vegetation_fact
from radiotwin.scene.streets import cut_streets
from radiotwin.scene.surfaces import Surfaces

OSM_SUFFIXES = (".osm", ".osm.pbf")
READERS: dict[str, Callable[[Path, str | None], MapFile]] = {
    ".osm": lambda path, _: assemble(read_osm_xml(path)),
    ".osm.pbf": lambda path, _: assemble(read_osm_pbf(path)),
    ".geojson": read_geojson, ".gpkg": read_geopackage,
    ".parquet": read_geoparquet,
    ".shp": read_shapefile, ".zip": read_shapefile,
    **dict.fromkeys((".city.json", ".city.json.gz", ".json", ".json.gz", ".cityjson",
                     ".geojson.gz", *LINES), read_json_map),
    ".gml": read_citygml, ".citygml": read_citygml}
LAYERED = {".gpkg": read_geopackage, ".zip": read_shapefile}  # files that may have layers
GROUND = "ground"  # name of the ground's shape
GROUND_MARGIN_M = 100.0  # [m], the ground extends this far beyond buildings and extent
MAX_WIDTH_M = 50e3  # [m], chosen so that a plane and single precision are good enough
ORIGIN_DECIMALS = 6  # of latitude and longitude [degrees]: a decimetre
DEFAULT_HEIGHT_M = 10.0  # [m], about three storeys
Bounds = tuple[float, float, float, float]


def _building_table(prisms: Sequence[Prism], shape_of: Mapping[int, str],
                   on_terrain: bool = False) -> pd.DataFrame:
    """Return the table of buildings, one row per prism (a building, or a part with its own height).

    x_m and y_m are a point inside, ground_m is the lowest ground under the building; bottom_m and
    top_m are above the datum. `shape_of` maps the index of a prism to the name of its shape.
    """
    rows, heights_sd_m = [], height_sds_m(
        np.array([prism.height.top_m - prism.ground_m for prism in prisms]),
        np.array([prism.height.sd_m for prism in prisms]))
    for index, prism in enumerate(prisms):
        inside = prism.area.representative_point()
        rows.append({
            "building": prism.name, "shape": shape_of.get(index, ""),
            "x_m": round(inside.x, 2), "y_m": round(inside.y, 2),
            "area_m2": round(prism.area.area, 1),
            **({"ground_m": prism.ground_m} if on_terrain else {}),
            "bottom_m": round(prism.height.bottom_m, 3),
            "top_m": round(prism.height.top_m, 3), "height_from": prism.height.source,
            "height_sd_m": round(float(heights_sd_m[index]), 1),
            "unusable": "; ".join(prism.height.unusable), "material": prism.material.name,
            "material_from": prism.material_from})
    return pd.DataFrame(rows)


def check_map_options(options: BuildOptions) -> None:
    """Raise BadInput if an option for building a scene from a map has an impossible value."""
    with_materials(options.material_table, options.materials or {})
    height_m = options.default_height_m
    if height_m is not None and not 0 < height_m <= MAX_HEIGHT_M:
        raise BadInput(f"a default height of {height_m:g} m is not possible; give more than 0 and "
                       f"at most {MAX_HEIGHT_M:g} m")
    if options.crs is not None:
        check_declared_system(options.crs)
    if options.terrain_unit not in (None, "m", "ft"):
        raise BadInput(f"--terrain-unit {options.terrain_unit!r} is not possible; give m or ft")
    if options.terrain_unit is not None and options.terrain is None:
        raise BadInput("--terrain-unit is that of a terrain; give one with --terrain FILE.tif")
    if options.ground_column is not None and options.height_column is None:
        raise BadInput("--ground-column is subtracted from the column of roofs; name that with "
                       "--height-column, too")
    if options.bbox is not None:
        south, west, north, east = options.bbox
        if not (-90 <= south < north <= 90 and -180 <= west < east <= 180):
            raise BadInput(f"bbox {options.bbox} is not possible; give SOUTH,WEST,NORTH,EAST in "
                           "degrees, the south below the north and the west below the east")
    options.check()


def map_suffix(source: Path | str) -> str | None:
    """Return the suffix of a map file's name, a key of `READERS`; None for other files."""
    name = str(source).lower()
    return next((suffix for suffix in READERS if name.endswith(suffix)), None)


def map_name(source: Path | str) -> str:
    """Return the name of the scene made from a map.

    >>> map_name("data/old town.osm.pbf")
    'old_town'
    """
    text = str(source)
    return scene_name(f"{text[:len(text) - len(map_suffix(source) or '')]}.osm")


def build_scene_from_map(
    source: Path | str, out_folder: Path | str, options: BuildOptions | None = None,
    check_only: bool = False,
) -> BuildReport:
    """Read footprints, extrude them, and write a scene folder with a table of all buildings.

    Args:
        source: file with one of the endings of `READERS`.
        out_folder: scene folder to write; a scene in it is replaced.
        options: how to read the map, and what to add to it, without `scale` and `up`; None: the
            defaults.
        check_only: write nothing.

    Raises:
        BadInput: the file cannot be read, holds no buildings (in the box), or an option is
            impossible.
    """
    path, out_folder = Path(source), Path(out_folder)
    options = options or BuildOptions()
    check_map_options(options)
    height_column = None if options.height_column is None else declared_column(
        options.height_column, options.ground_column)
    materials = with_materials(options.material_table, options.materials or {})
    default_m = options.default_height_m or DEFAULT_HEIGHT_M
    if not check_only:
        check_target(out_folder, source=path)
    check_input(path, f"map ({', '.join(READERS)})")
    suffix = map_suffix(path)
    if suffix is None:
        raise BadInput(f"{path} is not a map; allowed are {', '.join(READERS)}")
    if options.crs is not None and suffix in OSM_SUFFIXES:
        raise BadInput(f"{path} is in longitude and latitude, as all of OpenStreetMap; leave --crs "
                       "out")
    if suffix in LAYERED:
        found = LAYERED[suffix](path, options.crs, options.layers)
    elif options.layers:
        raise BadInput(f"{path} has no layers; leave --layer out (it is for {', '.join(LAYERED)})")
    else:
        found = READERS[suffix](path, options.crs)
    FEATURES.check(len(found.features), path)
    left_out = left_out_problems(found.left_out, options.bbox)
    if not found.features:
        raise BadInput("\n".join([
            f"{path} holds no buildings (closed ways or multipolygons with the tag building or "
            "building:part; of a table polygons); export an area or a layer that has some",
            *(problem.message for problem in [*found.problems, *left_out])]))
    features = _features_in_box(found.features, options.bbox, path)
    SHAPES.check(len(features), path)
    check_crowding(shapely.bounds([feature.area for feature in features]), path)
    origin = options.origin or _middle_of(features, options.bbox)
    _check_sizes(features, origin, path)
    if height_column is not None:
        check_declared(height_column, [one.tags for one in features], path)
    flat, shells = ([one for one in features if (one.shell is not None) == has_shell]
                    for has_shell in (False, True))
    prisms, problems = make_prisms(flat, origin, materials, default_m, height_column)
    models, model_problems = make_shell_prisms(shells, origin, materials)
    prisms += models
    _check_unit(prisms, found.plan_m, height_column, path)
    problems = (found.problems + left_out + problems + model_problems
                + _default_height_problems(prisms, features, options.default_height_m, path)
                + implausible_heights([(prism.name, prism.height,
                                        prism.building_footprint or prism.area)
                                       for prism in prisms],
                                      {feature.name: feature.tags for feature in features}))
    if not prisms:
        raise BadInput("\n".join([f"{path}: none of its {len(features)} buildings can be used; "
                                  "correct what is wrong with them:",
                                  *(problem.message for problem in problems)]))
    around = choose_extent(_bounds_m(prisms, origin, options.bbox))
    extent = around if options.extent_m is None else make_extent(options.extent_m)
    _check_width(max(np.ptp(extent.bounds[:2]), np.ptp(extent.bounds[2:])), MAX_WIDTH_M)
    ground = make_ground(None if options.terrain is None else Path(options.terrain), origin,
                         _ground_box(prisms, extent.bounds), GROUND, options.terrain_unit)
    if ground.config is not None:
        origin = origin.model_copy(update={"altitude_m": ground.config.datum_m})
        prisms = raise_to_terrain(prisms, ground)
    contacts = find_contacts(prisms)
    problems += [*overlap_problems(prisms, contacts), *ground.problems]
    city, shape_of = _assemble_city(prisms, contacts, ground, materials, problems)
    table = _building_table(prisms, shape_of, ground.config is not None)
    counts = Counter(table.drop_duplicates(["building", "height_from"])["height_from"])
    box_m = _enclosing_box(around.bounds, extent.bounds)
    vegetation, unusable = make_vegetation(found.vegetation, origin, box_m)
    city.problems.extend(unusable)
    heights = [f"{height_text(key, height_column)}: {number:,}" for key, number in counts.items()
               if key != "default"]
    heights.append(f"default: {counts['default']:,} ({default_m:g} m)")
    facts = (
        ("buildings", f"{table['building'].nunique():,} in {len(set(shape_of.values())):,} blocks"),
        ("heights from", ", ".join(heights)),
        *([("elevations", elevation_fact(shells))] if shells else []),
        ("ground", ground.fact),
        *([("vegetation", vegetation_fact(vegetation))] if vegetation else []),
        ("origin", f"latitude {origin.latitude_deg}, longitude {origin.longitude_deg}"),
        *_unused_fact(found, features, materials, height_column))
    provenance = {"source": source_text(source), "seed": str(options.seed),
                  "height_default_m": f"{default_m:g}",
                  "heights_from": ", ".join(f"{key} {number}" for key, number in counts.items())}
    if options.bbox is not None:
        provenance["bbox_deg"] = ", ".join(map(repr, options.bbox))
    declared = Declared(str(source), map_name(source), extent, origin, provenance, facts,
                        vegetation, ground.config, cut_streets(found.streets, origin, box_m))
    return finish_scene(city, declared, out_folder, options, check_only, table)


def _unused_fact(found: MapFile, features: list[Feature], materials: MaterialTable,
                 declared: HeightColumn | None) -> tuple[tuple[str, str], ...]:
    """Return a row of the report (subject, text) on tags, columns and layers not used, or ()."""
    used = READ_COLUMNS | READ_TAGS | set(materials.by_tag) | (
        {declared.name, declared.ground} if declared else set())
    names = {key for feature in features for key in feature.tags} | {
        column_name(name) for name in found.columns}
    unused = [f"tags or columns {listed_names(names - used)}"] * bool(names - used)
    unused += [f"layers {listed_names(found.layers)}"] * bool(found.layers)
    return (("not used", "; ".join(unused)),) if unused else ()


def _default_height_problems(prisms: list[Prism], features: list[Feature],
                             default_height_m: float | None, path: Path) -> list[Problem]:
    """Return a warning if buildings have the default height, and the user did not choose it.

    BadInput if all of a table have it, though one of its columns may hold heights.
    """
    buildings = {prism.name for prism in prisms}
    guessed = {prism.name for prism in prisms if prism.height.source == "default"}
    if not guessed or default_height_m is not None:
        return []
    text = no_height_text([feature.tags for feature in features])
    if guessed == buildings and text and map_suffix(path) not in OSM_SUFFIXES:
        raise BadInput(f"{path}: {text}")
    return problems_of(
        sorted(guessed), f"of {len(buildings):,} building(s) have no height in the map: "
        f"{DEFAULT_HEIGHT_M:g} m was taken for them. Give the height of such buildings with "
        "--height-default M, or name a column with --height-column")


def _check_unit(prisms: list[Prism], plan_m: float, declared: HeightColumn | None,
                path: Path) -> None:
    """Raise BadInput if the plan is in feet and a height column could be in feet or in metres."""
    unit_unknown = {column.name for column in KNOWN if column.unit == "m" and not column.ground
              and not column.name.endswith("_m")} - ({declared.name} if declared else set())
    used = sorted({prism.height.source for prism in prisms} & unit_unknown)
    if used and plan_m != 1.0:
        raise BadInput(f"{path}: its plan is in feet or another unit ({plan_m:.7g} m), and nothing "
                       f"says that of the column {used[0]!r}; say --height-column {used[0]}:ft or "
                       f"--height-column {used[0]}:m")


def _features_in_box(features: list[Feature], bbox_deg: Bounds | None, path: Path) -> list[Feature]:
    """Return the buildings that reach into the box (None: all); of 3D models, with all parts."""
    bounds_deg = np.array([feature.area.bounds for feature in features])  # empty area: NaN
    for feature, bounds in zip(features, bounds_deg):
        if (np.abs(bounds) > (180, 90, 180, 90)).any():
            raise BadInput(f"{path}: {feature.name} lies at {bounds[0]:g}, {bounds[1]:g}, which is "
                           "no longitude and latitude in degrees; export the map in EPSG:4326 or "
                           "with the name of its system, or declare it with --crs")
    budget = OutlineBudget(path)
    if bbox_deg is None:
        for feature in features:
            budget.check(feature.name, feature.area)
        return features
    south, west, north, east = bbox_deg
    box = shapely.box(west, south, east, north)
    near = [feature for feature, (x0, y0, x1, y1) in zip(features, bounds_deg)
            if x0 <= east and x1 >= west and y0 <= north and y1 >= south]
    for feature in near:
        budget.check(feature.name, feature.area)
    kept = [feature for feature in near if shapely.intersects(
        shapely.make_valid(shapely.get_parts(feature.area)), box).any()]
    if not kept:
        file_west, file_south = np.nanmin(bounds_deg[:, :2], axis=0)
        file_east, file_north = np.nanmax(bounds_deg[:, 2:], axis=0)
        swapped = ((bounds_deg[:, 1] <= east) & (bounds_deg[:, 3] >= west)
                   & (bounds_deg[:, 0] <= north) & (bounds_deg[:, 2] >= south)).any()
        hint = ("; latitude and longitude seem to be swapped: --bbox is "
                "LAT_MIN,LON_MIN,LAT_MAX,LON_MAX; if it is right, the file's are swapped"
                ) if swapped else ""
        raise BadInput(f"{path}: no building reaches into --bbox "
                       f"{south:g},{west:g},{north:g},{east:g}; the file's lie in "
                       f"{file_south:.5f},{file_west:.5f},{file_north:.5f},{file_east:.5f} "
                       f"(south,west,north,east){hint}")
    chosen, models = set(kept), {one.name for one in kept if one.shell is not None}
    return [one for one in features
            if one in chosen or (one.shell is not None and one.name in models)]


def _middle_of(features: list[Feature], bbox_deg: Bounds | None) -> Origin:
    """Return the middle of the box (south, west, north, east) [degrees]; None: of all buildings."""
    if bbox_deg is None:
        bounds = np.array([feature.area.bounds for feature in features])
        finite = np.isfinite(bounds)
        bounds = bounds[finite.all(axis=1)] if finite.any() else np.zeros((1, 4))
        (west, south), (east, north) = bounds[:, :2].min(axis=0), bounds[:, 2:].max(axis=0)
    else:
        south, west, north, east = bbox_deg
    return Origin(latitude_deg=round(float(south + north) / 2, ORIGIN_DECIMALS),
                  longitude_deg=round(float(west + east) / 2, ORIGIN_DECIMALS))


def _bounds_m(prisms: list[Prism], origin: Origin, bbox_deg: Bounds | None) -> Bounds:
    """Return (x_min, x_max, y_min, y_max) [m] of a box in degrees; None: of all buildings."""
    if bbox_deg is not None:
        south, west, north, east = bbox_deg
        x_m, y_m = to_local(origin, np.array([west, east, west, east]),
                            np.array([south, south, north, north]))
    else:
        bounds = np.array([prism.area.bounds for prism in prisms])
        x_m, y_m = bounds[:, [0, 2]], bounds[:, [1, 3]]
    box = float(np.min(x_m)), float(np.max(x_m)), float(np.min(y_m)), float(np.max(y_m))
    _check_width(max(box[1] - box[0], box[3] - box[2]), MAX_WIDTH_M)
    return box


def _enclosing_box(one_m: Bounds, other_m: Bounds) -> Bounds:
    """Return the smallest (x_min, x_max, y_min, y_max) around two boxes [m]."""
    return (min(one_m[0], other_m[0]), max(one_m[1], other_m[1]),
            min(one_m[2], other_m[2]), max(one_m[3], other_m[3]))


def _check_sizes(features: list[Feature], origin: Origin, path: Path) -> None:
    """Raise BadInput if a building, or the whole map, is too wide for a flat local frame."""
    bounds = np.array([feature.area.bounds for feature in features])
    middle = [origin.longitude_deg, origin.latitude_deg]
    bounds = np.where(np.isfinite(bounds), bounds, [middle * 2])
    corners = np.stack(to_local(origin, bounds[:, [0, 2, 2, 0]], bounds[:, [1, 1, 3, 3]]))
    widths_m = np.ptp(corners, axis=2).max(axis=0)
    widest = int(np.nan_to_num(widths_m, nan=np.inf).argmax())
    if not widths_m[widest] <= MAX_WIDTH_M:
        raise BadInput(f"{path}: {features[widest].name} is {widths_m[widest] / 1000:.0f} km wide, "
                       "as no building is; correct or remove it")
    # Measured from the origin: features that lie close together may still be far away from it
    _check_width(2 * float(np.abs(corners).max()), 10 * MAX_WIDTH_M)


def _check_width(width_m: float, max_m: float) -> None:
    """Raise BadInput if an area is wider than allowed [m]."""
    if not width_m <= max_m:  # also for NaN
        raise BadInput(f"the area is {width_m / 1000:.0f} km wide, {max_m / 1000:g} km are "
                       "allowed; choose a part with --bbox SOUTH,WEST,NORTH,EAST")


def _ground_box(prisms: list[Prism], extent_m: Bounds) -> Bounds:
    """Return x_min, x_max, y_min, y_max [m] of the ground: all buildings, extent and a margin."""
    bounds = np.array([prism.area.bounds for prism in prisms])
    x0, y0 = np.minimum(bounds[:, :2].min(axis=0), extent_m[::2]) - GROUND_MARGIN_M
    x1, y1 = np.maximum(bounds[:, 2:].max(axis=0), extent_m[1::2]) + GROUND_MARGIN_M
    return x0, x1, y0, y1


def _assemble_city(
    prisms: list[Prism], contacts: Contacts, ground: Ground, table: MaterialTable,
    problems: list[Problem],
) -> tuple[ImportedCity, dict[int, str]]:
    """Return the city of ground and buildings, and index of a prism -> name of its shape.

    Prisms (buildings or their parts) of one material that touch become one shape; roofs are shapes
    of their own if the table gives them a material. `problems` gets one for open meshes.
    """
    names, meshes = [GROUND], [(ground.vertices, ground.faces)]
    materials: list[Material | None] = [itu_material(table.ground)]
    taken = Names({*RESERVED_NAMES, GROUND})
    shape_of: dict[int, str] = {}
    for block in make_blocks(prisms, contacts):
        name = taken.unique(safe_name(prisms[block.members[0]].name))
        shape_of |= dict.fromkeys(block.members, name)
        walls, roof = split_roof(block.mesh) if table.roof else (block.mesh, None)
        names.append(name)
        materials.append(block.material)
        meshes.append((np.asarray(walls.vertices), np.asarray(walls.faces)))
        if roof is not None:
            names.append(taken.unique(f"{name}_roof"))
            materials.append(itu_material(table.roof or ""))
            meshes.append((np.asarray(roof.vertices), np.asarray(roof.faces)))
    surfaces = Surfaces(meshes)
    is_ground = surfaces.shape == 0
    city = ImportedCity(names, materials, surfaces, is_ground, problems)
    city.problems.extend(checks.check_closed(surfaces, is_ground, names))
    return city, shape_of
