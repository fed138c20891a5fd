"""The 3D map: line of sight, heights, what lies inside buildings, and maps as they might be.

Rays are cast with Embree [1], which computes in single precision: distances are accurate to about
1 mm in a city of 10 km, and surfaces closer together than `SKIN_M` count as one.

Surveyed maps have walls off by decimetres to metres, and heights by metres where they were counted
from storeys (`buildings.csv` says how well each is known). What such errors do to a prediction is
seen by predicting over several maps with random ones.

[1] Wald et al., "Embree: a kernel framework for efficient CPU ray tracing", ACM TOG 33(4), 2014.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from radiotwin.errors import BadInput, RunFailed
from radiotwin.io.cells import as_numbers, read_cells, refuse
from radiotwin.io.inputs import require_within
from radiotwin.runtime.processes import in_threads
from radiotwin.scene.folder import read_triangles
from radiotwin.scene.materials import Material
from radiotwin.scene.meshes import connected
from radiotwin.scene.vegetation import Vegetation

ON_SURFACE_M = 1e-3  # closer to a surface an antenna is on it [m]
SKIN_M = 0.01  # step past a surface before the next is looked for [m]
GROUND_M = 0.05  # faces this close to z = 0 are the ground [m]
SIGHT_CHUNK = 1 << 16  # lines of sight of one thread at a time
CHUNK = 1_000_000  # rays per call: bounds the memory of any query to about 100 MB
DOWN = np.array([0.0, 0.0, -1.0])
CONCRETE = Material("concrete", itu="concrete")  # of faces whose material is not known
SAME_CORNER_M = 0.01  # corners closer than this are one [m]
EARTH_RADIUS_M = 8.5e6  # 4/3 of the Earth's, for refraction (ITU-R P.526-15, Sec. 1)
FAR_M = 5_000.0  # between ends for which the Earth is round [m]; its bulge is 0.4 m there
BEND_M = 1_000.0  # pieces that are straight of a line of sight over the round Earth
HEIGHT_SD_M = 3.0  # of a roof whose accuracy is unknown: one storey
MIN_HEIGHT_SHARE = 0.2  # of a building's height that is left, whatever the error
_MAX_SD_M, _MAX_AREA_M2 = 1000.0, 1e9


def _embree_scene(triangles: np.ndarray) -> Any:
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise RunFailed(
            "the 3D map needs the package embreex; install it with `pip install embreex` (wheels "
            "exist for Linux, macOS and Windows on x86-64 and for macOS on ARM)") from error
    scene = EmbreeScene()
    TriangleMesh(scene, triangles.astype(np.float32))
    return scene


def _distinct(triangles: np.ndarray) -> np.ndarray:
    """Return the indices of triangles (n, 3, 3) in single precision without their copies.

    Embree looks at all copies of a triangle for every ray that meets one.
    """
    words = np.ascontiguousarray(triangles).reshape(len(triangles), 9).view(np.uint32)
    return np.flatnonzero(~pd.DataFrame(words).duplicated())


class CityMap:
    """Triangles of a city with outward normals, and queries along rays.

    Args:
        vertices: (v, 3) positions [m].
        faces: (f, 3) indices of vertices, counter-clockwise seen from outside.
        materials: Of the city; by default one, a slab of concrete of `Material`'s thickness.
        material: (f,) row of `materials` of each face; None: all are of the first.
        vegetation: Volumes that block no ray; None: there are none.
        terrain: (f,) bool, faces of a ground that is not flat; None: the ground is flat, at z = 0.
        height_sd_m: (f,) standard deviation of the mapped height of the building that each face
            belongs to [m], NaN where unknown; None: unknown for all.
    """

    never_changes = True

    def __init__(self, vertices: np.ndarray, faces: np.ndarray,
                 materials: Sequence[Material] = (CONCRETE,),
                 material: np.ndarray | None = None,
                 vegetation: Vegetation | None = None,
                 terrain: np.ndarray | None = None,
                 height_sd_m: np.ndarray | None = None) -> None:
        self.vertices = np.asarray(vertices, dtype=float)
        self.faces = np.asarray(faces, dtype=int)
        self.materials = tuple(materials)
        self.material = np.zeros(len(self.faces), dtype=int) if material is None \
            else np.asarray(material, dtype=int)
        self.vegetation = Vegetation.of(()) if vegetation is None else vegetation
        self.terrain = None if terrain is None or not np.any(terrain) else \
            np.asarray(terrain, dtype=bool)
        self.height_sd_m = None if height_sd_m is None else np.asarray(height_sd_m, dtype=float)
        triangles = self.vertices[self.faces]
        self._drawn = _distinct(triangles.astype(np.float32))
        self._scene = _embree_scene(triangles[self._drawn])
        self._normals = np.cross(triangles[:, 1] - triangles[:, 0],
                                 triangles[:, 2] - triangles[:, 0])
        self._top_m = float(self.vertices[:, 2].max()) + 1.0

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what the map is made of; Embree's scene is made again."""
        return CityMap, (self.vertices, self.faces, self.materials, self.material, self.vegetation,
                         self.terrain, self.height_sd_m)

    @classmethod
    def from_xml(cls, xml_path: Path | str, vegetation: Vegetation | None = None,
                 terrain: str | None = None,
                 height_sd_m: Mapping[str, float] | None = None) -> CityMap:
        """Read the meshes that a scene folder's `city.xml` names, and what they are made of.

        Args:
            xml_path: The file.
            vegetation: Of the scene.
            terrain: Name of the shape that is the ground; None: the ground is flat.
            height_sd_m: Standard deviation of the height of the building(s) of a shape [m].

        Raises:
            BadInput: No such file, malformed XML, a mesh that cannot be read, one outside the
                folder, or no shape of the ground's name.
        """
        meshes, found, names = zip(*read_triangles(xml_path))
        if terrain is not None and terrain not in names:
            raise BadInput(f"{xml_path} has no shape {terrain!r}, which scene.toml declares as "
                           "the ground ([terrain] shape); correct the name")
        of_shape = [material or CONCRETE for material in found]
        materials = list(dict.fromkeys(of_shape))
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        faces = [len(mesh.faces) for mesh in meshes]
        return cls(
            np.concatenate([mesh.vertices for mesh in meshes]),
            np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts)]),
            materials, np.repeat([materials.index(each) for each in of_shape], faces), vegetation,
            None if terrain is None else np.repeat([name == terrain for name in names], faces),
            None if height_sd_m is None else np.repeat(
                [height_sd_m.get(name, np.nan) for name in names], faces))

    @cached_property
    def ground_material(self) -> Material:
        """Material of the ground: that of most of its faces that look up; else concrete."""
        area_m2 = np.where(self.on_ground & (self._normals[:, 2] > 0), self._normals[:, 2] / 2, 0.0)
        by_material = np.bincount(self.material, weights=area_m2, minlength=len(self.materials))
        return self.materials[int(by_material.argmax())] if by_material.any() else CONCRETE

    @cached_property
    def on_ground(self) -> np.ndarray:
        """(f,) bool: faces of the terrain, or of flat ground, within `GROUND_M` of z = 0."""
        if self.terrain is not None:
            return self.terrain
        return (np.abs(self.vertices[self.faces][:, :, 2]) < GROUND_M).all(axis=1)

    def without(self, faces: np.ndarray) -> CityMap:
        """Return the map without some faces, (f,) bool."""
        terrain, height_sd_m = (None if each is None else each[~faces]
                                for each in (self.terrain, self.height_sd_m))
        return CityMap(self.vertices, self.faces[~faces], self.materials, self.material[~faces],
                       self.vegetation, terrain, height_sd_m)

    def with_vertices(self, vertices: np.ndarray) -> CityMap:
        """Return the map with other positions (v, 3) [m] of its vertices."""
        return CityMap(vertices, self.faces, self.materials, self.material, self.vegetation,
                       self.terrain, self.height_sd_m)

    def state(self) -> tuple[Any, ...]:
        """Return everything that queries of this map and paths over it depend on."""
        known = (self.vertices, self.faces, self.materials, self.material, self.vegetation.state())
        return (*known, self.terrain, self.height_sd_m)

    def line_of_sight(self, a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
        """Return whether no surface lies between points.

        Two points within one solid see each other. Between points more than `FAR_M` apart the line
        is bent by the curvature of the Earth, with mean refraction, and flat ground has no end.

        Args:
            a_m: (n, 3) or broadcastable to it [m].
            b_m: The other ends, likewise.

        Returns:
            (n,) bool
        """
        a_m, b_m = np.broadcast_arrays(np.atleast_2d(a_m), np.atleast_2d(b_m))
        los = np.empty(len(a_m), dtype=bool)

        def cast(start: int) -> None:
            part = slice(start, start + SIGHT_CHUNK)
            origin = np.ascontiguousarray(a_m[part], dtype=np.float32)
            # Not normalised: a length of 1 then ends the ray at b, which is faster
            way = np.ascontiguousarray(b_m[part] - a_m[part], dtype=np.float32)
            los[part] = self._scene.run(origin, way, np.ones(len(way), np.float32),
                                        query="OCCLUDED") == -1
            far.append(start + np.flatnonzero(way[:, 0] ** 2 + way[:, 1] ** 2 > FAR_M**2))

        far: list[np.ndarray] = [np.zeros(0, dtype=int)]
        in_threads(cast, range(0, len(a_m), SIGHT_CHUNK))
        rows = np.concatenate(far)
        if len(rows):
            los[rows] = self._sight_over_earth(a_m[rows], b_m[rows])
        return los

    def hidden_by_ground(self, a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
        """Return whether the terrain blocks the line of sight; arguments as for `line_of_sight`."""
        if self.terrain is None:
            return np.zeros(np.broadcast_shapes(np.shape(a_m), np.shape(b_m))[:-1], dtype=bool)
        return ~self.ground.line_of_sight(a_m, b_m)

    def _sight_over_earth(self, a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
        """Return whether lines of sight (n,) over the round Earth are clear, piece by piece."""
        offset_m = b_m - a_m
        length_m = np.hypot(offset_m[:, 0], offset_m[:, 1])
        share = np.linspace(0, 1, 1 + int(np.ceil(length_m.max() / BEND_M)))[:, None, None]
        bend_m = a_m + share * offset_m
        bend_m[..., 2] -= (share * (1 - share))[..., 0] * length_m**2 / (2 * EARTH_RADIUS_M)
        clear = np.ones(len(a_m), bool) if self.terrain is not None else \
            bend_m[..., 2].min(axis=0) >= np.minimum(a_m[:, 2], b_m[:, 2]).clip(None, 0)
        for start_m, end_m in zip(bend_m, bend_m[1:]):
            left = np.flatnonzero(clear)
            clear[left] = self.line_of_sight(start_m[left], end_m[left])
        return clear

    def height_at(self, x_m: np.ndarray | float, y_m: np.ndarray | float) -> np.ndarray:
        """Return the height of the highest surface above each point of the plane.

        Args:
            x_m: East coordinates, any shape [m].
            y_m: North coordinates, same shape [m].

        Returns:
            Heights of that shape [m]; 0 (the ground datum) where there is nothing.
        """
        x_m, y_m = np.broadcast_arrays(x_m, y_m)
        above = np.column_stack([x_m.ravel(), y_m.ravel(), np.full(x_m.size, self._top_m)])
        distance, face, _ = self.first_hits_towards(above, DOWN)
        height = np.where(face >= 0, self._top_m - distance, 0.0)
        return height.reshape(x_m.shape)

    @cached_property
    def ground(self) -> CityMap:
        """Map of the terrain without buildings; requires a terrain."""
        assert self.terrain is not None
        used, faces = np.unique(self.faces[self.terrain], return_inverse=True)
        faces = faces.reshape(-1, 3)
        return CityMap(self.vertices[used], faces, terrain=np.ones(len(faces), dtype=bool))

    def ground_height_m(self, x_m: np.ndarray | float, y_m: np.ndarray | float) -> np.ndarray:
        """Return the height of the ground above the datum.

        Args:
            x_m: East coordinates, any shape [m].
            y_m: North coordinates, same shape [m].

        Returns:
            Heights of that shape [m]; off the terrain those of its border, of flat ground 0.
        """
        x_m, y_m = np.broadcast_arrays(np.asarray(x_m, float), np.asarray(y_m, float))
        if self.terrain is None:
            return np.zeros(x_m.shape)
        return self._terrain_height_m(x_m.ravel(), y_m.ravel()).reshape(x_m.shape)

    def _terrain_height_m(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Return the heights (n,) of the terrain [m]."""
        ground = self.ground
        low_m, high_m = ground.vertices[:, :2].min(axis=0), ground.vertices[:, :2].max(axis=0)
        points_m = np.column_stack([x_m, y_m])
        height_m = np.full(len(points_m), np.nan)
        # A ray that meets a corner or a side exactly may pass between triangles: a hair beside it
        for aside_m in (0.0, 0.004, 0.03, 0.2):
            left = np.flatnonzero(np.isnan(height_m))
            if not len(left):
                break
            above = np.column_stack([
                np.clip(points_m[left] + aside_m * np.array([0.8, 0.6]), low_m + SKIN_M,
                        high_m - SKIN_M), np.full(len(left), ground._top_m)])
            far_m = ground.first_hits_towards(above, DOWN)[0]
            height_m[left] = np.where(np.isfinite(far_m), ground._top_m - far_m, np.nan)
        left = np.flatnonzero(np.isnan(height_m))  # in a hole of a terrain that was made elsewhere
        if len(left):
            corner = cKDTree(ground.vertices[:, :2]).query(points_m[left])[1]
            height_m[left] = ground.vertices[corner, 2]
        return height_m

    def below_ground(self, points_m: np.ndarray) -> np.ndarray:
        """Return whether points (n, 3) [m] lie below the ground, (n,) bool."""
        return points_m[:, 2] < self.ground_height_m(*points_m[:, :2].T)

    def inside(self, points_m: np.ndarray) -> np.ndarray:
        """Return whether each point lies within a building, or below the ground.

        A ray is sent straight up: the point is inside if the ray leaves more solids than it enters,
        which holds for overlapping solids and for the open-bottomed shells of most city models.

        Args:
            points_m: (n, 3) [m]

        Returns:
            (n,) bool
        """
        return self._depth(np.atleast_2d(np.asarray(points_m, dtype=float))) > 0

    def misplaced(self, points_m: np.ndarray) -> np.ndarray:
        """Return why no antenna can be at points (n, 3) [m], empty where one can, (n,) str.

        It is `below the ground`, `inside a building`, or `on a surface`: within `ON_SURFACE_M` of a
        wall, a roof or the ground, where rays would begin on either side of it.
        """
        points_m = np.atleast_2d(np.asarray(points_m, dtype=float))
        inside = self.inside(points_m)
        on, below = np.zeros_like(inside), np.zeros_like(inside)
        below[inside] = self.below_ground(points_m[inside])
        for step_m in np.concatenate([np.eye(3), -np.eye(3)]) * ON_SURFACE_M:
            on[inside] |= ~self.inside(points_m[inside] + step_m)
        return np.select([on, below, inside],
                         ["on a surface", "below the ground", "inside a building"], default="")

    def metres_inside(self, a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
        """Return the length of each segment that lies within buildings.

        Args:
            a_m: (n, 3) or broadcastable to it [m].
            b_m: The other ends, likewise.

        Returns:
            (n,) lengths [m]
        """
        a_m, b_m = np.broadcast_arrays(np.atleast_2d(a_m).astype(float),
                                       np.atleast_2d(b_m).astype(float))
        length = np.linalg.norm(b_m - a_m, axis=1)
        depth = np.maximum(self._depth(a_m), 0)
        metres = np.zeros(len(a_m))
        last = np.zeros(len(a_m))
        for distance, crossing, ray in self._crossings(a_m, b_m):
            metres[ray] += np.where(depth[ray] > 0, distance - last[ray], 0.0)
            last[ray] = distance
            depth[ray] = np.maximum(depth[ray] + crossing, 0)
        return metres + np.where(depth > 0, length - last, 0.0)

    def _depth(self, points_m: np.ndarray) -> np.ndarray:
        """Return the (n,) number of solids that each point lies in."""
        above = points_m.copy()
        above[:, 2] = np.maximum(self._top_m, points_m[:, 2] + 1.0)
        depth = np.zeros(len(points_m), dtype=int)
        for _, crossing, ray in self._crossings(points_m, above):
            np.subtract.at(depth, ray, crossing)
        return depth

    def _crossings(self, a_m: np.ndarray, b_m: np.ndarray
                   ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield the 1st, 2nd, … crossing of each segment that has one.

        Yields:
            Distances from a [m], +1 for entering or -1 for leaving a solid, indices of segments.
        """
        ray = np.arange(len(a_m))
        length = np.linalg.norm(b_m - a_m, axis=1)
        direction = (b_m - a_m) / np.maximum(length, 1e-12)[:, None]
        travelled = np.zeros(len(a_m))
        while len(ray):
            origin = a_m[ray] + travelled[ray, None] * direction[ray]
            distance, face, cosine = self.first_hits(origin, b_m[ray])
            hit = face >= 0
            ray = ray[hit]
            at = travelled[ray] + distance[hit]
            if len(ray):
                yield at, np.where(cosine[hit] < 0, 1, -1), ray
            travelled[ray] = at + SKIN_M
            ray = ray[travelled[ray] < length[ray]]

    def first_hits(self, a_m: np.ndarray, b_m: np.ndarray
                   ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the first surface on the way from a to b.

        Args:
            a_m: (n, 3) starts [m].
            b_m: (n, 3) ends [m].

        Returns:
            (n,) distance from a [m] (infinite: none), (n,) face (-1: none), and (n,) direction
            times normal, negative where the ray enters a solid.
        """
        a_m, b_m = np.asarray(a_m, dtype=float), np.asarray(b_m, dtype=float)
        offset = b_m - a_m
        length = np.linalg.norm(offset, axis=1)
        return self.first_hits_towards(a_m, offset / np.maximum(length, 1e-12)[:, None], length)

    def first_hits_towards(self, start_m: np.ndarray, direction: np.ndarray,
                           length_m: np.ndarray | float = np.inf
                           ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the first surface in some directions; returns those of `first_hits`.

        Args:
            start_m: (n, 3) [m].
            direction: (n, 3), or one, unit vectors.
            length_m: (n,), or one, how far to look [m].
        """
        n = len(start_m)
        direction = np.broadcast_to(direction, (n, 3))
        length_m = np.broadcast_to(length_m, n)
        distance, face, cosine = np.full(n, np.inf), np.full(n, -1), np.zeros(n)
        for start in range(0, n, CHUNK):
            part = slice(start, start + CHUNK)
            towards = np.ascontiguousarray(direction[part], dtype=np.float32)
            found = self._scene.run(np.ascontiguousarray(start_m[part], dtype=np.float32), towards,
                                    length_m[part].astype(np.float32), query="INTERSECT",
                                    output=True)
            hit = np.flatnonzero(found["primID"] >= 0)
            face[start + hit] = faces = self._drawn[found["primID"][hit]]
            distance[start + hit] = found["tfar"][hit]
            cosine[start + hit] = np.einsum("ij,ij->i", towards[hit], self._normals[faces])
        return distance, face, cosine


def building_of_vertex(city: CityMap) -> np.ndarray:
    """Return the building (v,) that each vertex belongs to; -1: only ground.

    A building is a set of triangles above the ground that are connected by shared corners.
    """
    corners, index = np.unique(np.round(city.vertices / SAME_CORNER_M).astype(np.int64), axis=0,
                               return_inverse=True)
    faces = index.reshape(-1)[city.faces]
    above = ~city.terrain if city.terrain is not None else (
        city.vertices[city.faces][:, :, 2] > GROUND_M).any(axis=1)
    sides = faces[above][:, [[0, 1], [1, 2]]].reshape(-1, 2)
    label = connected(sides, len(corners))
    built = np.zeros(len(corners), dtype=bool)
    built[sides.ravel()] = True
    _, building = np.unique(np.where(built, label, -1), return_inverse=True)
    return (building.reshape(-1) - (~built).any())[index.reshape(-1)]


@lru_cache(maxsize=8)  # a map holds what was found for its paths: tens of MB
def perturbed_map(city: CityMap, wall_sd_m: float, height_sd_m: float, seed: int) -> CityMap:
    """Return a map with the walls and roofs of every building moved by normal errors.

    The walls on opposite sides of a building move independently, so that it is shifted and grows or
    shrinks; its roof keeps its shape. The same seed moves them in the same direction whatever the
    standard deviations of a wall's position, across it, and of a building's height.
    """
    rng = np.random.default_rng(seed)
    building = building_of_vertex(city)
    count = int(building.max()) + 1 if len(building) else 0
    walls_m = wall_sd_m * rng.standard_normal((count, 2, 2))
    heights_m = height_sd_m * rng.standard_normal(count)
    vertices_m = city.vertices.copy()
    order = np.argsort(building, kind="stable")
    ends = np.searchsorted(building[order], np.arange(count + 1))
    for number in range(count):
        rows = order[ends[number]:ends[number + 1]]
        corners_m = vertices_m[rows]
        low_m, size_m = corners_m[:, :2].min(axis=0), np.ptp(corners_m[:, :2], axis=0)
        share = (corners_m[:, :2] - low_m) / np.maximum(size_m, SAME_CORNER_M)
        corners_m[:, :2] += (1 - share) * walls_m[number, 0] + share * walls_m[number, 1]
        base_m = 0.0 if city.terrain is None else corners_m[:, 2].min()
        corners_m[:, 2] -= base_m
        top_m = corners_m[:, 2].max()
        corners_m[:, 2] *= max(1 + heights_m[number] / top_m, MIN_HEIGHT_SHARE)
        corners_m[:, 2] += base_m
        vertices_m[rows] = corners_m
    return city.with_vertices(vertices_m)


def shape_height_sds_m(folder: Path) -> dict[str, float] | None:
    """Return the standard deviation of the height of each shape [m], as `buildings.csv` has it.

    A shape is a block of buildings that touch: it has their mean, by area. None if the folder has
    no such table, or one of an earlier version (without the column `height_sd_m`).

    Raises:
        BadInput: the table cannot be read, lies outside the folder, or has an impossible value.
    """
    path = folder / "buildings.csv"
    if not path.is_file():
        return None
    require_within(folder, path, str(folder))
    table = read_cells(path, optional=("shape", "area_m2", "height_sd_m"))
    if not {"shape", "area_m2", "height_sd_m"} <= set(table.columns):
        return None
    numbers = {name: as_numbers(table[name]) for name in ("area_m2", "height_sd_m")}
    for name, most in (("area_m2", _MAX_AREA_M2), ("height_sd_m", _MAX_SD_M)):
        refuse(path, name, table[name], ~((numbers[name] > 0) & (numbers[name] <= most)),
               f"is impossible; allowed are numbers above 0, up to {most:g}")
    areas_m2 = pd.Series(numbers["area_m2"]).groupby(table["shape"]).sum()
    sums = pd.Series(numbers["area_m2"] * numbers["height_sd_m"]).groupby(table["shape"]).sum()
    return dict((sums / areas_m2).items())
