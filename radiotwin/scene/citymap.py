"""The 3D map: line of sight, heights, points inside buildings, and maps with random errors.

Rays are cast with Embree [1], which computes in single precision: distances are accurate to about
1 mm in a city of 10 km, and surfaces closer together than `SKIN_M` count as one.

Walls of surveyed maps are off by decimetres to metres, and heights that were counted from storeys
by metres (`buildings.csv` has the standard deviation of each). Predictions over several maps with
random errors (`perturbed_map`) show how such errors matter.

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

ON_SURFACE_M = 1e-3  # an antenna closer to a surface is on it [m]
SKIN_M = 0.01  # a ray starts again this far behind a surface that it crossed [m]
GROUND_M = 0.05  # flat ground: faces within this distance of z = 0 [m]
SIGHT_CHUNK = 1 << 16  # lines of sight of one thread at a time
CHUNK = 1_000_000  # rays per call: bounds the memory of any query to about 100 MB
DOWN = np.array([0.0, 0.0, -1.0])
CONCRETE = Material("concrete", itu="concrete")  # of faces whose material is not known
SAME_CORNER_M = 0.01  # corners closer than this are one [m]
EARTH_RADIUS_M = 8.5e6  # effective radius, 4/3 of the true one (ITU-R P.526-15, Sec. 1)
FAR_M = 5_000.0  # longer links are bent by the Earth's curvature [m]; its bulge is 0.4 m there
BEND_M = 1_000.0  # length of the straight pieces of a bent line of sight [m]
HEIGHT_SD_M = 3.0  # of a roof whose accuracy is unknown: one storey
MIN_HEIGHT_SHARE = 0.2  # a perturbed building keeps at least this share of its height
_MAX_SD_M, _MAX_AREA_M2 = 1000.0, 1e9  # allowed in buildings.csv


def _embree_scene(triangles: np.ndarray) -> Any:
    """Return Embree's scene of triangles (n, 3, 3) [m]."""
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
    """Return indices of distinct triangles (n, 3, 3), float32: Embree tests every duplicate."""
    words = np.ascontiguousarray(triangles).reshape(len(triangles), 9).view(np.uint32)
    return np.flatnonzero(~pd.DataFrame(words).duplicated())


