"""OpenStreetMap: areas of buildings and vegetation, and streets, from files.

A closed way is an area, and so is a relation of type multipolygon whose ways form closed rings [1];
rings of role `inner` are courtyards. Where a ring has no role, those within an odd number of others
are. `.osm` files are the XML of OpenStreetMap's API, of Overpass and of JOSM; the first two also
answer in JSON [3]. `.osm.pbf` files are read with libosmium [2] in several passes that keep only
what is needed, so that an extract of a whole region needs little memory.

[1] https://wiki.openstreetmap.org/wiki/Relation:multipolygon
[2] https://osmcode.org/pyosmium
[3] https://wiki.openstreetmap.org/wiki/OSM_JSON
"""

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from radiotwin.errors import BadInput, optional_package
from radiotwin.io.budgets import FEATURES, OUTLINE_CORNERS, VERTICES
from radiotwin.io.inputs import check_input, parse_elements
from radiotwin.scene.checks import warning
from radiotwin.scene.readers.features import (
    BUILDING_KEYS,
    Feature,
    LeftOut,
    MapFile,
    OutlineBudget,
    hidden,
    is_building,
)
from radiotwin.scene.readers.vegetation import TAGS, kind_of

INCOMPLETE = ("building(s) lack nodes or ways, as where an extract was cut off: left out; take a "
              "larger extract, or ask Overpass for `out geom;`")
UNCLOSED = "building(s) have an outline that is not closed: left out"
NO_VEGETATION = "area(s) of vegetation are incomplete, not closed or too intricate: left out"
_MADE_UP = -(2**60)  # ids of nodes that have none
_PLACE_NODES = 1000  # that say where something lies: many relations may name one long way
MIN_RING_NODES = 4  # a triangle, with the first node again at the end
STREETS = ("motorway", "trunk", "primary", "secondary", "tertiary", "unclassified", "residential",
           "living_street", "pedestrian", "motorway_link", "trunk_link", "primary_link",
           "secondary_link", "tertiary_link")  # values of highway that pictures show
MAX_STREET_NODES = 1_000_000  # of an .osm.pbf file, in 200 MB; with more it is read without streets
_IDS_PER_BLOCK = 100  # elements: 40 kB of the filter for each that is looked for
REMARKED = ("Overpass added a remark to its answer, as where it ran out of time or memory: "
            "buildings may be missing; ask for a smaller area, or more time ([timeout:600])")


@dataclass
class Way:
    """A polyline.

    Attributes:
        nodes: ids, in order.
        tags: of the way.
    """

    nodes: list[int]
    tags: dict[str, str] = field(default_factory=dict)


@dataclass
class Relation:
    """A group of ways.

    Attributes:
        members: id of a way, and its role.
        tags: of the relation.
    """

    members: list[tuple[int, str]] = field(default_factory=list)
    tags: dict[str, str] = field(default_factory=dict)


@dataclass
class OsmElements:
    """Elements of a map file, by their ids.

    Attributes:
        positions: node -> longitude and latitude [degrees].
        ways: at least the buildings, and the ways of relations that are buildings.
        relations: at least those of type multipolygon.
        nodes_at: place -> node, of places that stand in ways and relations.
        remarked: whether Overpass remarks something, as where it ran out of time.
    """

    positions: dict[int, tuple[float, float]] = field(default_factory=dict)
    ways: dict[int, Way] = field(default_factory=dict)
    relations: dict[int, Relation] = field(default_factory=dict)
    nodes_at: dict[tuple[float, float], int] = field(default_factory=dict)
    remarked: bool = False

    def node_at(self, place: tuple[float, float], number: int | None = None) -> int:
        """Return the node at a place, with that number, or one that is made up."""
        known = self.nodes_at.setdefault(
            place, _MADE_UP - len(self.nodes_at) if number is None else number)
        known = known if number is None else number
        self.positions[known] = place
        return known

    def add(self, number: int, element: Way | Relation) -> None:
        """Add a way or relation; Overpass may give one twice, once without its tags."""
        if isinstance(element, Way):
            known = self.ways.get(number, element)
            self.ways[number] = Way(element.nodes or known.nodes, element.tags or known.tags)
        else:
            other = self.relations.get(number, element)
            self.relations[number] = Relation(element.members or other.members,
                                              element.tags or other.tags)


