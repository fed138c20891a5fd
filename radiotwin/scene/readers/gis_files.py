"""Readers of GeoJSON and other JSON maps, GeoPackage [1], GeoParquet [2]: columns become tags.

In a file with a column `building` or `building:part`, as exports of OpenStreetMap have, only rows
with such a value are buildings; else every polygon is one. `_` may replace the `:` of a tag, and
case does not matter. The tags in GDAL's column `other_tags` are read, too.

GeoPackages are read by SQLite, and GeoParquet by pyarrow, without GDAL, which looks at a file's
content, not at its suffix: a `.gpkg` could be an XML that names other files or servers. Well-known
binary [3] is checked before GEOS reads it: its reader is recursive, and a few kilobytes can nest
deeper than the stack.

[1] https://www.geopackage.org/spec140
[2] https://geoparquet.org/releases/v1.1.0
[3] OGC 06-103r4, Simple feature access, section 8.2; with the flags of PostGIS (EWKB).
"""

import re
import sqlite3
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from radiotwin.errors import BadInput
from radiotwin.io.budgets import COLUMNS, DOCUMENT_BYTES, FEATURES, FILE_BYTES, NESTING
from radiotwin.io.cells import read_cells, require_pyarrow
from radiotwin.io.inputs import decode_text, open_gzip, open_input, parse_json, read_text
from radiotwin.io.sqlite_tables import open_tables, require_table, scan, stored_columns
from radiotwin.scene.readers.cityjson import cityjson_map
from radiotwin.scene.readers.features import (
    BUILDING_KEYS,
    Feature,
    LeftOut,
    MapFile,
    is_building,
    why_excluded,
)
from radiotwin.scene.readers.heights import ALIASES
from radiotwin.scene.readers.layers import choose_layers, join_layers
from radiotwin.scene.readers.osm import assemble, osm_of_json
from radiotwin.scene.readers.systems import (
    WGS84,
    chosen_system,
    degrees_from,
    find_system,
    plane_unit_m,
)

_OTHER_TAG = re.compile(r'[\s,]*+"((?:[^"\\]|\\.)*+)"\s*+=>\s*+"((?:[^"\\]|\\.)*+)"', re.DOTALL)
_NAME_LENGTH = 200  # characters of an id that are kept
_AREAS = ("Polygon", "MultiPolygon", "GeometryCollection")
NO_AREA = "building(s) are points or lines, without an area: left out"
_KINDS = ("POLYGON", "MULTIPOLYGON", "GEOMETRY", "GEOMETRYCOLLECTION", "SURFACE", "MULTISURFACE",
          "CURVEPOLYGON")
ELEVATIONS = "z of the coordinates"  # name in the report of columns that are not used
UNREAD = ("building(s) have no geometry, or one that is not read (not finite, a curve, a surface "
          "in space): left out; `ogr2ogr -nlt CONVERT_TO_LINEAR` makes polygons of curves")
_ENVELOPE_DOUBLES = (0, 4, 6, 6, 8)  # of a geometry's header, by its code
_Z, _M, _SRID = 0x80000000, 0x40000000, 0x20000000  # flags of EWKB
_POINT, _RINGS = (1,), (3, 17)  # a polygon, a triangle
_POSITIONS = (2, 8)  # a line, a circular string
_COLLECTIONS = (4, 5, 6, 7, 9, 10, 11, 12, 15, 16)
_PLANE = (1, 2, 3, 4, 5, 6, 7)  # kinds that are read: without arcs, and surfaces in space
LINES = (".jsonl", ".ndjson", ".geojsonl", ".geojsons", ".geojsonseq")
"""Endings of files with a feature in each line."""
_GEOJSON = ("FeatureCollection", "Feature", "Polygon", "MultiPolygon")
_RECORD = "\x1e"  # may begin each line (RFC 8142)


