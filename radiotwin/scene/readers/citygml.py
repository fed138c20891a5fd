"""Reader of CityGML 1.0 to 3.0 [1, 2]: buildings with their surfaces, element by element.

Element names are compared without their namespaces, which differ between versions. Polygons are
read wherever they occur in an object. A solid often only refers (`xlink:href`) to the polygons of
walls and roofs beside it; then these are its surfaces.

[1] https://docs.ogc.org/is/20-010/20-010.html
[2] https://portal.ogc.org/files/?artifact_id=47842
"""

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.io.budgets import FEATURES, NESTING, TAG_BYTES, VERTICES
from radiotwin.io.inputs import parse_elements
from radiotwin.scene.readers.city_objects import (
    BUILT,
    CityObject,
    Geometry,
    Polygon,
    city_features,
)
from radiotwin.scene.readers.features import MapFile

_ROOTS = ("CityModel", "FeatureCollection")
_MEMBERS = ("cityObjectMember", "featureMember", "featureMembers")
_LOD = re.compile(r"lod([0-4])(\w+)")
# Interiors of buildings, placed copies (in coordinates of their own), textures
_SKIPPED = ("Room", "BuildingRoom", "BuildingFurniture", "IntBuildingInstallation",
            "interiorBuildingInstallation", "InteriorWallSurface", "CeilingSurface",
            "FloorSurface", "ImplicitGeometry", "appearanceMember", "appearance")
_BOUNDARIES = ("RoofSurface", "WallSurface", "GroundSurface", "ClosureSurface",
               "OuterCeilingSurface", "OuterFloorSurface")
_ROOF_EDGES = ("lod0RoofEdge", "RoofSurface")  # of CityGML 2.0 and 3.0
_POLYGONS = ("Polygon", "PolygonPatch", "Triangle", "Rectangle")
_VALUES = ("stringAttribute", "doubleAttribute", "intAttribute", "measureAttribute")
_NAME_LENGTH = 200
_MAX_SYSTEMS = 10
_MAX_VALUE = 1000  # characters of an attribute


def read_citygml(path: Path, crs: str | None = None) -> MapFile:
    """Read the buildings of a CityGML file with their surfaces; those without, with outlines.

    Args:
        path: CityGML file.
        crs: coordinate reference system of a file that names none; None: refuse it.

    Raises:
        BadInput: no such file, malformed XML, not CityGML, or coordinates that are not numbers;
            with the line.
    """
    reader = _Reader(path)
    parse_elements(path, reader.start, reader.end, text=reader.add_text)
    return city_features(path, reader.objects, reader.systems, crs)


@dataclass
class _Surfaces:
    """Geometries of one object, by level of detail: those of solids, and others.

    The outline (LoD 0) is the footprint, or if there is none the edge of the roof.
    """

    solids: dict[float, Geometry] = field(default_factory=dict)
    others: dict[float, Geometry] = field(default_factory=dict)
    roof_edges: dict[float, Geometry] = field(default_factory=dict)
    referring: set[float] = field(default_factory=set)  # levels with a solid that names surfaces

    def geometries(self) -> list[Geometry]:
        """Return one geometry per level of detail: the solid, else the other surfaces.

        A solid that is empty, or refers to surfaces (`xlink:href`), gets the others in addition.
        """
        found, others = [], self.roof_edges | self.others
        for lod in sorted({*self.solids, *others}):
            solid, other = self.solids.get(lod), others.get(lod)
            if solid is None or other is None:
                found.append(solid or other or Geometry(lod))
            elif lod in self.referring or not solid.polygons:
                found.append(Geometry(lod, solid.polygons + other.polygons))
            else:
                found.append(solid)
        return found


