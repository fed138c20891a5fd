"""Reader of `.osm` files: the XML of OpenStreetMap's API, of Overpass and of JOSM."""

import math
from pathlib import Path

from radiotwin.budgets import VERTICES
from radiotwin.errors import BadInput
from radiotwin.footprints.osm import OsmElements, Relation, Way
from radiotwin.safe_xml import parse_elements


def read_osm_xml(path: Path) -> OsmElements:
    """Read all nodes, ways and relations that are not deleted.

    Args:
        path: `.osm` file.

    Returns:
        The elements.

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

    def start(self, tag: str, attributes: dict[str, str], line: int) -> None:
        self.depth += 1
        if self.depth == 1 and tag != "osm":
            raise BadInput(f"{self.path}, line {line}: the file begins with <{tag}>, not <osm>; "
                           "give a map in OpenStreetMap's XML, as its export, Overpass "
                           "([out:xml]) or JOSM make it")
        if self.depth == 2:
            self.open = None
            if attributes.get("action") != "delete" and attributes.get("visible") != "false":
                self._element(tag, attributes, line)
        elif self.depth == 3 and self.open is not None:
            self._content(tag, attributes, line)

    def end(self, tag: str) -> None:
        self.depth -= 1

    def _element(self, tag: str, attributes: dict[str, str], line: int) -> None:
        if tag == "node":
            position = (self._degrees(attributes, "lon", 180, line),
                        self._degrees(attributes, "lat", 90, line))
            self.elements.positions[self._integer(attributes, "id", line)] = position
            if len(self.elements.positions) > self.most:
                VERTICES.check(len(self.elements.positions), self.path)
        elif tag == "way":
            self.open = self.elements.ways[self._integer(attributes, "id", line)] = Way([])
        elif tag == "relation":
            self.open = self.elements.relations[self._integer(attributes, "id", line)] = Relation()

    def _content(self, tag: str, attributes: dict[str, str], line: int) -> None:
        assert self.open is not None
        if tag == "tag":
            self.open.tags[attributes.get("k", "")] = attributes.get("v", "")
        elif tag == "nd" and isinstance(self.open, Way):
            self.open.nodes.append(self._integer(attributes, "ref", line))
        elif (tag == "member" and isinstance(self.open, Relation)
              and attributes.get("type") == "way"):
            way = self._integer(attributes, "ref", line)
            self.open.members.append((way, attributes.get("role", "")))

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