def assemble(elements: OsmElements) -> MapFile:
    """Assemble the areas of buildings and building parts, ways first, and of vegetation.

    Incomplete or open outlines are left out and reported.
    """
    budget = OutlineBudget("the map")
    left_out: list[LeftOut] = []
    relations: list[Feature] = []
    used: set[int] = set()
    for number, relation in elements.relations.items():
        tags = _relation_tags(relation, elements)
        if tags is None:
            continue
        area = _relation_area(f"relation/{number}", relation, elements, budget)
        if isinstance(area, str):
            left_out.append(LeftOut(f"relation/{number}", INCOMPLETE if area == "incomplete"
                                    else UNCLOSED, _place(relation, elements)))
            continue
        used.update(way for way, role in relation.members if role == "outer" or (
            role != "inner" and not _is_courtyard(elements.ways[way], area, elements)))
        if below := hidden(f"relation/{number}", tags, area):
            left_out.append(below)
        else:
            relations.append(Feature(f"relation/{number}", tags, area))
    ways = []
    for number, way in elements.ways.items():
        if number in used or not is_building(way.tags):
            continue
        if below := hidden(f"way/{number}", way.tags, None):
            left_out.append(replace(below, place=_place(way, elements)))
        elif not way.nodes or any(node not in elements.positions for node in way.nodes):
            left_out.append(LeftOut(f"way/{number}", INCOMPLETE, _place(way, elements)))
        elif len(way.nodes) < MIN_RING_NODES or way.nodes[0] != way.nodes[-1]:
            left_out.append(LeftOut(f"way/{number}", UNCLOSED, _place(way, elements)))
        else:
            OUTLINE_CORNERS.check(len(way.nodes), f"way/{number}")
            ways.append(Feature(f"way/{number}", way.tags, _polygon(way.nodes, elements)))
    left_out.sort(key=lambda one: one.reason != INCOMPLETE)
    vegetation, unusable = _vegetation(elements)
    return MapFile(ways + relations, left_out + unusable, vegetation=vegetation,
                   problems=[warning(REMARKED)] if elements.remarked else [],
                   streets=_streets(elements))


def _streets(elements: OsmElements) -> list[np.ndarray]:
    """Return the (n, 2) longitudes and latitudes of each street [degrees], for pictures."""
    lines = ([elements.positions[node] for node in way.nodes if node in elements.positions]
             for way in elements.ways.values()
             if way.tags.get("highway") in STREETS and way.tags.get("area") != "yes")
    return [np.array(line) for line in lines if len(line) > 1]


def _place(element: Way | Relation, elements: OsmElements) -> BaseGeometry:
    """Return the first points that are known of a way, or of the ways of a relation."""
    ways = [element] if isinstance(element, Way) else [
        elements.ways[number] for number, _ in element.members if number in elements.ways]
    nodes = islice((node for way in ways for node in way.nodes), _PLACE_NODES)
    return shapely.MultiPoint([elements.positions[node] for node in nodes
                               if node in elements.positions])


def _vegetation(elements: OsmElements) -> tuple[list[Feature], list[LeftOut]]:
    """Return areas of vegetation and rows of trees, and those that are unusable."""
    found: list[Feature] = []
    unusable: list[LeftOut] = []
    budget = OutlineBudget("the map")
    ways: list[tuple[str, Way | Relation]] = [
        (f"way/{number}", way) for number, way in elements.ways.items()]
    for name, element in [*ways, *((f"relation/{number}", relation)
                                   for number, relation in elements.relations.items())]:
        kind = kind_of(element.tags)
        if kind is None or is_building(element.tags):
            continue
        try:
            area = _way_area(name, element, kind, elements) if isinstance(element, Way) \
                else _relation_area(name, element, elements, budget)
            if not isinstance(area, str):
                budget.check(name, area)
        except BadInput:  # a wood may have more corners than any building
            area = "incomplete"
        if isinstance(area, str):
            unusable.append(LeftOut(name, NO_VEGETATION, _place(element, elements)))
        else:
            found.append(Feature(name, element.tags, area))
    return found, unusable


