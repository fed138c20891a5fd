"""A GeoPackage with layers of features (OGC 12-128r18, version 1.3), made in memory.

GDAL swallows some errors of a full disk, and writes the time of day; the same layers are the same
bytes here, and are written like any other file.
"""

import sqlite3
import struct
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import shapely
from pyproj import CRS

_APPLICATION, _VERSION = 0x47504B47, 10300  # "GPKG" (requirement 2)
_CARTESIAN, _DEGREES = -1, 4326
_CHANGED = "1970-01-01T00:00:00.000Z"  # of every layer
_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
 organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL,
 description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL,
 identifier TEXT UNIQUE, description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT
 (strftime('%Y-%m-%dT%H:%M:%fZ','now')), min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE,
 srs_id INTEGER, CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES
 gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL, column_name TEXT NOT NULL,
 geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL,
 CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
 CONSTRAINT uk_gc_table_name UNIQUE (table_name),
 CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
 CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id));
"""  # annex C


@dataclass(frozen=True)
class Layer:
    """Features of one kind.

    Attributes:
        name: of the layer.
        kind: of all geometries, such as MULTIPOLYGON.
        shapes: (n,) geometries of shapely, in longitude and latitude or in metres.
        columns: Name -> (n,) texts or numbers; NaN is null.
    """

    name: str
    kind: str
    shapes: np.ndarray
    columns: Mapping[str, np.ndarray]


def geopackage(layers: Iterable[Layer], in_degrees: bool) -> bytes:
    """Return the bytes of a GeoPackage.

    Args:
        layers: their names and those of their columns are identifiers.
        in_degrees: coordinates are WGS84 degrees; else metres of a local frame.
    """
    system = _DEGREES if in_degrees else _CARTESIAN
    with closing(sqlite3.connect(":memory:")) as database:
        database.executescript(
            f"PRAGMA application_id={_APPLICATION}; PRAGMA user_version={_VERSION}; {_TABLES}")
        database.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?,?,?,?,?,?)", [
            ("Undefined Cartesian SRS", _CARTESIAN, "NONE", -1, "undefined", None),
            ("Undefined geographic SRS", 0, "NONE", 0, "undefined", None),
            ("WGS 84 geodetic", _DEGREES, "EPSG", 4326,
             CRS.from_epsg(4326).to_wkt("WKT1_GDAL"), "longitude and latitude")])
        for layer in layers:
            kinds = ["TEXT" if values.dtype == object else "REAL"
                     for values in layer.columns.values()]
            columns = "".join(f', "{name}" {kind}' for name, kind in zip(layer.columns, kinds))
            bounds = shapely.total_bounds(layer.shapes).tolist()  # NaN, so null, without a shape
            database.execute(f'CREATE TABLE "{layer.name}" (fid INTEGER PRIMARY KEY AUTOINCREMENT '
                             f"NOT NULL, geom {layer.kind}{columns})")
            database.execute("INSERT INTO gpkg_contents VALUES (?,'features',?,'',?,?,?,?,?,?)",
                             (layer.name, layer.name, _CHANGED, *bounds, system))
            database.execute("INSERT INTO gpkg_geometry_columns VALUES (?,'geom',?,?,0,0)",
                             (layer.name, layer.kind, system))
            database.executemany(
                f'INSERT INTO "{layer.name}" VALUES (NULL,?{",?" * len(kinds)})',
                zip(_blobs(layer.shapes, system), *(v.tolist() for v in layer.columns.values())))
        database.commit()
        return database.serialize()


def _blobs(shapes: np.ndarray, system: int) -> list[bytes]:
    """Return geometries with the header of a GeoPackage (2.1.3), with the bounds, little endian."""
    bounds = shapely.bounds(shapes)[:, [0, 2, 1, 3]]
    return [struct.pack("<2sBBi4d", b"GP", 0, 0b11, system, *box) + body
            for box, body in zip(bounds, shapely.to_wkb(shapes, byte_order=1))]
