"""Large cities by tiles: batches of links that lie close together, and the geometry they reach.

A path of length L between two ends at the distance d leaves their straight line by no more than
r = sqrt(L² - d²) / 2, as the shortest way by a point beside the line is that by a point beside its
middle. So a culling radius about the line keeps all paths up to a length; longer ones are left out,
with all buildings that none of the others meets.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.scene import Scene
from radiotwin.scene.folder import CityShape
from radiotwin.scene.materials import Material
from radiotwin.trace.settings import SolverSettings

MANY_SHAPES = 5_000
"""Shapes from which on a city is traced by tiles unless the settings say otherwise."""
RADIUS_M = 400.0
"""Culling radius unless the settings say otherwise; its error is in docs/scale.md."""
OMITTED_DB = 20.0
"""How far below the limit of detection a path is that is left out for its length: 1 % of the power
of the weakest link that is detected."""


@dataclass(frozen=True)
class Tile:
    """Part of a city that the links of a batch reach.

    Attributes:
        hull_m: Corners of the convex hull of the links' ends, from above [m].
        radius_m: What is farther from it is left out [m].
    """

    hull_m: tuple[tuple[float, float], ...]
    radius_m: float


@dataclass(frozen=True, eq=False)
class PackedCity:
    """A city in a few arrays: 50,000 shapes take the memory of their triangles.

    Attributes:
        vertices_m: (v, 3) positions [m].
        faces: (f, 3) indices of vertices, shape by shape.
        first_face: (n + 1,) first face of each of n shapes.
        material: (n,) row of `materials`.
        materials: Of all shapes.
    """

    vertices_m: np.ndarray
    faces: np.ndarray
    first_face: np.ndarray
    material: np.ndarray
    materials: tuple[Material, ...]

    @classmethod
    def of(cls, shapes: Sequence[CityShape]) -> "PackedCity":
        """Pack shapes."""
        starts = np.cumsum([0, *(len(shape.mesh.vertices) for shape in shapes)])
        row = {material: index for index, material in
               enumerate(dict.fromkeys(shape.material for shape in shapes))}
        return cls(np.concatenate([np.asarray(shape.mesh.vertices) for shape in shapes]),
                   np.concatenate([np.asarray(shape.mesh.faces) + start
                                   for shape, start in zip(shapes, starts)]),
                   np.cumsum([0, *(len(shape.mesh.faces) for shape in shapes)]),
                   np.array([row[shape.material] for shape in shapes]), tuple(row))

    def __len__(self) -> int:
        return len(self.material)

    @property
    def nbytes(self) -> int:
        """Size in memory."""
        return self.vertices_m.nbytes + self.faces.nbytes

    @cached_property
    def _boxes(self) -> Any:
        """(n,) rectangles around the shapes, from above."""
        import shapely

        corner_m = self.vertices_m[self.faces][..., :2]
        filled = np.diff(self.first_face) > 0
        bounds_m = np.full((len(self), 4), np.nan)  # of a shape without faces: near nothing
        starts = self.first_face[:-1][filled]
        bounds_m[filled, :2] = np.minimum.reduceat(corner_m.min(axis=1), starts)
        bounds_m[filled, 2:] = np.maximum.reduceat(corner_m.max(axis=1), starts)
        return shapely.box(*bounds_m.T)

    def near(self, tile: Tile) -> np.ndarray:
        """Return (n,) bool: shapes whose bounding rectangle lies within reach of a tile.

        The ground reaches everywhere, so it stays whole.
        """
        import shapely

        hull = shapely.MultiPoint(tile.hull_m).convex_hull
        shapely.prepare(hull)
        return shapely.dwithin(self._boxes, hull, tile.radius_m)

    def part(self, kept: np.ndarray) -> list[CityShape]:
        """Return some shapes, (n,) bool, those of one material as one."""
        import trimesh

        shape = np.repeat(np.arange(len(self)), np.diff(self.first_face))
        part = []
        for row, material in enumerate(self.materials):
            faces = self.faces[(kept & (self.material == row))[shape]]
            if len(faces):
                used, renumbered = np.unique(faces, return_inverse=True)
                mesh = trimesh.Trimesh(self.vertices_m[used], renumbered.reshape(-1, 3),
                                       process=False)
                part.append(CityShape(f"part-{row}", mesh, material))
        return part


def with_radius(scene: Scene, settings: SolverSettings) -> SolverSettings:
    """Return the settings with the culling radius that holds for a scene; a given one stays."""
    if settings.solver != "paths" or settings.radius_m is not None:
        return settings
    folder = scene.folder / "meshes"
    shapes = sum(1 for _ in folder.iterdir()) if folder.is_dir() else 0
    return replace(settings, radius_m=RADIUS_M) if shapes > MANY_SHAPES else settings


def longest_path_m(scene: Scene) -> float:
    """Return the length of a path that free space leaves `OMITTED_DB` below the limit [m].

    Walls and edges only take power away, and antennas are counted with their peaks.
    """
    peaks_dbi = [0.0 if antenna is None else antenna.pattern.peak_dbi
                 for antenna in scene.device_antennas]
    uav_dbi = 0.0 if scene.uav_antenna is None else scene.uav_antenna.pattern.peak_dbi
    budget_db = (OMITTED_DB - scene.config.gain_limit_db + max(peaks_dbi, default=0.0) + uav_dbi)
    wavelength_m = speed_of_light / scene.config.radio.frequency_hz
    return float(wavelength_m / (4 * np.pi) * 10 ** (budget_db / 20))


def tile_of(device_m: np.ndarray, points_m: np.ndarray, radius_m: float, longest_m: float
            ) -> Tile:
    """Return the part of the city that links from a device (3,) to points (n, 3) reach [m].

    Paths longer than `longest_m` need not be found: if all shorter ones stay closer to the straight
    line than `radius_m`, the tile is that much narrower.
    """
    import shapely

    nearest_m = np.linalg.norm(points_m - device_m, axis=1).min()
    aside_m = math.sqrt(max(longest_m**2 - nearest_m**2, 0.0)) / 2
    ends_m = np.vstack([device_m[:2], points_m[:, :2]])
    hull = shapely.MultiPoint(ends_m).convex_hull
    corners_m = tuple((float(x), float(y)) for x, y in shapely.get_coordinates(hull))
    return Tile(corners_m, min(radius_m, aside_m))


def batches_by_place(points_m: np.ndarray, size: int) -> list[np.ndarray]:
    """Split points (n, 3) into batches of points that lie close together: ascending indices.

    The points are halved across their longer side, again and again, as a k-d tree is made. All
    batches but one are full, as a batch costs the same however few points it has.
    """
    def split(index: np.ndarray) -> list[np.ndarray]:
        batches = math.ceil(len(index) / size)
        if batches < 2:
            return [np.sort(index)]
        x_m, y_m, z_m = points_m[index].T
        long_m, short_m = (x_m, y_m) if np.ptp(x_m) >= np.ptp(y_m) else (y_m, x_m)
        index = index[np.lexsort((z_m, short_m, long_m))]
        return [*split(index[:batches // 2 * size]), *split(index[batches // 2 * size:])]

    return split(np.arange(len(points_m))) if len(points_m) else []

