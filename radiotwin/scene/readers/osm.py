"""Reader of OpenStreetMap files: areas of buildings and vegetation, and streets.

A closed way is an area, and so is a relation of type multipolygon whose ways form closed rings [1];
rings of role `inner` are courtyards. Without roles, rings within an odd number of others are.
`.osm` files are the XML of OpenStreetMap's API, of Overpass and of JOSM; the first two also
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
    is_building,
    why_excluded,
)
from radiotwin.scene.readers.vegetation import TAGS, kind_of

INCOMPLETE = ("building(s) lack nodes or ways, as where an extract was cut off: left out; take a "
              "larger extract, or ask Overpass for `out geom;`")
UNCLOSED = "building(s) have an outline that is not closed: left out"
NO_VEGETATION = "area(s) of vegetation are incomplete, not closed or too intricate: left out"
_MADE_UP = -(2**60)  # first id of nodes that have none in the file
_PLACE_NODES = 1000  # enough to locate a relation; many relations may share one long way
MIN_RING_NODES = 4  # a triangle, with the first node again at the end
STREETS = ("motorway", "trunk", "primary", "secondary", "tertiary", "unclassified", "residential",
           "living_street", "pedestrian", "motorway_link", "trunk_link", "primary_link",
           "secondary_link", "tertiary_link")  # values of highway that pictures show
MAX_STREET_NODES = 1_000_000  # of an .osm.pbf file, 200 MB; with more, its streets are not read
# pyosmium's filter by id takes 4 MiB for each block of 2^25 ids in which there is one: it is used
# if a block has this many on average, so for at most 40 kB an id
_IDS_PER_BLOCK = 100
REMARKED = ("Overpass added a remark to its answer, as where it ran out of time or memory: "
            "buildings may be missing; ask for a smaller area, or more time ([timeout:600])")


@dataclass
class Way:
    """A polyline, or an area if it is closed.

    Attributes:
        nodes: ids of its nodes, in order.
        tags: tags of the way.
    """

    nodes: list[int]
    tags: dict[str, str] = field(default_factory=dict)


@dataclass
class Relation:
    """A group of ways.

    Attributes:
        members: id and role of each way.
        tags: tags of the relation.
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
        nodes_at: (longitude, latitude) -> node, of positions that are in ways and relations.
        remarked: whether Overpass added a remark, e.g. that it ran out of time.
    """

    positions: dict[int, tuple[float, float]] = field(default_factory=dict)
    ways: dict[int, Way] = field(default_factory=dict)
    relations: dict[int, Relation] = field(default_factory=dict)
    nodes_at: dict[tuple[float, float], int] = field(default_factory=dict)
    remarked: bool = False

    def store_node(self, place: tuple[float, float], number: int | None = None) -> int:
        """Store a node's position; return its id: if None, that of a known node there, or new."""
        known = self.nodes_at.setdefault(
            place, _MADE_UP - len(self.nodes_at) if number is None else number)
        known = known if number is None else number
        self.positions[known] = place
        return known

    def has_positions(self, nodes: Iterable[int]) -> bool:
        """Return whether the positions of all nodes are known."""
        return all(node in self.positions for node in nodes)

    def add(self, number: int, element: Way | Relation) -> None:
        """Add a way or relation; Overpass may return one twice, once without its tags."""
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
        if below := why_excluded(f"relation/{number}", tags, area):
            left_out.append(below)
        else:
            relations.append(Feature(f"relation/{number}", tags, area))
    ways = []
    for number, way in elements.ways.items():
        if number in used or not is_building(way.tags):
            continue
        if below := why_excluded(f"way/{number}", way.tags, None):
            left_out.append(replace(below, place=_place(way, elements)))
        elif not way.nodes or not elements.has_positions(way.nodes):
            left_out.append(LeftOut(f"way/{number}", INCOMPLETE, _place(way, elements)))
        elif not _is_ring(way.nodes):
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
    """Return the known points of a way's or relation's first nodes, to tell where it lies."""
    ways = [element] if isinstance(element, Way) else [
        elements.ways[number] for number, _ in element.members if number in elements.ways]
    nodes = islice((node for way in ways for node in way.nodes), _PLACE_NODES)
    return shapely.MultiPoint([elements.positions[node] for node in nodes
                               if node in elements.positions])