class _Reader:
    """Callbacks of the XML parser that collect the objects of one file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.objects: list[CityObject] = []
        self.systems: list[str] = []
        self.tags: list[str] = []
        self.open: list[tuple[int, CityObject, _Surfaces]] = []  # with their depths
        self.skipped = 0  # depth of the element that is skipped with all in it
        self.lod: tuple[int, float, bool] | None = None  # depth, level, whether of a solid
        self.surface = 0  # depth of the wall, roof, … that is open
        self.dimensions: list[tuple[int, int]] = []  # depths, and dimensions of positions
        self.rings: Polygon | None = None
        self.numbers: list[float] = []
        self.text: list[str] | None = None
        self.text_length = 0
        self.attribute = ""  # name of the generic attribute that is open
        self.unit = ""
        self.corners = 0
        self.limits = NESTING.limit, VERTICES.limit, TAG_BYTES.limit
        self.line = 0

    def start(self, tag: str, attributes: dict[str, str], line: int) -> None:
        """Begin an XML element: skip it, open an object, or note what the open object has in it."""
        name = tag.rpartition(":")[2]
        self.tags.append(name)
        depth, self.line = len(self.tags), line
        if depth == 1 and name not in _ROOTS:
            raise BadInput(f"{self.path}, line {line}: the file begins with <{name[:60]}>, not "
                           "<CityModel>; give a model in CityGML")
        if depth > self.limits[0]:
            NESTING.check(depth, f"{self.path}, line {line}")
        self._note_system(attributes)
        if self.skipped:
            return
        if name in _SKIPPED:
            self.skipped = depth
        elif self.tags[-2:-1] and self.tags[-2] in _MEMBERS or (self.open and name in BUILT):
            self._open_object(name, attributes, depth)
        elif self.open:
            self._content(name, attributes, depth)

    def _note_system(self, attributes: dict[str, str]) -> None:
        """Note the coordinate reference system and the dimension that an element declares."""
        system = attributes.get("srsName")
        if system and system not in self.systems and len(self.systems) < _MAX_SYSTEMS:
            self.systems.append(system)
        dimension = attributes.get("srsDimension")
        if dimension in ("2", "3"):
            self.dimensions.append((len(self.tags), int(dimension)))

    def _open_object(self, name: str, attributes: dict[str, str], depth: int) -> None:
        """Add an object of the model, as a part of the one that is open."""
        known = attributes.get("gml:id") or f"{name} {len(self.objects) + 1}"
        parent = self.open[-1][1].name if self.open else ""
        made = CityObject(known[:_NAME_LENGTH], name, parent=parent)
        self.objects.append(made)
        FEATURES.check(len(self.objects), self.path)
        self.open.append((depth, made, _Surfaces()))

    def _content(self, name: str, attributes: dict[str, str], depth: int) -> None:
        """Begin an element within an object: level of detail, wall or roof, polygon, or value."""
        surfaces = self.open[-1][2]
        if found := _LOD.fullmatch(name):
            self.lod = depth, float(found[1]), "Solid" in found[2]
        elif name in _BOUNDARIES:
            self.surface = depth
        elif name in _POLYGONS and self.lod:
            self.rings = []
        elif self.rings is not None:
            if name in ("posList", "pos", "coordinates"):
                self.text = []
        elif self.lod and self.lod[2] and any(key.endswith(":href") for key in attributes):
            surfaces.referring.add(self.lod[1])
        elif name in _VALUES:
            self.attribute = attributes.get("name", "")
        elif not self.lod and not self.surface:
            self.text, self.unit = [], attributes.get("uom", "")

    def add_text(self, text: str) -> None:
        """Collect a piece of text, if the open element holds positions or a value."""
        if self.text is not None:
            self.text.append(text)
            self.text_length += len(text)
            if self.text_length > self.limits[2]:
                TAG_BYTES.check(self.text_length, f"{self.path}, line {self.line}")

    def end(self, tag: str) -> None:
        """End an XML element: store the positions, polygon or value in it, or close its object."""
        name, depth = self.tags[-1], len(self.tags)
        self.tags.pop()
        if self.dimensions and self.dimensions[-1][0] == depth:
            dimension = self.dimensions.pop()[1]
        else:
            dimension = self.dimensions[-1][1] if self.dimensions else 3
        if self.skipped:
            self.skipped = 0 if self.skipped == depth else self.skipped
            return
        if not self.open:
            return
        if self.rings is not None:
            self._end_of_geometry(name, dimension)
        elif self.text is not None:
            self._end_of_value(name, "".join(self.text).strip()[:_MAX_VALUE])
        self.text, self.text_length = None, 0
        if self.lod and self.lod[0] == depth:
            self.lod = None
        if self.surface == depth:
            self.surface = 0
        if name in _VALUES:
            self.attribute = ""
        if self.open[-1][0] == depth:
            _, made, surfaces = self.open.pop()
            made.geometries = surfaces.geometries()

    def _end_of_geometry(self, name: str, dimension: int) -> None:
        """End positions (add to the ring), a ring (add to the polygon) or a polygon (store it)."""
        assert self.rings is not None
        if self.text is not None:
            self._add_numbers("".join(self.text), dimension)
        elif name == "LinearRing":
            ring = np.array(self.numbers, dtype=float).reshape(-1, 3)
            self.numbers = []
            if len(ring) > 1 and (ring[0] == ring[-1]).all():
                ring = ring[:-1]
            self.corners += len(ring)
            if self.corners > self.limits[1]:
                VERTICES.check(self.corners, self.path)
            self.rings.append(ring)
        elif name in _POLYGONS:
            if self.rings and self.lod:
                _, lod, is_solid = self.lod
                surfaces = self.open[-1][2]
                is_edge = lod == 0 and any(tag in _ROOF_EDGES for tag in self.tags)
                kept = surfaces.solids if is_solid else \
                    surfaces.roof_edges if is_edge else surfaces.others
                kept.setdefault(lod, Geometry(lod)).polygons.append(self.rings)
            self.rings = None

    def _add_numbers(self, text: str, dimension: int) -> None:
        """Append the coordinates in a text to the open ring, with z = 0 in two dimensions."""
        try:
            # `coordinates` of GML 2 has `x,y,z x,y,z`
            numbers = [float(word) for word in text.replace(",", " ").split()]
            if len(numbers) % dimension or len(numbers) // dimension > self.limits[1]:
                raise ValueError
        except ValueError:
            raise BadInput(f"{self.path}, line {self.line}: {text.strip()[:60]!r} is no list of "
                           f"positions of {dimension} numbers; export the model again") from None
        if dimension == 2:
            flat = np.array(numbers).reshape(-1, 2)
            numbers = np.column_stack([flat, np.zeros(len(flat))]).ravel().tolist()
        self.numbers += numbers
        if len(self.numbers) > 3 * self.limits[1]:
            VERTICES.check(len(self.numbers) / 3, self.path)

    def _end_of_value(self, name: str, value: str) -> None:
        """Store a text as an attribute of the open object, with ` ft` if its unit is the foot."""
        known = self.open[-1][1].attributes
        if not value:
            return
        if self.unit.lower().endswith(("ft", "foot", "feet")):
            value += " ft"
        if self.attribute and name == "value":
            known[self.attribute[:_NAME_LENGTH].lower()] = value
        elif name == "value" and "Height" in self.tags:  # CityGML 3.0, section 7.5
            known.setdefault("measuredheight", value)
        elif len(self.tags) == self.open[-1][0]:
            known[name.lower()] = value
