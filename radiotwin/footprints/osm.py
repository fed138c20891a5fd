"""Areas of buildings from OpenStreetMap's nodes, ways and relations.

A closed way is an area, and so is a relation of type multipolygon whose ways form closed rings
[1]; rings of role `inner` are courtyards.

[1] https://wiki.openstreetmap.org/wiki/Relation:multipolygon
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Literal

import shapely
from shapely.geometry.base import BaseGeometry

from radiotwin.budgets import OUTLINE_CORNERS
from radiotwin.errors import BadInput
from radiotwin.footprints.features import Feature, LeftOut, MapFile, is_building
from radiotwin.footprints.outlines import OutlineBudget
from radiotwin.footprints.vegetation import kind_of

INCOMPLETE = ("building(s) lack nodes or ways, as where an extract was cut off: left out; take a "
              "larger extract")
UNCLOSED = "building(s) have an outline that is not closed: left out"
NO_VEGETATION = "area(s) of vegetation are incomplete, not closed or too intricate: left out"
_PLACE_NODES = 1000  # that say where something lies: many relations may name one long way
MIN_RING_NODES = 4  # a triangle, with the first node again at the end


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
    """

    positions: dict[int, tuple[float, float]] = field(default_factory=dict)
    ways: dict[int, Way] = field(default_factory=dict)
    relations: dict[int, Relation] = field(default_factory=dict)


def assemble(elements: OsmElements) -> MapFile:
    """Assemble the areas of buildings and building parts, and of vegetation.

    Args:
        elements: of a map file.

    Returns:
        The areas, ways first; incomplete or open outlines are left out and reported.
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
        used.update(way for way, role in relation.members if role != "inner")
        relations.append(Feature(f"relation/{number}", tags, area))
    ways = []
    for number, way in elements.ways.items():
        if number in used or not is_building(way.tags):
            continue
        if any(node not in elements.positions for node in way.nodes):
            left_out.append(LeftOut(f"way/{number}", INCOMPLETE, _place(way, elements)))
        elif len(way.nodes) < MIN_RING_NODES or way.nodes[0] != way.nodes[-1]:
            left_out.append(LeftOut(f"way/{number}", UNCLOSED, _place(way, elements)))
        else:
            OUTLINE_CORNERS.check(len(way.nodes), f"way/{number}")
            ways.append(Feature(f"way/{number}", way.tags, _polygon(way.nodes, elements)))
    left_out.sort(key=lambda one: one.reason != INCOMPLETE)
    vegetation, unusable = _vegetation(elements)
    return MapFile(ways + relations, left_out + unusable, vegetation=vegetation)


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
    corners = 0
    for number, role in relation.members:
        way = elements.ways.get(number)
        corners += len(way.nodes) if way is not None else 0
        OUTLINE_CORNERS.check(corners, name)
        if way is None or any(node not in elements.positions for node in way.nodes):
            return "incomplete"
        chains[role != "inner"].append(way.nodes)
    outer, inner = stitch(chains[True]), stitch(chains[False])
    if not outer or inner is None:
        return "open"
    outlines, holes = ([_polygon(ring, elements) for ring in rings] for rings in (outer, inner))
    budget.check(name, shapely.MultiPolygon([*outlines, *holes]))
    area = _union(outlines)
    return area.difference(_union(holes)) if holes else area


def _union(polygons: list[shapely.Polygon]) -> BaseGeometry:
    return shapely.union_all([shapely.make_valid(polygon) for polygon in polygons])


def stitch(chains: list[Sequence[int]]) -> list[list[int]] | None:
    """Join ways that meet at their ends to closed rings.

    Args:
        chains: node ids of each way.

    Returns:
        Node ids of each ring, the first again at its end; None where an end remains open.
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
