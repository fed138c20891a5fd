"""Reader of `.osm.pbf` files, with libosmium [1].

The file is read in several passes that keep only what belongs to buildings and vegetation, so that
an extract of a whole region needs little memory.

[1] https://osmcode.org/pyosmium
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from radiotwin.budgets import FEATURES, VERTICES
from radiotwin.errors import BadInput
from radiotwin.footprints.features import BUILDING_KEYS
from radiotwin.footprints.osm import OsmElements, Relation, Way
from radiotwin.footprints.vegetation import TAGS, kind_of
from radiotwin.inputs import check_input

_IDS_PER_BLOCK = 100  # elements: 40 kB of the filter for each that is looked for


def read_osm_pbf(path: Path) -> OsmElements:
    """Read the elements that belong to buildings and vegetation.

    Args:
        path: `.osm.pbf` file.

    Returns:
        Buildings and vegetation, their ways and their nodes.

    Raises:
        BadInput: pyosmium is not installed, no such file, or not a PBF file.
    """
    try:
        import osmium
    except ImportError:
        raise BadInput(
            f"{path}: .osm.pbf is read with the package osmium, which is not installed; install it "
            "with `pip install 'radiotwin[gis]'`, or convert the file: `osmium cat area.osm.pbf -o "
            "area.osm`") from None
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


def _drop_other_relations(elements: OsmElements) -> None:
    """Keep vegetation, and buildings that are so themselves or, as in old maps, by their ways."""
    for number, relation in list(elements.relations.items()):
        if kind_of(relation.tags) is None and not any(
                key in relation.tags for key in BUILDING_KEYS) and not any(
                way in elements.ways for way, role in relation.members if role != "inner"):
            del elements.relations[number]