def _way_area(name: str, way: Way, kind: str,
              elements: OsmElements) -> BaseGeometry | Literal["incomplete"]:
    closed = len(way.nodes) >= MIN_RING_NODES and way.nodes[0] == way.nodes[-1]
    complete = all(node in elements.positions for node in way.nodes)
    OUTLINE_CORNERS.check(len(way.nodes), name)
    if not complete or not (closed or (kind == "tree_row" and len(way.nodes) > 1)):
        return "incomplete"
    if kind == "tree_row":
        return shapely.LineString([elements.positions[node] for node in way.nodes])
    return _polygon(way.nodes, elements)


def _relation_tags(relation: Relation, elements: OsmElements) -> dict[str, str] | None:
    """Return the tags of a building, in old maps those of its outer ways; None: not a building."""
    if relation.tags.get("type") != "multipolygon":
        return None
    outer = [elements.ways[way].tags for way, role in relation.members
             if role != "inner" and way in elements.ways]
    if is_building(relation.tags):
        inherited = outer if len(outer) == 1 else []
    elif len(relation.tags) == 1 and outer and all(is_building(tags) for tags in outer):
        inherited = outer
    else:
        return None
    merged: dict[str, str] = {}
    for tags in inherited:
        merged |= tags
    return merged | relation.tags


def _relation_area(
    name: str, relation: Relation, elements: OsmElements, budget: OutlineBudget
) -> BaseGeometry | Literal["incomplete", "open"]:
    """Return the area, or that ways or nodes are missing, or that the ways do not close."""
    chains: dict[bool, list[Sequence[int]]] = {True: [], False: []}
    corners, named = 0, True
    for number, role in relation.members:
        way = elements.ways.get(number)
        corners += len(way.nodes) if way is not None else 0
        OUTLINE_CORNERS.check(corners, name)
        if way is None or any(node not in elements.positions for node in way.nodes):
            return "incomplete"
        chains[role != "inner"].append(way.nodes)
        named &= role in ("outer", "inner")
    outer, inner = stitch(chains[True]), stitch(chains[False])
    if not outer or inner is None:
        return "open"
    outlines, holes = ([_polygon(ring, elements) for ring in rings] for rings in (outer, inner))
    budget.check(name, shapely.MultiPolygon([*outlines, *holes]))
    if not named:
        return shapely.build_area(shapely.union_all(shapely.get_rings([*outlines, *holes])))
    area = _union(outlines)
    return area.difference(_union(holes)) if holes else area


def _is_courtyard(way: Way, area: BaseGeometry, elements: OsmElements) -> bool:
    """Return whether what is just inside of a way is not in an area."""
    if len(way.nodes) < MIN_RING_NODES or way.nodes[0] != way.nodes[-1]:
        return False
    outline = shapely.make_valid(_polygon(way.nodes, elements))
    rim = outline.difference(outline.buffer(-1e-3 * math.sqrt(outline.area)))
    return not area.contains(rim.representative_point())


def _union(polygons: list[shapely.Polygon]) -> BaseGeometry:
    return shapely.union_all([shapely.make_valid(polygon) for polygon in polygons])


