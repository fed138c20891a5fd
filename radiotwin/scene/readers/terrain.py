"""The ground of a scene from a map: flat, or terrain from a GeoTIFF that buildings stand on.

Heights are read at the nodes of a grid in the local frame. GDAL may use only its GeoTIFF driver, so
another file under that name (a VRT, which names other files or servers) is refused, and it looks at
no file beside it. It reads windows in full resolution: for others it would open the overviews that
a file names.

Triangles approximate the heights by greedy refinement [1]: a Delaunay triangulation [2] of few
nodes is extended, round by round, by the node of each triangle that is farthest from it, until all
are within a tolerance, or the number of triangles reaches its maximum.

[1] Garland, Heckbert, "Fast polygonal approximation of terrains and height fields", CMU-CS-95-181,
    1995.
[2] Barber, Dobkin, Huhdanpaa, "The Quickhull algorithm for convex hulls", ACM TOMS 22(4), 1996.
"""

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.spatial import Delaunay

from radiotwin.errors import BadInput, optional_package
from radiotwin.geo import to_geographic, to_local
from radiotwin.io.budgets import TERRAIN_BLOCK_BYTES, TERRAIN_PIXELS
from radiotwin.io.forms import Origin
from radiotwin.io.inputs import check_input
from radiotwin.runtime.console import progress
from radiotwin.scene.checks import Problem, warning
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.config import TerrainConfig, Vertical
from radiotwin.scene.folder import source_text
from radiotwin.scene.readers.heights import FOOT_M, UNITS_M
from radiotwin.scene.readers.plausible import STEP_M, steep_steps, zero_voids
from radiotwin.scene.readers.solids import Prism
from radiotwin.scene.readers.systems import find_system, plane_unit_m

if TYPE_CHECKING:
    from pyproj import CRS

MAX_NODES = 400_000  # of the grid; its spacing is increased accordingly
MIN_SPACING_M = 1.0  # of the grid
MARGIN_PIXELS = 2  # around the grid, for the interpolation at its border
HEIGHTS_M = (-500.0, 9_000.0)  # of land; other values mean "no data"
MIN_KNOWN = 0.5  # least share of the nodes that the raster has a height for
_FEET = dict.fromkeys(("ft", "foot", "feet", "international foot"), FOOT_M) | dict.fromkeys(
    ("us survey foot", "us survey feet", "us_survey_foot", "us_survey_feet", "us-ft", "ftus",
     "foot_us"), 1200 / 3937)
_METRES = ("", "m", "metre", "metres", "meter", "meters")
_GDAL = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_PAM_ENABLED": "NO",
         "GTIFF_REPORT_COMPD_CS": "YES", "GDAL_CACHEMAX": 2**26}
Bounds = tuple[float, float, float, float]
BORDER_NODES = 8  # of the first triangulation, along each side
TOLERANCE_M = 0.5  # of the triangles: most terrain models are less accurate
MAX_FACES = 20_000  # triangles of the ground
SKIRT_M = 1.0  # walls begin this far below the lowest ground under them, so that no gap opens
SAMPLE_M = 2.0  # of the ground along outlines: between samples, a slope of 45 degrees falls 1 m
FLAT_FACT = "flat, at z = 0: a map holds no terrain (--terrain FILE.tif adds one)"


@dataclass(frozen=True, eq=False)
class HeightGrid:
    """Heights of the ground at the nodes of a regular grid in the local frame.

    Attributes:
        x_m: (nx,) east coordinates, ascending [m].
        y_m: (ny,) north coordinates, ascending [m].
        height_m: (ny, nx) heights above the zero of the vertical reference [m].
        filled: share of the nodes without data, which were filled with the nearest height.
        reference: name of the vertical reference.
        kind: kind of the reference.
        notes: warnings about the raster.
    """

    x_m: np.ndarray
    y_m: np.ndarray
    height_m: np.ndarray
    filled: float = 0.0
    reference: str = "not declared"
    kind: Vertical = "unknown"
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class GroundMesh:
    """Triangles of the ground, all facing up.

    Attributes:
        vertices: (v, 3) [m].
        faces: (f, 3) indices of vertices, counter-clockwise seen from above.
        max_error_m: largest vertical distance of a grid node from the triangles [m].
        rms_error_m: root mean square of these distances [m].
    """

    vertices: np.ndarray
    faces: np.ndarray
    max_error_m: float
    rms_error_m: float


