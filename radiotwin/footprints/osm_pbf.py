"""`.osm.pbf` files, read with libosmium [1] in three passes, so that an extract of a whole region needs little memory.

[1] https://osmcode.org/pyosmium
"""

from pathlib import Path

from radiotwin.errors import BadInput
from radiotwin.footprints.osm import OsmElements, Relation, Way

KEYS = ("building", "building:part")


def read_osm_pbf(path: Path) -> OsmElements:
    """Read what belongs to buildings.

    Raises:
        BadInput: pyosmium is not installed, no such file, or not a PBF file.
    """
    try:
        import osmium
    except ImportError:
        raise BadInput(f"{path}: .osm.pbf is read with the package osmium, which is not installed; install it with "
                       "`pip install 'radiotwin[gis]'`, or convert the file: `osmium cat area.osm.pbf -o area.osm`"
                       ) from None
    if not path.is_file():
        raise BadInput(f"{path} does not exist; give a map in OpenStreetMap's PBF format")
    file = osmium.io.File(str(path), "pbf")
    elements = OsmElements()
    try:
        for relation in osmium.FileProcessor(file, osmium.osm.RELATION).with_filter(
                osmium.filter.TagFilter(("type", "multipolygon"))):
            assert isinstance(relation, osmium.osm.Relation)
            members = [(member.ref, member.role) for member in relation.members if member.type == "w"]
            elements.relations[relation.id] = Relation(members, dict(relation.tags))
        built = osmium.FileProcessor(file, osmium.osm.WAY).with_filter(osmium.filter.KeyFilter(*KEYS))
        _add_ways(elements, built)
        _drop_others(elements)
        wanted = {way for relation in elements.relations.values() for way, _ in relation.members} - elements.ways.keys()
        if wanted:
            _add_ways(elements, osmium.FileProcessor(file, osmium.osm.WAY).with_filter(osmium.filter.IdFilter(wanted)))
        nodes = {node for way in elements.ways.values() for node in way.nodes}
        if nodes:
            for node in osmium.FileProcessor(file, osmium.osm.NODE).with_filter(osmium.filter.IdFilter(nodes)):
                assert isinstance(node, osmium.osm.Node)
                if node.location.valid():
                    elements.places[node.id] = node.location.lon, node.location.lat
    except RuntimeError as error:
        raise BadInput(f"{path} is not a readable .osm.pbf file ({error}); download it again") from None
    return elements


def _add_ways(elements: OsmElements, ways) -> None:
    for way in ways:
        elements.ways[way.id] = Way([node.ref for node in way.nodes], dict(way.tags))


def _drop_others(elements: OsmElements) -> None:
    """Keep relations that are buildings themselves or, as in old maps, by their ways."""
    for number, relation in list(elements.relations.items()):
        if not any(key in relation.tags for key in KEYS) and not any(
                way in elements.ways for way, role in relation.members if role != "inner"):
            del elements.relations[number]
