"""Surfaces of the multipatches of a Shapefile [1]: buildings in three dimensions.

[1] https://www.esri.com/library/whitepapers/pdfs/shapefile.pdf, MultiPatch
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from radiotwin.footprints.city_objects import (
    CityObject,
    Geometry,
    Polygon,
    city_features,
)
from radiotwin.footprints.features import MapFile
from radiotwin.footprints.systems import degrees_from, find_system, plane_of, vertical_unit_m

MULTIPATCH = 31
_STRIP, _FAN, _OUTER, _INNER, _FIRST, _RING = range(6)  # kinds of a part [1]
_FOLLOWS = {_INNER: _OUTER, _RING: _FIRST}  # a ring, and the kind that begins its surface
_LOD = 2.0  # of a building with its roof, in the words of CityGML


def patches_file(path: Path, rows: Iterable[tuple[str, Mapping, Any]], system: str) -> MapFile:
    """Return the buildings of multipatches, as those of 3D city models.

    Args:
        path: file, for messages.
        rows: name, columns and surfaces of each, as of `patch_surfaces`.
        system: name of the coordinate reference system.

    Raises:
        BadInput: an unknown system.
    """
    known = find_system(path, system)
    project, unit_m = degrees_from(path, plane_of(known)), vertical_unit_m(known)
    objects = []
    for name, columns, surfaces in rows:
        rings = [ring for surface in surfaces for ring in surface]
        if rings:
            corners = np.concatenate(rings)
            corners[:, :2] = project(corners[:, :2])
            corners[:, 2] *= unit_m
            placed = iter(np.split(corners, np.cumsum([len(ring) for ring in rings])[:-1]))
            surfaces = [[next(placed) for _ in surface] for surface in surfaces]
        attributes = {str(key).lower(): f"{value:g}" if isinstance(value, float) else str(value)
                      for key, value in columns.items() if value is not None}
        objects.append(CityObject(name, "Building", attributes, "", [Geometry(_LOD, surfaces)]))
    return city_features(path, objects, ["OGC:CRS84"])


def patch_surfaces(shape: Any) -> list[Polygon]:
    """Return the polygons of a multipatch: triangles of strips and fans, rings with their holes.

    Args:
        shape: as pyshp reads it.

    Raises:
        ValueError: a part begins outside its shape, or a corner is not finite.
    """
    starts = list(shape.parts)
    if not starts:
        return []
    corners = np.column_stack([np.array([point[:2] for point in shape.points], dtype=float),
                               np.array(shape.z, dtype=float)])
    if not np.isfinite(corners).all():
        raise ValueError("a coordinate is not finite")
    if starts != sorted(starts) or not 0 <= starts[0] <= starts[-1] <= len(corners):
        raise ValueError("a part begins outside its shape")
    found: list[Polygon] = []
    begun = None  # kind of the ring that the next ones may be holes of
    for part, kind in zip(np.split(corners, starts[1:]), shape.partTypes):
        if kind in (_STRIP, _FAN):
            found += [[part[[0 if kind == _FAN else i, i + 1, i + 2]]]
                      for i in range(len(part) - 2)]
            begun = None
            continue
        ring = part[:-1] if len(part) > 1 and (part[0] == part[-1]).all() else part
        if begun is not None and _FOLLOWS.get(kind) == begun:
            found[-1].append(ring)
        else:
            found.append([ring])
            begun = kind
    return found
