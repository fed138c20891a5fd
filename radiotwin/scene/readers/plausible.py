"""Plausibility of heights: warnings about buildings of a map, and voids in terrain rasters.

Some 200 buildings are taller than 300 m [1]; the most slender one is 24 times as tall as wide [2].
No city has a median height above 60 m, and a room is at least 2.1 m high [5]. Rasters that were
clipped or warped without a no-data value have zeros there [3]. SRTM's editors took single pixels
for errors that differ by more than 100 m from their neighbours [4].

[1] Council on Tall Buildings and Urban Habitat, height criteria ("supertall").
[2] https://skyscraper.org/super-slenders/slenderness
[3] https://gdal.org/en/stable/programs/gdalwarp.html (-dstnodata)
[4] Slater et al., "The SRTM data 'finishing' process and products", Photogrammetric Engineering and
    Remote Sensing 72(3), 2006.
[5] International Residential Code, R305.1.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely
from scipy import ndimage
from shapely.geometry.base import BaseGeometry

from radiotwin.scene.checks import MAX_MEDIAN_M, Problem
from radiotwin.scene.readers.features import problems_of
from radiotwin.scene.readers.heights import KNOWN, STOREYS, Height, number

RARE_M, RARE_SLENDERNESS = 300.0, 24.0  # height [1], and height over width [2], of a building
ROOM_M = 2.1  # least height of a room [5]
VOID_STEP_M, VOID_SLOPE = 30.0, 1.0  # a step from 0 that is higher and steeper borders a void
VOID_BORDER = 0.9  # share of such steps along the border of a void
KERNEL_PIXELS = 3  # pixels beside a void that a cubic interpolation mixed with it
STEP_M, STEP_SLOPE = 100.0, math.tan(math.radians(80.0))  # larger steps are implausible [4]
_AROUND = np.ones((3, 3), dtype=bool)
_FIRST, _LAST, _ALL = slice(None, -1), slice(1, None), slice(None)
# (Pixels, their neighbours) as indices of a raster, for each of the four sides
_NEIGHBOURS = (((_FIRST, _ALL), (_LAST, _ALL)), ((_LAST, _ALL), (_FIRST, _ALL)),
               ((_ALL, _FIRST), (_ALL, _LAST)), ((_ALL, _LAST), (_ALL, _FIRST)))


def implausible_heights(buildings: Sequence[tuple[str, Height, BaseGeometry]],
                        columns: Mapping[str, Mapping[str, str]]) -> list[Problem]:
    """Return a warning about buildings whose height is implausible, and what the column may hold.

    Implausible is above `RARE_M` or `RARE_SLENDERNESS` times the width; of all buildings, a median
    above `MAX_MEDIAN_M` or below the height of a room.

    Args:
        buildings: name, height, footprint [m]; the tallest of a name counts, defaults do not.
        columns: name of a building -> its tags.
    """
    tallest: dict[str, tuple[str, Height, BaseGeometry]] = {}
    for name, height, footprint in buildings:
        if height.source != "default" and (
                name not in tallest or height.top_m > tallest[name][1].top_m):
            tallest[name] = name, height, footprint
    known = list(tallest.values())
    tops_m = np.array([height.top_m for _, height, _ in known])
    if not len(tops_m):
        return []
    footprints: Any = np.array([footprint for _, _, footprint in known], dtype=object)
    bounds_m = shapely.bounds(footprints)
    # A building is at least as wide as its area over its diagonal: most need no exact width
    least_m = shapely.area(footprints) / np.hypot(*(bounds_m[:, 2:] - bounds_m[:, :2]).T)
    width_m = np.array([_width_m(footprint) if top_m > RARE_SLENDERNESS * low_m else math.inf
                        for footprint, top_m, low_m in zip(footprints, tops_m, least_m)])
    rare = (tops_m > RARE_M) | (tops_m > RARE_SLENDERNESS * np.maximum(width_m, 1.0))
    median_m = float(np.median(tops_m)) if len(tops_m) > 1 else ROOM_M
    is_tall = median_m > MAX_MEDIAN_M
    if median_m < ROOM_M:
        return problems_of([f"{name}: {height.top_m:.3g} m" for name, height, _ in known],
                           f"building(s) have a median height of {median_m:.3g} m, less than a "
                           "room has. If a column counts storeys, say --height-column NAME:storeys")
    if not (rare.any() or is_tall):
        return []
    named = np.flatnonzero(rare if rare.any() else tops_m > MAX_MEDIAN_M)
    examples = [f"{known[row][0]}: {tops_m[row]:.4g} m tall, {_width_m(footprints[row]):.3g} m wide"
                for row in sorted(named, key=lambda row: -tops_m[row])]
    what = (f"building(s) are taller than {RARE_M:g} m, or than {RARE_SLENDERNESS:g} times their "
            "width, as hardly any building is" if rare.any() else
            f"of {len(tops_m):,} building(s) are taller than {MAX_MEDIAN_M:g} m, more than half, "
            "as in no city")
    return problems_of(examples, what + _remedy(known[int(named[0])][1].source, known, columns))


def _width_m(footprint: BaseGeometry) -> float:
    """Return the shorter side of the narrowest rectangle around an area [m]."""
    corners = shapely.get_coordinates(shapely.oriented_envelope(footprint))
    sides_m = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    return float(sides_m[:2].min()) if len(sides_m) > 1 else 0.0


def _remedy(source: str, known: Sequence[tuple[str, Height, BaseGeometry]],
            columns: Mapping[str, Mapping[str, str]]) -> str:
    """Return advice on a column of implausible heights: what it may hold, which option to give."""
    if source == "model":
        return "; are the model's elevations in metres?"
    column = source.split(" - ")[0]
    if any(one.name == column and one.unit == STOREYS for one in KNOWN):
        return (f". If {column!r} does not count storeys, say --height-column {column}; if it "
                "does, nothing is to be done")
    ground = _ground_column(known, columns)
    return (f". If {column!r} is an elevation, say --height-column {column} --ground-column "
            f"{ground or 'GROUND'}; if it is in feet or centimetres, --height-column {column}:ft "
            f"or {column}:cm. If the heights are right, nothing is to be done")


def _ground_column(known: Sequence[tuple[str, Height, BaseGeometry]],
                   columns: Mapping[str, Mapping[str, str]]) -> str | None:
    """Return a column that, subtracted from implausible heights, leaves usual ones, or None."""
    rows = [(height.top_m, columns.get(name, {})) for name, height, _ in known]
    for column in sorted({column for _, tags in rows for column in tags}):
        above_m = np.array([top_m - number(tags.get(column, "")) for top_m, tags in rows])
        ground_m = np.array([top_m for top_m, _ in rows]) - above_m
        if ((above_m > 0) & (ground_m > MAX_MEDIAN_M)).all() and np.median(above_m) < MAX_MEDIAN_M:
            return column
    return None


def zero_voids(height_m: np.ndarray, pixel_m: float) -> np.ndarray:
    """Return a mask of zeros that mean "no data", and of pixels interpolated with such zeros.

    A region of zeros means "no data" if nine tenths of its border are steps of more than 30 m and
    steeper than 45 degrees.

    Args:
        height_m: (rows, columns) [m].
        pixel_m: side of a pixel [m].
    """
    region, count = ndimage.label(height_m == 0.0, _AROUND)
    if not count:
        return np.zeros(height_m.shape, dtype=bool)
    wall_m = max(VOID_STEP_M, VOID_SLOPE * pixel_m)
    borders, walls = np.zeros(count + 1), np.zeros(count + 1)
    for inner, outer in _NEIGHBOURS:
        beside = (region[inner] > 0) & (region[outer] == 0) & np.isfinite(height_m[outer])
        bordered = region[inner][beside]
        borders += np.bincount(bordered, minlength=count + 1)
        walls += np.bincount(bordered, height_m[outer][beside] > wall_m, minlength=count + 1)
    void = ((borders > 0) & (walls >= VOID_BORDER * borders))[region]
    for _ in range(KERNEL_PIXELS if void.any() else 0):
        rim = ndimage.binary_dilation(void, _AROUND) & ~void
        mixed = np.zeros_like(void)
        for inner, outer in _NEIGHBOURS:
            mixed[inner] |= rim[inner] & ~void[outer] & (height_m[outer] - height_m[inner] > wall_m)
        void |= mixed
    return void


def steep_steps(height_m: np.ndarray, pixel_m: float) -> tuple[float, int]:
    """Return the largest step between neighbouring pixels [m], and how many are implausible.

    Implausible are more than `STEP_M` with a slope steeper than 80 degrees.

    Args:
        height_m: (rows, columns) [m], NaN without data.
        pixel_m: side of a pixel [m].
    """
    steps_m = np.concatenate([np.abs(np.diff(height_m, axis=axis)).ravel() for axis in (0, 1)])
    steps_m = steps_m[np.isfinite(steps_m)]
    steep = steps_m > max(STEP_M, STEP_SLOPE * pixel_m)
    return float(steps_m.max(initial=0.0)), int(np.count_nonzero(steep))
