"""Buildings as prisms in the local frame, from areas with tags or from shells; their contacts.

Closed shells become solids like the extruded ones, so that coincident walls of neighbours are
united. Open ones are kept unchanged, and reported. The lowest point of each building is put on the
flat ground: terrain of the file itself is not used.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeAlias

import numpy as np
import shapely
import trimesh
from manifold3d import Error, Manifold, Mesh64
from shapely.geometry.base import BaseGeometry

from radiotwin.geo import to_local
from radiotwin.io.budgets import CORNERS, FACES, OVERLAPS, PART_PAIRS, TOUCHING_CORNERS
from radiotwin.io.forms import Origin
from radiotwin.scene.checks import Problem, Severity
from radiotwin.scene.materials import Material, MaterialTable
from radiotwin.scene.meshes import clean, cut_polygon, is_closed, triangulate
from radiotwin.scene.readers.features import (
    Feature,
    Shell,
    check_crowding,
    is_below_zero,
    problems_of,
)
from radiotwin.scene.readers.heights import KNOWN, MAX_HEIGHT_M, Height, HeightColumn, height_of
from radiotwin.scene.surfaces import Surfaces

GRID_M = 0.01  # [m], corners are rounded to it, so that walls meant to coincide do
MIN_OVERLAP_M2 = 1.0  # [m²], smaller overlaps are not reported
_CHUNK, _PAIRS_AT_ONCE = 64, 10_000  # prisms, and pairs of them, at once: bound the memory
SLIVER_AREA_M2 = 1.0  # [m²]
SLIVER_WIDTH_M = 0.3  # [m], mean width; the thickness of one wall
MIN_COVERED_SHARE = 0.9  # an outline is left out if its parts cover at least this share
HEADROOM_M = 2.5  # [m], a building that begins higher above the ground is reported
Area = tuple[Feature, shapely.MultiPolygon]
_WALL_SINE = 0.02  # a triangle with a smaller share of its area seen from above is of a wall
_DECIMALS = 4  # of corners [m]: equal ones are welded, as by `meshes.WELD_M`


ModelSurfaces: TypeAlias = Manifold | tuple[np.ndarray, np.ndarray]
"""Surfaces of a 3D model, in the local frame [m]: closed, or open: corners (v, 3), faces (f, 3)."""


@dataclass(frozen=True, eq=False)
class Prism:
    """A building or part of one, with vertical walls and a flat roof, or a 3D model.

    Attributes:
        name: name of the feature; several prisms may share one.
        area: one valid polygon in the local frame; with a 3D model, its footprint [m].
        height: bottom and top, and their source.
        material: material of its surfaces.
        material_from: tag that the material follows from, or `default`.
        model_surfaces: surfaces of a 3D model; None: vertical walls and a flat roof over the area.
        building_footprint: footprint of the whole building, whose ground the height counts from;
            None: the area.
        ground_m: height of that ground above the datum [m].
    """

    name: str
    area: shapely.Polygon | shapely.MultiPolygon
    height: Height
    material: Material
    material_from: str
    model_surfaces: ModelSurfaces | None = None
    building_footprint: BaseGeometry | None = None
    ground_m: float = 0.0


def make_prisms(
    features: Sequence[Feature], origin: Origin, table: MaterialTable, default_height_m: float,
    height_column: HeightColumn | None = None
) -> tuple[list[Prism], list[Problem]]:
    """Make prisms (outline, bottom, top, material) from buildings and parts, parts first.

    Args:
        features: buildings and parts.
        origin: origin of the local frame.
        table: materials by tag.
        default_height_m: height of a building without a usable one [m].
        height_column: column of heights that the user named; None: known ones.

    Returns:
        The prisms, and problems of the features.
    """
    defects = _Defects()
    areas_m = shapely.transform([feature.area for feature in features],
                                lambda points: np.column_stack(to_local(origin, *points.T)))
    areas = [(feature, kept) for feature, area_m in zip(features, areas_m)
             if (kept := _clean_area(feature, area_m, defects)) is not None]
    buildings = [(feature, area) for feature, area in areas if not feature.is_part]
    parts = [(feature, area) for feature, area in areas if feature.is_part]
    prisms = []
    lowest_m: dict[str, float] = {}  # by building
    for feature, area, (building, footprint) in _resolve_parts(buildings, parts, defects):
        height = height_of(feature.tags, default_height_m, height_column)
        if is_below_zero(feature.tags, "layer") or is_below_zero(feature.tags, "level"):
            defects.add("layer", feature.name)
        if height.unusable:
            defects.add("height", f"{feature.name}: {', '.join(height.unusable)}")
        if height.bottom_m >= height.top_m:
            defects.add("upside down", feature.name)
            continue
        unknown = table.unknown(feature.tags)
        if unknown:
            defects.add("material", f"{feature.name}: {unknown}")
        material, material_from = table.material_of(feature.tags)
        prisms += [Prism(feature.name, polygon, height, material, material_from,
                         building_footprint=footprint)
                   for polygon in shapely.get_parts(area)]
        if not building.is_part:  # a part without an outline may stand on something else
            lowest_m[building.name] = min(lowest_m.get(building.name, np.inf), height.bottom_m)
    for name, bottom_m in lowest_m.items():
        if bottom_m > HEADROOM_M:
            defects.add("floating", name)
    return prisms, defects.problems()


class _Defects:
    """Collects the names of features by the kind of their defect."""

    _KINDS: ClassVar[dict[str, tuple[Severity, str]]] = {
        "invalid": ("fixed", "outline(s) cut or touched themselves: taken apart"),
        "nested": ("fixed", "outline(s) had parts that overlap or lie in each other: united"),
        "no area": ("warning", "building(s) have no area: left out"),
        "sliver": ("warning", f"sliver(s), under {SLIVER_AREA_M2:g} m² or {SLIVER_WIDTH_M:g} m "
                              "wide: left out"),
        "height": ("warning", "building(s) have a height, level or bottom that cannot be used; "
                              "the next tag, or the default, was taken"),
        "upside down": ("warning", "building(s) begin (min_height) no lower than they end: left "
                                   "out"),
        "no footprint": ("warning", "building(s) have no area seen from above: left out"),
        "too tall": ("warning", f"building(s) are not between 0 and {MAX_HEIGHT_M:g} m tall: left "
                                "out; are their elevations in metres?"),
        "open": ("warning", "building(s) are not closed, or cross themselves: kept as they are, "
                            "and not united with what they touch"),
        "material": ("warning", "building(s) have a building:material that is not in the table; "
                                "the default was taken. Name it in --material-table or with "
                                "--material NAME=ITU"),
        "uncovered": ("warning", "outline(s) are covered to less than "
                                 f"{MIN_COVERED_SHARE:.0%} by their parts: the rest keeps the "
                                 "outline's own height"),
        "layer": ("warning", "building(s) have a layer or level below zero, and a height or "
                             "storeys, which count from the ground: built"),
        "no parts": ("warning", "building(s) have parts (has_parts) that the file does not hold: "
                                "built as their outline. Give the parts (building_part of "
                                "Overture Maps) as another layer of one GeoPackage"),
        "floating": ("warning", f"building(s) begin more than {HEADROOM_M:g} m above the ground, "
                                "with all their parts: nothing of them reaches it. They are built "
                                "so; where that is wrong, correct min_height or add what is below"),
    }

    def __init__(self) -> None:
        self.names: dict[str, list[str]] = {}

    def add(self, kind: str, name: str) -> None:
        """Add a feature with a defect of a kind."""
        self.names.setdefault(kind, []).append(name)

    def problems(self) -> list[Problem]:
        """Return one problem for each kind of defect."""
        return [problem for kind, (severity, text) in self._KINDS.items()
                for problem in problems_of(self.names.get(kind, ()), text, severity)]


def _clean_area(feature: Feature, area: BaseGeometry,
                defects: _Defects) -> shapely.MultiPolygon | None:
    """Return a feature's polygons [m], repaired, rounded, without slivers; None if none is left."""
    invalid = not area.is_valid
    area, shared_m2 = _unite_polygons(area)
    if area.area < GRID_M**2:
        defects.add("no area", feature.name)
        return None
    area = _polygons(shapely.set_precision(area, GRID_M))
    if any(_touches_itself(polygon) for polygon in shapely.get_parts(area)):
        shrunk = area.buffer(-0.01, join_style="mitre")  # [m], enough to separate the rings
        area, invalid = _polygons(shapely.set_precision(shrunk, GRID_M / 2)), True
    kept = [polygon for polygon in shapely.get_parts(area) if polygon.area >= SLIVER_AREA_M2
            and 2 * polygon.area / polygon.length >= SLIVER_WIDTH_M]
    if len(kept) < shapely.get_num_geometries(area):
        defects.add("sliver", feature.name)
    if shared_m2 > MIN_OVERLAP_M2:
        defects.add("nested", feature.name)
    elif invalid:
        defects.add("invalid", feature.name)
    return shapely.MultiPolygon(kept) if kept else None


