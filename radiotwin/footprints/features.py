"""Areas of a map file with their tags, as every reader returns them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from shapely.geometry.base import BaseGeometry

from radiotwin.scene.problems import Problem, Severity, listed

BUILDING_KEYS = ("building", "building:part")  # tags of OpenStreetMap


@dataclass(frozen=True, eq=False)
class Feature:
    """One building or part of a building, or an area or line of vegetation.

    Attributes:
        name: as in the file: `way/17`, `relation/3`, `feature 4`.
        tags: as in OpenStreetMap: `building`, `building:part`, `height`, `building:levels`, ….
        area: polygons, or the line of a row of trees, in longitude and latitude [degrees]; as in
            the file, so possibly invalid.
    """

    name: str
    tags: Mapping[str, str]
    area: BaseGeometry

    @property
    def is_part(self) -> bool:
        """Whether it is part of a building and not a building itself."""
        return _is_set(self.tags, "building:part") and not _is_set(self.tags, "building")


@dataclass
class MapFile:
    """Buildings and vegetation of a map file.

    Attributes:
        features: buildings and parts, in the file's order.
        vegetation: areas, and lines of trees, see `radiotwin.footprints.vegetation`.
        problems: parts of the file that could not be used, and why.
    """

    features: list[Feature]
    problems: list[Problem] = field(default_factory=list)
    vegetation: list[Feature] = field(default_factory=list)


def problems_of(names: Sequence[str], text: str, severity: Severity = "warning") -> list[Problem]:
    """Return one problem about several features, with their number and first names; none: empty."""
    return [Problem(severity, "", f"{len(names)} {text} ({listed(names)})")] if names else []


def is_building(tags: Mapping[str, str]) -> bool:
    """Return whether tags describe something built above the ground."""
    return any(_is_set(tags, key) for key in BUILDING_KEYS) \
        and tags.get("location") != "underground"


def _is_set(tags: Mapping[str, str], key: str) -> bool:
    return tags.get(key, "").strip().lower() not in ("", "no", "none", "false", "0")
