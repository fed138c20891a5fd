"""Vegetation of OpenStreetMap as areas that a scene declares, with heights.

These are woods (`natural=wood`, `landuse=forest`), parks (`leisure=park`) and rows of trees
(`natural=tree_row`) [1]. Heights are from `height` tags; otherwise woods are as high as the forest
of the measurements of ITU-R P.833-10, and trees of parks and rows lower.

[1] https://wiki.openstreetmap.org/wiki/Key:natural
"""

from collections.abc import Mapping, Sequence

import numpy as np
import shapely

from radiotwin.geo import to_local
from radiotwin.io.budgets import VEGETATION_CORNERS
from radiotwin.io.forms import Origin
from radiotwin.scene.checks import Problem
from radiotwin.scene.readers.features import Feature, problems_of
from radiotwin.scene.readers.heights import parse_length_m
from radiotwin.scene.vegetation import VegetationConfig

TAGS = {("natural", "wood"): "wood", ("landuse", "forest"): "wood", ("leisure", "park"): "park",
        ("natural", "tree_row"): "tree_row"}
"""Tag -> kind of vegetation."""
HEIGHT_M = {"wood": 16.0, "park": 10.0, "tree_row": 10.0}  # of tree tops without a tag
MAX_HEIGHT_M = 120.0  # the tallest tree has 116 m
ROW_WIDTH_M = 6.0  # of the crowns along a row
SIMPLIFIED_M = 1.0  # tolerance of simplified outlines
MIN_AREA_M2 = 50.0  # smaller areas are gardens, and left out


def kind_of(tags: Mapping[str, str]) -> str | None:
    """Return the kind of vegetation that tags of OpenStreetMap describe, or None.

    >>> kind_of({"landuse": "forest"}), kind_of({"natural": "water"})
    ('wood', None)
    """
    return next((kind for (key, value), kind in TAGS.items() if tags.get(key) == value), None)


def make_vegetation(features: Sequence[Feature], origin: Origin,
                    box_m: tuple[float, float, float, float]
                    ) -> tuple[list[VegetationConfig], list[Problem]]:
    """Make vegetation from areas and lines, cut to a box (x_min, x_max, y_min, y_max) [m].

    Each polygon of `MIN_AREA_M2` or more is one entry; several may share a name. Also returns a
    warning if the smallest were left out, as a scene has a limit of corners.
    """
    x_min, x_max, y_min, y_max = box_m
    box = shapely.box(x_min, y_min, x_max, y_max)
    found = []
    for feature in features:
        kind = kind_of(feature.tags)
        assert kind is not None
        area = shapely.transform(feature.area, lambda points: np.column_stack(
            to_local(origin, *points.T)))
        area = area.buffer(ROW_WIDTH_M / 2) if kind == "tree_row" else shapely.make_valid(area)
        area = shapely.make_valid(shapely.simplify(shapely.intersection(area, box), SIMPLIFIED_M))
        for part in shapely.get_parts(shapely.get_parts(area)):
            if part.geom_type == "Polygon" and part.area >= MIN_AREA_M2:
                rings_m = [np.round(ring.coords, 2)[:-1, :2].tolist()
                           for ring in (part.exterior, *part.interiors)]
                found.append(VegetationConfig(name=feature.name, kind=kind,
                                              height_m=_height_m(feature.tags, kind),
                                              rings_m=rings_m))
    return _largest(found)


def _largest(found: list[VegetationConfig]) -> tuple[list[VegetationConfig], list[Problem]]:
    """Return the largest areas, with as many corners as a scene may have; warn of the others."""
    size_m2 = [_area_m2(area) for area in found]
    order = sorted(range(len(found)), key=lambda row: -size_m2[row])
    corners = np.cumsum([sum(map(len, found[row].rings_m)) for row in order])
    kept = int(np.searchsorted(corners, VEGETATION_CORNERS.limit, side="right"))
    names = [found[row].name for row in order[kept:]]
    return ([found[row] for row in sorted(order[:kept])],
            problems_of(names, "area(s) of vegetation, the smallest ones, are left out: a scene "
                               f"may have {VEGETATION_CORNERS.limit:,} corners of them; take a "
                               "smaller --bbox"))


def _area_m2(declared: VegetationConfig) -> float:
    """Return the size of an area of vegetation without its clearings [m²]."""
    return shapely.Polygon(declared.rings_m[0], declared.rings_m[1:]).area


def vegetation_fact(declared: Sequence[VegetationConfig]) -> str:
    """Format the number of areas of vegetation, and their size [ha] by kind, for the report."""
    area_m2 = dict.fromkeys(HEIGHT_M, 0.0)
    for area in declared:
        area_m2[area.kind] += _area_m2(area)
    kinds = ", ".join(f"{kind.replace('_', ' ')}: {total / 1e4:,.1f} ha"
                      for kind, total in area_m2.items() if total)
    return f"{len(declared):,} areas ({kinds}), which paths are not traced through"


def _height_m(tags: Mapping[str, str], kind: str) -> float:
    """Return the height of vegetation by its tag, else by its kind [m]."""
    height_m = parse_length_m(tags.get("height", ""))
    return height_m if 0 < height_m <= MAX_HEIGHT_M else HEIGHT_M[kind]