def _unite_polygons(area: BaseGeometry) -> tuple[shapely.MultiPolygon, float]:
    """Return the valid polygons of an area, and the area by which its polygons overlap [m²].

    A polygon inside another one is united with it: a courtyard would be a ring of the polygon [1].

    [1] OGC 06-103r4, Simple feature access, section 6.1.14 (MultiPolygon).
    """
    polygons = _polygons(area)
    if polygons.is_valid:
        return polygons, 0.0
    parts = [shapely.make_valid(polygon) for polygon in polygons.geoms]
    united = _polygons(shapely.union_all(parts) if len(parts) > 1 else parts[0])
    return united, sum(part.area for part in parts) - united.area


def _polygons(area: BaseGeometry) -> shapely.MultiPolygon:
    """Return the polygons in any geometry."""
    flat = shapely.get_parts(shapely.get_parts(area))
    return shapely.MultiPolygon([part for part in flat if part.geom_type == "Polygon"])


def _touches_itself(polygon: shapely.Polygon) -> bool:
    """Return whether the rings of a polygon pass any point twice."""
    rings = (polygon.exterior, *polygon.interiors)
    points = np.concatenate([shapely.get_coordinates(ring)[:-1] for ring in rings])
    return len(np.unique(points, axis=0)) < len(points)


