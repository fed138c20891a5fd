"""Geographic coordinates: WGS84, coordinate reference systems by name, and the local frame.

The local frame, x east and y north [m], is the azimuthal equidistant projection of the WGS84
ellipsoid about an origin; heights are left as they are. Distance and bearing from the origin are
exact, and the ground stays at one z, as on a flat city map; in a tangent plane (topocentric frame)
the ground 10 km away would lie 8 m below zero. `frame.toml` beside tables of positions holds the
origin of their frame.

The name of a reference system may come from a stranger's file. PROJ's own language, its JSON, and
WKT with grids can make PROJ open any file, or wait at a pipe for ever. So only AUTHORITY:CODE, a
title of PROJ's database, and WKT without grids are accepted.
"""

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd
import tomli_w
from numpy.typing import ArrayLike
from pydantic import ConfigDict, Field, ValidationError, model_validator

from radiotwin.errors import BadInput
from radiotwin.io.forms import Origin, Table
from radiotwin.io.inputs import is_within, read_toml

if TYPE_CHECKING:
    from pyproj import CRS, Proj

ALLOWED = "AUTHORITY:CODE, a title of PROJ's database, or WKT without grids"
_CODE = re.compile(r"(?:urn:ogc:def:crs:)?([A-Za-z]+):(?:[\d.]*:)?(\w+)")
_TITLE = re.compile(r"[\w .,()/'-]+")
# Parts of WKT that can name a file: parameters that are files, PROJ strings in extensions, and
# names of methods and geoid models that PROJ reads as its own language ("PROJ-based …").
_OPENS_FILES = re.compile(r"PARAMETERFILE|EXTENSION|GRIDS|INIT\s*=|PROJ\s*=|\bPROJ[\s-]",
                          re.IGNORECASE)
GroundHeight = Callable[[np.ndarray, np.ndarray], np.ndarray]
FRAME_FILE = "frame.toml"
ORIGIN_DECIMALS = 7  # of degrees: 1 cm
# Largest difference of two origins that are the same but for rounding; 1e-9 degrees are 0.1 mm
SAME_DEG, SAME_ALTITUDE_M = 1e-9, 1e-3


def local_crs(origin: Origin) -> str:
    """Return the PROJ string of the local frame, for programs that georeference files."""
    return (f"+proj=aeqd +lat_0={origin.latitude_deg!r} +lon_0={origin.longitude_deg!r} "
            "+x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs +type=crs")


def origin_attributes(origin: Origin | None) -> dict[str, Any]:
    """Return an origin as attributes of a NetCDF data set: `origin_latitude_deg` and so on."""
    return {} if origin is None else {
        f"origin_{name}": value for name, value in origin.model_dump().items()}


