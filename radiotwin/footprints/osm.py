"""From OpenStreetMap's nodes, ways and relations to areas.

What counts as an area: a closed way, or a relation of type multipolygon whose ways make closed rings [1]; of role
`inner` they are courtyards.

[1] https://wiki.openstreetmap.org/wiki/Relation:multipolygon
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import shapely

from radiotwin.footprints.features import Feature, MapFile, is_building
from radiotwin.scene.problems import Problem, listed

LEAST_NODES = 4  # of a ring: a triangle, and the first node again


@dataclass
class Way:
    nodes: list[int]
    tags: dict[str, str] = field(default_factory=dict)


@dataclass
class Relation:
    """`members`: (way, role)."""

    members: list[tuple[int, str]] = field(default_factory=list)
    tags: dict[str, str] = field(default_factory=dict)


@dataclass
class OsmElements:
    """What was read of a file.

    Attributes:
        places: node -> longitude and latitude [degrees].
        ways: at least those that are buildings, or ways of relations that are.
        relations: at least those of type multipolygon.
    """

    places: dict[int, tuple[float, float]] = field(default_factory=dict)
    ways: dict[int, Way] = field(default_factory=dict)
    relations: dict[int, Relation] = field(default_factory=dict)


def assemble(elements: OsmElements) -> MapFile:
    """Buildings and building parts, ways first; what is cut off or not closed is left out and said."""
    cut: list[str] = []
    unclosed: list[str] = []
    features: list[Feature] = []
    used: set[int] = set()
    for number, relation in elements.relations.items():
        tags = _relation_tags(relation, elements)
        if tags is None:
            continue
        area = _relation_area(relation, elements)
        if isinstance(area, str):
            (cut if area == "cut" else unclosed).append(f"relation/{number}")
            continue
        used.update(way for way, role in relation.members if role != "inner")
        features.append(Feature(f"relation/{number}", tags, area))
    ways = []
    for number, way in elements.ways.items():
        if number in used or not is_building(way.tags):
            continue
        if any(node not in elements.places for node in way.nodes):
            cut.append(f"way/{number}")
        elif len(way.nodes) < LEAST_NODES or way.nodes[0] != way.nodes[-1]:
            unclosed.append(f"way/{number}")
        else:
            ways.append(Feature(f"way/{number}", way.tags, _polygon(way.nodes, elements)))
    problems = []
    if cut:
        problems.append(Problem("warning", "", f"{len(cut)} building(s) lack nodes or ways, as where an extract was "
                                f"cut off: left out ({listed(cut)}); take a larger extract"))
    if unclosed:
        problems.append(Problem("warning", "", f"{len(unclosed)} building(s) have an outline that is not closed: left "
                                f"out ({listed(unclosed)})"))
    return MapFile(ways + features, problems)


def _relation_tags(relation: Relation, elements: OsmElements) -> dict[str, str] | None:
    """Tags of a building; None where the relation is none. Old maps have them at the outer ways."""
    if relation.tags.get("type") != "multipolygon":
        return None
    outer = [elements.ways[way].tags for way, role in relation.members if role != "inner" and way in elements.ways]
    built = is_building(relation.tags)
    if not built and (len(relation.tags) > 1 or not outer or not all(is_building(tags) for tags in outer)):
        return None
    tags: dict[str, str] = {}
    for one in outer if len(outer) == 1 or not built else []:
        tags |= one
    return tags | relation.tags


def _relation_area(relation: Relation, elements: OsmElements):
    """The area, or `cut` where ways or nodes are missing, or `open` where the ways do not close."""
    chains: dict[bool, list[Sequence[int]]] = {True: [], False: []}
    for way, role in relation.members:
        if way not in elements.ways or any(node not in elements.places for node in elements.ways[way].nodes):
            return "cut"
        chains[role != "inner"].append(elements.ways[way].nodes)
    outer, inner = stitch(chains[True]), stitch(chains[False])
    if not outer or inner is None:
        return "open"
    area = shapely.union_all([shapely.make_valid(_polygon(ring, elements)) for ring in outer])
    if inner:
        area = area.difference(shapely.union_all([shapely.make_valid(_polygon(ring, elements)) for ring in inner]))
    return area


def stitch(chains: list[Sequence[int]]) -> list[list[int]] | None:
    """Closed rings of nodes out of ways that meet at their ends, or None where that leaves an end over."""
    rings = [list(chain) for chain in chains if len(chain) >= LEAST_NODES and chain[0] == chain[-1]]
    loose = {number: list(chain) for number, chain in enumerate(chains) if len(chain) > 1 and chain[0] != chain[-1]}
    at: dict[int, list[int]] = {}
    for number, chain in loose.items():
        for node in (chain[0], chain[-1]):
            at.setdefault(node, []).append(number)
    while loose:
        _, ring = loose.popitem()
        while ring[0] != ring[-1]:
            following = next((number for number in at[ring[-1]] if number in loose), None)
            if following is None:
                return None
            chain = loose.pop(following)
            ring += (chain if chain[0] == ring[-1] else chain[::-1])[1:]
        if len(ring) >= LEAST_NODES:
            rings.append(ring)
    return rings


def _polygon(nodes: Sequence[int], elements: OsmElements) -> shapely.Polygon:
    return shapely.Polygon([elements.places[node] for node in nodes])