def stitch(chains: list[Sequence[int]]) -> list[list[int]] | None:
    """Join ways, by their nodes' ids, that meet at their ends to closed rings.

    The first node of a ring stands again at its end. None if an end remains open.
    """
    rings = [list(chain) for chain in chains
             if len(chain) >= MIN_RING_NODES and chain[0] == chain[-1]]
    loose = {number: list(chain) for number, chain in enumerate(chains)
             if len(chain) > 1 and chain[0] != chain[-1]}
    at_node: dict[int, deque[int]] = {}
    for number, chain in loose.items():
        for node in (chain[0], chain[-1]):
            at_node.setdefault(node, deque()).append(number)
    while loose:
        _, ring = loose.popitem()
        while ring[0] != ring[-1]:
            waiting = at_node[ring[-1]]
            while waiting and waiting[0] not in loose:
                waiting.popleft()
            if not waiting:
                return None
            chain = loose.pop(waiting.popleft())
            ring += (chain if chain[0] == ring[-1] else chain[::-1])[1:]
        if len(ring) >= MIN_RING_NODES:
            rings.append(ring)
    return rings


def _polygon(nodes: Sequence[int], elements: OsmElements) -> shapely.Polygon:
    return shapely.Polygon([elements.positions[node] for node in nodes])


def read_osm_xml(path: Path) -> OsmElements:
    """Read all nodes, ways and relations of an `.osm` file that are not deleted.

    Raises:
        BadInput: no such file, malformed XML, not a map of OpenStreetMap, or an impossible value;
            with file and line.
    """
    reader = _Reader(path)
    parse_elements(path, reader.start, reader.end)
    return reader.elements


