"""Reader of GeoPackages [1]: their tables by SQLite, without GDAL.

GDAL looks at a file's content, not at its ending: a `.gpkg` can be an XML that names other files
or servers.

[1] https://www.geopackage.org/spec140
"""

import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import shapely

from radiotwin.budgets import COLUMNS, FILE_BYTES
from radiotwin.errors import BadInput
from radiotwin.footprints.features import MapFile
from radiotwin.footprints.gis_files import area_of_wkb, map_file
from radiotwin.footprints.systems import chosen_system
from radiotwin.sqlite_tables import open_tables, require_table, scan, stored_columns

_KINDS = ("POLYGON", "MULTIPOLYGON", "GEOMETRY", "GEOMETRYCOLLECTION", "SURFACE", "MULTISURFACE",
          "CURVEPOLYGON")
_ENVELOPE_DOUBLES = (0, 4, 6, 6, 8)  # of a geometry's header, by its code


def read_geopackage(path: Path, crs: str | None = None) -> MapFile:
    """Read the polygons of all layers of a GeoPackage, in any coordinate reference system.

    Args:
        path: `.gpkg` file.
        crs: coordinate reference system of layers whose own is undefined; None: refuse them.

    Returns:
        The buildings, layer by layer.

    Raises:
        BadInput: no such file, not a GeoPackage, one that another program has open, or a layer
            that is a view.
    """
    found = MapFile([])
    try:
        with open_tables(path, "GeoPackage") as database:
            for layer, geometry, srs in _layers(database):
                rows = _rows(path, database, layer, geometry)
                part = map_file(path, rows, chosen_system(path, _system(database, srs), crs))
                found.features += part.features
                found.left_out += part.left_out
    except (sqlite3.Error, shapely.errors.GEOSException, OverflowError) as error:
        raise _unreadable(path, error) from None
    return found


def _unreadable(path: Path, reason: object) -> BadInput:
    return BadInput(f"{path} is not a readable GeoPackage ({reason}); export it again")


def _layers(database: sqlite3.Connection) -> list[tuple[str, str, int]]:
    """Return table, column of the geometry, and number of the system of each layer of areas."""
    for table in ("gpkg_contents", "gpkg_geometry_columns", "gpkg_spatial_ref_sys"):
        require_table(database, table)
    registered = {str(name).lower() for name, kind in scan(
        database, "gpkg_contents", ["table_name", "data_type"]) if kind == "features"}
    layers = []
    for table, column, kind, srs in scan(
            database, "gpkg_geometry_columns",
            ["table_name", "column_name", "geometry_type_name", "srs_id"]):
        if str(table).lower() in registered and str(kind).upper() in _KINDS:
            require_table(database, str(table))
            if not isinstance(srs, int):  # of SQLite's columns the type is a wish
                raise sqlite3.DataError(f"srs_id of {str(table)[:100]!r} is {srs!r:.100}")
            layers.append((str(table), str(column), srs))
    return layers


def _rows(path: Path, database: sqlite3.Connection, layer: str,
          geometry: str) -> Iterator[tuple[str, dict[str, Any], Any]]:
    """Yield name, columns and area of each row of a layer."""
    # The integer primary key is no attribute
    columns = [name for _, name, kind, _, _, key in stored_columns(database, layer)
               if name.lower() != geometry.lower() and not (key and kind.upper() == "INTEGER")]
    COLUMNS.check(len(columns), f"{path}, layer {layer}")
    read = 0
    for number, (blob, *values) in enumerate(
            scan(database, layer, [geometry, *columns]), start=1):
        read += sum(len(value) for value in (blob, *values) if isinstance(value, bytes | str))
        FILE_BYTES.check(read, f"{path}, layer {layer}")
        yield f"{layer} {number}", dict(zip(columns, values)), _area(blob)


def _area(blob: Any) -> Any:
    """Return the geometry of a blob [1, section 2.1.3]; None where there is none."""
    if not isinstance(blob, bytes) or len(blob) < 8 or blob[:2] != b"GP":
        return None
    flags = blob[3]
    extended, empty, code = flags & 32, flags & 16, (flags >> 1) & 7
    if extended or empty or code >= len(_ENVELOPE_DOUBLES):
        return None
    return area_of_wkb(blob[8 + 8 * _ENVELOPE_DOUBLES[code]:])


def _system(database: sqlite3.Connection, number: int) -> str | None:
    """Return the coordinate reference system of a number: authority and code, or WKT."""
    for known, authority, code, definition in scan(
            database, "gpkg_spatial_ref_sys",
            ["srs_id", "organization", "organization_coordsys_id", "definition"]):
        if known == number and number not in (0, -1):  # 0 and -1: undefined
            name = str(authority).upper()
            return f"{name}:{code}" if name in ("EPSG", "ESRI", "OGC") else str(definition)
    return None
