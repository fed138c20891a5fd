"""Objects of 3D city models (CityGML, CityJSON, multipatches), and their conversion to features.

Objects have attributes, children, and geometries of several levels of detail (LoD). Of a building,
the most detailed geometry up to LoD 2 is taken, else its outline (LoD 0) with a height from its
attributes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from radiotwin.errors import BadInput
from radiotwin.io.budgets import SHAPES, VERTICES
from radiotwin.scene.checks import Problem, listed, warning
from radiotwin.scene.readers.features import Feature, LeftOut, MapFile, Shell, why_excluded
from radiotwin.scene.readers.heights import column_name
from radiotwin.scene.readers.systems import (
    chosen_system,
    find_city_system,
    plane_of,
    to_degrees,
    vertical_unit_m,
)

if TYPE_CHECKING:
    from pyproj import CRS

BUILT = ("Building", "BuildingPart", "BuildingInstallation", "BuildingConstructiveElement",
         "BuildingUnit", "Bridge", "BridgePart", "BridgeInstallation",
         "BridgeConstructionElement", "BridgeConstructiveElement", "OtherConstruction",
         "ConstructiveElement")
"""Types of objects that are read; others (terrain, plants, traffic) are counted in a warning."""
_MAX_PARENTS = 10  # usual are three: a building, its part, an installation of the part
_NOT_BUILT = "object(s) have no surfaces that can be used: left out"

Polygon = list[np.ndarray]


@dataclass
class Geometry:
    """One geometry of an object: a solid's shell, or a set of surfaces.

    Attributes:
        lod: level of detail, 0 to 4; 3D BAG has 1.2, 1.3 and 2.2.
        polygons: rings of each polygon, (n, 3) corners in the file's coordinates.
    """

    lod: float
    polygons: list[Polygon] = field(default_factory=list)


@dataclass
class CityObject:
    """An object of a city model.

    Attributes:
        name: identifier.
        kind: type without `+`, such as `Building`.
        attributes: name in lower case -> value as text.
        parent: identifier of the object that it is a part of; "": none.
        geometries: geometries of all levels of detail.
    """

    name: str
    kind: str
    attributes: dict[str, str] = field(default_factory=dict)
    parent: str = ""
    geometries: list[Geometry] = field(default_factory=list)


def city_features(path: Path, objects: Sequence[CityObject], systems: Sequence[str],
                  crs: str | None = None) -> MapFile:
    """Convert the buildings among the objects of a city model to features.

    Args:
        path: file, for messages.
        objects: objects in the file's order.
        systems: names of all coordinate reference systems in the file.
        crs: system of a file that names none; None: refuse it.

    Raises:
        BadInput: no, several or an unknown system, or coordinates outside its area of use.
    """
    by_name = {one.name: one for one in objects}
    built = [one for one in objects if one.kind in BUILT]
    chosen: list[tuple[CityObject, str, list[Geometry]]] = []
    unusable: list[CityObject] = []
    rows = [(one, _building_name(one, by_name), _best_geometries(one, 1), _best_geometries(one, 0))
            for one in built]
    with_surfaces = {building for _, building, surfaces, _ in rows if surfaces}
    with_any = with_surfaces | {building for _, building, _, outlines in rows if outlines}
    for one, building, surfaces, outlines in rows:
        # The outline of a building is not needed if its parts have surfaces
        geometries = surfaces or ([] if building in with_surfaces else outlines)
        if geometries:
            chosen.append((one, building, geometries))
        elif building not in with_any and one.name == building or (
                one.geometries and building not in with_surfaces):
            unusable.append(one)
    SHAPES.check(sum(len(geometries) for _, _, geometries in chosen), path)
    problems = _other_objects(objects)
    if not chosen:
        return MapFile([], [LeftOut(one.name, _NOT_BUILT, None) for one in unusable], problems)
    systems = systems or ([crs] if crs else [])
    if not systems:
        raise BadInput(f"{path} names no coordinate reference system (CityJSON: "
                       "metadata.referenceSystem, GML: srsName); declare it with --crs, such as "
                       "--crs EPSG:25832")
    points = _in_degrees(path, [geometry for _, _, found in chosen for geometry in found],
                         _one_system(path, systems, crs))
    features, left_out = [], [LeftOut(one.name, _NOT_BUILT, None) for one in unusable]
    for feature in _features(chosen, points, by_name):
        if below := why_excluded(feature.name, feature.tags, feature.area):
            left_out.append(below)
        else:
            features.append(feature)
    return MapFile(features, left_out, problems)


def _building_name(one: CityObject, by_name: Mapping[str, CityObject]) -> str:
    """Return the name of the building that an object belongs to: its outermost built parent.

    A group of buildings (CityObjectGroup), which has them as children, does not count.
    """
    seen = [one.name]
    while (one.parent in by_name and by_name[one.parent].kind in BUILT
           and len(seen) < _MAX_PARENTS):
        one = by_name[one.parent]
        if one.name in seen:  # in a file, an object may be a part of itself
            return min(seen)
        seen.append(one.name)
    return one.name


def _best_geometries(one: CityObject, lowest_lod: int) -> list[Geometry]:
    """Return surfaces (`lowest_lod` 1) or outlines (0) of the highest level below 3, or lowest."""
    usable = [geometry for geometry in one.geometries
              if any(len(ring) for polygon in geometry.polygons for ring in polygon)
              and (geometry.lod >= 1) == (lowest_lod >= 1)]
    levels = sorted({geometry.lod for geometry in usable})
    if not levels:
        return []
    best = max((lod for lod in levels if lod < 3), default=levels[0])
    return [geometry for geometry in usable if geometry.lod == best]


def _other_objects(objects: Sequence[CityObject]) -> list[Problem]:
    """Return a warning that counts the objects that are neither buildings nor bridges; or []."""
    counts: dict[str, int] = {}
    for one in objects:
        if one.kind not in BUILT and one.geometries:
            counts[one.kind] = counts.get(one.kind, 0) + 1
    if not counts:
        return []
    kinds = [f"{kind}: {number:,}" for kind, number in counts.items()]
    return [warning(f"{sum(counts.values()):,} objects are neither buildings nor bridges and were "
                    f"left out ({listed(kinds)})")]


def _one_system(path: Path, names: Sequence[str], crs: str | None) -> "CRS":
    """Return the coordinate reference system that `names` and `crs` mean; BadInput if several."""
    chosen_system(path, names[0], crs)
    systems = [find_city_system(path, name) for name in dict.fromkeys(names)]
    for name, other in zip(dict.fromkeys(names), systems):
        if plane_of(other) != plane_of(systems[0]):
            raise BadInput(f"{path} names several coordinate reference systems ({names[0][:60]!r} "
                           f"and {name[:60]!r}); export it in one")
    return systems[0]


def _in_degrees(path: Path, geometries: Sequence[Geometry], system: "CRS") -> list[np.ndarray]:
    """Return the corners of each geometry: longitude, latitude [degrees], elevation [m]."""
    corners = [np.concatenate([ring for polygon in geometry.polygons for ring in polygon])
               for geometry in geometries]
    together = np.concatenate(corners)
    VERTICES.check(len(together), path)
    if not np.isfinite(together).all():
        raise BadInput(f"{path}: {int((~np.isfinite(together).all(axis=1)).sum()):,} corners are "
                       "not finite; export the model again")
    together[:, :2] = to_degrees(path, system, together[:, :2])
    together[:, 2] *= vertical_unit_m(system)
    if not np.isfinite(together).all():
        raise BadInput(f"{path}: some coordinates lie outside of what {system.name!r} can "
                       "express; correct them, or the system")
    return np.split(together, np.cumsum([len(each) for each in corners])[:-1])


def _features(chosen: list[tuple[CityObject, str, list[Geometry]]], points: list[np.ndarray],
              by_name: Mapping[str, CityObject]) -> list[Feature]:
    """Return a feature for each chosen geometry, an outline or a shell of surfaces, with tags.

    `points` are the corners (n, 3) of each: longitude, latitude [degrees], height [m].
    """
    ground_m: dict[str, float] = {}
    corners = iter(points)
    rows = [(one, root, geometry, next(corners))
            for one, root, geometries in chosen for geometry in geometries]
    for _, root, geometry, known in rows:
        if geometry.lod >= 1:
            ground_m[root] = min(ground_m.get(root, np.inf), float(known[:, 2].min()))
    features = []
    for one, root, geometry, known in rows:
        tags = by_name[root].attributes | one.attributes | {"building": "yes"}
        tags = {column_name(key): value for key, value in tags.items()}
        if geometry.lod < 1:
            features.append(Feature(root, tags, _outline(geometry, known)))
            continue
        shell = Shell(known, _ring_indices(geometry), ground_m[root])
        features.append(Feature(root, tags, shapely.MultiPoint(known[:, :2]).convex_hull, shell))
    return features


def _ring_indices(geometry: Geometry) -> list[list[np.ndarray]]:
    """Return the rings of each polygon as indices of the geometry's corners."""
    sizes = [len(ring) for polygon in geometry.polygons for ring in polygon]
    rings = iter(np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1]))
    return [[next(rings) for _ in polygon] for polygon in geometry.polygons]


def _outline(geometry: Geometry, known: np.ndarray) -> shapely.MultiPolygon:
    """Return an outline (LoD 0) as polygons in degrees; `known` are its corners (n, 3)."""
    polygons = []
    for rings in _ring_indices(geometry):
        loops = [known[ring, :2] for ring in rings if len(ring) > 2]
        if loops:
            polygons.append((loops[0], loops[1:]))
    return shapely.MultiPolygon(polygons)
