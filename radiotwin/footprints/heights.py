"""Height of a building from its tags, with its source.

Tags and units as in OpenStreetMap [1]: metres unless a unit is given, `33'`, `33 ft`, `33'6"`.

[1] https://wiki.openstreetmap.org/wiki/Key:height
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from radiotwin.footprints.height_columns import KNOWN, LEVEL_M, STOREYS, UNITS_M, HeightColumn

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
        source: of the top: a tag or column, as `HeightColumn.label` has it, `model` of a solid that
            the file holds, or `default`.
        unusable: tags that were skipped, as `height=-3`.
    """

    bottom_m: float
    top_m: float
    source: str
    unusable: list[str] = field(default_factory=list)


def height_of(tags: Mapping[str, str], default_m: float,
              declared: HeightColumn | None = None) -> Height:
    """Return the vertical extent of a building.

    The top is the first usable of the declared column, the known ones (see
    `radiotwin.footprints.height_columns.KNOWN`), and the default; the bottom that of `min_height`,
    `building:min_level` × 3 m, and the ground.

    Args:
        tags: of the building.
        default_m: top of a building whose tags give none [m].
        declared: column that goes before all known ones.

    Returns:
        The extent; impossible values are skipped and listed in its `unusable`.
    """
    unusable: list[str] = []
    top_m, source = default_m, "default"
    for column in (*((declared,) if declared else ()), *KNOWN):
        if column.name not in tags or (column.ground and column.ground not in tags):
            continue
        value_m = _top_m(column, tags)
        if 0 < value_m <= MAX_HEIGHT_M:
            top_m, source = value_m, column.label
            break
        unusable.append(", ".join(f"{name}={tags[name]}" for name in (column.name, column.ground)
                                  if name))
    bottom_m = 0.0
    for key, unit_m in (("min_height", 1.0), ("building:min_level", LEVEL_M)):
        if key in tags:
            value_m = parse_length_m(tags[key]) if unit_m == 1 else unit_m * _number(tags[key])
            if 0 <= value_m <= MAX_HEIGHT_M:
                bottom_m = value_m
                break
            unusable.append(f"{key}={tags[key]}")
    return Height(bottom_m, top_m, source, unusable)


def source_text(source: str, declared: HeightColumn | None = None) -> str:
    """Return the source of a height as a report names it.

    >>> source_text("num_floors"), source_text("height")
    ('num_floors × 3 m', 'height tag')

    Args:
        source: of a `Height`.
        declared: column that the user named.
    """
    column = next((one for one in (*((declared,) if declared else ()), *KNOWN)
                   if one.label == source), None)
    if column is None or column.unit == "m":
        return {"height": "height tag", "model": "model"}.get(source, source)
    return f"{source} × {LEVEL_M:g} m" if column.unit == STOREYS else f"{source} [{column.unit}]"


def _top_m(column: HeightColumn, tags: Mapping[str, str]) -> float:
    """Return the top above the ground [m]; NaN where a text is no number."""
    unit_m = UNITS_M[column.unit]
    top = parse_length_m(tags[column.name]) if column.unit == "m" else _number(tags[column.name])
    ground = parse_length_m(tags[column.ground]) if column.ground else 0.0
    return unit_m * (top - ground)


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
