"""Height of a building from its tags, with its source.

Tags and units as in OpenStreetMap [1]: metres unless a unit is given, `33'`, `33 ft`, `33'6"`.

[1] https://wiki.openstreetmap.org/wiki/Key:height
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

LEVEL_M = 3.0  # [m], a usual storey
MAX_HEIGHT_M = 1000.0  # [m], the tallest building has 828 m
_METRES = re.compile(r"([+-]?\d+(?:\.\d*)?|[+-]?\.\d+)\s*(?:m|meters?|metres?)?", re.IGNORECASE)
_FEET = re.compile(r"([+-]?\d+(?:\.\d*)?)\s*(?:'|′|’|ft\.?|feet|foot)\s*"
                   r"(?:(\d+(?:\.\d*)?)\s*(?:\"|″|”|''|in\.?|inch(?:es)?)?)?", re.IGNORECASE)


def parse_length_m(text: str) -> float:
    """Parse a length of OpenStreetMap.

    >>> parse_length_m("12.5"), round(parse_length_m("33'"), 4)
    (12.5, 10.0584)

    Args:
        text: value of a tag.

    Returns:
        The length [m]; NaN where the text is none.
    """
    text = text.strip()
    if found := _METRES.fullmatch(text):
        return float(found[1])
    if found := _FEET.fullmatch(text):
        feet, inches = float(found[1]), float(found[2] or 0)
        length_m = abs(feet) * 0.3048 + inches * 0.0254
        return math.copysign(length_m, feet)
    return math.nan


@dataclass(frozen=True)
class Height:
    """Vertical extent of a building above the ground.

    Attributes:
        bottom_m: lower end [m].
        top_m: upper end [m].
        source: of the top: `height`, `building:levels` (times 3 m) or `default`.
        unusable: tags that were skipped, as `height=-3`.
    """

    bottom_m: float
    top_m: float
    source: str
    unusable: list[str] = field(default_factory=list)


def height_of(tags: Mapping[str, str], default_m: float) -> Height:
    """Return the vertical extent of a building.

    The top is the first usable of tag `height`, `building:levels` × 3 m, and the default; the
    bottom that of `min_height`, `building:min_level` × 3 m, and the ground.

    Args:
        tags: of the building.
        default_m: top of a building whose tags give none [m].

    Returns:
        The extent; impossible values are skipped and listed in its `unusable`.
    """
    unusable: list[str] = []

    def first_usable(*keys: str) -> tuple[float, str]:
        for key in keys:
            if key not in tags:
                continue
            value_m = LEVEL_M * _number(tags[key]) if "level" in key else parse_length_m(tags[key])
            if 0 < value_m <= MAX_HEIGHT_M or (value_m == 0 and "min" in key):
                return value_m, key
            unusable.append(f"{key}={tags[key]}")
        return math.nan, ""

    top_m, source = first_usable("height", "building:levels")
    bottom_m, raised = first_usable("min_height", "building:min_level")
    if not source:
        top_m, source = default_m, "default"
    return Height(bottom_m if raised else 0.0, top_m, source, unusable)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
