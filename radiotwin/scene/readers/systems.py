"""Coordinate reference systems of files: lookup by name, and conversion to longitude, latitude."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.geo import reference_system

if TYPE_CHECKING:
    from pyproj import CRS

WGS84 = ("EPSG:4326", "OGC:CRS84", "urn:ogc:def:crs:OGC:1.3:CRS84", "urn:ogc:def:crs:EPSG::4326")
# EPSG codes in names of GML and CityJSON: URN, URI, lists of a horizontal and a vertical system
_EPSG = re.compile(r"EPSG(?::|/)(?:[\d.]*(?::|/))?(\d{4,6})(?!\d)", re.IGNORECASE)
_EPSG_OLD = re.compile(r"epsg\.xml#(\d{4,6})$", re.IGNORECASE)
# Names of the German states' survey (AdV, "ETRS89_UTM32*DE_DHHN2016_NH")
_ADV = re.compile(r"urn:adv:crs:(?:ETRS89_UTM(3[123])|DE_DHDN_3GK([2345]))", re.IGNORECASE)
_MARGIN_DEG = 1.0  # around the area of use that a system declares


def find_system(path: Path, name: str) -> "CRS":
    """Look up a coordinate reference system by its name in a file; see `reference_system`.

    Raises:
        BadInput: the name is unknown, or of a form that could open a file.
    """
    from pyproj.exceptions import CRSError

    try:
        return reference_system(name)
    except CRSError as error:
        raise BadInput(f"{path}: its coordinate reference system {name[:60]!r} is unknown "
                       f"({error!s:.200}); export it in EPSG:4326") from None


def degrees_from(path: Path, system: "CRS") -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from (n, 2) east, north to (n, 2) longitude, latitude [degrees].

    Raises:
        BadInput: the system cannot be converted; also raised by the function.
    """
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    def refuse(error: ProjError) -> BadInput:
        return BadInput(f"{path}: its coordinate reference system {system.name[:60]!r} cannot be "
                        f"converted ({error!s:.120}); export it in EPSG:4326")

    def convert(points: np.ndarray) -> np.ndarray:
        try:
            return np.column_stack(transformer.transform(*points.T))
        except ProjError as error:
            raise refuse(error) from None

    try:
        transformer = Transformer.from_crs(system, "EPSG:4326", always_xy=True)
    except ProjError as error:
        raise refuse(error) from None
    return convert


def chosen_system(path: Path, named: str | None, declared: str | None) -> str | None:
    """Return the name of a file's coordinate reference system: the file's own, else the user's.

    Raises:
        BadInput: both are given, and their horizontal parts differ.
    """
    if named is None or declared is None:
        return declared if named is None else named
    in_file, by_user = (plane_of(find_city_system(path, name)) for name in (named, declared))
    if not in_file.equals(by_user, ignore_axis_order=True):
        raise BadInput(f"{path} is in {in_file.name[:80]!r}, and --crs says {by_user.name[:80]!r}; "
                       "leave --crs out, or correct the file if its system is wrong")
    return named


def check_declared_system(name: str) -> None:
    """Raise BadInput if --crs is no known coordinate reference system."""
    try:
        find_system(Path(), name)
    except BadInput:
        raise BadInput(f"--crs {name[:60]!r} is no coordinate reference system that is known; give "
                       "AUTHORITY:CODE, such as EPSG:25832") from None


def find_city_system(path: Path, name: str) -> "CRS":
    """Look up a coordinate reference system by a name as in GML and CityJSON.

    Such names are `urn:ogc:def:crs:EPSG::25832`, `https://www.opengis.net/def/crs/EPSG/0/7415`,
    `urn:ogc:def:crs,crs:EPSG::25832,crs:EPSG::7837`, `urn:adv:crs:ETRS89_UTM32`.

    Raises:
        BadInput: the name is unknown.
    """
    if found := _EPSG.search(name) or _EPSG_OLD.search(name):
        return find_system(path, f"EPSG:{found[1]}")
    if found := _ADV.match(name):
        return find_system(path, f"EPSG:258{found[1]}" if found[1]
                           else f"EPSG:3146{int(found[2]) + 4}")
    if name.upper().endswith("CRS84"):
        return find_system(path, "OGC:CRS84")
    return find_system(path, name)


def vertical_unit_m(system: "CRS") -> float:
    """Return how many metres the unit of a system's elevations has; without one, of its plane."""
    axes = system.axis_info
    return float(axes[2].unit_conversion_factor) if len(axes) > 2 else plane_unit_m(system)


def plane_unit_m(system: "CRS") -> float:
    """Return the unit of a system's east and north [m]; 1 if it is geographic."""
    plane = plane_of(system)
    axes = plane.axis_info
    return 1.0 if plane.is_geographic or not axes else float(axes[0].unit_conversion_factor)


def to_degrees(path: Path, system: "CRS", points: np.ndarray) -> np.ndarray:
    """Convert points (n, 2) of a 3D city model to longitude and latitude [degrees].

    Standards require the system's order of axes, but many programs write east before north. The
    order is taken in which the points lie in the system's area of use.

    Raises:
        BadInput: the points lie outside the system's area of use in both orders.
    """
    convert = degrees_from(path, plane_of(system))
    north_first = system.is_geographic and system.to_authority() != ("OGC", "CRS84")
    orders = [points[:, ::-1], points] if north_first else [points, points[:, ::-1]]
    area = system.area_of_use
    for ordered in orders:
        degrees = convert(ordered)
        if area is None:
            return degrees
        middle = np.median(degrees, axis=0)  # NaN and infinite compare as outside
        west, east = area.west, area.east if area.east >= area.west else area.east + 360
        if (area.south - _MARGIN_DEG <= middle[1] <= area.north + _MARGIN_DEG
                and any(west - _MARGIN_DEG <= middle[0] + turn <= east + _MARGIN_DEG
                        for turn in (0, 360))):
            return degrees
    first, second = np.median(points, axis=0)
    raise BadInput(f"{path}: coordinates such as {first:.8g}, {second:.8g} are not in the area of "
                   f"{system.name!r} ({area.name[:80] if area else ''}); correct the coordinate "
                   "reference system that the file names, or the order of its coordinates")


def plane_of(system: "CRS") -> "CRS":
    """Return the horizontal part of a system."""
    return system.sub_crs_list[0] if system.sub_crs_list else system.to_2d()