def _vegetation(elements: OsmElements) -> tuple[list[Feature], list[LeftOut]]:
    """Return woods, parks and rows of trees, and those with a broken or too intricate outline."""
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
    """Return a way of vegetation as a polygon, a row of trees as a line; else `incomplete`."""
    OUTLINE_CORNERS.check(len(way.nodes), name)
    if not elements.has_positions(way.nodes) or not (
            _is_ring(way.nodes) or (kind == "tree_row" and len(way.nodes) > 1)):
        return "incomplete"
    if kind == "tree_row":
        return shapely.LineString([elements.positions[node] for node in way.nodes])
    return _polygon(way.nodes, elements)


def _relation_tags(relation: Relation, elements: OsmElements) -> dict[str, str] | None:
    """Return the tags of a multipolygon relation that is a building; None if it is not.

    A single outer way adds its tags; in old maps, all outer ways have them instead.
    """
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
    """Return a multipolygon's area; `incomplete`: ways or nodes lack; `open`: no ring closes."""
    chains: dict[bool, list[Sequence[int]]] = {True: [], False: []}
    corners, named = 0, True
    for number, role in relation.members:
        way = elements.ways.get(number)
        corners += len(way.nodes) if way is not None else 0
        OUTLINE_CORNERS.check(corners, name)
        if way is None or not elements.has_positions(way.nodes):
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
    """Return whether a way bounds a hole of an area: a point just inside the way is not in it."""
    if not _is_ring(way.nodes):
        return False
    outline = shapely.make_valid(_polygon(way.nodes, elements))
    rim = outline.difference(outline.buffer(-1e-3 * math.sqrt(outline.area)))
    return not area.contains(rim.representative_point())


def _union(polygons: list[shapely.Polygon]) -> BaseGeometry:
    """Unite polygons that may cross themselves."""
    return shapely.union_all([shapely.make_valid(polygon) for polygon in polygons])


def _is_ring(nodes: Sequence[int]) -> bool:
    """Return whether a way is closed, and has at least three corners."""
    return len(nodes) >= MIN_RING_NODES and nodes[0] == nodes[-1]


def stitch(chains: list[Sequence[int]]) -> list[list[int]] | None:
    """Join ways at their common end nodes into closed rings.

    Args:
        chains: ids of the nodes of each way.

    Returns:
        ids of the nodes of each ring, the first again at the end; rings of fewer than three corners
        are dropped. None if a way cannot be closed to a ring.
    """
    rings = [list(chain) for chain in chains if _is_ring(chain)]
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
    """Return the polygon of a ring of nodes, in longitude and latitude [degrees]."""
    return shapely.Polygon([elements.positions[node] for node in nodes])


def read_osm_xml(path: Path) -> OsmElements:
    """Read all nodes, ways and relations of an `.osm` file that are not deleted.

    Raises:
        BadInput: no such file, malformed XML, not a map of OpenStreetMap, or an impossible value;
            with file and line.
    """
    reader = _XmlReader(path)
    parse_elements(path, reader.start, reader.end)
    return reader.elements


