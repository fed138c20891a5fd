"""The ground of a scene from a map: flat, or a terrain that buildings stand on."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import shapely

from radiotwin.errors import BadInput
from radiotwin.footprints.solids import Prism
from radiotwin.footprints.terrain_raster import read_heights
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.problems import Problem, warning
from radiotwin.scene.sources import source_text
from radiotwin.scene.terrain import GroundMesh, HeightGrid, TerrainConfig, triangulate
from radiotwin.tables import Origin

Bounds = tuple[float, float, float, float]
TOLERANCE_M = 0.5  # of the triangles: better than most terrain models are
MAX_FACES = 20_000
SKIRT_M = 1.0  # that walls reach below the lowest ground under them, so that no gap opens
SAMPLE_M = 2.0  # along outlines: on a slope of 45 degrees the ground falls by a skirt in half of it
FLAT_FACT = "flat, at z = 0: a map holds no terrain (--terrain FILE.tif adds one)"


@dataclass(frozen=True, eq=False)
class Ground:
    """The ground of a scene.

    Attributes:
        vertices, faces: of its shape [m].
        fact: on it, for a report.
        config: for `scene.toml`; None: flat.
        problems: on how it was read.
    """

    vertices: np.ndarray
    faces: np.ndarray
    fact: str = FLAT_FACT
    config: TerrainConfig | None = None
    problems: tuple[Problem, ...] = ()


def make_ground(terrain: Path | None, origin: Origin, box_m: Bounds, shape: str) -> Ground:
    """Return the ground of an area.

    Args:
        terrain: GeoTIFF of heights; None: the ground is flat.
        origin: of the local frame; an altitude other than 0 becomes the datum of a terrain.
        box_m: (x_min, x_max, y_min, y_max) [m].
        shape: name of its shape.

    Returns:
        The ground, above its datum.

    Raises:
        BadInput: the raster cannot be used, or the declared altitude is above the lowest ground.
    """
    x0, x1, y0, y1 = box_m
    if terrain is None:
        corners = np.array([[x0, y0, 0], [x1, y0, 0], [x1, y1, 0], [x0, y1, 0]])
        return Ground(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    grid = read_heights(terrain, origin, box_m)
    low_m = round(float(grid.height_m.min()), 3)
    # Of 0 m, an origin declares no altitude
    datum_m = origin.altitude_m or float(np.floor(low_m)) or -1.0
    if datum_m > low_m:
        raise BadInput(f"the altitude of --origin, {datum_m:g} m, is above the lowest ground of "
                       f"the scene, {low_m:.1f} m; give one at or below it, or none")
    mesh = triangulate(grid, TOLERANCE_M, MAX_FACES)
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
    above = {"geoid": "above the geoid", "ellipsoid": "above the ellipsoid",
             "unknown": "reference not declared"}[grid.kind]
    name = f"{grid.reference}, " if grid.kind != "unknown" else ""
    low_m, high_m = grid.height_m.min(), grid.height_m.max()
    return (f"terrain from {low_m:.1f} to {high_m:.1f} m ({name}{above});"
            f" z = 0 is at {datum_m:g} m; {len(mesh.faces):,} triangles within "
            f"{mesh.max_error_m:.2f} m of the heights (RMS {mesh.rms_error_m:.2f} m)")


def stand_on(prisms: Sequence[Prism], ground: Ground) -> list[Prism]:
    """Put buildings on a terrain.

    Heights of OpenStreetMap count from the lowest point where the building meets the ground [1], as
    those of most 3D city models do: so do those of all its parts. A wall from the ground begins
    `SKIRT_M` below that point.

    [1] https://wiki.openstreetmap.org/wiki/Key:height

    Args:
        prisms: with heights above the ground.
        ground: that they are put on; flat ground leaves them as they are.

    Returns:
        The prisms, with heights above the datum.
    """
    if ground.config is None:
        return list(prisms)
    # Parts of a building share its site, of which the ground is looked up once
    sites = {id(site): site for site in (prism.site or prism.area for prism in prisms)}
    lowest_m = dict(zip(sites, lowest_ground_m(list(sites.values()), ground).tolist()))
    stood = []
    for prism in prisms:
        low_m, height = round(lowest_m[id(prism.site or prism.area)], 3), prism.height
        bottom_m = low_m + height.bottom_m if height.bottom_m > 0 else low_m - SKIRT_M
        body = prism.body
        if body is not None and body.mesh is not None:  # a solid one follows its height
            body = replace(body, mesh=(body.mesh[0] + [0.0, 0.0, low_m], body.mesh[1]))
        stood.append(replace(prism, ground_m=low_m, body=body, height=replace(
            height, bottom_m=bottom_m, top_m=low_m + height.top_m)))
    return stood


def lowest_ground_m(areas: Sequence[shapely.Geometry], ground: Ground) -> np.ndarray:
    """Return the (n,) lowest height of the ground under areas [m].

    Args:
        areas: n polygons, in the rectangle of the ground [m].
        ground: with a terrain.
    """
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
