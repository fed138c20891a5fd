"""Reader of GeoPackages [1]: their tables by SQLite, without GDAL.

GDAL looks at a file's content, not at its ending: a `.gpkg` can be an XML that names other files
or servers. Of SQLite, too, only what a scan of a table needs is used: no view, trigger, virtual
table, computed column, function or second file is ever evaluated.

[1] https://www.geopackage.org/spec140
"""

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from radiotwin.budgets import COLUMNS, FEATURES, FILE_BYTES
from radiotwin.errors import BadInput
from radiotwin.footprints.features import MapFile
from radiotwin.footprints.gis_files import map_file
from radiotwin.inputs import check_input, open_input

_MAGIC = b"SQLite format 3\0"
_KINDS = ("POLYGON", "MULTIPOLYGON", "GEOMETRY", "GEOMETRYCOLLECTION", "SURFACE", "MULTISURFACE",
          "CURVEPOLYGON")
_ENVELOPE_DOUBLES = (0, 4, 6, 6, 8)  # of a geometry's header, by its code
_ALLOWED = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ, sqlite3.SQLITE_PRAGMA)


def read_geopackage(path: Path) -> MapFile:
    """Read the polygons of all layers of a GeoPackage, in any coordinate reference system.

    Args:
        path: `.gpkg` file.

    Returns:
        The buildings, layer by layer.

    Raises:
        BadInput: no such file, not a GeoPackage, one that another program has open, or a layer
            that is a view.
    """
    with open_input(path, "GeoPackage") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise _unreadable(path, "it is no SQLite database")
    for suffix in ("-wal", "-journal"):
        log = path.with_name(path.name + suffix)
        if log.exists() and check_input(log, "log of SQLite"):
            raise BadInput(f"{log} holds changes that are not in {path.name} yet: another program "
                           "has it open, or was killed; close or open and close it there")
    found = MapFile([])
    try:
        with closing(_connect(path)) as database:
            for layer, geometry, srs in _layers(database):
                rows = _rows(path, database, layer, geometry)
                part = map_file(path, rows, _system(database, srs))
                found.features += part.features
                found.left_out += part.left_out
    except (sqlite3.Error, shapely.errors.GEOSException, OverflowError) as error:
        raise _unreadable(path, error) from None
    return found


def _unreadable(path: Path, reason: object) -> BadInput:
    return BadInput(f"{path} is not a readable GeoPackage ({reason}); export it again")


def _connect(path: Path) -> sqlite3.Connection:
    """Open a database so that it can do nothing but read this one file."""
    database = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro&immutable=1", uri=True)
    database.text_factory = lambda data: data.decode("utf-8", "replace")
    database.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(FILE_BYTES.limit, 2**31 - 1))
    database.execute("PRAGMA trusted_schema = OFF")
    database.execute("PRAGMA cell_size_check = ON")
    database.set_authorizer(lambda action, *_: sqlite3.SQLITE_OK if action in _ALLOWED
                            else sqlite3.SQLITE_DENY)
    return database


def _layers(database: sqlite3.Connection) -> list[tuple[str, str, int]]:
    """Return table, column of the geometry, and number of the system of each layer of areas."""
    for table in ("gpkg_contents", "gpkg_geometry_columns", "gpkg_spatial_ref_sys"):
        _require_table(database, table)
    registered = {str(name).lower() for name, kind in _scan(
        database, "gpkg_contents", ["table_name", "data_type"]) if kind == "features"}
    layers = []
    for table, column, kind, srs in _scan(
            database, "gpkg_geometry_columns",
            ["table_name", "column_name", "geometry_type_name", "srs_id"]):
        if str(table).lower() in registered and str(kind).upper() in _KINDS:
            _require_table(database, str(table))
            layers.append((str(table), str(column), int(srs)))
    return layers


def _require_table(database: sqlite3.Connection, name: str) -> None:
    """Raise sqlite3.Error unless a name is that of an ordinary table."""
    for kind, known, text in _scan(database, "sqlite_master", ["type", "name", "sql"]):
        if str(known).lower() != name.lower() or kind not in ("table", "view"):
            continue
        if kind == "view" or str(text).split()[:2] and \
                [word.lower() for word in str(text).split()[:2]] != ["create", "table"]:
            raise sqlite3.DatabaseError(
                f"{name!r} is a view or a virtual table, only tables are read")
        return
    raise sqlite3.DatabaseError(f"it has no table {name!r}")


def _scan(database: sqlite3.Connection, table: str, columns: list[str]) -> Iterator[tuple]:
    """Yield the given columns of every row, within the budget of buildings."""
    missing = set(columns) - {row[1] for row in _stored_columns(database, table)}
    if missing:  # or a computed one, or in SQLite's reading of quotation marks a text
        raise sqlite3.DatabaseError(f"{table!r} has no column {min(missing)!r}")
    names = ", ".join(map(_quoted, columns))
    rows = database.execute(f"SELECT {names} FROM {_quoted(table)} NOT INDEXED")
    for number, row in enumerate(rows):
        if number >= FEATURES.limit:  # a damaged tree of pages may be endless
            FEATURES.refuse(table, f"more than {FEATURES.limit:,} rows")
        yield row


def _stored_columns(database: sqlite3.Connection, table: str) -> list[tuple]:
    """Return number, name, type, … of a table's columns, without those that are computed."""
    return database.execute(f"PRAGMA table_info({_quoted(table)})").fetchall()


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


def _rows(path: Path, database: sqlite3.Connection, layer: str,
          geometry: str) -> Iterator[tuple[str, dict[str, Any], Any]]:
    """Yield name, columns and area of each row of a layer."""
    # The integer primary key is no attribute
    columns = [name for _, name, kind, _, _, key in _stored_columns(database, layer)
               if name.lower() != geometry.lower() and not (key and kind.upper() == "INTEGER")]
    COLUMNS.check(len(columns), f"{path}, layer {layer}")
    read = 0
    for number, (blob, *values) in enumerate(
            _scan(database, layer, [geometry, *columns]), start=1):
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
    area = shapely.from_wkb(blob[8 + 8 * _ENVELOPE_DOUBLES[code]:])
    return shapely.force_2d(area) if np.isfinite(shapely.get_coordinates(area)).all() else None


def _system(database: sqlite3.Connection, number: int) -> str | None:
    """Return the coordinate reference system of a number: authority and code, or WKT."""
    for known, authority, code, definition in _scan(
            database, "gpkg_spatial_ref_sys",
            ["srs_id", "organization", "organization_coordsys_id", "definition"]):
        if known == number and number not in (0, -1):  # 0 and -1: undefined
            name = str(authority).upper()
            return f"{name}:{code}" if name in ("EPSG", "ESRI", "OGC") else str(definition)
    return None
