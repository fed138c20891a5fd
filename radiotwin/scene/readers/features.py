"""`MapFile`: buildings and vegetation of a map with their tags, as every reader returns them.

Repairing an outline that crosses itself takes time and memory by the number of crossings, which can
grow with the square of the number of corners: `OutlineBudget` checks it before.

Buildings below the ground are recognised by tags of OpenStreetMap [1] [2] [3], Overture Maps [4],
CityGML (`relativeToTerrain`), ALKIS of the German states (`OFL`) and the Dutch BGT.

[1] https://wiki.openstreetmap.org/wiki/Key:location
[2] https://wiki.openstreetmap.org/wiki/Tag:building:levels=0
[3] https://wiki.openstreetmap.org/wiki/Simple_Indoor_Tagging
[4] https://docs.overturemaps.org/schema/reference/buildings/building
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from radiotwin.io.budgets import CROSSINGS, OUTLINE_CORNERS, PART_PAIRS, VERTICES
from radiotwin.scene.checks import Problem, Severity, listed
from radiotwin.scene.readers.heights import number, parse_length_m
from radiotwin.scene.vegetation import count_meetings

BUILDING_KEYS = ("building", "building:part")  # tags of OpenStreetMap
UNDERGROUND = "building(s) lie below the ground: left out"
INDOORS = "room(s) are inside of buildings: left out"
NOT_THERE = "building(s) do not stand, or not yet: left out"
_LIFECYCLE = ("proposed", "planned", "demolished", "removed", "razed", "destroyed", "collapsed")
_CAR_PARKS = ("parking", "garage", "garages")
_BELOW = {  # tag or column -> values that mean below the ground
    "is_underground": ("true", "yes", "1"),
    "tunnel": ("yes", "true", "1"),
    "relativetoterrain": ("entirelybelowterrain",),
    "ofl": ("1200",), "lagezurerdoberflaeche": ("1200",)}
# Tags that count levels from 0 at the ground
_LEVELS = ("layer", "level", "max_level", "relatievehoogteligging", "relatieve_hoogteligging")
READ_TAGS = frozenset((*BUILDING_KEYS, *_BELOW, *_LEVELS, "location", "parking", "indoor",
                       "has_parts", "building_id", "building:levels:underground", "other_tags"))
_LEVEL_RANGE = re.compile(r"\s*(-?\d+(?:\.\d+)?)\s*(?:-\s*(-?\d+(?:\.\d+)?)\s*)?")
_CHUNK = 256  # segments or boxes that are queried at once: bounds the memory


@dataclass(frozen=True, eq=False)
class Shell:
    """Surfaces of a building in three dimensions.

    Attributes:
        points: (n, 3) longitude, latitude [degrees] and elevation [m].
        polygons: rings of each surface, the outer one first: indices of points, not closed.
        ground_m: elevation of the ground beside the building, i.e. of its lowest point [m].
    """

    points: np.ndarray
    polygons: Sequence[Sequence[np.ndarray]]
    ground_m: float


@dataclass(frozen=True, eq=False)
class Feature:
    """One building or part of a building, or an area or line of vegetation.

    Attributes:
        name: name in the file: `way/17`, `relation/3`, `feature 4`.
        tags: tags as in OpenStreetMap: `building`, `building:part`, `height`, ….
        area: polygons, or the line of a row of trees, in longitude and latitude [degrees]; may be
            invalid, as in the file. With a shell, the convex hull of its points.
        shell: surfaces in three dimensions; None: the area is to be extruded.
    """

    name: str
    tags: Mapping[str, str]
    area: BaseGeometry
    shell: Shell | None = None

    @property
    def is_part(self) -> bool:
        """Whether it is a part of a building, not a building itself."""
        return _is_set(self.tags, "building:part") and not _is_set(self.tags, "building")


@dataclass(frozen=True, eq=False)
class LeftOut:
    """A building or area of a map file that could not be used.

    Attributes:
        name: name in the file.
        reason: the reason, as `building(s) lie below the ground: left out`.
        place: points or area, longitude and latitude [degrees]; None: unknown.
    """

    name: str
    reason: str
    place: BaseGeometry | None


@dataclass
class MapFile:
    """Buildings and vegetation of a map file.

    Attributes:
        features: buildings and parts, in the file's order.
        vegetation: areas, and lines of trees, see `radiotwin.scene.readers.vegetation`.
        left_out: buildings and areas that could not be used.
        problems: problems of the whole file.
        plan_m: unit of the file's east and north [m].
        columns: names of all columns of its tables.
        layers: names of layers without areas.
        streets: (n, 2) longitudes and latitudes of each street [degrees].
    """

    features: list[Feature]
    left_out: list[LeftOut] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)
    vegetation: list[Feature] = field(default_factory=list)
    plan_m: float = 1.0
    columns: set[str] = field(default_factory=set)
    layers: tuple[str, ...] = ()
    streets: list[np.ndarray] = field(default_factory=list)


def problems_of(names: Sequence[str], text: str, severity: Severity = "warning") -> list[Problem]:
    """Return one problem: the number of names, a text, and the first names; [] without names."""
    return [Problem(severity, f"{len(names)} {text} ({listed(names)})")] if names else []


def left_out_problems(left_out: Sequence[LeftOut],
                      bbox_deg: tuple[float, float, float, float] | None) -> list[Problem]:
    """Return a warning for each reason why features of a map were left out.

    Only features known to reach into the box (south, west, north, east) [degrees] count; None: all.
    """
    by_reason: dict[str, list[str]] = {}
    for one in left_out:
        if bbox_deg is not None:
            south, west, north, east = bbox_deg
            if one.place is None or one.place.is_empty:
                continue
            x0, y0, x1, y1 = one.place.bounds
            if not (x0 <= east and x1 >= west and y0 <= north and y1 >= south):
                continue
        by_reason.setdefault(one.reason, []).append(one.name)
    return [problem for reason, names in by_reason.items()
            for problem in problems_of(names, reason)]


def is_building(tags: Mapping[str, str]) -> bool:
    """Return whether tags describe a building or a part of one."""
    return any(_is_set(tags, key) for key in BUILDING_KEYS)


def why_excluded(name: str, tags: Mapping[str, str], place: BaseGeometry | None) -> LeftOut | None:
    """Return why tags exclude a building (underground, indoors, not standing); None: it is kept."""
    for key in BUILDING_KEYS:
        if tags.get(key, "").strip().lower() in _LIFECYCLE:
            return LeftOut(f"{name}: {key}={tags[key]}", NOT_THERE, place)
    why = _below_ground(tags)
    if why:
        return LeftOut(f"{name}: {why}", UNDERGROUND, place)
    if _is_set(tags, "indoor") and not _is_set(tags, "building"):
        return LeftOut(f"{name}: indoor={tags['indoor']}", INDOORS, place)
    return None


def _below_ground(tags: Mapping[str, str]) -> str:
    """Return the tag (`key=value`) that puts a building below the ground; "" if none does."""
    for key, values in _BELOW.items():
        if tags.get(key, "").strip().lower() in values:
            return f"{key}={tags[key]}"
    places = {text.strip().lower() for text in tags.get("location", "").split(";")}
    if "underground" in places <= {"underground", "indoor"}:
        return f"location={tags['location']}"
    storeys, below = (number(tags.get(key, "")) for key in (
        "building:levels", "building:levels:underground"))
    top_m, roof_m = (parse_length_m(tags.get(key, "")) for key in ("height", "roof:height"))
    # A layer is only relative to other objects, and a level may be that of a shop in the building
    stands = {"layer": top_m > 0, "level": _is_set(tags, "building") and (top_m > 0 or storeys > 0)}
    for key in _LEVELS:
        if is_below_zero(tags, key) and not stands.get(key):
            return f"{key}={tags[key]}"
    rises = top_m > 0 or roof_m > 0 or number(tags.get("roof:levels", "")) > 0
    if (tags.get("parking", "").strip().lower() == "underground" and not (rises or storeys > 0)
            and (tags.get("building") in _CAR_PARKS or tags.get("amenity") == "parking")):
        return f"parking={tags['parking']}"
    if below > 0 and storeys == 0 and not rises:
        return f"building:levels=0, building:levels:underground={below:g}"
    if top_m <= 0 and parse_length_m(tags.get("min_height", "")) < 0:
        return f"min_height={tags['min_height']}, height={tags['height']}"
    return ""


def is_below_zero(tags: Mapping[str, str], key: str) -> bool:
    """Return whether all levels in a tag, such as `-2;-1` or `-2--1`, are below zero."""
    ranges = [_LEVEL_RANGE.fullmatch(part) for part in tags.get(key, "").split(";")]
    levels = [float(level) for found in ranges if found for level in found.groups() if level]
    return all(ranges) and max(levels) < 0


def _is_set(tags: Mapping[str, str], key: str) -> bool:
    """Return whether a tag exists with another value than no."""
    return tags.get(key, "").strip().lower() not in ("", "no", "none", "false", "0")


def check_crowding(bounds: np.ndarray, source: object) -> None:
    """Raise BadInput if too many bounding boxes (n, 4) overlap for their areas to be processed.

    For each box, the boxes that contain its centre are counted. In a city these are few: the
    building itself, and the building that it is a part of.
    """
    bounds = bounds[np.isfinite(bounds).all(axis=1)]
    boxes: Any = shapely.box(*bounds.T)
    middles: Any = shapely.points((bounds[:, :2] + bounds[:, 2:]) / 2)
    tree, found = shapely.STRtree(boxes), 0
    for start in range(0, len(bounds), _CHUNK):
        found += tree.query(middles[start:start + _CHUNK]).shape[1]
        PART_PAIRS.check(found, source)


class OutlineBudget:
    """Counts corners and crossings of the outlines of a map; messages begin with `source`."""

    def __init__(self, source: object) -> None:
        self.source = source
        self.corners = self.crossings = 0

    def check(self, name: str, area: BaseGeometry) -> None:
        """Count the corners and crossings of an outline (polygons, valid or not) against limits.

        Raises:
            BadInput: it, or all outlines so far, have too many corners or crossings.
        """
        subject = f"{self.source}: {name}"
        corners = int(shapely.get_num_coordinates(area))
        OUTLINE_CORNERS.check(corners, subject)
        self.corners += corners
        VERTICES.check(self.corners, self.source)
        if area.is_valid:
            return
        rings = shapely.get_rings(shapely.get_parts(shapely.get_parts(area)))
        points = [shapely.get_coordinates(ring) for ring in rings]
        ends = [np.stack([ring[:-1], ring[1:]], axis=1) for ring in points]
        segments: Any = shapely.linestrings(np.concatenate([np.zeros((0, 2, 2)), *ends]))
        self.crossings += count_meetings(
            segments, _CHUNK, lambda count: CROSSINGS.check(self.crossings + count, subject))
