"""Readers of GeoJSON and GeoPackage: areas, with the columns of a table as tags.

Where a file has a column `building` or `building:part`, as exports of OpenStreetMap do, only such
rows are buildings; else every polygon is one. `_` may stand for the `:` of a tag, and case does not
matter. The tags in GDAL's column `other_tags` are read, too.
"""

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from radiotwin.errors import BadInput
from radiotwin.footprints.features import (
    BUILDING_KEYS,
    Feature,
    MapFile,
    is_building,
    problems_of,
)

WGS84 = ("EPSG:4326", "OGC:CRS84", "urn:ogc:def:crs:OGC:1.3:CRS84", "urn:ogc:def:crs:EPSG::4326")
_ALIASES = {key.replace(":", "_"): key for key in (
    "building:part", "building:levels", "building:min_level", "building:material")}
_OTHER_TAGS = re.compile(r'"((?:[^"\\]|\\.)*)"\s*=>\s*"((?:[^"\\]|\\.)*)"')


def read_geojson(path: Path) -> MapFile:
    """Read the polygons of a GeoJSON file.

    Args:
        path: file after RFC 7946 (longitude, latitude), or with an older `crs` member.

    Returns:
        The buildings.

    Raises:
        BadInput: no such file, not GeoJSON, or coordinates that are not numbers; with the
            feature's number.
    """
    try:
        data = json.loads(path.read_bytes())
    except OSError as error:
        raise BadInput(f"{path} cannot be read ({error.strerror}); give a GeoJSON file") from None
    except (ValueError, RecursionError) as error:
        raise BadInput(f"{path} is not valid JSON ({error}); export the map again") from None
    features = data.get("features") if isinstance(data, dict) else None
    if not isinstance(features, list):
        raise BadInput(f"{path} is not a GeoJSON FeatureCollection; export polygons as GeoJSON")
    rows = []
    for number, feature in enumerate(features, start=1):
        geometry, tags = (feature.get(key) or {} if isinstance(feature, dict) else None
                          for key in ("geometry", "properties"))
        if not isinstance(geometry, dict) or not isinstance(tags, dict):
            raise BadInput(f"{path}: feature {number} is not a GeoJSON feature; export the map "
                           "again")
        name = str(feature.get("id") or tags.get("@id") or f"feature {number}")
        rows.append((name, tags, _polygons(path, number, geometry)))
    return _map_file(path, rows, _crs_name(path, data))


def read_geopackage(path: Path) -> MapFile:
    """Read the polygons of all layers of a GeoPackage, in any coordinate reference system.

    Args:
        path: `.gpkg` file.

    Returns:
        The buildings, layer by layer.

    Raises:
        BadInput: pyogrio is not installed, no such file, or not a GeoPackage.
    """
    try:
        import pyogrio
    except ImportError:
        raise BadInput(
            f"{path}: GeoPackages are read with the package pyogrio, which is not installed; "
            "install it with `pip install 'radiotwin[gis]'`, or export the layer as GeoJSON"
        ) from None
    if not path.is_file():
        raise BadInput(f"{path} does not exist; give a GeoPackage")
    found = MapFile([])
    try:
        for layer, kind in pyogrio.list_layers(path):
            if kind is None or "Polygon" not in kind and kind not in (
                    "Unknown", "Geometry", "GeometryCollection"):
                continue
            meta, _, shapes, columns = pyogrio.raw.read(path, layer=layer)
            names = [str(name) for name in meta["fields"]]
            rows = [(f"{layer} {number}", dict(zip(names, values)), shape)
                    for number, (shape, *values) in enumerate(
                        zip(shapely.from_wkb(shapes), *columns), start=1)]
            part = _map_file(path, rows, meta["crs"])
            found.features += part.features
            found.problems += part.problems
    except (pyogrio.errors.DataSourceError, pyogrio.errors.DataLayerError,
            shapely.errors.GEOSException) as error:
        raise BadInput(f"{path} is not a readable GeoPackage ({error}); export it again") from None
    return found


