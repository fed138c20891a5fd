"""Areas of a map file with their tags: what every reader returns."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from shapely.geometry.base import BaseGeometry

from radiotwin.scene.problems import Problem

NOT_BUILT = ("", "no", "none", "false", "0")


@dataclass(frozen=True, eq=False)
class Feature:
    """One building or part of one.

    Attributes:
        name: how the file calls it: `way/17`, `relation/3`, `feature 4`.
        tags: as in OpenStreetMap: `building`, `building:part`, `height`, `building:levels`, `min_height`, ….
        area: polygons, longitude and latitude [degrees]; as the file has them, so possibly invalid.
    """

    name: str
    tags: Mapping[str, str]
    area: BaseGeometry

    @property
    def is_part(self) -> bool:
        return is_set(self.tags, "building:part") and not is_set(self.tags, "building")


@dataclass
class MapFile:
    """What a map file holds about buildings.

    Attributes:
        features: buildings and parts, in the file's order.
        problems: what could not be read, and why.
    """

    features: list[Feature]
    problems: list[Problem] = field(default_factory=list)


def is_set(tags: Mapping[str, str], key: str) -> bool:
    return tags.get(key, "").strip().lower() not in NOT_BUILT


def is_building(tags: Mapping[str, str]) -> bool:
    """Whether tags stand for something built above the ground."""
    return (is_set(tags, "building") or is_set(tags, "building:part")) and tags.get("location") != "underground"