def approximate(grid: HeightGrid, tolerance_m: float, max_faces: int) -> GroundMesh:
    """Approximate the heights of a grid by few triangles.

    Args:
        grid: heights; at least 2 x 2 nodes.
        tolerance_m: vertical distance of a node from the triangles [m] that is aimed at.
        max_faces: maximum number of triangles, even if nodes are then farther away; the first
            triangulation, of the border, may have more.

    Returns:
        Triangles whose corners are nodes of the grid, and their largest and RMS vertical distance
        from the nodes. They cover the grid's rectangle without gaps.
    """
    height_m = np.asarray(grid.height_m, dtype=float)
    rows, columns = np.indices(height_m.shape)
    # In whole numbers: nodes in a line stay exactly in a line, so the rectangle has no notches
    node = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    z_m, chosen = height_m.ravel(), _border(height_m.shape)
    while True:
        mesh = Delaunay(node[chosen])
        triangle, error_m = _errors(mesh, node, z_m, chosen)
        room = (max_faces - len(mesh.simplices)) // 2  # a node in a triangle makes two more
        worst = _worst_nodes(triangle, error_m, tolerance_m)[:max(room, 0)]
        if not len(worst):
            break
        chosen = np.union1d(chosen, worst)
    corners = np.column_stack([grid.x_m[columns.ravel()[chosen]], grid.y_m[rows.ravel()[chosen]],
                               z_m[chosen]])
    return GroundMesh(corners, _upward(node[chosen], mesh.simplices), float(error_m.max()),
                      float(np.sqrt(np.mean(error_m**2))))


def _border(shape: tuple[int, ...]) -> np.ndarray:
    """Return the flat indices (n,) of up to `BORDER_NODES` nodes along each side of a grid."""
    across, up = (np.unique(np.linspace(0, size - 1, min(size, BORDER_NODES)).round().astype(int))
                  for size in (shape[1], shape[0]))
    return np.unique(np.concatenate([across, (shape[0] - 1) * shape[1] + across,
                                     up * shape[1], up * shape[1] + shape[1] - 1]))