def to_local(origin: Origin, longitude_deg: ArrayLike,
             latitude_deg: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Convert longitude and latitude [degrees] to x and y of the local frame [m].

    Where the projection is undefined, x and y are infinite or NaN.
    """
    longitude_deg, latitude_deg = np.asarray(longitude_deg, float), np.asarray(latitude_deg, float)
    return _projection(origin)(longitude_deg, latitude_deg)


def to_geographic(origin: Origin, x_m: ArrayLike, y_m: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Convert x and y of the local frame [m] to longitude and latitude [degrees]."""
    return _projection(origin)(np.asarray(x_m, float), np.asarray(y_m, float), inverse=True)


def _projection(origin: Origin) -> "Proj":
    """Return the projection from longitude and latitude [degrees] to the local frame [m]."""
    from pyproj import Proj

    return Proj(proj="aeqd", lat_0=origin.latitude_deg, lon_0=origin.longitude_deg, ellps="WGS84")


def reference_system(name: str) -> "CRS":
    """Look up a coordinate reference system by `AUTHORITY:CODE`, URN, title in PROJ, or WKT.

    Raises:
        pyproj.exceptions.CRSError: the name is unknown, or of a form that could open a file.
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


class FrameRecord(Table):
    """Content of `frame.toml`: all tables in its folder are in this local frame."""

    schema_: Literal["radiotwin.frame/1"] = Field("radiotwin.frame/1", alias="schema")
    crs: str | None = Field(None, description="PROJ string of the frame, for other programs")
    origin: Origin

    model_config = ConfigDict(populate_by_name=True)

    @model_validator(mode="after")
    def _consistent(self) -> "FrameRecord":
        if self.crs not in (None, local_crs(self.origin)):
            raise ValueError("crs is not that of the local frame about [origin]; remove it, or "
                             f'write crs = "{local_crs(self.origin)}"')
        return self


def read_frame(folder: Path) -> Origin | None:
    """Read the origin of a folder's local frame from its `frame.toml`; None if there is no file.

    Raises:
        BadInput: the file cannot be read, is a link out of the folder, or has an impossible value.
    """
    path = folder / FRAME_FILE
    if not os.path.lexists(path):
        return None
    if not is_within(path, folder):
        raise BadInput(f"{path} is a link out of its folder; copy it there")
    try:
        return FrameRecord.model_validate(read_toml(path)).origin
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        reason = first["msg"].removeprefix("Value error, ")
        raise BadInput(f"{path}: {key + ': ' if key else ''}{reason}; import the measurements "
                       "again, or correct it") from None


def write_frame(origin: Origin, path: Path) -> None:
    """Write the origin of a local frame to a file `frame.toml`."""
    record = FrameRecord(origin=origin, crs=local_crs(origin))
    with path.open("wb") as file:
        tomli_w.dump(record.model_dump(by_alias=True), file)


def origin_text(origin: Origin) -> str:
    """Format latitude and longitude of an origin for a message.

    >>> origin_text(Origin(latitude_deg=36.0001, longitude_deg=-78.93575))
    '36.0001, -78.93575'
    """
    return f"{origin.latitude_deg:.10g}, {origin.longitude_deg:.10g}"


def is_same_frame(one: Origin, other: Origin) -> bool:
    """Return whether two origins agree to 1e-9 degrees and, if both have an altitude, 1 mm."""
    turn_deg = abs(one.longitude_deg - other.longitude_deg) % 360
    return (abs(one.latitude_deg - other.latitude_deg) <= SAME_DEG
            and min(turn_deg, 360 - turn_deg) <= SAME_DEG
            and abs(_datum_difference_m(one, other)) <= SAME_ALTITUDE_M)


def between_frames(position_m: np.ndarray, source: Origin, target: Origin) -> np.ndarray:
    """Convert positions (n, 3) [m] from one local frame to another, by latitude and longitude.

    NaN stays NaN. Heights count from the ground datum of a frame. They change only if both origins
    declare the altitude of their datum; 0 m, as of maps without terrain, counts as not declared.
    """
    target_m = np.array(position_m, dtype=float)
    known = np.isfinite(target_m[:, :2]).all(axis=1)
    target_m[known, :2] = np.column_stack(to_local(target, *to_geographic(
        source, *target_m[known, :2].T)))
    target_m[:, 2] += _datum_difference_m(source, target)
    return target_m


def _datum_difference_m(source: Origin, target: Origin) -> float:
    """Return the height to add to z of one frame to get z of another [m]; 0 if not declared."""
    if not (source.altitude_m and target.altitude_m):
        return 0.0
    return source.altitude_m - target.altitude_m


def median_origin(places: pd.DataFrame) -> Origin:
    """Return the median of the columns latitude and longitude [degrees], ignoring NaN.

    >>> median_origin(pd.DataFrame({"latitude": [10.0, 12.0], "longitude": [179.0, -179.0]}))
    Origin(latitude_deg=11.0, longitude_deg=-180.0, altitude_m=0.0)
    """
    first = places["longitude"].dropna().iloc[0]
    east = (places["longitude"] - first + 180) % 360 - 180  # continuous across the date line
    longitude = (first + east.median() + 180) % 360 - 180
    return Origin(latitude_deg=round(float(places["latitude"].median()), ORIGIN_DECIMALS),
                  longitude_deg=round(float(longitude), ORIGIN_DECIMALS))


def with_coordinates(table: pd.DataFrame, position_m: np.ndarray,
                origin: Origin | None) -> pd.DataFrame:
    """Add columns x_m, y_m, z_m of positions (n, 3) [m] to a table.

    If an origin is given, also add latitude_deg and longitude_deg.
    """
    table = table.assign(**dict(zip(("x_m", "y_m", "z_m"), position_m.T)))
    if origin is None:
        return table
    longitude_deg, latitude_deg = to_geographic(origin, *position_m[:, :2].T)
    unknown = ~np.isfinite(position_m[:, :2]).all(axis=1)
    return table.assign(latitude_deg=np.where(unknown, np.nan, latitude_deg),
                        longitude_deg=np.where(unknown, np.nan, longitude_deg))


def with_datum_heights(table: pd.DataFrame, what: str, position: list[str],
                       ground_height_m: GroundHeight | None) -> pd.DataFrame:
    """Convert heights above the ground to heights above z = 0, and drop their column.

    Args:
        table: columns x, y and z, and one named like z with `above_ground_m` in the place of `z_m`;
            a row has one of the two heights, or none.
        what: contents of the table, for messages.
        position: names of the columns x, y and z.
        ground_height_m: function of x and y (n,) that returns the height (n,) of the ground [m];
            None: flat ground at z = 0.

    Raises:
        BadInput: a row has both heights, or a height above the ground without x and y.
    """
    column = position[2].replace("z_m", "above_ground_m")
    if column not in table:
        return table
    (x_m, y_m, z_m), above_m = table[position].to_numpy(dtype=float).T, table[column].to_numpy()
    given = np.isfinite(above_m)
    twice = np.flatnonzero(given & np.isfinite(z_m))
    if len(twice):
        raise BadInput(f"{what}, row {twice[0] + 2}: {position[2]} (above the datum) and {column} "
                       "are both given; leave one of them empty")
    nowhere = np.flatnonzero(given & ~np.isfinite(x_m + y_m))
    if len(nowhere) and ground_height_m is not None:
        raise BadInput(f"{what}, row {nowhere[0] + 2}: {column} needs a known position; a device "
                       f"to be found is searched at one height above the datum: give {position[2]}")
    ground_m = np.zeros(len(table))
    if ground_height_m is not None:
        ground_m[given] = ground_height_m(x_m[given], y_m[given])
    return table.drop(columns=column).assign(**{position[2]: np.where(given, ground_m + above_m,
                                                                      z_m)})


def map_positions(table: pd.DataFrame, columns: list[str],
                    position_m: Callable[[np.ndarray], np.ndarray]) -> pd.DataFrame:
    """Apply a function of positions (n, 3) [m] to the columns of a table that hold x, y and z."""
    mapped_m = position_m(table[columns].to_numpy(dtype=float))
    return table.assign(**dict(zip(columns, mapped_m.T)))
