"""Reader of GeoJSON, and what it shares with that of GeoPackages: columns of a table as tags.

Where a file has a column `building` or `building:part`, as exports of OpenStreetMap do, only such
rows are buildings; else every polygon is one. `_` may stand for the `:` of a tag, and case does not
matter. The tags in GDAL's column `other_tags` are read, too.
"""

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
    LeftOut,
    MapFile,
    is_building,
)
from radiotwin.footprints.height_columns import ALIASES
from radiotwin.footprints.systems import WGS84, chosen_system, degrees_from, find_system
from radiotwin.inputs import parse_json, read_text

_OTHER_TAG = re.compile(r'[\s,]*+"((?:[^"\\]|\\.)*+)"\s*+=>\s*+"((?:[^"\\]|\\.)*+)"', re.DOTALL)
_NAME_LENGTH = 200  # characters of an id that are kept


def read_geojson(path: Path, crs: str | None = None) -> MapFile:
    """Read the polygons of a GeoJSON file.

    Args:
        path: file after RFC 7946 (longitude, latitude), or with an older `crs` member.
        crs: coordinate reference system of a file without that member; None: that of RFC 7946.

    Returns:
        The buildings.

    Raises:
        BadInput: no such file, not GeoJSON, or coordinates that are not numbers; with the
            feature's number.
    """
    data = parse_json(read_text(path, "GeoJSON file"), path, allow_nan=True)
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
        known = feature.get("id") or tags.get("@id")
        name = (str(known)[:_NAME_LENGTH] if isinstance(known, str | int | float)
                else f"feature {number}")
        rows.append((name, tags, _polygons(path, number, geometry)))
    return map_file(path, rows, chosen_system(path, _crs_name(path, data), crs) or WGS84[0])


def _polygons(path: Path, number: int, geometry: Mapping) -> BaseGeometry | None:
    """Return the polygons of a GeoJSON geometry, or the points of another type; None: none."""
    kind = geometry.get("type")
    coordinates: Any = geometry.get("coordinates")  # unchecked: no list raises TypeError below
    if kind not in ("Polygon", "MultiPolygon"):
        return _points(coordinates)
    try:
        polygons = [[np.array([point[:2] for point in ring], dtype=float) for ring in polygon]
                    for polygon in ([coordinates] if kind == "Polygon" else coordinates)]
        if not all(np.isfinite(ring).all() and ring.ndim == 2
                   for polygon in polygons for ring in polygon):
            raise ValueError
        # RFC 7946 wants at least four points a ring; shorter ones have no area anyway
        return shapely.MultiPolygon([(polygon[0], [ring for ring in polygon[1:] if len(ring) > 3])
                                     for polygon in polygons if polygon and len(polygon[0]) > 3])
    except (TypeError, ValueError, LookupError, OverflowError):
        raise BadInput(f"{path}: feature {number} has coordinates that are not rings of finite "
                       "numbers; export the map again") from None


def area_of_wkb(data: bytes) -> BaseGeometry | None:
    """Return a geometry in well-known binary, in the plane; None: not finite.

    Raises:
        shapely.errors.GEOSException: damaged.
    """
    area = shapely.from_wkb(data)
    return shapely.force_2d(area) if np.isfinite(shapely.get_coordinates(area)).all() else None


def _points(coordinates: Any) -> BaseGeometry | None:
    """Return all positions of a geometry that is no area, for where it lies."""
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
    """Return the buildings among the rows of a table.

    Args:
        path: file, for messages.
        rows: name, properties and area of each.
        crs: name of the coordinate reference system of the areas; None: not known.

    Raises:
        BadInput: no system, or one that is not known.
    """
    tagged = [(name, _tags(properties), area) for name, properties, area in rows]
    marked = any(key in tags for _, tags, _ in tagged for key in BUILDING_KEYS)
    features, unusable = [], []
    for name, tags, area in tagged:
        if marked and not is_building(tags):
            continue
        if area is None or area.geom_type not in ("Polygon", "MultiPolygon", "GeometryCollection"):
            unusable.append(Feature(name, {}, shapely.Point() if area is None else area))
            continue
        features.append(Feature(name, tags if marked else tags | {"building": "yes"}, area))
    return MapFile(_to_degrees(path, features, crs), [
        LeftOut(one.name, "building(s) are points or lines, without an area: left out", one.area)
        for one in _to_degrees(path, unusable, crs)])


def _tags(properties: Mapping) -> dict[str, str]:
    """Return columns as tags, without empty cells."""
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


def _other_tags(text: str) -> dict[str, str]:
    """Return the pairs of `"key"=>"value","key"=>"value"`, as GDAL writes rare tags."""
    tags, found = {}, _OTHER_TAG.match(text)
    while found:  # one after the other: a search would try every quotation mark of a long text
        tags[found[1]] = found[2]
        found = _OTHER_TAG.match(text, found.end())
    return tags


def _to_degrees(path: Path, features: list[Feature], crs: str | None) -> list[Feature]:
    if not features or crs in WGS84:
        return features
    if crs is None:
        raise BadInput(f"{path} has no coordinate reference system; declare it with --crs, such as "
                       "--crs EPSG:25832")
    project = degrees_from(path, find_system(path, crs))
    return [Feature(feature.name, feature.tags, shapely.transform(feature.area, project))
            for feature in features]