def _polygons(path: Path, number: int, geometry: Mapping) -> BaseGeometry | None:
    """Return the polygons of a GeoJSON geometry; None if it is of another type."""
    kind = geometry.get("type")
    coordinates: Any = geometry.get("coordinates")  # unchecked: no list raises TypeError below
    if kind not in ("Polygon", "MultiPolygon"):
        return None
    try:
        polygons = [[np.array([point[:2] for point in ring], dtype=float) for ring in polygon]
                    for polygon in ([coordinates] if kind == "Polygon" else coordinates)]
        if not all(np.isfinite(ring).all() and ring.ndim == 2
                   for polygon in polygons for ring in polygon):
            raise ValueError
        # RFC 7946 wants at least four points a ring; shorter ones have no area anyway
        return shapely.MultiPolygon([(polygon[0], [ring for ring in polygon[1:] if len(ring) > 3])
                                     for polygon in polygons if polygon and len(polygon[0]) > 3])
    except (TypeError, ValueError, IndexError, OverflowError):
        raise BadInput(f"{path}: feature {number} has coordinates that are not rings of finite "
                       "numbers; export the map again") from None


def _crs_name(path: Path, data: Mapping) -> str:
    crs = data.get("crs")
    if crs is None:
        return WGS84[0]
    try:
        return str(crs["properties"]["name"])
    except (TypeError, KeyError):
        raise BadInput(f"{path}: its crs is {crs!r}, which names no system; remove it (longitude, "
                       "latitude) or name one") from None


def _map_file(
    path: Path, rows: Iterable[tuple[str, Mapping, BaseGeometry | None]], crs: str | None
) -> MapFile:
    """Return the buildings among rows of name, properties and area."""
    tagged = [(name, _tags(properties), area) for name, properties, area in rows]
    marked = any(key in tags for _, tags, _ in tagged for key in BUILDING_KEYS)
    features, unusable = [], []
    for name, tags, area in tagged:
        if marked and not is_building(tags):
            continue
        if area is None or area.geom_type not in ("Polygon", "MultiPolygon", "GeometryCollection"):
            unusable.append(name)
            continue
        features.append(Feature(name, tags if marked else tags | {"building": "yes"}, area))
    problems = problems_of(
        unusable, "building(s) are points or lines, without an area: left out")
    return MapFile(_to_degrees(path, features, crs), problems)


def _tags(properties: Mapping) -> dict[str, str]:
    """Return columns as tags, without empty cells."""
    tags: dict[str, str] = {}
    for key, value in properties.items():
        if value is None or (isinstance(value, float) and not np.isfinite(value)):
            continue
        key = str(key).lower()
        if key == "other_tags":
            tags |= dict(_OTHER_TAGS.findall(str(value)))
        else:
            is_float = isinstance(value, float | np.floating)
            tags[_ALIASES.get(key, key)] = f"{value:g}" if is_float else str(value)
    return tags


def _to_degrees(path: Path, features: list[Feature], crs: str | None) -> list[Feature]:
    if not features or crs in WGS84:
        return features
    from pyproj import CRS, Transformer
    from pyproj.exceptions import CRSError

    if crs is None:
        raise BadInput(f"{path} has no coordinate reference system; assign one (in QGIS: Layer "
                       "CRS) and export it again")
    try:
        transformer = Transformer.from_crs(CRS(crs), "EPSG:4326", always_xy=True)
    except CRSError as error:
        raise BadInput(f"{path}: its coordinate reference system {crs!r} is unknown ({error}); "
                       "export it in EPSG:4326") from None

    def project(points: np.ndarray) -> np.ndarray:
        return np.column_stack(transformer.transform(*points.T))

    return [Feature(feature.name, feature.tags, shapely.transform(feature.area, project))
            for feature in features]