def read_json_map(path: Path, crs: str | None = None) -> MapFile:
    """Read a map in JSON: CityJSON, GeoJSON, or an answer of Overpass.

    Args:
        path: JSON file, also of one object per line, also gzipped.
        crs: coordinate reference system of a file that names none; None: as the format has it.

    Raises:
        BadInput: no such file, none of the three, or an impossible value, with the object's name.
    """
    with open_gzip(path, "map in JSON", DOCUMENT_BYTES) as file:
        text = decode_text(file.read(), path)
    if path.name.lower().removesuffix(".gz").endswith(LINES):
        lines = [line for line in text.replace(_RECORD, "").split("\n") if line.strip()]
        FEATURES.check(len(lines), path)
        documents = [parse_json(line, f"{path}, row {row}") for row, line in
                     enumerate(lines, start=1)]
    else:
        documents = [parse_json(text, path)]
    head = documents[0] if documents and isinstance(documents[0], dict) else {}
    if head.get("type") == "CityJSON":
        return cityjson_map(path, documents, crs)
    if head.get("type") in _GEOJSON:
        return geojson_map(path, head if len(documents) == 1 else
                           {"type": "FeatureCollection", "features": documents}, crs)
    if not isinstance(head.get("elements"), list):
        raise BadInput(f"{path} is neither CityJSON (\"type\": \"CityJSON\"), GeoJSON, nor an "
                       "answer of Overpass ([out:json]); export the map as one of them")
    if crs is not None:
        raise BadInput(f"{path} is in longitude and latitude, as all of OpenStreetMap; leave --crs "
                       "out")
    return assemble(osm_of_json(path, head))


def read_geojson(path: Path, crs: str | None = None) -> MapFile:
    """Read the polygons of a GeoJSON file; see `geojson_map`.

    Raises:
        BadInput: no such file, not JSON, or as `geojson_map`.
    """
    return geojson_map(path, parse_json(read_text(path, "GeoJSON file"), path, allow_nan=True), crs)


def geojson_map(path: Path, data: Any, crs: str | None = None) -> MapFile:
    """Return the polygons of parsed GeoJSON: a collection of features, a feature, or a geometry.

    Coordinates are longitude and latitude (RFC 7946), or in the system of an older `crs` member, or
    in the system `crs` that the user declares for a file without it.

    Raises:
        BadInput: not GeoJSON, or coordinates that are not numbers; with the feature's number.
    """
    features = data.get("features") if isinstance(data, dict) else None
    if isinstance(data, dict) and data.get("type") == "Feature":
        features = [data]
    elif isinstance(data, dict) and data.get("type") in ("Polygon", "MultiPolygon"):
        features = [{"type": "Feature", "geometry": data, "properties": {}}]
    if not isinstance(features, list):
        raise BadInput(f"{path} is not a GeoJSON FeatureCollection; export polygons as GeoJSON")
    rows = []
    for number, feature in enumerate(features, start=1):
        geometry, tags = (feature.get(key) or {} if isinstance(feature, dict) else None
                          for key in ("geometry", "properties"))
        if not isinstance(geometry, dict) or not isinstance(tags, dict):
            raise BadInput(f"{path}: feature {number} is not a GeoJSON feature; export the map "
                           "again")
        known = feature.get("id") or tags.get("@id")
        name = (str(known)[:_NAME_LENGTH] if isinstance(known, str | int | float)
                else f"feature {number}")
        rows.append((name, tags, _polygons(path, number, geometry)))
    return map_file(path, rows, chosen_system(path, _crs_name(path, data), crs) or WGS84[0])


