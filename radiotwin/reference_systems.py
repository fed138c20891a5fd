"""Coordinate reference systems by their names, of which none may open a file.

A name comes from a stranger. In PROJ's own language, in its JSON, or in WKT with grids, it can open
any file, and a pipe for ever: only an authority with its code, a title of PROJ's database, and WKT
without grids are used.
"""

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pyproj import CRS

ALLOWED = "AUTHORITY:CODE, a title of PROJ's database, or WKT without grids"
_CODE = re.compile(r"(?:urn:ogc:def:crs:)?([A-Za-z]+):(?:[\d.]*:)?(\w+)")
_TITLE = re.compile(r"[\w .,()/'-]+")
# What can hold the name of a file in WKT: parameters that are files, PROJ's strings in extensions,
# and names of methods and geoid models that PROJ takes for its own language ("PROJ-based …").
_OPENS_FILES = re.compile(r"PARAMETERFILE|EXTENSION|GRIDS|INIT\s*=|PROJ\s*=|\bPROJ[\s-]",
                          re.IGNORECASE)


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
