"""Reader of `.osm.pbf` files, with libosmium [1].

The file is read in several passes that keep only what belongs to buildings, so that an extract of
a whole region needs little memory.

[1] https://osmcode.org/pyosmium
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from radiotwin.errors import BadInput
from radiotwin.footprints.features import BUILDING_KEYS
from radiotwin.footprints.osm import OsmElements, Relation, Way


def read_osm_pbf(path: Path) -> OsmElements:
    """Read the elements that belong to buildings.

    Args:
        path: `.osm.pbf` file.

    Returns:
        Buildings, their ways and their nodes.

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
    if not path.is_file():
        raise BadInput(f"{path} does not exist; give a map in OpenStreetMap's PBF format")
    file = osmium.io.File(str(path), "pbf")
    kinds, filters = osmium.osm, osmium.filter

    def matching(kind: Any, selected: Any) -> Iterable[Any]:
        return osmium.FileProcessor(file, kind).with_filter(selected)

    elements = OsmElements()
    try:
        for relation in matching(kinds.RELATION, filters.TagFilter(("type", "multipolygon"))):
            members = [(member.ref, member.role) for member in relation.members
                       if member.type == "w"]
            elements.relations[relation.id] = Relation(members, dict(relation.tags))
        _add_ways(elements, matching(kinds.WAY, filters.KeyFilter(*BUILDING_KEYS)))
        _drop_other_relations(elements)
        member_ids = {way for relation in elements.relations.values()
                       for way, _ in relation.members}
        missing = member_ids - elements.ways.keys()
        if missing:
            _add_ways(elements, matching(kinds.WAY, filters.IdFilter(missing)))
        nodes = {node for way in elements.ways.values() for node in way.nodes}
        if nodes:
            for node in matching(kinds.NODE, filters.IdFilter(nodes)):
                if node.location.valid():
                    elements.positions[node.id] = node.location.lon, node.location.lat
    except RuntimeError as error:
        raise BadInput(f"{path} is not a readable .osm.pbf file ({error}); download it again"
                       ) from None
    return elements


def _add_ways(elements: OsmElements, ways: Iterable[Any]) -> None:
    for way in ways:
        elements.ways[way.id] = Way([node.ref for node in way.nodes], dict(way.tags))


def _drop_other_relations(elements: OsmElements) -> None:
    """Keep relations that are buildings themselves or, as in old maps, by their ways."""
    for number, relation in list(elements.relations.items()):
        if not any(key in relation.tags for key in BUILDING_KEYS) and not any(
                way in elements.ways for way, role in relation.members if role != "inner"):
            del elements.relations[number]