def _polygons(path: Path, number: int, geometry: Mapping) -> BaseGeometry | None:
    """Return the polygons of a GeoJSON geometry; its points if it has none; None: neither.

    If any point has an elevation other than 0, all get z = 1, as a mark that it was there.
    """
    kind = geometry.get("type")
    coordinates: Any = geometry.get("coordinates")  # unchecked: no list raises TypeError below
    members = geometry.get("geometries")
    if kind == "GeometryCollection" and isinstance(members, list):
        areas = [_polygons(path, number, one) for one in members if isinstance(one, dict)
                 and one.get("type") in ("Polygon", "MultiPolygon")]
        return shapely.MultiPolygon([part for area in areas for part in shapely.get_parts(area)]
                                    ) if areas else None
    if kind not in ("Polygon", "MultiPolygon"):
        return _all_positions(coordinates)
    listed = [coordinates] if kind == "Polygon" else coordinates
    try:
        polygons = [[np.array([point[:2] for point in ring], dtype=float) for ring in polygon]
                    for polygon in listed]
        if not all(np.isfinite(ring).all() and ring.ndim == 2
                   for polygon in polygons for ring in polygon):
            raise ValueError
        # RFC 7946 wants at least four points a ring; shorter ones have no area anyway
        area = shapely.MultiPolygon([(polygon[0], [ring for ring in polygon[1:] if len(ring) > 3])
                                     for polygon in polygons if polygon and len(polygon[0]) > 3])
        elevated = any(len(point) > 2 and point[2] for polygon in listed for ring in polygon
                       for point in ring)
        return shapely.force_3d(area, 1.0) if elevated else area
    except (TypeError, ValueError, LookupError, OverflowError):
        raise BadInput(f"{path}: feature {number} has coordinates that are not rings of finite "
                       "numbers; export the map again") from None


def _all_positions(coordinates: Any) -> BaseGeometry | None:
    """Return all positions of a geometry that is no area, to locate it; None if impossible."""
    points, waiting = [], [coordinates]
    while waiting:
        part = waiting.pop()
        if not isinstance(part, list):
            return None
        if len(part) > 1 and all(isinstance(value, int | float) for value in part[:2]):
            points.append(part[:2])
        else:
            waiting += part
    try:
        known = np.array(points, dtype=float).reshape(-1, 2)
    except OverflowError:
        return None
    return shapely.MultiPoint(known) if np.isfinite(known).all() else None


def _crs_name(path: Path, data: Mapping) -> str | None:
    """Return the coordinate reference system that older GeoJSON names in `crs`; None: none."""
    crs = data.get("crs")
    if crs is None:
        return None
    try:
        return str(crs["properties"]["name"])
    except (TypeError, KeyError):
        raise BadInput(f"{path}: its crs is {crs!r:.60}, which names no system; remove it "
                       "(longitude, latitude) or name one") from None


def map_file(
    path: Path, rows: Iterable[tuple[str, Mapping, BaseGeometry | None]], crs: str | None
) -> MapFile:
    """Convert a table's rows to buildings, except those without an area or excluded by their tags.

    If any row has a tag `building` or `building:part`, only such rows are buildings.

    Args:
        path: file, for messages.
        rows: name, columns, and geometry of each row, None: it has none.
        crs: coordinate reference system of the geometries; None: unknown.

    Raises:
        BadInput: the coordinate reference system is unknown.
    """
    tagged: list[tuple[str, dict[str, str], BaseGeometry | None]] = []
    columns: set[str] = set()
    for name, properties, area in rows:
        columns.update(properties)
        if area is not None and area.has_z:
            if np.nan_to_num(shapely.get_coordinates(area, include_z=True)[:, 2]).any():
                columns.add(ELEVATIONS)
            area = shapely.force_2d(area)
        tagged.append((name, _part_or_whole(properties, _tags(properties)), area))
    marked = any(key in tags for _, tags, _ in tagged for key in BUILDING_KEYS)
    features, left_out = [], []
    for name, tags, area in tagged:
        if marked and not is_building(tags):
            continue
        tags = tags if marked else tags | {"building": "yes"}
        if below := why_excluded(name, tags, area):
            left_out.append(below)
        elif area is None or area.geom_type not in _AREAS:
            left_out.append(LeftOut(name, UNREAD if area is None else NO_AREA, area))
        else:
            features.append(Feature(name, tags, area))
    plan_m = 1.0
    if (features or left_out) and crs not in WGS84:
        if crs is None:
            raise BadInput(f"{path} has no coordinate reference system; declare it with --crs, "
                           "such as --crs EPSG:25832")
        system = find_system(path, crs)
        project, plan_m = degrees_from(path, system), plane_unit_m(system)
        features = [replace(one, area=shapely.transform(one.area, project)) for one in features]
        left_out = [replace(one, place=shapely.transform(one.place, project))
                    if one.place is not None else one for one in left_out]
    return MapFile(features, left_out, plan_m=plan_m, columns=set(map(str, columns)))


