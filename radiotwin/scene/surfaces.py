"""`Surfaces`: all triangles of a city in one array; their orientation, ground faces, edges."""

from collections.abc import Iterator, Sequence
from functools import cached_property

import numpy as np

from radiotwin.scene.meshes import WELD_M, connected

FLAT_M = 0.5  # surfaces whose heights differ by less (a kerb, a step) are at one level [m]
_MAX_WALL_COSINE = 0.3  # between normal and vertical: walls lean by at most 17 degrees
_MIN_GROUND_SHARE = 0.3  # least share of the city's plan that the ground covers


class Surfaces:
    """Triangles of several meshes in one array.

    Args:
        meshes: (vertices (v, 3) [m], faces (f, 3)) of each shape, welded.

    Attributes:
        vertices: (v, 3) [m]
        faces: (f, 3) indices of vertices.
        shape: (f,) index of the mesh that each face belongs to.
        shapes: Number of meshes.
        part: (f,) index of the connected part that each face belongs to; a mesh may have several.
        parts: Number of connected parts of all meshes.
    """

    def __init__(self, meshes: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
        sizes = np.array([len(vertices) for vertices, _ in meshes])
        starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        self.vertices = np.concatenate([vertices for vertices, _ in meshes])
        self.faces = np.concatenate([faces + start for (_, faces), start in zip(meshes, starts)])
        self.shape = np.repeat(np.arange(len(meshes)), [len(faces) for _, faces in meshes])
        self.shapes = len(meshes)
        self._starts = starts
        label = connected(self.faces[:, [[0, 1], [1, 2]]].reshape(-1, 2), len(self.vertices))
        self.part = np.unique(label[self.faces[:, 0]], return_inverse=True)[1]
        self.parts = int(self.part.max()) + 1

    @cached_property
    def area_vectors(self) -> np.ndarray:
        """(f, 3) normal times area, signed by the faces' order of corners [m²]."""
        corners = self.vertices[self.faces]
        return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    @cached_property
    def areas(self) -> np.ndarray:
        """(f,) areas [m²]."""
        return np.linalg.norm(self.area_vectors, axis=1)

    @cached_property
    def centres(self) -> np.ndarray:
        """(f, 3) centroids [m]."""
        return self.vertices[self.faces].mean(axis=1)

    @cached_property
    def free_edges(self) -> tuple[np.ndarray, np.ndarray]:
        """(n, 2) edges with only one triangle (border, holes), and (n,) that triangle's index."""
        edges, owner = self._edges()
        _, inverse, counts = np.unique(_edge_keys(np.sort(edges, axis=1)), return_inverse=True,
                                       return_counts=True)
        is_free = counts[inverse] == 1
        return edges[is_free], owner[is_free]

    def _edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the (3 f, 2) directed edges of all faces, and (3 f,) the faces they belong to."""
        edges = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        return edges, np.repeat(np.arange(len(self.faces)), 3)

    def _slices(self) -> Iterator[tuple[slice, slice]]:
        """Yield, for each mesh, the range of its faces and that of its vertices."""
        rows = np.searchsorted(self.shape, np.arange(self.shapes + 1))
        ends = [*self._starts[1:], len(self.vertices)]
        for first, last, start, end in zip(rows, rows[1:], self._starts, ends):
            yield slice(first, last), slice(start, end)

    def meshes(self, keep: np.ndarray | None = None) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return (vertices, faces) of each mesh, without unused vertices.

        Only faces that are True in `keep`, (f,) bool, are returned (None: all); meshes without any
        are left out.
        """
        keep = np.ones(len(self.faces), dtype=bool) if keep is None else keep
        result = []
        for rows, _ in self._slices():
            used, index = np.unique(self.faces[rows][keep[rows]], return_inverse=True)
            if len(used):
                result.append((self.vertices[used], index.reshape(-1, 3)))
        return result

    def turned(self, reverse: np.ndarray) -> "Surfaces":
        """Return the surfaces with the orientation of the faces `reverse`, (f,) bool, reversed."""
        faces = np.where(reverse[:, None], self.faces[:, ::-1], self.faces)
        return Surfaces([(self.vertices[points], faces[rows] - points.start)
                         for rows, points in self._slices()])

    def moved(self, offset_m: np.ndarray) -> "Surfaces":
        """Return the surfaces translated by (3,) [m]."""
        return Surfaces([(vertices + offset_m, faces) for vertices, faces in self.meshes()])

    def part_sum(self, values: np.ndarray) -> np.ndarray:
        """Return the (parts,) sums of (f,) values over the faces of each part."""
        return np.bincount(self.part, weights=values, minlength=self.parts)

    def part_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the (parts, 3) lowest and highest coordinates of each connected part [m]."""
        face_low, face_high = self.face_bounds()
        low, high = np.full((self.parts, 3), np.inf), np.full((self.parts, 3), -np.inf)
        np.minimum.at(low, self.part, face_low)
        np.maximum.at(high, self.part, face_high)
        return low, high

    def face_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the (f, 3) lowest and highest coordinates of each face [m]."""
        corners = self.vertices[self.faces]
        return corners.min(axis=1), corners.max(axis=1)

    @cached_property
    def _upright(self) -> np.ndarray:
        """(f,) bool: faces of walls."""
        return np.abs(self.area_vectors[:, 2]) < _MAX_WALL_COSINE * self.areas

    @cached_property
    def wall_share(self) -> np.ndarray:
        """(parts,) share of each part's area that is walls."""
        return self.part_sum(self.areas * self._upright) / self.part_sum(self.areas)

    @cached_property
    def closed(self) -> np.ndarray:
        """(parts,) bool: parts without a free edge."""
        closed = np.ones(self.parts, dtype=bool)
        closed[self.part[self.free_edges[1]]] = False
        return closed

    def inconsistent_shapes(self) -> np.ndarray:
        """Return indices of meshes where two triangles at an edge face opposite sides."""
        edges, owner = self._edges()
        _, inverse, counts = np.unique(_edge_keys(edges), return_inverse=True, return_counts=True)
        _, pair, pairs = np.unique(_edge_keys(np.sort(edges, axis=1)), return_inverse=True,
                                   return_counts=True)
        return np.unique(self.shape[owner[(counts[inverse] == 2) & (pairs[pair] == 2)]])

    def inward(self) -> np.ndarray:
        """Return (f,) bool: faces to reverse so that solids face outwards and sheets upwards.

        All faces of a connected part are reversed, or none. What decides is the sign of the flux of
        the vector (x, y, 0) through the part, which is twice the volume it encloses; a missing flat
        bottom would add nothing. Walls without a roof are judged by the flux of their whole mesh,
        as those of a courtyard rightly face inwards; sheets by their area seen from above.
        """
        middle = np.stack([self.part_sum(self.areas * axis) for axis in self.centres.T], axis=1)
        offset = self.centres - (middle / self.part_sum(self.areas)[:, None])[self.part]
        flux = self.part_sum(np.einsum("ij,ij->i", offset[:, :2], self.area_vectors[:, :2])) / 2
        up = self.part_sum(self.area_vectors[:, 2])
        sheet = ~self.closed & (self.wall_share < 0.1)
        bare_walls = ~self.closed & (self.wall_share > 0.95)
        shape_of_part = np.zeros(self.parts, dtype=int)
        shape_of_part[self.part] = self.shape
        wall_flux = np.bincount(shape_of_part, weights=flux * bare_walls, minlength=self.shapes)
        measure = np.where(sheet, up, np.where(bare_walls, wall_flux[shape_of_part], flux))
        scale = self.part_sum(self.areas) ** np.where(sheet, 1.0, 1.5)
        return (measure < -1e-6 * scale)[self.part]

    def ground_faces(self) -> np.ndarray:
        """Return (f,) bool: faces of the ground (terrain, plane, streets).

        Ground is a connected sheet or slab that covers at least 30 % of the city's plan, and whose
        mean height is at most the median top of the other parts. Upward faces at the lowest level
        are ground, too, if they cover as much (they may be connected to buildings). So are thin
        sheets at the level of flat ground, or below.
        """
        low, high = self.part_bounds()
        extent_m2 = np.prod(np.maximum((high.max(axis=0) - low.min(axis=0))[:2], 1e-9))
        flat_area = self.part_sum(np.abs(self.area_vectors[:, 2]))
        area = self.part_sum(self.areas)
        sheet = (flat_area > 0.7 * area) & (self.wall_share < np.where(self.closed, 0.1, 0.01))
        cover = np.minimum(flat_area, np.prod((high - low)[:, :2], axis=1))
        others = high[~sheet, 2] if (~sheet).any() else high[:, 2]
        middle = self.part_sum(self.areas * self.centres[:, 2]) / area
        min_cover_m2 = _MIN_GROUND_SHARE * extent_m2
        faces = (sheet & (cover >= min_cover_m2) & (middle <= np.median(others)))[self.part]
        face_top = self.face_bounds()[1][:, 2]
        up = self.area_vectors[:, 2] > 0.95 * self.areas
        lowest = up & (face_top <= low[:, 2].min() + FLAT_M)
        if self.areas[lowest].sum() >= min_cover_m2:
            faces |= lowest
        if faces.any():
            level = face_top[faces].max()
            if level - face_top[faces].min() <= FLAT_M:
                faces |= (sheet & (high[:, 2] <= level + FLAT_M))[self.part]
        return faces

    def level_m(self, faces: np.ndarray) -> float:
        """Return the median height [m], weighted by area, of the faces (f,) bool that face up.

        If none of them does, all count.
        """
        up = faces & (self.area_vectors[:, 2] > 0)
        up = up if up.any() else faces
        order = np.argsort(self.centres[up, 2])
        area = np.cumsum(self.areas[up][order])
        return float(self.centres[up, 2][order][np.searchsorted(area, area[-1] / 2)])

    def seams(self) -> np.ndarray:
        """Return pairs (n, 2) of meshes where an open edge of a wall meets one of a roof."""
        edges, owner = self.free_edges
        if len(edges) == 0:
            return np.zeros((0, 2), dtype=int)
        _, position = np.unique(np.round(self.vertices / WELD_M).astype(np.int64), axis=0,
                                return_inverse=True)
        keys = _edge_keys(np.sort(position.reshape(-1)[edges], axis=1))
        owner = owner[np.argsort(keys, kind="stable")]
        _, start, counts = np.unique(np.sort(keys), return_index=True, return_counts=True)
        first, second = owner[start[counts == 2]], owner[start[counts == 2] + 1]
        meets = ((self.shape[first] != self.shape[second])
                 & (self._upright[first] != self._upright[second]))
        pairs = self.shape[np.stack([first, second], axis=1)[meets]]
        return np.unique(np.sort(pairs, axis=1), axis=0)


def _edge_keys(edges: np.ndarray) -> np.ndarray:
    """Return a unique integer (n,) for each edge of (n, 2) indices of vertices."""
    return edges[:, 0].astype(np.int64) << 32 | edges[:, 1].astype(np.int64)