def _resolve_parts(
    buildings: list[Area], parts: list[Area], defects: _Defects
) -> list[tuple[Feature, shapely.MultiPolygon, Area]]:
    """Assign parts to buildings: parts inherit tags, buildings lose the areas of their parts.

    Returned are parts, then buildings: feature, area, and the building with its full area. That of
    a part is the smallest one around it, or the part itself. Covered buildings are left out.
    """
    tree, found = shapely.STRtree([area for _, area in buildings]), 0
    building_m2 = [area.area for _, area in buildings]
    parts_of: dict[int, list[shapely.MultiPolygon]] = {}
    resolved = []
    for feature, area in parts:
        inside = area.representative_point()
        owners = [int(index) for index in tree.query(inside, predicate="within")]
        found += len(owners)
        PART_PAIRS.check(found, "the map")
        building = feature, area
        if owners:
            owner = min(owners, key=building_m2.__getitem__)
            parts_of.setdefault(owner, []).append(area)
            building = buildings[owner]
            feature = _inherit_tags(feature, building[0])
        resolved.append((feature, area, building))
    for index, (feature, area) in enumerate(buildings):
        if index in parts_of:
            uncovered = _polygons(area.difference(shapely.union_all(parts_of[index])))
            if uncovered.area <= (1 - MIN_COVERED_SHARE) * area.area:
                continue
            defects.add("uncovered", feature.name)
            area = shapely.MultiPolygon([polygon for polygon in uncovered.geoms
                                         if polygon.area >= SLIVER_AREA_M2])
        elif feature.tags.get("has_parts", "").lower() in ("true", "1"):
            defects.add("no parts", feature.name)
        resolved.append((feature, area, buildings[index]))
    return resolved


def _inherit_tags(part: Feature, building: Feature) -> Feature:
    """Return a part with its building's tags, except bottom and replaced heights."""
    tags = {key: value for key, value in building.tags.items()
            if key not in ("min_height", "building:min_level")}
    known = [column.name for column in KNOWN]
    row = next((row for row, name in enumerate(known) if name in part.tags), None)
    # Tags that would precede the height of the part, or be added to it
    for name in () if row is None else (*known[:row], "roof:height", "roof:levels"):
        tags.pop(name, None)
    return replace(part, tags=tags | dict(part.tags))


@dataclass(frozen=True, eq=False)
class Contacts:
    """Pairs of prisms that touch or overlap, in the plane and in height.

    Attributes:
        pairs: (n, 2) indices of prisms, the lower index first.
        shared_m2: (n,) common area [m²].
        shared_m: (n,) length of the common area's outline, or of the common wall [m].
    """

    pairs: np.ndarray
    shared_m2: np.ndarray
    shared_m: np.ndarray