class _XmlReader:
    """Callbacks of the XML parser: ways and relations are collected in the form of OSM JSON."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.elements = OsmElements()
        self.depth = 0
        self.max_nodes = VERTICES.limit  # looked up once: there are millions of nodes
        self.open: dict[str, Any] | None = None  # way or relation
        self.subject = ""  # its file and line

    def start(self, tag: str, attributes: dict[str, str], line: int) -> None:
        """Begin an XML element: open a node, way or relation, or add to the open one.

        Elements that an editor marked as deleted are skipped.
        """
        self.depth += 1
        if self.depth == 1 and tag != "osm":
            raise BadInput(f"{self.path}, line {line}: the file begins with <{tag}>, not <osm>; "
                           "give a map in OpenStreetMap's XML, as its export, Overpass "
                           "([out:xml]) or JOSM make it")
        if self.depth == 2:
            if attributes.get("action") != "delete" and attributes.get("visible") != "false":
                self._element(tag, attributes, line)
        elif self.open is None:
            return
        elif self.depth == 4 and tag == "nd" and self.open["members"]:  # of `out geom;`
            self.open["members"][-1]["geometry"].append(attributes)
        elif self.depth == 3 and tag == "tag":
            self.open["tags"][attributes.get("k", "")] = attributes.get("v", "")
        elif self.depth == 3 and tag == "nd" and self.open["type"] == "way":
            self.open["nodes"].append(self._integer(attributes, "ref", line))
            self.open["geometry"].append(attributes if "lat" in attributes else None)
        elif self.depth == 3 and tag == "member":
            is_way = attributes.get("type") == "way"
            self.open["members"].append({
                "type": attributes.get("type"), "role": attributes.get("role", ""), "geometry": [],
                "ref": self._integer(attributes, "ref", line) if is_way else None})

    def _element(self, tag: str, attributes: dict[str, str], line: int) -> None:
        """Store a node, open a way or relation, or note that Overpass added a remark."""
        if tag == "node":
            number = self._integer(attributes, "id", line)
            self.elements.positions[number] = _position(f"{self.path}, line {line}: a node",
                                                        attributes)
            if len(self.elements.positions) > self.max_nodes:
                VERTICES.check(len(self.elements.positions), self.path)
        elif tag in ("way", "relation"):
            self.subject = f"{self.path}, line {line}: a {tag}"
            self.open = {"type": tag, "id": self._integer(attributes, "id", line), "tags": {},
                         "nodes": [], "geometry": [], "members": []}
        elif tag == "remark":
            self.elements.remarked = True

    def end(self, tag: str) -> None:
        """End an XML element; the open way or relation is stored at its end."""
        self.depth -= 1
        if self.depth == 1 and self.open is not None:
            _add_element(self.elements, self.subject, self.open)
            self.open = None

    def _integer(self, attributes: dict[str, str], name: str, line: int) -> int:
        """Return an attribute that is an integer; BadInput if it is absent or another text."""
        try:
            return int(attributes[name])
        except (KeyError, ValueError):
            raise BadInput(f"{self.path}, line {line}: {name}={attributes.get(name)!r} is not a "
                           "whole number; export the map again") from None


def osm_of_json(path: Path, document: Mapping) -> OsmElements:
    """Return the elements of OpenStreetMap's JSON [3].

    Nodes are elements of their own, or, if Overpass was asked for `out geom;`, positions in ways
    and in members of relations.

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
    for subject, element in by_kind["node"]:
        elements.store_node(_position(subject, element), _whole(subject, element.get("id")))
    for subject, element in (*by_kind["way"], *by_kind["relation"]):
        _add_element(elements, subject, element)
    return elements


def _add_element(elements: OsmElements, subject: str, element: Mapping) -> None:
    """Add a way or relation in the form of OSM JSON; `subject` names it in messages."""
    number, tags = _whole(subject, element.get("id")), element.get("tags")
    tags = {str(key): str(value) for key, value in tags.items()} if isinstance(tags, dict) else {}
    if element["type"] == "way":
        elements.add(number, Way(_nodes(elements, subject, element), tags))
        return
    members = [(_whole(subject, member.get("ref")), str(member.get("role", "")), member)
               for member in _list(subject, element, "members")
               if isinstance(member, dict) and member.get("type") == "way"]
    for way, _, member in members:
        if way not in elements.ways and member.get("geometry"):
            elements.ways[way] = Way(_nodes(elements, subject, member))
    elements.add(number, Relation([(way, role) for way, role, _ in members], tags))