class _Reader:
    """Callbacks of the XML parser that collect the elements of one file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.elements = OsmElements()
        self.depth = 0
        self.most = VERTICES.limit  # read once: there are millions of nodes
        self.open: Way | Relation | None = None
        self.number = 0  # of the one that is open
        self.member: Way | None = None  # of the relation that is open

    def start(self, tag: str, attributes: dict[str, str], line: int) -> None:
        self.depth += 1
        if self.depth == 1 and tag != "osm":
            raise BadInput(f"{self.path}, line {line}: the file begins with <{tag}>, not <osm>; "
                           "give a map in OpenStreetMap's XML, as its export, Overpass "
                           "([out:xml]) or JOSM make it")
        if self.depth == 2:
            if attributes.get("action") != "delete" and attributes.get("visible") != "false":
                self._element(tag, attributes, line)
        elif self.depth == 3 and self.open is not None:
            self._content(tag, attributes, line)
        elif self.depth == 4 and tag == "nd" and self.member is not None:  # of `out geom;`
            self.member.nodes.append(self.elements.node_at(self._place(attributes, line)))

    def end(self, tag: str) -> None:
        self.depth -= 1
        if self.depth == 2 and self.member is not None and isinstance(self.open, Relation):
            if self.member.nodes:
                self.elements.ways.setdefault(self.open.members[-1][0], self.member)
            self.member = None
        if self.depth == 1 and self.open is not None:
            self.elements.add(self.number, self.open)
            self.open = None

    def _element(self, tag: str, attributes: dict[str, str], line: int) -> None:
        if tag == "node":
            self.elements.positions[self._integer(attributes, "id", line)] = self._place(
                attributes, line)
            if len(self.elements.positions) > self.most:
                VERTICES.check(len(self.elements.positions), self.path)
        elif tag in ("way", "relation"):
            self.open = Way([]) if tag == "way" else Relation()
            self.number = self._integer(attributes, "id", line)
        elif tag == "remark":
            self.elements.remarked = True

    def _content(self, tag: str, attributes: dict[str, str], line: int) -> None:
        assert self.open is not None
        if tag == "tag":
            self.open.tags[attributes.get("k", "")] = attributes.get("v", "")
        elif tag == "nd" and isinstance(self.open, Way):
            node = self._integer(attributes, "ref", line)
            if "lat" in attributes:  # of `out geom;`
                self.elements.node_at(self._place(attributes, line), node)
            self.open.nodes.append(node)
        elif (tag == "member" and isinstance(self.open, Relation)
              and attributes.get("type") == "way"):
            way = self._integer(attributes, "ref", line)
            self.open.members.append((way, attributes.get("role", "")))
            self.member = Way([])

    def _place(self, attributes: dict[str, str], line: int) -> tuple[float, float]:
        return (self._degrees(attributes, "lon", 180, line),
                self._degrees(attributes, "lat", 90, line))

    def _integer(self, attributes: dict[str, str], name: str, line: int) -> int:
        try:
            return int(attributes[name])
        except (KeyError, ValueError):
            raise BadInput(f"{self.path}, line {line}: {name}={attributes.get(name)!r} is not a "
                           "whole number; export the map again") from None

    def _degrees(self, attributes: dict[str, str], name: str, limit: float, line: int) -> float:
        try:
            value = float(attributes[name])
        except (KeyError, ValueError):
            value = math.nan
        if not -limit <= value <= limit:
            raise BadInput(f"{self.path}, line {line}: a node has {name}={attributes.get(name)!r}; "
                           f"allowed is -{limit} to {limit} degrees; export the map again")
        return value


def osm_of_json(path: Path, document: Mapping) -> OsmElements:
    """Return the elements of OpenStreetMap's JSON.

    Nodes are elements of their own, or, where Overpass was asked for `out geom;`, places in the
    ways and in the members of relations.

    Raises:
        BadInput: an impossible value, with the element.
    """
    elements = OsmElements(remarked="remark" in document)
    by_kind: dict[str, list[tuple[str, Mapping]]] = {"node": [], "way": [], "relation": []}
    for number, element in enumerate(document["elements"], start=1):
        if not isinstance(element, dict):
            raise BadInput(f"{path}: element {number} is not an object; export the map again")
        if element.get("visible") is not False:
            by_kind.get(str(element.get("type")), []).append((f"{path}: element {number}", element))

    def place(subject: str, point: Mapping) -> tuple[float, float]:
        try:
            found = float(point["lon"]), float(point["lat"])
        except (KeyError, TypeError, ValueError, OverflowError):
            found = math.nan, math.nan
        if not (abs(found[0]) <= 180 and abs(found[1]) <= 90):
            raise BadInput(f"{subject} has lon={point.get('lon')!r:.20}, lat="
                           f"{point.get('lat')!r:.20}; allowed are -180 to 180 and -90 to 90 "
                           "degrees; export the map again")
        return found

    def way(subject: str, element: Mapping) -> Way:
        nodes, points = _list(subject, element, "nodes"), _list(subject, element, "geometry")
        found = [_whole(subject, node) for node in nodes]
        for row, point in enumerate(points):
            if isinstance(point, dict):  # of a part outside of a box, null
                number = found[row] if row < len(found) else None
                found[row:row + 1] = [elements.node_at(place(subject, point), number)]
            elif row >= len(found):
                found.append(0)  # a node without a place
        VERTICES.check(len(elements.positions), path)
        return Way(found, _tags(element))

    for subject, element in by_kind["node"]:
        elements.node_at(place(subject, element), _whole(subject, element.get("id")))
    for subject, element in by_kind["way"]:
        elements.add(_whole(subject, element.get("id")), way(subject, element))
    for subject, element in by_kind["relation"]:
        members = [(_whole(subject, one.get("ref")), str(one.get("role", "")), one)
                   for one in _list(subject, element, "members")
                   if isinstance(one, dict) and one.get("type") == "way"]
        for number, _, member in members:
            if number not in elements.ways and member.get("geometry"):
                elements.ways[number] = way(subject, member)
        elements.add(_whole(subject, element.get("id")), Relation(
            [(number, role) for number, role, _ in members], _tags(element)))
    return elements


def _list(subject: str, element: Mapping, name: str) -> list:
    found = element.get(name) or []
    if not isinstance(found, list):
        raise BadInput(f"{subject}: its {name} are no list; export the map again")
    return found


def _whole(subject: str, value: object) -> int:
    if type(value) is not int:
        raise BadInput(f"{subject}: {value!r:.40} is no whole number; export the map again")
    return value


def _tags(element: Mapping) -> dict[str, str]:
    tags = element.get("tags")
    return {str(key): str(value) for key, value in tags.items()} if isinstance(tags, dict) else {}


def read_osm_pbf(path: Path) -> OsmElements:
    """Read buildings, vegetation and streets, their ways and nodes, of an `.osm.pbf` file.

    Raises:
        BadInput: pyosmium is not installed, no such file, or not a PBF file.
    """
    osmium = optional_package(
        "osmium", f"{path}: .osm.pbf is read with the package osmium, which is not installed; "
                  "install it with `pip install 'radiotwin[gis]'`, or convert the file: `osmium "
                  "cat area.osm.pbf -o area.osm`")
    check_input(path, "map in OpenStreetMap's PBF format")
    # An absolute path: what begins with `http:` would be fetched, `-` is standard input
    file = osmium.io.File(str(path.absolute()), "pbf")
    kinds, filters = osmium.osm, osmium.filter

    def matching(kind: Any, selected: Any) -> Iterable[Any]:
        return osmium.FileProcessor(file, kind).with_filter(selected)

    def selected(kind: Any, ids: set[int]) -> Iterable[Any]:
        # The filter takes 4 MiB for every 2^25 numbers of which there is one, and no negative ones
        if min(ids) > 0 and len({number >> 25 for number in ids}) * _IDS_PER_BLOCK <= len(ids):
            return matching(kind, filters.IdFilter(ids))
        return (each for each in osmium.FileProcessor(file, kind) if each.id in ids)

    elements = OsmElements()
    try:
        for relation in matching(kinds.RELATION, filters.TagFilter(("type", "multipolygon"))):
            members = [(member.ref, member.role) for member in relation.members
                       if member.type == "w"]
            elements.relations[relation.id] = Relation(members, dict(relation.tags))
        _add_ways(elements, matching(kinds.WAY, filters.KeyFilter(*BUILDING_KEYS)))
        _add_ways(elements, matching(kinds.WAY, filters.TagFilter(*TAGS)))
        _drop_other_relations(elements)
        member_ids = {way for relation in elements.relations.values()
                       for way, _ in relation.members}
        missing = member_ids - elements.ways.keys()
        if missing:
            _add_ways(elements, selected(kinds.WAY, missing))
        elements.ways |= _street_ways(
            matching(kinds.WAY, filters.TagFilter(*(("highway", kind) for kind in STREETS))),
            elements.ways)
        nodes = {node for way in elements.ways.values() for node in way.nodes}
        if nodes:
            for node in selected(kinds.NODE, nodes):
                if node.location.valid():
                    elements.positions[node.id] = node.location.lon, node.location.lat
    except (RuntimeError, ValueError, IndexError, OverflowError, MemoryError) as error:
        raise BadInput(f"{path} is not a readable .osm.pbf file ({error}); download it again"
                       ) from None
    return elements


def _add_ways(elements: OsmElements, ways: Iterable[Any]) -> None:
    corners = sum(len(way.nodes) for way in elements.ways.values())
    for way in ways:
        nodes = [node.ref for node in way.nodes]
        corners += len(nodes)
        VERTICES.check(corners, "the map")
        elements.ways[way.id] = Way(nodes, dict(way.tags))
    FEATURES.check(len(elements.ways), "the map")


def _street_ways(ways: Iterable[Any], known: Mapping[int, Way]) -> dict[int, Way]:
    """Return the streets that are not known, none where they have too many nodes."""
    found: dict[int, Way] = {}
    nodes = 0
    for way in ways:
        if way.id in known:
            continue
        nodes += len(way.nodes)
        if nodes > MAX_STREET_NODES:
            return {}
        found[way.id] = Way([node.ref for node in way.nodes], dict(way.tags))
    return found


def _drop_other_relations(elements: OsmElements) -> None:
    """Keep vegetation, and buildings that are so themselves or, as in old maps, by their ways."""
    for number, relation in list(elements.relations.items()):
        if kind_of(relation.tags) is None and not any(
                key in relation.tags for key in BUILDING_KEYS) and not any(
                way in elements.ways for way, role in relation.members if role != "inner"):
            del elements.relations[number]