def _tags(properties: Mapping) -> dict[str, str]:
    """Convert the columns of a row to tags (key -> text), without empty and nested cells."""
    tags: dict[str, str] = {}
    for key, value in properties.items():
        if (value is None or isinstance(value, dict | list | bytes)
                or (isinstance(value, float) and not np.isfinite(value))):
            continue
        key = str(key).lower()
        if key == "other_tags":
            tags |= _other_tags(str(value))
        else:
            is_float = isinstance(value, float | np.floating)
            tags[ALIASES.get(key, key)] = f"{value:g}" if is_float else str(value)
    return tags


def _part_or_whole(columns: Mapping, tags: dict[str, str]) -> dict[str, str]:
    """Add the tag `building` or `building:part` to a row of Overture Maps; leave others as is."""
    names = {str(name).lower() for name in columns}
    if not names & set(BUILDING_KEYS) and names & {"facade_color", "roof_shape", "is_underground"}:
        if "building_id" in tags:  # that the part belongs to
            return tags | {"building:part": "yes"}
        if "has_parts" in names:
            return tags | {"building": "yes"}
    return tags


def _other_tags(text: str) -> dict[str, str]:
    """Parse GDAL's column of rare tags, `"key"=>"value","key"=>"value"`."""
    tags, found = {}, _OTHER_TAG.match(text)
    while found:  # `findall` would try every quotation mark of a long text
        tags[found[1]] = found[2]
        found = _OTHER_TAG.match(text, found.end())
    return tags


def read_geopackage(path: Path, crs: str | None = None, wanted: Sequence[str] = ()) -> MapFile:
    """Read the polygons of a GeoPackage's layers of buildings, in any coordinate reference system.

    Args:
        path: `.gpkg` file.
        crs: coordinate reference system of layers with an undefined one; None: refuse them.
        wanted: names of layers; empty: those that hold buildings, see `choose_layers`.

    Raises:
        BadInput: no such file, not a GeoPackage, one that another program has open, a layer that is
            a view, or no layer seems to hold buildings.
    """
    parts: dict[str, MapFile] = {}
    others: list[str] = []
    try:
        with open_tables(path, "GeoPackage") as database:
            layers = {layer: (geometry, srs) for layer, geometry, srs in _layers(database, others)}
            chosen, problems = choose_layers(
                path, {layer: [row[1] for row in stored_columns(database, layer)]
                       for layer in layers}, wanted)
            for layer in chosen:
                geometry, srs = layers[layer]
                rows = _layer_rows(path, database, layer, geometry)
                parts[layer] = map_file(path, rows, chosen_system(path, _srs_name(database, srs),
                                                                  crs))
    except (sqlite3.Error, shapely.errors.GEOSException, OverflowError,
            UnicodeDecodeError) as error:  # of a name in a message of SQLite
        raise BadInput(f"{path} is not a readable GeoPackage ({error}); export it again") from None
    return replace(join_layers(path, parts, problems), layers=tuple(others))


def _layers(database: sqlite3.Connection, others: list[str]) -> list[tuple[str, str, int]]:
    """Return table, geometry column and srs_id of each layer of areas; `others` gets the others."""
    for table in ("gpkg_contents", "gpkg_geometry_columns", "gpkg_spatial_ref_sys"):
        require_table(database, table)
    registered = {str(name).lower() for name, kind in scan(
        database, "gpkg_contents", ["table_name", "data_type"]) if kind == "features"}
    layers = []
    for table, column, kind, srs in scan(
            database, "gpkg_geometry_columns",
            ["table_name", "column_name", "geometry_type_name", "srs_id"]):
        if str(table).lower() in registered and str(kind).upper() not in _KINDS:
            others.append(str(table)[:_NAME_LENGTH])
        elif str(table).lower() in registered:
            require_table(database, str(table))
            if not isinstance(srs, int):  # SQLite does not enforce the types of columns
                raise sqlite3.DataError(f"srs_id of {str(table)[:100]!r} is {srs!r:.100}")
            layers.append((str(table), str(column), srs))
    return layers


