"""The 3D map: what stands between two points, how high it is, and what is inside it.

Rays are cast with Embree [1], which computes in single precision: distances are good to about 1 mm in a city
of 10 km, and surfaces closer together than `SKIN_M` count as one.

[1] Wald et al., "Embree: a kernel framework for efficient CPU ray tracing", ACM TOG 33(4), 2014.
"""

from pathlib import Path

import numpy as np

from radiotwin.errors import BadInput, RunFailed
from radiotwin.scene.mitsuba_xml import scene_meshes
from radiotwin.scene.ply import read_ply

SKIN_M = 0.01
CHUNK = 1_000_000  # rays a call: bounds the memory of any query to about 100 MB


def _embree_scene(triangles: np.ndarray):
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError as error:
        raise RunFailed("the 3D map needs the package embreex; install it with `pip install embreex` (wheels "
                        "exist for Linux, macOS and Windows on x86-64 and for macOS on ARM)") from error
    scene = EmbreeScene()
    TriangleMesh(scene, triangles.astype(np.float32))
    return scene


class CityMap:
    """Triangles of a city with outward normals, and the questions that radio asks of them.

    Args:
        vertices: (v, 3) positions [m].
        faces: (f, 3) indices of vertices, counter-clockwise seen from outside.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        self.vertices = np.asarray(vertices, dtype=float)
        self.faces = np.asarray(faces, dtype=int)
        triangles = self.vertices[self.faces]
        self._scene = _embree_scene(triangles)
        self._normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        self._top_m = float(self.vertices[:, 2].max()) + 1.0

    @classmethod
    def from_xml(cls, xml_path: Path | str) -> "CityMap":
        """Read the meshes that a scene folder's `city.xml` names (PLY shapes, as `build-scene` writes them).

        Raises:
            BadInput: no such file, malformed XML, a mesh that cannot be read, or one outside of the folder.
        """
        xml_path = Path(xml_path)
        if not xml_path.is_file():
            raise BadInput(f"{xml_path} does not exist; `radiotwin build-scene` makes a scene folder")
        vertices, faces, count = [], [], 0
        for path in scene_meshes(xml_path):
            corners, polygons = read_ply(path)
            vertices.append(corners)
            faces += [triangles + count for triangles in polygons]
            count += len(corners)
        if not faces or any(triangles.shape[1] != 3 for triangles in faces):
            raise BadInput(f"{xml_path} names no meshes, or some that are not of triangles; build the scene with "
                           "`radiotwin build-scene`")
        return cls(np.concatenate(vertices), np.concatenate(faces))

    def line_of_sight(self, a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
        """Whether nothing stands between the points (two points within one solid have nothing in between).

        Args:
            a_m, b_m: (n, 3) or broadcastable to it [m].

        Returns:
            (n,) bool
        """
        a_m, b_m = np.broadcast_arrays(np.atleast_2d(a_m), np.atleast_2d(b_m))
        los = np.empty(len(a_m), dtype=bool)
        for start in range(0, len(a_m), CHUNK):
            part = slice(start, start + CHUNK)
            origin = np.ascontiguousarray(a_m[part], dtype=np.float32)
            way = np.ascontiguousarray(b_m[part] - a_m[part], dtype=np.float32)  # no unit vectors: faster
            los[part] = self._scene.run(origin, way, np.ones(len(way), np.float32), query="OCCLUDED") == -1
        return los

    def first_face(self, a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
        """(n,) index of the first face on the way from a to b, both (n, 3) [m]; -1 where nothing stands between."""
        return self._first_hits(np.asarray(a_m, dtype=float), np.asarray(b_m, dtype=float))[1]

    def height_at(self, x_m: np.ndarray | float, y_m: np.ndarray | float) -> np.ndarray:
        """Height of the highest surface above each point of the plane.

        Args:
            x_m, y_m: arrays of one shape [m].

        Returns:
            heights [m] of that shape; 0 (the ground datum) where there is nothing.
        """
        x_m, y_m = np.broadcast_arrays(x_m, y_m)
        above = np.column_stack([x_m.ravel(), y_m.ravel(), np.full(x_m.size, self._top_m)])
        distance, face, _ = self._first_hits(above, above - [0, 0, 1], infinite=True)
        height = np.where(face >= 0, self._top_m - distance, 0.0)
        return height.reshape(x_m.shape)

    def inside(self, points_m: np.ndarray) -> np.ndarray:
        """Whether each point lies within a building.

        A ray is sent straight up: the point is inside when it leaves more solids than it enters, which holds
        for overlapping solids and for the open-bottomed shells that most city models are made of.

        Args:
            points_m: (n, 3)

        Returns:
            (n,) bool
        """
        return self._depth(np.atleast_2d(np.asarray(points_m, dtype=float))) > 0

    def metres_inside(self, a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
        """Length of each segment that lies within buildings.

        Args:
            a_m, b_m: (n, 3) or broadcastable to it [m].

        Returns:
            (n,) lengths [m]
        """
        a_m, b_m = np.broadcast_arrays(np.atleast_2d(a_m).astype(float), np.atleast_2d(b_m).astype(float))
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
        """(n,) how many solids each point lies in."""
        above = points_m.copy()
        above[:, 2] = np.maximum(self._top_m, points_m[:, 2] + 1.0)
        depth = np.zeros(len(points_m), dtype=int)
        for _, crossing, ray in self._crossings(points_m, above):
            np.subtract.at(depth, ray, crossing)
        return depth

    def _crossings(self, a_m: np.ndarray, b_m: np.ndarray):
        """Yield the 1st, 2nd, … surface along each segment: distance from a, +1 entering or -1 leaving, ray."""
        ray = np.arange(len(a_m))
        length = np.linalg.norm(b_m - a_m, axis=1)
        direction = (b_m - a_m) / np.maximum(length, 1e-12)[:, None]
        travelled = np.zeros(len(a_m))
        while len(ray):
            origin = a_m[ray] + travelled[ray, None] * direction[ray]
            distance, face, cosine = self._first_hits(origin, b_m[ray])
            hit = face >= 0
            ray = ray[hit]
            at = travelled[ray] + distance[hit]
            if len(ray):
                yield at, np.where(cosine[hit] < 0, 1, -1), ray
            travelled[ray] = at + SKIN_M
            ray = ray[travelled[ray] < length[ray]]

    def _first_hits(self, a_m, b_m, infinite: bool = False):
        """First surface from a towards b: distance [m], face (-1: none), sign of direction · normal."""
        n = len(a_m)
        distance, face, cosine = np.full(n, np.inf), np.full(n, -1), np.zeros(n)
        for start in range(0, n, CHUNK):
            part = slice(start, start + CHUNK)
            origin, direction, length = _rays(a_m[part], b_m[part])
            if infinite:
                length[:] = np.inf
            found = self._scene.run(origin, direction, length, query="INTERSECT", output=True)
            face[part] = found["primID"]
            hit = face[part] >= 0
            distance[part] = np.where(hit, found["tfar"], np.inf)
            normal = self._normals[np.maximum(face[part], 0)]
            cosine[part] = np.where(hit, np.einsum("ij,ij->i", direction, normal), 0.0)
        return distance, face, cosine


def _rays(a_m: np.ndarray, b_m: np.ndarray):
    """Single-precision origins, unit directions and lengths of segments."""
    offset = b_m - a_m
    length = np.linalg.norm(offset, axis=1)
    direction = offset / np.maximum(length, 1e-12)[:, None]
    return (np.ascontiguousarray(a_m, dtype=np.float32), np.ascontiguousarray(direction, dtype=np.float32),
            length.astype(np.float32))