class CityMap:
    """Triangles of a city with outward normals, and queries along rays.

    Args:
        vertices: (v, 3) positions [m].
        faces: (f, 3) indices of vertices, counter-clockwise seen from outside.
        materials: Materials of the city; default: concrete.
        material: (f,) index of each face's material; None: all have the first.
        vegetation: Volumes of vegetation, which block no ray; None: none.
        terrain: (f,) bool, faces of ground that is not flat; None: flat ground at z = 0.
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
        """Pickle the constructor's arguments: Embree's scene cannot be pickled, and is rebuilt."""
        return CityMap, (self.vertices, self.faces, self.materials, self.material, self.vegetation,
                         self.terrain, self.height_sd_m)

    @classmethod
    def from_xml(cls, xml_path: Path | str, vegetation: Vegetation | None = None,
                 terrain: str | None = None,
                 height_sd_m: Mapping[str, float] | None = None) -> CityMap:
        """Read the meshes of a scene folder's `city.xml`, and their materials.

        Args:
            xml_path: Path of `city.xml`.
            vegetation: Volumes of vegetation; None: none.
            terrain: Name of the shape that is the ground; None: flat ground.
            height_sd_m: Name of a shape -> standard deviation of its height [m]; None: unknown.

        Raises:
            BadInput: No such file, malformed XML, a mesh that cannot be read, one outside the
                folder, or no shape of the ground's name.
        """
        meshes, declared, names = zip(*read_triangles(xml_path))
        if terrain is not None and terrain not in names:
            raise BadInput(f"{xml_path} has no shape {terrain!r}, which scene.toml declares as "
                           "the ground ([terrain] shape); correct the name")
        shape_materials = [material or CONCRETE for material in declared]
        materials = list(dict.fromkeys(shape_materials))
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        faces = [len(mesh.faces) for mesh in meshes]
        return cls(
            np.concatenate([mesh.vertices for mesh in meshes]),
            np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts)]),
            materials, np.repeat([materials.index(one) for one in shape_materials], faces),
            vegetation,
            None if terrain is None else np.repeat([name == terrain for name in names], faces),
            None if height_sd_m is None else np.repeat(
                [height_sd_m.get(name, np.nan) for name in names], faces))

    @cached_property
    def ground_material(self) -> Material:
        """Material of most of the ground's upward area; concrete if there is no ground."""
        area_m2 = np.where(self.on_ground & (self._normals[:, 2] > 0), self._normals[:, 2] / 2, 0.0)
        by_material = np.bincount(self.material, weights=area_m2, minlength=len(self.materials))
        return self.materials[int(by_material.argmax())] if by_material.any() else CONCRETE

    @cached_property
    def on_ground(self) -> np.ndarray:
        """(f,) bool: faces of the terrain; without one, faces within `GROUND_M` of z = 0."""
        if self.terrain is not None:
            return self.terrain
        return (np.abs(self.vertices[self.faces][:, :, 2]) < GROUND_M).all(axis=1)

    def without(self, faces: np.ndarray) -> CityMap:
        """Return a map without the faces that are True in `faces`, (f,) bool."""
        terrain, height_sd_m = (None if values is None else values[~faces]
                                for values in (self.terrain, self.height_sd_m))
        return CityMap(self.vertices, self.faces[~faces], self.materials, self.material[~faces],
                       self.vegetation, terrain, height_sd_m)

    def with_vertices(self, vertices: np.ndarray) -> CityMap:
        """Return a map whose vertices are moved to (v, 3) [m]."""
        return CityMap(vertices, self.faces, self.materials, self.material, self.vegetation,
                       self.terrain, self.height_sd_m)

    def state(self) -> tuple[Any, ...]:
        """Return everything that queries of this map, and paths over it, depend on, for a hash."""
        return (self.vertices, self.faces, self.materials, self.material, self.vegetation.state(),
                self.terrain, self.height_sd_m)

    def line_of_sight(self, a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
        """Return whether links have line of sight: no surface between their ends.

        Two points within one solid see each other. Lines longer than `FAR_M` are bent by the
        curvature of the Earth, with mean refraction, and flat ground extends without end.

        Args:
            a_m: (n, 3) one end of each link, or broadcastable to it [m].
            b_m: (n, 3) other end, likewise [m].

        Returns:
            (n,) bool
        """
        a_m, b_m = np.broadcast_arrays(np.atleast_2d(a_m), np.atleast_2d(b_m))
        los = np.empty(len(a_m), dtype=bool)

        def cast(start: int) -> None:
            part = slice(start, start + SIGHT_CHUNK)
            origin = np.ascontiguousarray(a_m[part], dtype=np.float32)
            # Not normalised: a length of 1 then ends the ray at b, which is faster
            ray = np.ascontiguousarray(b_m[part] - a_m[part], dtype=np.float32)
            los[part] = self._scene.run(origin, ray, np.ones(len(ray), np.float32),
                                        query="OCCLUDED") == -1
            far.append(start + np.flatnonzero(ray[:, 0] ** 2 + ray[:, 1] ** 2 > FAR_M**2))

        far: list[np.ndarray] = [np.zeros(0, dtype=int)]
        in_threads(cast, range(0, len(a_m), SIGHT_CHUNK))
        rows = np.concatenate(far)
        if len(rows):
            los[rows] = self._sight_over_earth(a_m[rows], b_m[rows])
        return los

    def hidden_by_ground(self, a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
        """Return whether terrain, if any, blocks the sight; arguments as for `line_of_sight`."""
        if self.terrain is None:
            return np.zeros(np.broadcast_shapes(np.shape(a_m), np.shape(b_m))[:-1], dtype=bool)
        return ~self.ground.line_of_sight(a_m, b_m)

    def _sight_over_earth(self, a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
        """Return whether long links have line of sight over the round Earth, (n,) bool.

        Instead of the ground, the line between a and b is bent, by the effective Earth radius, and
        tested piece by piece; over flat ground also against the horizon.
        """
        offset_m = b_m - a_m
        length_m = np.hypot(offset_m[:, 0], offset_m[:, 1])
        share = np.linspace(0, 1, 1 + int(np.ceil(length_m.max() / BEND_M)))[:, None, None]
        bend_m = a_m + share * offset_m
        bend_m[..., 2] -= (share * (1 - share))[..., 0] * length_m**2 / (2 * EARTH_RADIUS_M)
        clear = np.ones(len(a_m), bool) if self.terrain is not None else \
            bend_m[..., 2].min(axis=0) >= np.minimum(a_m[:, 2], b_m[:, 2]).clip(None, 0)
        for start_m, end_m in zip(bend_m, bend_m[1:]):
            rows = np.flatnonzero(clear)
            clear[rows] = self.line_of_sight(start_m[rows], end_m[rows])
        return clear

    def height_at(self, x_m: np.ndarray | float, y_m: np.ndarray | float) -> np.ndarray:
        """Return the height of the highest surface at each point of the plane.

        Args:
            x_m: East coordinates, any shape [m].
            y_m: North coordinates, same shape [m].

        Returns:
            Heights of that shape above the datum [m]; 0 where there is no surface.
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
        """Return the height of the ground above the datum at each point of the plane.

        Args:
            x_m: East coordinates, any shape [m].
            y_m: North coordinates, same shape [m].

        Returns:
            Heights of that shape [m]; beyond the terrain, the height of its border; 0 if flat.
        """
        x_m, y_m = np.broadcast_arrays(np.asarray(x_m, float), np.asarray(y_m, float))
        if self.terrain is None:
            return np.zeros(x_m.shape)
        return self._terrain_height_m(x_m.ravel(), y_m.ravel()).reshape(x_m.shape)

    def _terrain_height_m(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Return the terrain's heights (n,) at x and y (n,) [m], by rays; in holes, the nearest."""
        ground = self.ground
        low_m, high_m = ground.vertices[:, :2].min(axis=0), ground.vertices[:, :2].max(axis=0)
        points_m = np.column_stack([x_m, y_m])
        height_m = np.full(len(points_m), np.nan)
        # A ray that meets a corner or an edge exactly may pass between triangles: then it is cast
        # again a little beside
        for aside_m in (0.0, 0.004, 0.03, 0.2):
            missing = np.flatnonzero(np.isnan(height_m))
            if not len(missing):
                break
            above = np.column_stack([
                np.clip(points_m[missing] + aside_m * np.array([0.8, 0.6]), low_m + SKIN_M,
                        high_m - SKIN_M), np.full(len(missing), ground._top_m)])
            far_m = ground.first_hits_towards(above, DOWN)[0]
            height_m[missing] = np.where(np.isfinite(far_m), ground._top_m - far_m, np.nan)
        missing = np.flatnonzero(np.isnan(height_m))  # in a hole: terrain of another program
        if len(missing):
            corner = cKDTree(ground.vertices[:, :2]).query(points_m[missing])[1]
            height_m[missing] = ground.vertices[corner, 2]
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
        """Return the reason (n,) why no antenna can be at points (n, 3) [m]; "" where one can.

        Reasons are `below the ground`, `inside a building`, and `on a surface`: within
        `ON_SURFACE_M` of a wall, a roof or the ground, where rays could start on either side.
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
        """Return the length that straight links run inside buildings.

        Args:
            a_m: (n, 3) one end of each link, or broadcastable to it [m].
            b_m: (n, 3) other end, likewise [m].

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
        """Return the number (n,) of solids that each point (n, 3) [m] lies in, by a ray upwards."""
        above = points_m.copy()
        above[:, 2] = np.maximum(self._top_m, points_m[:, 2] + 1.0)
        depth = np.zeros(len(points_m), dtype=int)
        for _, crossing, ray in self._crossings(points_m, above):
            np.subtract.at(depth, ray, crossing)
        return depth

    def _crossings(self, a_m: np.ndarray, b_m: np.ndarray
                   ) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Yield first crossings of segments (a, b) with surfaces, then second ones, and so on.

        Of each: distance from a [m], +1 (entering) or -1 (leaving a solid), index of the segment.
        """
        ray = np.arange(len(a_m))
        length = np.linalg.norm(b_m - a_m, axis=1)
        direction = (b_m - a_m) / np.maximum(length, 1e-12)[:, None]
        travelled = np.zeros(len(a_m))
        while len(ray):
            origin = a_m[ray] + travelled[ray, None] * direction[ray]
            distance, face, facing = self.first_hits(origin, b_m[ray])
            hit = face >= 0
            ray = ray[hit]
            along_m = travelled[ray] + distance[hit]
            if len(ray):
                yield along_m, np.where(facing[hit] < 0, 1, -1), ray
            travelled[ray] = along_m + SKIN_M
            ray = ray[travelled[ray] < length[ray]]

    def first_hits(self, a_m: np.ndarray, b_m: np.ndarray
                   ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the first surface between a and b.

        Args:
            a_m: (n, 3) starts [m].
            b_m: (n, 3) ends [m].

        Returns:
            (n,) distance from a [m] (infinite: none), (n,) face (-1: none), and (n,) direction
            times a normal of any length, negative where the ray enters a solid.
        """
        a_m, b_m = np.asarray(a_m, dtype=float), np.asarray(b_m, dtype=float)
        offset = b_m - a_m
        length = np.linalg.norm(offset, axis=1)
        return self.first_hits_towards(a_m, offset / np.maximum(length, 1e-12)[:, None], length)

    def first_hits_towards(self, start_m: np.ndarray, direction: np.ndarray,
                           length_m: np.ndarray | float = np.inf
                           ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the first surface along rays; returns the same as `first_hits`.

        Args:
            start_m: (n, 3) starts of the rays [m].
            direction: (n, 3) unit vectors, or one for all.
            length_m: (n,) length of the rays [m], or one for all.
        """
        n = len(start_m)
        direction = np.broadcast_to(direction, (n, 3))
        length_m = np.broadcast_to(length_m, n)
        distance, face, facing = np.full(n, np.inf), np.full(n, -1), np.zeros(n)
        for start in range(0, n, CHUNK):
            part = slice(start, start + CHUNK)
            towards = np.ascontiguousarray(direction[part], dtype=np.float32)
            found = self._scene.run(np.ascontiguousarray(start_m[part], dtype=np.float32), towards,
                                    length_m[part].astype(np.float32), query="INTERSECT",
                                    output=True)
            hit = np.flatnonzero(found["primID"] >= 0)
            face[start + hit] = faces = self._drawn[found["primID"][hit]]
            distance[start + hit] = found["tfar"][hit]
            facing[start + hit] = np.einsum("ij,ij->i", towards[hit], self._normals[faces])
        return distance, face, facing


def building_of_vertex(city: CityMap) -> np.ndarray:
    """Return the number (v,) of the building that each vertex belongs to; -1: ground only.

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


@lru_cache(maxsize=8)  # a map also holds its precomputed walls and edges: tens of MB
def perturbed_map(city: CityMap, wall_sd_m: float, height_sd_m: float, seed: int) -> CityMap:
    """Return a map with normally distributed errors of every building's walls and height.

    The walls on opposite sides of a building move independently, so that it is shifted and grows or
    shrinks; its roof keeps its shape. A seed always draws the same errors, in units of the
    standard deviations.

    Args:
        city: Map to perturb.
        wall_sd_m: Standard deviation of a wall's position, across the wall [m].
        height_sd_m: Standard deviation of a building's height [m].
        seed: Seed of the errors.
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
    """Read the standard deviation of the height of each shape [m] from a folder's `buildings.csv`.

    A shape is a block of buildings that touch: the mean over its buildings is weighted by area.
    None without such a table, or without its columns `shape`, `area_m2` and `height_sd_m`.

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
    for name, highest in (("area_m2", _MAX_AREA_M2), ("height_sd_m", _MAX_SD_M)):
        refuse(path, name, table[name], ~((numbers[name] > 0) & (numbers[name] <= highest)),
               f"is impossible; allowed are numbers above 0, up to {highest:g}")
    areas_m2 = pd.Series(numbers["area_m2"]).groupby(table["shape"]).sum()
    sums = pd.Series(numbers["area_m2"] * numbers["height_sd_m"]).groupby(table["shape"]).sum()
    return dict((sums / areas_m2).items())
