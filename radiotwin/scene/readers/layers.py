"""Choice of the layers that hold buildings in a file of several, and their union.

A GeoPackage of 3D BAG [1] has the same buildings in each level of detail, one of Overture Maps has
buildings and their parts, an extract of Geofabrik [2] also woods, water and railways.

[1] https://docs.3dbag.nl/en/schema/layers
[2] https://download.geofabrik.de/osm-data-in-gis-formats-free.pdf
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely

from radiotwin.errors import BadInput
from radiotwin.scene.checks import Problem, listed, warning
from radiotwin.scene.readers.features import BUILDING_KEYS, MapFile
from radiotwin.scene.readers.heights import KNOWN, column_name, listed_names

# Names in 3D BAG: layer of outlines, columns of the ground's height, column of identifiers, layers
# of roofs seen from above by level of detail
OUTLINES, GROUND_COLUMNS = "pand", ("b3_h_maaiveld", "h_maaiveld")
IDENTIFIER = "identificatie"
_PROJECTED = re.compile(r"lod(\d)(\d)_2d")
_NAMES = re.compile(r"building|gebaeude|gebäude|b[aâ]timent|pand(?![a-z])|edifi[ck]|fabbricat|"
                    r"budyn|bygning|byggnad|rakennu|epulet|épület|footprint|hous|haeuser|häuser|"
                    r"huizen", re.IGNORECASE)
# Two layers hold the same buildings if more than this share of one lies within those of the other
SAME_GROUND = 0.5


def choose_layers(path: Path, columns: Mapping[str, Sequence[str]],
                  wanted: Sequence[str]) -> tuple[list[str], list[Problem]]:
    """Choose the layers that hold the buildings; also return a warning about the others.

    They are the wanted ones; else, in 3D BAG, the outlines and the most detailed roofs seen from
    above; else layers with tags of buildings, or with a name of buildings, or with known heights.

    Args:
        path: file, for messages.
        columns: name of each layer of areas -> its columns.
        wanted: names of layers that the user wants; empty: choose.

    Raises:
        BadInput: a wanted layer does not exist, or no layer seems to hold buildings.
    """
    names = list(columns)
    if unknown := [name for name in wanted if name not in columns]:
        raise BadInput(f"{path} has no layer of areas called {unknown[0]!r}; its layers are: "
                       f"{listed_names(names)}")
    chosen = [name for name in names if name in wanted] if wanted else _building_layers(columns)
    if not chosen and names:
        raise BadInput(f"{path} has {len(names)} layers of areas, and none is known to hold "
                       "buildings by its name or columns; choose with --layer NAME: "
                       f"{listed_names(names)}")
    left = [name for name in names if name not in chosen]
    if wanted or not left:
        return chosen, []
    return chosen, [warning(f"{len(left)} layer(s) were not read ({listed(left)}): buildings are "
                            f"taken from {listed_names(chosen)}; --layer NAME reads another")]


def _building_layers(columns: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the layers that hold buildings, by their names and columns."""
    names = list(columns)
    if len(names) < 2:
        return names
    if projected := [name for name in names if _PROJECTED.fullmatch(name.lower())]:
        return [max(projected), *(name for name in names if name.lower() == OUTLINES)]
    heights = {one.name for one in KNOWN} - {one.name for one in KNOWN if one.ground}
    tags = {name: {column_name(column) for column in columns[name]} for name in names}
    rules = ([name for name in names if tags[name] & {*BUILDING_KEYS, "has_parts"} or
              {"building_id", "is_underground"} <= tags[name]],
             [name for name in names if _NAMES.search(name)],
             [name for name in names if tags[name] & heights])
    return next((found for found in rules if found), [])


def join_layers(path: Path, parts: Mapping[str, MapFile], problems: list[Problem]) -> MapFile:
    """Join the buildings of all layers that were read.

    In 3D BAG, which is known by a layer called `OUTLINES`, an outline is only used for a building
    without roofs, such as a greenhouse; roofs without a ground height get the outline's.

    Raises:
        BadInput: layers of another file hold the same buildings.
    """
    plans_m = [part.plan_m for part in parts.values() if part.plan_m != 1.0]
    found = MapFile([], [one for part in parts.values() for one in part.left_out], problems,
                    plan_m=plans_m[0] if plans_m else 1.0,
                    columns={name for part in parts.values() for name in part.columns})
    bag = next((name for name in parts if name.lower() == OUTLINES), None)
    if bag is not None and len(parts) > 1:
        outlines = {one.tags.get(IDENTIFIER): one for one in parts[bag].features}
        for one in (one for name in parts if name != bag for one in parts[name].features):
            outline = outlines.get(one.tags.get(IDENTIFIER))
            ground = {} if outline is None else {
                key: outline.tags[key] for key in GROUND_COLUMNS if key in outline.tags}
            found.features.append(replace(one, tags=ground | dict(one.tags)))
        roofed = {one.tags.get(IDENTIFIER) for one in found.features}
        found.features += [one for one in parts[bag].features
                           if one.tags.get(IDENTIFIER) not in roofed]
        return found
    buildings = {name: [one.area for one in part.features if not one.is_part]
                 for name, part in parts.items()}
    for name, areas in buildings.items():
        for other, others in buildings.items():
            if name != other and _share_within(areas, others) > SAME_GROUND:
                raise BadInput(f"{path}: the layers {name!r} and {other!r} hold the same "
                               f"buildings; choose one with --layer {name}")
    found.features += [one for part in parts.values() for one in part.features]
    return found


def _share_within(areas: Sequence[shapely.Geometry], others: Sequence[shapely.Geometry]) -> float:
    """Return the share (0 to 1) of areas that have an inner point within one of the others."""
    if not areas or not others:
        return 0.0
    inside = shapely.STRtree(others).query(shapely.point_on_surface(list(areas)), "within")[0]
    return len(np.unique(inside)) / len(areas)
