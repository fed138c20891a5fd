"""Geodesy: conversion between geographic and local coordinates, and reference systems by code.

Conversion between WGS84 and the local frame: x east, y north [m].

The local frame is the azimuthal equidistant projection of the WGS84 ellipsoid about an origin;
heights are left as they are. Distance and bearing from the origin are exact, and the ground stays
at one z, as on a flat city map; in a tangent plane (topocentric frame) the ground 10 km away would
lie 8 m below zero.

Coordinate reference systems by their names, of which none may open a file.

A name comes from a stranger. In PROJ's own language, in its JSON, or in WKT with grids, it can open
any file, and a pipe for ever: only an authority with its code, a title of PROJ's database, and WKT
without grids are used.
"""

import re
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from radiotwin.io.forms import Origin

if TYPE_CHECKING:
    from pyproj import CRS, Proj

ALLOWED = "AUTHORITY:CODE, a title of PROJ's database, or WKT without grids"
_CODE = re.compile(r"(?:urn:ogc:def:crs:)?([A-Za-z]+):(?:[\d.]*:)?(\w+)")
_TITLE = re.compile(r"[\w .,()/'-]+")
# What can hold the name of a file in WKT: parameters that are files, PROJ's strings in extensions,
# and names of methods and geoid models that PROJ takes for its own language ("PROJ-based …").
_OPENS_FILES = re.compile(r"PARAMETERFILE|EXTENSION|GRIDS|INIT\s*=|PROJ\s*=|\bPROJ[\s-]",
                          re.IGNORECASE)


def local_crs(origin: Origin) -> str:
    """Return the PROJ string of the local frame, for programs that georeference files.

    Args:
        origin: of the local frame.
    """
    return (f"+proj=aeqd +lat_0={origin.latitude_deg!r} +lon_0={origin.longitude_deg!r} "
            "+x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs +type=crs")


def to_local(origin: Origin, longitude_deg: ArrayLike,
             latitude_deg: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Convert longitude and latitude to the local frame.

    Args:
        origin: of the local frame.
        longitude_deg: (n,) [degrees].
        latitude_deg: (n,) [degrees].

    Returns:
        x and y [m], (n,) each; not finite where the projection is undefined.
    """
    longitude_deg, latitude_deg = np.asarray(longitude_deg, float), np.asarray(latitude_deg, float)
    return _projection(origin)(longitude_deg, latitude_deg)


def to_geographic(origin: Origin, x_m: ArrayLike, y_m: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Convert points of the local frame to longitude and latitude.

    Args:
        origin: of the local frame.
        x_m: (n,) [m].
        y_m: (n,) [m].

    Returns:
        longitude and latitude [degrees], (n,) each.
    """
    return _projection(origin)(np.asarray(x_m, float), np.asarray(y_m, float), inverse=True)


def _projection(origin: Origin) -> "Proj":
    from pyproj import Proj

    return Proj(proj="aeqd", lat_0=origin.latitude_deg, lon_0=origin.longitude_deg, ellps="WGS84")


def reference_system(name: str) -> "CRS":
    """Return a coordinate reference system.

    Args:
        name: `AUTHORITY:CODE`, URN, title of PROJ's database, or WKT.

    Raises:
        pyproj.exceptions.CRSError: it is not known, or a name that could open a file.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    if code := _CODE.fullmatch(name):
        return CRS.from_authority(code[1].upper(), code[2])
    if _TITLE.fullmatch(name):
        return CRS.from_user_input(name)
    if "[" in name and not _OPENS_FILES.search(name):
        return CRS.from_wkt(name)  # refuses PROJ's language and its JSON
    raise CRSError(f"it is not {ALLOWED}")
