"""How tall a building is, and how that is known.

Tags and units as in OpenStreetMap [1]: metres unless a unit is given, `33'`, `33 ft`, `33'6"`.

[1] https://wiki.openstreetmap.org/wiki/Key:height
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

LEVEL_M = 3.0  # a usual storey
FOOT_M, INCH_M = 0.3048, 0.0254
TALLEST_M = 1000.0  # the tallest building that exists has 828 m
_METRES = re.compile(r"([+-]?\d+(?:\.\d*)?|[+-]?\.\d+)\s*(?:m|meters?|metres?)?", re.IGNORECASE)
_FEET = re.compile(r"([+-]?\d+(?:\.\d*)?)\s*(?:'|′|’|ft\.?|feet|foot)\s*"
                   r"(?:(\d+(?:\.\d*)?)\s*(?:\"|″|”|''|in\.?|inch(?:es)?)?)?", re.IGNORECASE)


def parse_length_m(text: str) -> float:
    """A length of OpenStreetMap in metres; NaN where it is none.

    >>> parse_length_m("12.5"), round(parse_length_m("33'"), 4)
    (12.5, 10.0584)
    """
    text = text.strip()
    if found := _METRES.fullmatch(text):
        return float(found[1])
    if found := _FEET.fullmatch(text):
        return math.copysign(abs(float(found[1])) * FOOT_M + float(found[2] or 0) * INCH_M, float(found[1]))
    return math.nan


@dataclass(frozen=True)
class Height:
    """From where to where a building stands above the ground.

    Attributes:
        bottom_m, top_m: [m]
        provenance: `height`, `building:levels` (times 3 m) or `default`.
        unusable: tags that were passed over, as `height=-3`.
    """

    bottom_m: float
    top_m: float
    provenance: str
    unusable: list[str] = field(default_factory=list)


def height_of(tags: Mapping[str, str], default_m: float) -> Height:
    """The first of: tag `height`, `building:levels` × 3 m, the default; and its bottom: `min_height`, or
    `building:min_level` × 3 m, or the ground. A value that cannot be is passed over and kept in `unusable`."""
    unusable: list[str] = []

    def first(*keys: str) -> tuple[float, str]:
        for key in keys:
            if key not in tags:
                continue
            value_m = LEVEL_M * _number(tags[key]) if "level" in key else parse_length_m(tags[key])
            if 0 < value_m <= TALLEST_M or (value_m == 0 and "min" in key):
                return value_m, key
            unusable.append(f"{key}={tags[key]}")
        return math.nan, ""

    top_m, provenance = first("height", "building:levels")
    bottom_m, above_ground = first("min_height", "building:min_level")
    if not provenance:
        top_m, provenance = default_m, "default"
    return Height(bottom_m if above_ground else 0.0, top_m, provenance, unusable)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