def _layer_rows(path: Path, database: sqlite3.Connection, layer: str,
                geometry: str) -> Iterator[tuple[str, dict[str, Any], Any]]:
    """Yield a name, the columns and the geometry (None: none) of each row of a GeoPackage layer."""
    # The integer primary key is no attribute
    columns = [name for _, name, kind, _, _, key in stored_columns(database, layer)
               if name.lower() != geometry.lower() and not (key and kind.upper() == "INTEGER")]
    COLUMNS.check(len(columns), f"{path}, layer {layer}")
    read = 0
    for number, (blob, *values) in enumerate(
            scan(database, layer, [geometry, *columns]), start=1):
        name = f"{layer} {number}"
        read += sum(len(value) for value in (blob, *values) if isinstance(value, bytes | str))
        FILE_BYTES.check(read, f"{path}, layer {layer}")
        yield name, dict(zip(columns, values)), _package_geometry(blob, f"{path}: {name}")


def _package_geometry(blob: Any, source: str) -> BaseGeometry | None:
    """Return a GeoPackage blob's geometry [1, section 2.1.3]; None: empty, or not a geometry."""
    if not isinstance(blob, bytes) or len(blob) < 8 or blob[:2] != b"GP":
        return None
    flags = blob[3]
    extended, empty, code = flags & 32, flags & 16, (flags >> 1) & 7
    if extended or empty or code >= len(_ENVELOPE_DOUBLES):
        return None
    return area_of_wkb(blob[8 + 8 * _ENVELOPE_DOUBLES[code]:], source)


def _srs_name(database: sqlite3.Connection, number: int) -> str | None:
    """Return the coordinate reference system of a srs_id: code or WKT; None: undefined."""
    for known, authority, code, definition in scan(
            database, "gpkg_spatial_ref_sys",
            ["srs_id", "organization", "organization_coordsys_id", "definition"]):
        if known == number and number not in (0, -1):  # 0 and -1: undefined
            name = str(authority).upper()
            return f"{name}:{code}" if name in ("EPSG", "ESRI", "OGC") else str(definition)
    return None


def read_geoparquet(path: Path, crs: str | None = None) -> MapFile:
    """Read the polygons of a GeoParquet file, in any coordinate reference system.

    Nested columns, such as the names and sources of Overture Maps, are left out.

    Args:
        path: `.parquet` file.
        crs: coordinate reference system of a file that names none; None: longitude and latitude
            [2], but a file that declares its system unknown is refused.

    Raises:
        BadInput: no such file, no GeoParquet, damaged, or too large; no pyarrow.
    """
    names, nested, geometry, declared = _schema(path)
    system = chosen_system(path, _system_name(path, declared) if declared else None, crs)
    if declared is None and system is None:
        system = WGS84[0]
    cells = read_cells(path, [geometry], names, [geometry])
    columns = [name for name in cells.columns if name != geometry]
    values = [cells[name].tolist() for name in columns]

    def rows() -> Iterator[tuple[str, dict[str, Any], Any]]:
        for number, data in enumerate(cells[geometry], start=1):
            tags = {name: column[number - 1] for name, column in zip(columns, values)}
            yield (f"row {number}", tags,
                   area_of_wkb(data, f"{path}: row {number}") if isinstance(data, bytes) else None)

    try:
        found = map_file(path, rows(), system)
        return replace(found, columns=found.columns | {*names, *nested} - {geometry})
    except shapely.errors.GEOSException as error:
        raise BadInput(f"{path}: a geometry is damaged ({str(error)[:100]}); export it again"
                       ) from None