def find_contacts(prisms: Sequence[Prism]) -> Contacts:
    """Find pairs of buildings or parts (prisms) that touch or overlap; BadInput if too many."""
    areas: Any = np.array([prism.area for prism in prisms], dtype=object)
    pairs = _touching_pairs(prisms, areas)
    shared_m2, shared_m = np.zeros(len(pairs)), np.zeros(len(pairs))
    overlapping = 0
    for start in range(0, len(pairs), _PAIRS_AT_ONCE):
        part = slice(start, start + _PAIRS_AT_ONCE)
        common = shapely.intersection(*areas[pairs[part].T])
        shared_m2[part], shared_m[part] = shapely.area(common), shapely.length(common)
        overlapping += int(np.count_nonzero(shared_m2[part] > MIN_OVERLAP_M2))
        OVERLAPS.check(overlapping, "the map")
    return Contacts(pairs, shared_m2, shared_m)


def _touching_pairs(prisms: Sequence[Prism], areas: Any) -> np.ndarray:
    """Return the (n, 2) pairs of prisms that touch in plan and height, the lower index first."""
    bottom_m = np.array([prism.height.bottom_m for prism in prisms])
    top_m = np.array([prism.height.top_m for prism in prisms])
    corners, found = shapely.get_num_coordinates(areas), 0
    tree, parts = shapely.STRtree(areas), [np.zeros((0, 2), dtype=int)]
    for start in range(0, len(areas), _CHUNK):
        a, b = tree.query(areas[start:start + _CHUNK], predicate="intersects")
        a = a + start
        common_m = np.minimum(top_m[a], top_m[b]) - np.maximum(bottom_m[a], bottom_m[b])
        kept = (a < b) & (common_m > -GRID_M)
        parts.append(np.stack([a[kept], b[kept]], axis=1))
        found += int(corners[parts[-1]].sum())
        TOUCHING_CORNERS.check(found, "the map")
    return np.concatenate(parts)


def overlap_problems(prisms: Sequence[Prism], contacts: Contacts) -> list[Problem]:
    """Return a warning about buildings that overlap by over 1 m², the largest overlap first."""
    found = []
    for row in np.argsort(-contacts.shared_m2, kind="stable"):
        a, b = (prisms[index] for index in contacts.pairs[row])
        shared_m2 = contacts.shared_m2[row]
        if (shared_m2 > MIN_OVERLAP_M2 and a.name != b.name and min(a.height.top_m, b.height.top_m)
                > max(a.height.bottom_m, b.height.bottom_m)):
            found.append(f"{a.name} and {b.name}: {shared_m2:.0f} m²")
    return problems_of(found, "pair(s) of buildings overlap: their common part is built once")


def make_shell_prisms(features: Sequence[Feature], origin: Origin, table: MaterialTable
                      ) -> tuple[list[Prism], list[Problem]]:
    """Make a prism from each building with 3D surfaces (a shell); also return the problems.

    The prism has the shell's footprint, bottom and top, and its surfaces.

    Args:
        features: features with shells.
        origin: origin of the local frame.
        table: materials by tag.
    """
    prisms: list[Prism] = []
    defects, faces_so_far = _Defects(), 0
    shells = [feature.shell for feature in features if feature.shell is not None]
    points = np.concatenate([np.zeros((0, 3)), *(shell.points for shell in shells)])
    x_m, y_m = to_local(origin, points[:, 0], points[:, 1])
    points_m = np.split(np.column_stack([x_m, y_m, points[:, 2]]),
                        np.cumsum([len(shell.points) for shell in shells])[:-1])
    for feature, shell, corners_m in zip(features, shells, points_m):
        vertices, faces = _triangulate(shell, corners_m)
        faces_so_far += len(faces)
        FACES.check(faces_so_far, "the map")
        area = _footprint(vertices, faces, feature.name)
        if area.area < SLIVER_AREA_M2:
            defects.add("no footprint", feature.name)
            continue
        bottom_m, top_m = vertices[:, 2].min(), vertices[:, 2].max()
        if not 0 < top_m <= MAX_HEIGHT_M:
            defects.add("too tall", f"{feature.name}: {top_m:.4g} m")
            continue
        model_surfaces = _model_surfaces(vertices, faces)
        if isinstance(model_surfaces, tuple):
            defects.add("open", feature.name)
        if value := table.unknown(feature.tags):
            defects.add("material", f"{feature.name}: {value}")
        height = Height(float(bottom_m), float(top_m), "model")
        prisms.append(Prism(feature.name, area, height, *table.material_of(feature.tags),
                            model_surfaces))
    areas: dict[str, list[BaseGeometry]] = {}  # by building
    for prism in prisms:
        areas.setdefault(prism.name, []).append(prism.area)
    footprints = {name: shapely.union_all(parts) for name, parts in areas.items()}
    return ([replace(prism, building_footprint=footprints[prism.name]) for prism in prisms],
            defects.problems())


