"""Areas with tags -> upright prisms in the local frame, and everything that was wrong with them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely

from radiotwin.footprints.features import Feature
from radiotwin.footprints.heights import Height, height_of
from radiotwin.footprints.material_table import MaterialTable
from radiotwin.geodesy import to_local
from radiotwin.scene.materials import Material
from radiotwin.scene.problems import Problem, Severity, listed
from radiotwin.tables import Origin

GRID_M = 0.01  # corners are rounded to it, so that walls that are meant to lie on one another do
SLIVER_AREA_M2 = 1.0
SLIVER_WIDTH_M = 0.3  # mean width; the thickness of one wall
OVERLAP_M2 = 1.0
WHOLE = 0.9  # of an outline that its parts cover for it to be left out
PINCH_M = 0.01  # taken off an area whose outline touches itself, so that it does not


@dataclass(frozen=True, eq=False)
class Prism:
    """A solid with an upright wall around it and a flat roof.

    Attributes:
        name: of the feature; several prisms may have one.
        area: one valid polygon in the local frame [m].
        height: bottom and top, and how they are known.
        material, material_from: and the tag that says so, or `default`.
    """

    name: str
    area: shapely.Polygon
    height: Height
    material: Material
    material_from: str

    def meets(self, other: "Prism", slack_m: float = 0.0) -> bool:
        """Whether both stand at one height somewhere; with slack, also where one stands on the other."""
        return (min(self.height.top_m, other.height.top_m) - max(self.height.bottom_m, other.height.bottom_m)
                > -slack_m)


def make_prisms(features: Sequence[Feature], origin: Origin, table: MaterialTable, default_height_m: float
                ) -> tuple[list[Prism], list[Problem]]:
    """Prisms of buildings and their parts.

    Args:
        features: buildings and parts.
        origin: of the local frame.
        table: what tags are made of.
        default_height_m: of a building that says nothing about its height.
    """
    notes = _Notes()
    areas = [_clean(feature, origin, notes) for feature in features]
    wholes = [(feature, area) for feature, area in zip(features, areas) if area is not None and not feature.is_part]
    parts = [(feature, area) for feature, area in zip(features, areas) if area is not None and feature.is_part]
    prisms = []
    for feature, area in _without_parts(wholes, parts, notes):
        height = height_of(feature.tags, default_height_m)
        if height.unusable:
            notes.add("height", f"{feature.name}: {', '.join(height.unusable)}")
        if height.bottom_m >= height.top_m:
            notes.add("upside down", feature.name)
            continue
        unknown = table.unknown(feature.tags)
        if unknown:
            notes.add("material", f"{feature.name}: {unknown}")
        material, material_from = table.material_of(feature.tags)
        prisms += [Prism(feature.name, polygon, height, material, material_from) for polygon in shapely.get_parts(area)]
    return prisms, notes.problems()


class _Notes:
    """Findings of one kind, gathered."""

    _KINDS: dict[str, tuple[Severity, str]] = {
        "invalid": ("fixed", "outline(s) cut or touched themselves: taken apart"),
        "no area": ("warning", "building(s) have no area: left out"),
        "sliver": ("warning", f"sliver(s), under {SLIVER_AREA_M2:g} m² or {SLIVER_WIDTH_M:g} m wide: left out"),
        "height": ("warning", "building(s) have a height, a level or a bottom that cannot be; the next tag, or the "
                              "default, was taken"),
        "upside down": ("warning", "building(s) begin (min_height) no lower than they end: left out"),
        "material": ("warning", "building(s) have a building:material that the table does not know; the default was "
                                "taken. Name it in --material-table or with --material NAME=ITU"),
        "rest": ("warning", f"outline(s) are covered to less than {WHOLE:.0%} by their parts: the rest stands at the "
                            "outline's own height"),
    }

    def __init__(self):
        self.names: dict[str, list[str]] = {}

    def add(self, kind: str, name: str) -> None:
        self.names.setdefault(kind, []).append(name)

    def problems(self) -> list[Problem]:
        return [Problem(severity, "", f"{len(self.names[kind])} {text} ({listed(self.names[kind])})")
                for kind, (severity, text) in self._KINDS.items() if kind in self.names]


def _clean(feature: Feature, origin: Origin, notes: _Notes):
    """The valid area in the local frame, a polygon or several; None where nothing is left."""
    area = shapely.transform(feature.area, lambda places: np.column_stack(to_local(origin, *places.T)))
    invalid = not area.is_valid
    area = _polygons(shapely.make_valid(area))
    if area.area < GRID_M**2:
        notes.add("no area", feature.name)
        return None
    area = _polygons(shapely.set_precision(area, GRID_M))
    if any(_touches_itself(polygon) for polygon in shapely.get_parts(area)):
        area, invalid = _polygons(shapely.set_precision(area.buffer(-PINCH_M, join_style="mitre"), GRID_M / 2)), True
    kept = [polygon for polygon in shapely.get_parts(area)
            if polygon.area >= SLIVER_AREA_M2 and 2 * polygon.area / polygon.length >= SLIVER_WIDTH_M]
    if len(kept) < shapely.get_num_geometries(area):
        notes.add("sliver", feature.name)
    if invalid:
        notes.add("invalid", feature.name)
    return shapely.MultiPolygon(kept) if kept else None


def _polygons(area):
    """The polygons of any geometry, as one MultiPolygon."""
    flat = shapely.get_parts(shapely.get_parts(area))
    return shapely.MultiPolygon([part for part in flat if part.geom_type == "Polygon"])


def _touches_itself(polygon: shapely.Polygon) -> bool:
    """Whether two rings, or one ring twice, go through one point."""
    places = np.concatenate([shapely.get_coordinates(ring)[:-1] for ring in (polygon.exterior, *polygon.interiors)])
    return len(np.unique(places, axis=0)) < len(places)


def _without_parts(wholes, parts, notes: _Notes):
    """Parts, with what they do not say taken from their building, and buildings without what their parts stand for."""
    tree = shapely.STRtree([area for _, area in wholes])
    of_whole: dict[int, list] = {}
    result = []
    for feature, area in parts:
        middle = area.representative_point()
        owners = [int(index) for index in tree.query(middle, predicate="within")]
        if owners:
            owner = min(owners, key=lambda index: wholes[index][1].area)
            of_whole.setdefault(owner, []).append(area)
            inherited = {key: value for key, value in wholes[owner][0].tags.items() if key not in ("min_height",
                                                                                                   "building:min_level")}
            if "building:levels" in feature.tags and "height" not in feature.tags:
                inherited.pop("height", None)
            feature = replace(feature, tags=inherited | dict(feature.tags))
        result.append((feature, area))
    for index, (feature, area) in enumerate(wholes):
        if index in of_whole:
            rest = _polygons(area.difference(shapely.union_all(of_whole[index])))
            if rest.area <= (1 - WHOLE) * area.area:
                continue
            notes.add("rest", feature.name)
            area = shapely.MultiPolygon([polygon for polygon in rest.geoms if polygon.area >= SLIVER_AREA_M2])
        result.append((feature, area))
    return result


def find_overlaps(prisms: Sequence[Prism]) -> list[tuple[Prism, Prism, float]]:
    """Pairs of prisms of different buildings that stand in one another, with the area they share [m²]."""
    found = []
    for a, b in _pairs(prisms):
        first, second = prisms[a], prisms[b]
        if first.name == second.name or not first.meets(second):
            continue
        shared_m2 = first.area.intersection(second.area).area
        if shared_m2 > OVERLAP_M2:
            found.append((first, second, shared_m2))
    return found


def neighbours(prisms: Sequence[Prism]) -> list[tuple[int, int]]:
    """Pairs of prisms that share a piece of wall, of roof or of their inside; not those that touch in a corner only."""
    pairs = []
    for a, b in _pairs(prisms):
        if prisms[a].meets(prisms[b], slack_m=GRID_M):
            shared = prisms[a].area.intersection(prisms[b].area)
            if shared.length > GRID_M:
                pairs.append((a, b))
    return pairs


def _pairs(prisms: Sequence[Prism]) -> list[tuple[int, int]]:
    areas = [prism.area for prism in prisms]
    a, b = shapely.STRtree(areas).query(areas, predicate="intersects") if areas else ([], [])
    return [(int(i), int(j)) for i, j in zip(a, b) if i < j]