def _nodes(elements: OsmElements, subject: str, element: Mapping) -> list[int]:
    """Return a way's node ids; positions in it (by Overpass's `out geom;`) go to `elements`."""
    nodes = [_whole(subject, node) for node in _list(subject, element, "nodes")]
    for row, point in enumerate(_list(subject, element, "geometry")):
        if isinstance(point, dict):  # null: outside of Overpass's box
            number = nodes[row] if row < len(nodes) else None
            nodes[row:row + 1] = [elements.store_node(_position(subject, point), number)]
        elif row >= len(nodes):
            nodes.append(0)  # a node without a position
    VERTICES.check(len(elements.positions), subject)
    return nodes


def _position(subject: str, point: Mapping) -> tuple[float, float]:
    """Return longitude and latitude [degrees] of a node; BadInput if they are impossible."""
    try:
        longitude_deg, latitude_deg = float(point["lon"]), float(point["lat"])
    except (KeyError, TypeError, ValueError, OverflowError):
        longitude_deg = latitude_deg = math.nan
    if not (abs(longitude_deg) <= 180 and abs(latitude_deg) <= 90):
        raise BadInput(f"{subject} has lon={point.get('lon')!r:.20}, lat={point.get('lat')!r:.20}; "
                       "allowed are -180 to 180 and -90 to 90 degrees; export the map again")
    return longitude_deg, latitude_deg


def _list(subject: str, element: Mapping, name: str) -> list:
    """Return a list of an element, empty if it has none; BadInput if it is something else."""
    found = element.get(name) or []
    if not isinstance(found, list):
        raise BadInput(f"{subject}: its {name} are no list; export the map again")
    return found


def _whole(subject: str, value: object) -> int:
    """Return an integer of JSON; BadInput if it is something else."""
    if type(value) is not int:
        raise BadInput(f"{subject}: {value!r:.40} is no whole number; export the map again")
    return value


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

    def matching(kind: Any, condition: Any) -> Iterable[Any]:
        return osmium.FileProcessor(file, kind).with_filter(condition)

    def with_ids(kind: Any, ids: set[int]) -> Iterable[Any]:
        # The filter knows no negative ids
        if min(ids) > 0 and len({number >> 25 for number in ids}) * _IDS_PER_BLOCK <= len(ids):
            return matching(kind, filters.IdFilter(ids))
        return (element for element in osmium.FileProcessor(file, kind) if element.id in ids)

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
            _add_ways(elements, with_ids(kinds.WAY, missing))
        elements.ways |= _street_ways(
            matching(kinds.WAY, filters.TagFilter(*(("highway", kind) for kind in STREETS))),
            elements.ways)
        nodes = {node for way in elements.ways.values() for node in way.nodes}
        if nodes:
            for node in with_ids(kinds.NODE, nodes):
                if node.location.valid():
                    elements.positions[node.id] = node.location.lon, node.location.lat
    except (RuntimeError, ValueError, IndexError, OverflowError, MemoryError) as error:
        raise BadInput(f"{path} is not a readable .osm.pbf file ({error}); download it again"
                       ) from None
    return elements


def _add_ways(elements: OsmElements, ways: Iterable[Any]) -> None:
    """Add the ways that pyosmium reads to `elements`; BadInput if there are too many."""
    corners = sum(len(way.nodes) for way in elements.ways.values())
    for way in ways:
        nodes = [node.ref for node in way.nodes]
        corners += len(nodes)
        VERTICES.check(corners, "the map")
        elements.ways[way.id] = Way(nodes, dict(way.tags))
    FEATURES.check(len(elements.ways), "the map")


def _street_ways(ways: Iterable[Any], known: Mapping[int, Way]) -> dict[int, Way]:
    """Return id -> street of pyosmium's ways that are not in `known`; {} with too many nodes."""
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
    """Delete relations that neither a tag nor an outer way makes a building or vegetation.

    At that time `elements.ways` holds only ways of buildings and vegetation.
    """
    for number, relation in list(elements.relations.items()):
        if kind_of(relation.tags) is None and not any(
                key in relation.tags for key in BUILDING_KEYS) and not any(
                way in elements.ways for way, role in relation.members if role != "inner"):
            del elements.relations[number]