def elevation_fact(features: Sequence[Feature]) -> str:
    """Format the range of the ground's elevations below buildings with shells, for the report."""
    ground_m = [feature.shell.ground_m for feature in features if feature.shell is not None]
    return (f"buildings begin at {min(ground_m):.1f} to {max(ground_m):.1f} m above the file's "
            "vertical datum; each was put on the ground")


def _triangulate(shell: Shell, points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut the polygons of a shell, points (n, 3) in the local frame [m], into triangles.

    Returned are corners (v, 3) with heights above the building's ground [m], and faces (f, 3).
    """
    vertices = np.round(points_m - [0, 0, shell.ground_m], _DECIMALS)
    vertices, same = np.unique(vertices, axis=0, return_inverse=True)
    same = same.reshape(-1)
    outlines: dict[int, list[np.ndarray]] = {}  # number of corners -> polygons without holes
    faces, seen = [np.zeros((0, 3), dtype=np.int64)], set()
    for polygon in filter(None, shell.polygons):
        rings = [same[ring] for ring in polygon]
        if (key := tuple(ring.tobytes() for ring in rings)) in seen:  # it is in the file twice
            continue
        seen.add(key)
        rings = [ring[ring != np.roll(ring, 1)] for ring in rings]
        rings = [rings[0], *(ring for ring in rings[1:] if len(ring) > 2)]
        corners = np.concatenate(rings)
        CORNERS.check(len(corners), "the map")
        if len(rings) == 1:
            outlines.setdefault(len(corners), []).append(corners)
        elif len(rings[0]) > 2:
            ends = np.cumsum([len(ring) for ring in rings]).tolist()
            faces.append(corners[cut_polygon(vertices[corners], ends)])
    faces += [triangulate(vertices, np.array(group)) for count, group in outlines.items()
              if count > 2]
    return vertices, np.concatenate(faces)


def _footprint(vertices: np.ndarray, faces: np.ndarray, name: str) -> shapely.MultiPolygon:
    """Return the footprint of a building: its faces seen from above, without walls."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    level = np.abs(normals[:, 2]) > _WALL_SINE * np.linalg.norm(normals, axis=1)
    if not level.any():
        return shapely.MultiPolygon()
    plan = corners[level][:, :, :2]
    check_crowding(np.concatenate([plan.min(axis=1), plan.max(axis=1)], axis=1), name)
    flat: Any = shapely.polygons(plan)
    return _polygons(shapely.union_all(shapely.set_precision(flat, GRID_M)))


def _model_surfaces(vertices: np.ndarray, faces: np.ndarray) -> ModelSurfaces:
    """Return a building's triangles as a solid if they are closed, else as a mesh."""
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    solid = closed_solid(vertices, faces)
    if solid is None:  # surfaces of a multi-surface may face either way
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        trimesh.repair.fix_winding(mesh)
        faces = np.asarray(mesh.faces)
        solid = closed_solid(vertices, faces)
    if solid is not None:
        return solid
    cleaned = clean(vertices, faces)[:2]
    surfaces = Surfaces([cleaned])
    return cleaned[0], surfaces.turned(surfaces.inward()).faces


def closed_solid(vertices: np.ndarray, faces: np.ndarray) -> Manifold | None:
    """Return the solid that triangles enclose; None if they are not closed.

    Closedness is tested first: manifold3d reads beyond its memory if an edge has no partner.
    """
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    faces = faces[distinct]
    if not is_closed(faces) or not np.isfinite(vertices).all():
        return None
    solid = Manifold(Mesh64(vertices, faces.astype(np.uint64)))
    if solid.status() == Error.NoError and solid.volume() < 0:
        solid = Manifold(Mesh64(vertices, faces[:, ::-1].astype(np.uint64)))
    return solid if solid.status() == Error.NoError and solid.volume() > 0 else None
