"""Height of a building from its tags, with its source.

Tags and units as in OpenStreetMap [1]: metres unless a unit is given, `33'`, `33 ft`, `33'6"`.

[1] https://wiki.openstreetmap.org/wiki/Key:height
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from radiotwin.footprints.height_columns import KNOWN, LEVEL_M, STOREYS, UNITS_M, HeightColumn

TAG_SD_M, STOREYS_SD_M = 1.5, 3.0  # of a height that is given in metres; counted from storeys
GUESS_SD_M = 6.0  # of a default, where few heights of the map are known
MIN_KNOWN = 10  # heights of a map that tell how far a default is off
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
        sd_m: standard deviation of the top [m]; NaN of a default.
    """

    bottom_m: float
    top_m: float
    source: str
    unusable: list[str] = field(default_factory=list)
    sd_m: float = TAG_SD_M


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
    top_m, source, sd_m = default_m, "default", math.nan
    for column in (*((declared,) if declared else ()), *KNOWN):
        if column.name not in tags or (column.ground and column.ground not in tags):
            continue
        value_m = _top_m(column, tags)
        if 0 < value_m <= MAX_HEIGHT_M:
            top_m, source = value_m, column.label
            sd_m = STOREYS_SD_M if column.unit == STOREYS else TAG_SD_M
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
    return Height(bottom_m, top_m, source, unusable, sd_m)


def height_sds_m(top_m: np.ndarray, sd_m: np.ndarray) -> np.ndarray:
    """Return how well the height of each building of a map is known, of defaults, too.

    A default is off as far as heights of the same map that are known lie from it.

    Args:
        top_m: (n,) tops above the ground [m].
        sd_m: (n,) standard deviation of each as `Height` has it [m]; NaN of a default.

    Returns:
        (n,) standard deviations [m]
    """
    guessed = np.isnan(sd_m)
    if guessed.any():
        spread_m = GUESS_SD_M
        if (~guessed).sum() >= MIN_KNOWN:
            spread_m = float(np.sqrt(np.mean((top_m[~guessed] - top_m[guessed][0]) ** 2)))
        sd_m = np.where(guessed, max(spread_m, STOREYS_SD_M), sd_m)
    return sd_m


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
