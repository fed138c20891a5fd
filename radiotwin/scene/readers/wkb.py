"""Well-known binary [1], checked before GEOS reads it: that goes down a level for every level.

A few kilobytes can hold more levels than a stack has room for.

[1] OGC 06-103r4, Simple feature access, section 8.2; with the flags of PostGIS (EWKB).
"""

import struct

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from radiotwin.io.budgets import NESTING

_Z, _M, _SRID = 0x80000000, 0x40000000, 0x20000000  # flags of EWKB
_POINT, _RINGS = (1,), (3, 17)  # a polygon, a triangle
_POSITIONS = (2, 8)  # a line, a circular string
_COLLECTIONS = (4, 5, 6, 7, 9, 10, 11, 12, 15, 16)
_PLANE = (1, 2, 3, 4, 5, 6, 7)  # that GEOS has as we need them: without arcs and surfaces in space


def area_of_wkb(data: bytes, source: object) -> BaseGeometry | None:
    """Return a geometry in well-known binary, with its z.

    Args:
        data: one geometry.
        source: of it, for the message.

    Returns:
        None of one that is not finite, or has curves or surfaces in space.

    Raises:
        BadInput: geometries within geometries, too many levels of them.
        shapely.errors.GEOSException: damaged.
    """
    if not _kinds(data, source) <= {*_PLANE}:
        return None
    area = shapely.from_wkb(data)
    while any(part.geom_type == "GeometryCollection" for part in shapely.get_parts(area)):
        area = shapely.GeometryCollection(list(shapely.get_parts(shapely.get_parts(area))))
    return area if np.isfinite(shapely.get_coordinates(area)).all() else None


def _kinds(data: bytes, source: object) -> set[int]:
    """Return the kinds of a geometry and all within it."""
    found: set[int] = set()
    at, waiting = 0, [1]  # geometries that are still to come, by level
    try:
        while waiting:
            if not waiting[-1]:
                waiting.pop()
                continue
            waiting[-1] -= 1
            order = "<" if data[at] else ">"
            code, = struct.unpack_from(order + "I", data, at + 1)
            at += 9 if code & _SRID else 5
            more, kind = divmod(code & ~(_Z | _M | _SRID), 1000)
            has_z, has_m = more in (1, 3) or code & _Z, more in (2, 3) or code & _M
            size = 8 * (2 + bool(has_z) + bool(has_m))
            found.add(kind)
            if kind in _POINT:
                at += size
                continue
            count, = struct.unpack_from(order + "I", data, at)
            at += 4
            if kind in _POSITIONS:
                at += count * size
            elif kind in _RINGS:
                for _ in range(count):
                    corners, = struct.unpack_from(order + "I", data, at)
                    at += 4 + corners * size
            elif kind in _COLLECTIONS:
                waiting.append(count)
                NESTING.check(len(waiting) - 2, source)
            else:
                raise shapely.errors.GEOSException(f"unknown kind of geometry {code}")
    except (struct.error, IndexError):
        raise shapely.errors.GEOSException("cut off") from None
    return found