def _upward(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Orient triangles (f, 3) of points (n, 2) counter-clockwise, and drop those without area."""
    a, b, c = points[faces].swapaxes(0, 1)
    double_area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    faces = np.where((double_area < 0)[:, None], faces[:, ::-1], faces)
    return faces[np.abs(double_area) > 0.5].astype(np.int64)  # an integer: 0, or at least 1


def _errors(mesh: Delaunay, node: np.ndarray, z_m: np.ndarray,
            chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangle that each node (n,) lies in, and its vertical distance from that [m]."""
    triangle = mesh.find_simplex(node)
    affine = mesh.transform[triangle]
    weight = np.einsum("nij,nj->ni", affine[:, :2], node - affine[:, 2])
    weight = np.column_stack([weight, 1 - weight.sum(axis=1)])
    surface_m = np.einsum("ni,ni->n", weight, z_m[chosen][mesh.simplices[triangle]])
    error_m = np.nan_to_num(np.abs(surface_m - z_m))  # NaN: in a triangle without area, at a border
    error_m[chosen] = 0.0
    return triangle, error_m


def _worst_nodes(triangle: np.ndarray, error_m: np.ndarray, tolerance_m: float) -> np.ndarray:
    """Return the index of the farthest node of each triangle, beyond the tolerance, worst first."""
    order = np.argsort(-error_m, kind="stable")
    order = order[error_m[order] > tolerance_m]
    _, first = np.unique(triangle[order], return_index=True)
    return order[np.sort(first)]


def read_heights(path: Path, origin: Origin, box_m: Bounds, unit: str | None = None) -> HeightGrid:
    """Read the terrain heights of an area from a GeoTIFF, averaged or interpolated to a grid.

    Nodes without data, or beyond `HEIGHTS_M`, get the height of the nearest pixel with data.

    Args:
        path: GeoTIFF.
        origin: origin of the local frame.
        box_m: (x_min, x_max, y_min, y_max) of the area [m].
        unit: unit of a file that names none, `m` or `ft`; None: metres, unless its plan is in feet.

    Raises:
        BadInput: rasterio is not installed; not a GeoTIFF; a file without a coordinate reference
            system, with several bands, of impossible numbers, or too large; or it does not cover
            the area.
    """
    from pyproj import Transformer

    with _opened(path) as file:
        system = _system(path, file)
        factor, reference, kind = _vertical(path, file, system, unit)
        x_m, y_m, every, pixel_m = _nodes(file, system, origin, box_m)
        to_system = Transformer.from_crs("EPSG:4326", system.to_2d(), always_xy=True)
        x, y = map(np.asarray, to_system.transform(
            *to_geographic(origin, *np.meshgrid(x_m, y_m))))
        inverse = ~file.transform
        column = inverse.a * x + inverse.b * y + inverse.c
        row = inverse.d * x + inverse.e * y + inverse.f
        height, first, voids = _window(path, file, column, row, every, pixel_m / factor)
    height = height * factor
    wrong = (height < HEIGHTS_M[0]) | (height > HEIGHTS_M[1])
    height[wrong] = np.nan
    step_m, steps = steep_steps(height, every * pixel_m)
    known = np.isfinite(height)
    position = [(row - first[0]) / every - 0.5, (column - first[1]) / every - 0.5]
    nearest = [np.clip(np.round(axis), 0, size - 1).astype(int)
               for axis, size in zip(position, height.shape)]
    covered = (known[tuple(nearest)] & (np.abs(position[0] - nearest[0]) <= 0.51)
               & (np.abs(position[1] - nearest[1]) <= 0.51))
    if not covered.mean() >= MIN_KNOWN:
        x_min, x_max, y_min, y_max = box_m
        west, south = (float(value) for value in to_geographic(origin, x_min, y_min))
        east, north = (float(value) for value in to_geographic(origin, x_max, y_max))
        raise BadInput(f"{path} has heights for {covered.mean():.0%} of the scene, "
                       f"{MIN_KNOWN:.0%} are needed; give a raster that covers {south:.5f},"
                       f"{west:.5f},{north:.5f},{east:.5f} (south,west,north,east), or choose a "
                       "part with --bbox")
    if not known.all():
        height = height[tuple(distance_transform_edt(~known, return_distances=False,
                                                     return_indices=True))]
    heights_m = map_coordinates(height, position, order=1, mode="nearest")
    notes = []
    if wrong.any():
        notes.append(f"{np.count_nonzero(wrong):,} pixel(s) are no heights on land "
                     f"({HEIGHTS_M[0]:g} to {HEIGHTS_M[1]:g} m): taken for no data")
    if voids:
        notes.append(f"{voids:,} pixel(s) are 0 amid heights that are not, or mixed with such: "
                     "taken for no data. Where 0 is a height, declare another value as no data "
                     "(`gdal_edit.py -a_nodata -9999`)")
    if steps:
        notes.append(f"the ground falls by up to {step_m:.0f} m between neighbouring pixels "
                     f"{every * pixel_m:.3g} m apart ({steps:,} times more than {STEP_M:g} m and "
                     "80 degrees): are these voids, or is it a surface model with towers? Declare "
                     "what is no data with `gdal_edit.py -a_nodata VALUE`")
    if factor != 1.0:
        notes.append(f"heights in feet were converted to metres ({factor:.7g})")
    return HeightGrid(x_m, y_m, heights_m, float(1 - covered.mean()), reference, kind, tuple(notes))


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a GeoTIFF for reading in a context; BadInput if `_check` refuses it."""
    check_input(path, "terrain raster (GeoTIFF)")
    rasterio = optional_package(
        "rasterio", f"{path}: terrain is read with the package rasterio, which is not installed; "
                    "install it with `pip install 'radiotwin[gis]'`")
    from pyproj.exceptions import ProjError
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    try:
        with rasterio.Env(**_GDAL), warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(str(path.resolve()), driver="GTiff", sharing=False,
                               GEOREF_SOURCES="INTERNAL") as file:
                _check(path, file)
                yield file
    except (RasterioError, ProjError, UnicodeDecodeError) as error:  # of names in the file
        reason = " ".join(str(error).split())
        raise BadInput(f"{path} cannot be read as a GeoTIFF ({reason}); give a .tif of terrain "
                       "heights, or convert it with `gdal_translate -of GTiff`") from None


def _check(path: Path, file: Any) -> None:
    """Raise BadInput if a GeoTIFF has several bands, no numbers, large blocks, or overviews."""
    if file.count != 1:
        raise BadInput(f"{path} has {file.count} bands, as a picture has; give a GeoTIFF with one "
                       "band of heights (`gdal_translate -b 1` takes out the first)")
    if not re.fullmatch("u?int[0-9]+|float[0-9]+", file.dtypes[0]):  # numpy lacks some of GDAL's
        raise BadInput(f"{path} has pixels of type {file.dtypes[0]}, which are no heights; give a "
                       "GeoTIFF of integers or real numbers")
    block = file.block_shapes[0]
    TERRAIN_BLOCK_BYTES.check(float(block[0]) * block[1] * np.dtype(file.dtypes[0]).itemsize,
                              f"{path}, a block of {block[1]:,} x {block[0]:,} pixels")
    if file.tags(ns="OVERVIEWS"):
        raise BadInput(f"{path} names another file as its overview; make a copy without, with "
                       "`gdal_translate -of GTiff`")


def _system(path: Path, file: Any) -> "CRS":
    """Return the coordinate reference system of a raster; BadInput if it is not georeferenced."""
    if file.crs is None or file.transform.is_identity:
        raise BadInput(f"{path} does not say where on the earth it lies (no coordinate reference "
                       "system, or no position); export it as a GeoTIFF with both")
    if not abs(file.transform.determinant) > 0:
        raise BadInput(f"{path} has pixels without an area; export it again")
    return find_system(path, file.crs.to_wkt(version="WKT2_2019"))


def _vertical(path: Path, file: Any, system: "CRS",
              declared: str | None) -> tuple[float, str, Vertical]:
    """Return the factor of heights to metres, and the name and kind of their vertical reference."""
    vertical = next((part for part in system.sub_crs_list if part.is_vertical), None)
    axis = vertical.axis_info[0] if vertical is not None else (
        system.axis_info[2] if len(system.axis_info) == 3 else None)
    unit = (file.units[0] or "").strip().lower()
    plan_m = plane_unit_m(system)
    if not unit and axis is None:  # no unit: some programs take the plan's, some metres
        if declared is None and plan_m != 1.0:
            raise BadInput(f"{path} names no unit of its heights, and its plan is in feet or "
                           f"another unit ({plan_m:.7g} m); say --terrain-unit ft or "
                           "--terrain-unit m")
        is_foot = abs(plan_m - FOOT_M) < 1e-3  # US survey or international foot
        factor = plan_m if declared == "ft" and is_foot else UNITS_M[declared or "m"]
    elif declared is not None:
        raise BadInput(f"{path} names the unit of its heights itself; leave --terrain-unit out, or "
                       "correct the file's unit if it is wrong")
    elif unit in _METRES:
        factor = axis.unit_conversion_factor if axis is not None and not unit else 1.0
    elif unit in _FEET:
        factor = _FEET[unit]
    else:
        raise BadInput(f"{path} has heights in {unit[:40]!r}; allowed are metres and feet: convert "
                       "them (`gdal_calc.py`), or correct the unit (`gdal_edit.py -units m`)")
    if vertical is not None:
        kind: Vertical = "ellipsoid" if "ellipsoid" in vertical.name.lower() else "geoid"
        return factor, vertical.name, kind
    if axis is not None:
        return factor, f"ellipsoid of {system.name}", "ellipsoid"
    return factor, "not declared", "unknown"


def _nodes(file: Any, system: "CRS", origin: Origin,
           box_m: Bounds) -> tuple[np.ndarray, np.ndarray, int, float]:
    """Choose the nodes of the grid over a box: as dense as pixels, at most `MAX_NODES`.

    Returned are their x (nx,) and y (ny,) [m], the pixels per node, and the side of a pixel [m].
    """
    from pyproj import Transformer

    x_min, x_max, y_min, y_max = box_m
    middle = (x_min + x_max) / 2, (y_min + y_max) / 2
    to_degrees = Transformer.from_crs(system.to_2d(), "EPSG:4326", always_xy=True)
    to_system = Transformer.from_crs("EPSG:4326", system.to_2d(), always_xy=True)
    centre = np.array(to_system.transform(*to_geographic(origin, *middle)))
    affine = file.transform
    corners = np.array([[0, 0], [affine.a, affine.d], [affine.b, affine.e]]) + centre  # of a pixel
    x_m, y_m = to_local(origin, *to_degrees.transform(*corners.T))
    pixel_m2 = abs((x_m[1] - x_m[0]) * (y_m[2] - y_m[0]) - (x_m[2] - x_m[0]) * (y_m[1] - y_m[0]))
    pixel_m = float(np.sqrt(pixel_m2)) if np.isfinite(pixel_m2) else 0.0
    if not pixel_m > 0:
        raise BadInput("the terrain raster's system is not defined around the scene; give one that "
                       "covers it")
    spacing_m = max(pixel_m, MIN_SPACING_M, np.sqrt((x_max - x_min) * (y_max - y_min) / MAX_NODES))
    lines = [np.linspace(low, high, max(int(np.ceil((high - low) / spacing_m)), 1) + 1)
             for low, high in ((x_min, x_max), (y_min, y_max))]
    return lines[0], lines[1], max(int(spacing_m / pixel_m), 1), pixel_m


def _window(path: Path, file: Any, column: np.ndarray, row: np.ndarray, every: int,
            pixel: float) -> tuple[np.ndarray, tuple[int, int], int]:
    """Read the part of a raster around some pixels, averaged over squares of `every` pixels a side.

    `pixel` is the side of a pixel, in the unit of heights. Returned are mean heights (NaN without
    data), row and column of the first pixel, and the number of zeros that were taken for no data.
    """
    finite = np.isfinite(column) & np.isfinite(row)
    bounds = []
    for values, size in ((row, file.height), (column, file.width)):
        low = np.floor(np.min(values[finite], initial=np.inf)) - MARGIN_PIXELS * every
        high = np.ceil(np.max(values[finite], initial=-np.inf)) + MARGIN_PIXELS * every
        low, high = max(low, 0), min(high, size)
        if not low < high:
            return np.full((1, 1), np.nan), (0, 0), 0
        bounds.append((int(low), int(high)))
    (top, bottom), (left, right) = bounds
    TERRAIN_PIXELS.check(float(bottom - top) * (right - left), path)
    rows, columns = -(-(bottom - top) // every), -(-(right - left) // every)
    out = np.empty((rows, columns))
    at_once = max(1, 8_000_000 // (every * (right - left)))
    scale, offset, voids = file.scales[0], file.offsets[0], 0
    with progress("reading terrain", total=rows) as advance:
        for first in range(0, rows, at_once):
            count = min(at_once, rows - first)
            start, end = top + first * every, min(top + (first + count) * every, bottom)
            part = file.read(1, window=((start, end), (left, right)), masked=True)
            values = np.full((count * every, columns * every), np.nan)
            with np.errstate(invalid="ignore"):  # signalling NaN
                values[:end - start, :right - left] = np.ma.filled(part.astype(float), np.nan)
            if file.nodata is None:
                void = zero_voids(values, pixel / scale)
                values[void] = np.nan
                voids += int(np.count_nonzero(void))
            out[first:first + count] = _means(values, every)
            advance(count)
    return out * scale + offset, (top, left), voids


def _means(values: np.ndarray, every: int) -> np.ndarray:
    """Return the mean of the finite values in each square of `every` x `every` pixels, or NaN."""
    squares = values.reshape(values.shape[0] // every, every, values.shape[1] // every, every)
    known = np.isfinite(squares)
    count = known.sum(axis=(1, 3))
    total = np.where(known, squares, 0.0).sum(axis=(1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


@dataclass(frozen=True, eq=False)
class Ground:
    """The ground of a scene.

    Attributes:
        vertices, faces: (v, 3) [m] and (f, 3) of its shape.
        fact: description for the report.
        config: entry of `scene.toml`; None: flat.
        problems: problems of the raster.
    """

    vertices: np.ndarray
    faces: np.ndarray
    fact: str = FLAT_FACT
    config: TerrainConfig | None = None
    problems: tuple[Problem, ...] = ()


def make_ground(terrain: Path | None, origin: Origin, box_m: Bounds, shape: str,
                unit: str | None = None) -> Ground:
    """Make the ground of an area, with heights above the scene's datum.

    Args:
        terrain: GeoTIFF of heights; None: flat ground.
        origin: origin of the local frame; an altitude other than 0 becomes the datum of a terrain.
        box_m: (x_min, x_max, y_min, y_max) of the area [m].
        shape: name of the ground's shape.
        unit: unit of heights in a file that names none, `m` or `ft`.

    Raises:
        BadInput: the raster cannot be used, or the declared altitude is above the lowest ground.
    """
    x0, x1, y0, y1 = box_m
    if terrain is None:
        corners = np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]])
        return Ground(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    grid = read_heights(terrain, origin, box_m, unit)
    low_m = round(float(grid.height_m.min()), 3)
    # An altitude of 0 m counts as not declared
    datum_m = origin.altitude_m or float(np.floor(low_m)) or -1.0
    if datum_m > low_m:
        raise BadInput(f"the altitude of --origin, {datum_m:g} m, is above the lowest ground of "
                       f"the scene, {low_m:.1f} m; give one at or below it, or none")
    mesh = approximate(grid, TOLERANCE_M, MAX_FACES)
    config = TerrainConfig(shape=shape, source=source_text(str(terrain))[:300], datum_m=datum_m,
                           reference=grid.reference[:200], kind=grid.kind)
    problems = [warning(f"{terrain}: {note}") for note in grid.notes]
    if grid.filled > 0:
        problems.append(warning(f"{terrain} has no height for {grid.filled:.1%} of the ground: the "
                                "nearest one was taken"))
    if mesh.max_error_m > TOLERANCE_M:
        problems.append(warning(
            f"the terrain was cut to {len(mesh.faces):,} triangles, which are up to "
            f"{mesh.max_error_m:.1f} m off its heights; take a smaller --bbox for finer ones"))
    if grid.kind == "unknown":
        problems.append(warning(
            f"{terrain} does not declare a vertical reference: whether its heights count from the "
            "geoid (mean sea level) or from the ellipsoid, tens of metres apart, is not known. It "
            "matters only where other data with altitudes join the scene"))
    return Ground(mesh.vertices - [0, 0, datum_m], mesh.faces, _fact(grid, mesh, datum_m), config,
                  tuple(problems))


def _fact(grid: HeightGrid, mesh: GroundMesh, datum_m: float) -> str:
    """Describe a terrain for the report: range, vertical reference, datum, triangles, error."""
    above = {"geoid": "above the geoid", "ellipsoid": "above the ellipsoid",
             "unknown": "reference not declared"}[grid.kind]
    name = f"{grid.reference}, " if grid.kind != "unknown" else ""
    low_m, high_m = grid.height_m.min(), grid.height_m.max()
    return (f"terrain from {low_m:.1f} to {high_m:.1f} m ({name}{above});"
            f" z = 0 is at {datum_m:g} m; {len(mesh.faces):,} triangles within "
            f"{mesh.max_error_m:.2f} m of the heights (RMS {mesh.rms_error_m:.2f} m)")


def raise_to_terrain(prisms: Sequence[Prism], ground: Ground) -> list[Prism]:
    """Return the buildings moved up to a terrain.

    Heights of OpenStreetMap, and of most 3D city models, count from the lowest point where the
    building meets the ground [1], those of its parts, too. Walls that begin at the ground are
    extended `SKIRT_M` below that point.

    [1] https://wiki.openstreetmap.org/wiki/Key:height
    """
    # Parts of a building share its footprint: the ground is looked up once for all
    footprints = {id(footprint): footprint for footprint in (
        prism.building_footprint or prism.area for prism in prisms)}
    lowest_m = dict(zip(footprints, _lowest_ground_m(list(footprints.values()), ground).tolist()))
    raised = []
    for prism in prisms:
        low_m, height = round(lowest_m[id(prism.building_footprint or prism.area)], 3), prism.height
        bottom_m = low_m + height.bottom_m if height.bottom_m > 0 else low_m - SKIRT_M
        surfaces = prism.model_surfaces
        # Closed ones are moved by their height later.
        if isinstance(surfaces, tuple):
            surfaces = surfaces[0] + [0.0, 0.0, low_m], surfaces[1]
        raised.append(replace(prism, ground_m=low_m, model_surfaces=surfaces, height=replace(
            height, bottom_m=bottom_m, top_m=low_m + height.top_m)))
    return raised


def _lowest_ground_m(areas: Sequence[shapely.Geometry], ground: Ground) -> np.ndarray:
    """Return the lowest height (n,) of a terrain under polygons [m]."""
    surface = CityMap(ground.vertices, ground.faces,
                      terrain=np.ones(len(ground.faces), dtype=bool))
    outlines = shapely.segmentize(shapely.boundary(np.asarray(areas, dtype=object)), SAMPLE_M)
    points_m, owner = shapely.get_coordinates(outlines, return_index=True)
    lowest_m = np.full(len(areas), np.inf)
    np.minimum.at(lowest_m, owner, surface.ground_height_m(*points_m.T))
    tree = shapely.STRtree(np.asarray(shapely.points(ground.vertices[:, :2])))
    area, corner = tree.query(np.asarray(areas, dtype=object), predicate="contains")
    np.minimum.at(lowest_m, area, ground.vertices[corner, 2])
    return lowest_m