def _schema(path: Path) -> tuple[list[str], list[str], str, dict | str | None]:
    """Return the names of a GeoParquet file's plain, nested and geometry columns, and its system.

    That is in PROJ's JSON, or a name; "": unknown; None: longitude and latitude.
    """
    require_pyarrow(path)
    from pyarrow import ArrowException, types
    from pyarrow.parquet import ParquetFile

    with open_input(path, "GeoParquet file") as file:
        try:
            content = ParquetFile(file)
            schema = content.schema_arrow
            FEATURES.check(content.metadata.num_rows, path)
        except (ArrowException, OSError, ValueError) as error:
            raise BadInput(f"{path} cannot be read as Parquet ({str(error)[:200]}); export it "
                           "again") from None
    text = (schema.metadata or {}).get(b"geo")
    if text is None:
        raise BadInput(f"{path} is Parquet without geometries (no metadata `geo`); export it as "
                       "GeoParquet")
    DOCUMENT_BYTES.check(len(text), f"{path}: its metadata")
    known = parse_json(text.decode("utf-8", "replace"), f"{path}: its metadata `geo`")
    try:
        geometry = str(known["primary_column"])
        column = known["columns"][geometry]
        if column["encoding"] != "WKB":
            raise BadInput(f"{path}: its geometries are encoded as {column['encoding']!r:.40}; "
                           "only WKB is read: export it again with that")
        declared = column.get("crs")
        if declared is None and "crs" in column:
            declared = ""
        if not isinstance(declared, dict | str | None) or geometry not in schema.names:
            raise TypeError
    except (KeyError, TypeError):
        raise BadInput(f"{path}: its metadata `geo` is not as GeoParquet has it (primary_column, "
                       "and of that encoding and crs); export it again") from None
    names, nested = ([field.name for field in schema if types.is_nested(field.type) == is_nested]
                     for is_nested in (False, True))
    return names, nested, geometry, declared


def _system_name(path: Path, declared: dict | str) -> str:
    """Return a coordinate reference system in PROJ's JSON by its code, else as WKT."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    if isinstance(declared, str):
        return declared
    known = declared.get("id")
    if isinstance(known, dict) and {"authority", "code"} <= known.keys():
        return f"{known['authority']}:{known['code']}"
    try:
        return CRS.from_json_dict(declared).to_wkt()
    except CRSError as error:
        raise BadInput(f"{path}: its coordinate reference system is unknown ({error!s:.100}); "
                       "export it in EPSG:4326") from None


def area_of_wkb(data: bytes, source: object) -> BaseGeometry | None:
    """Parse a geometry in well-known binary, with its z.

    Args:
        data: one geometry.
        source: name of the row, for messages.

    Returns:
        The geometry; None if it is not finite, or has curves or surfaces in space.

    Raises:
        BadInput: geometries are nested too deep.
        shapely.errors.GEOSException: the data are damaged.
    """
    if not _wkb_kinds(data, source) <= {*_PLANE}:
        return None
    area = shapely.from_wkb(data)
    while any(part.geom_type == "GeometryCollection" for part in shapely.get_parts(area)):
        area = shapely.GeometryCollection(list(shapely.get_parts(shapely.get_parts(area))))
    return area if np.isfinite(shapely.get_coordinates(area)).all() else None


def _wkb_kinds(data: bytes, source: object) -> set[int]:
    """Return the kinds of a geometry and all nested in it: codes of well-known binary [3]."""
    found: set[int] = set()
    at, waiting = 0, [1]  # geometries that are still to be read, by level of nesting
    try:
        while waiting:
            if not waiting[-1]:
                waiting.pop()
                continue
            waiting[-1] -= 1
            order = "<" if data[at] else ">"
            code, = struct.unpack_from(order + "I", data, at + 1)
            at += 9 if code & _SRID else 5
            more, kind = divmod(code & ~(_Z | _M | _SRID), 1000)
            has_z, has_m = more in (1, 3) or code & _Z, more in (2, 3) or code & _M
            size = 8 * (2 + bool(has_z) + bool(has_m))
            found.add(kind)
            if kind in _POINT:
                at += size
                continue
            count, = struct.unpack_from(order + "I", data, at)
            at += 4
            if kind in _POSITIONS:
                at += count * size
            elif kind in _RINGS:
                for _ in range(count):
                    corners, = struct.unpack_from(order + "I", data, at)
                    at += 4 + corners * size
            elif kind in _COLLECTIONS:
                waiting.append(count)
                NESTING.check(len(waiting) - 2, source)
            else:
                raise shapely.errors.GEOSException(f"unknown kind of geometry {code}")
    except (struct.error, IndexError):
        raise shapely.errors.GEOSException("cut off") from None
    return found
