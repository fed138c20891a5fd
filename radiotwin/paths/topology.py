"""A triangulated city as a graph: which triangles meet along which segments.

City models are rarely clean: corners are stored once per building, walls are cut into slices that
do not end where those of the neighbour do (T-junctions), and slivers are left over. So corners
closer than `WELD_M` become one, every side of a triangle is split at the corners that lie on it,
and slivers are dropped; their neighbours then meet along the same short segments.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from radiotwin.errors import BadInput
from radiotwin.scene.citymap import CityMap

WELD_M = 0.002  # [m], well above the single precision of PLY files: 0.06 mm at 1 km
QUERY_CHUNK = 2_000  # sides per query of the tree: bounds the memory


@dataclass(frozen=True, eq=False)
class Topology:
    """Triangles and the segments that they share.

    Attributes:
        vertices_m: (v, 3) welded corners [m].
        triangles: (t, 3) indices of corners, counter-clockwise seen from outside; without slivers
            and without faces on flat ground.
        source: (t,) face of the city that each triangle is.
        normal: (t, 3) outward unit normals.
        segments: (s, 2) corners, lower index first, one row for each triangle that borders on the
            segment, sorted.
        owner: (s,) the triangle of each row.
        group: (g + 1,) first row of each distinct segment.
    """

    vertices_m: np.ndarray
    triangles: np.ndarray
    source: np.ndarray
    normal: np.ndarray
    segments: np.ndarray
    owner: np.ndarray
    group: np.ndarray


def build_topology(city: CityMap) -> Topology:
    """Weld the corners of a city, split its triangles' sides and sort the segments.

    Args:
        city: 3D map.

    Returns:
        The topology of all faces but those of a flat ground, within 5 cm of z = 0.

    Raises:
        BadInput: a corner is not finite.
    """
    if not np.isfinite(city.vertices).all():
        raise BadInput("the city has corners that are not finite numbers [m]; repair its meshes")
    vertices_m, index = _weld(city.vertices)
    corners = index[city.faces]
    normal, height_m = _normals_and_heights(vertices_m[corners])
    on_plane = city.on_ground if city.terrain is None else np.zeros(len(corners), dtype=bool)
    source = np.flatnonzero((height_m > WELD_M) & ~on_plane)
    triangles, normal = corners[source], normal[source]
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(sides, axis=0, return_inverse=True)
    pieces, side_of_piece = _split(vertices_m, unique)
    segments, owner = _rows_of_sides(pieces, side_of_piece, inverse.reshape(-1), len(unique))
    order = np.lexsort((owner, segments[:, 1], segments[:, 0]))
    segments, owner = segments[order], owner[order]
    is_new = np.ones(len(segments), dtype=bool)
    is_new[1:] = (segments[1:] != segments[:-1]).any(axis=1)
    group = np.append(np.flatnonzero(is_new), len(segments))
    return Topology(vertices_m, triangles, source, normal, segments, owner, group)


def _weld(vertices_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean positions of corners within `WELD_M`, and the row of each vertex in them."""
    exact, index = np.unique(vertices_m, axis=0, return_inverse=True)
    pairs = cKDTree(exact).query_pairs(WELD_M, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T.reshape(2, -1)), shape=(len(exact),) * 2)
    count, label = connected_components(graph, directed=False)
    mean_m = np.zeros((count, 3))
    np.add.at(mean_m, label, exact)
    return mean_m / np.bincount(label)[:, None], label[index.reshape(-1)]


def _normals_and_heights(triangle_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals (n, 3) and smallest heights (n,) [m] of triangles (n, 3, 3)."""
    cross = np.cross(triangle_m[:, 1] - triangle_m[:, 0], triangle_m[:, 2] - triangle_m[:, 0])
    twice_area = np.linalg.norm(cross, axis=1)
    sides_m = np.linalg.norm(triangle_m - np.roll(triangle_m, 1, axis=1), axis=2)
    longest_m = np.maximum(sides_m.max(axis=1), 1e-12)
    return cross / np.maximum(twice_area, 1e-12)[:, None], twice_area / longest_m


def _split(vertices_m: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split sides at the corners on them; return (p, 2) corners and the side of each piece (p,)."""
    tree = cKDTree(vertices_m)
    start, end = vertices_m[sides[:, 0]], vertices_m[sides[:, 1]]
    length_m = np.linalg.norm(end - start, axis=1)
    side, corner = [np.arange(len(sides))] * 2, [sides[:, 0], sides[:, 1]]
    along_m = [np.zeros(len(sides)), length_m]
    for first in range(0, len(sides), QUERY_CHUNK):
        part = slice(first, first + QUERY_CHUNK)
        found = tree.query_ball_point((start[part] + end[part]) / 2, length_m[part] / 2)
        row = first + np.repeat(np.arange(len(found)), [len(near) for near in found])
        near = np.concatenate([np.asarray(near, dtype=int) for near in found])
        offset = vertices_m[near] - start[row]
        direction = (end[row] - start[row]) / length_m[row, None]
        at_m = np.einsum("ij,ij->i", offset, direction)
        aside_m = np.linalg.norm(offset - at_m[:, None] * direction, axis=1)
        on = (aside_m < WELD_M) & (at_m > WELD_M) & (at_m < length_m[row] - WELD_M)
        side.append(row[on])
        corner.append(near[on])
        along_m.append(at_m[on])
    sides, corners = np.concatenate(side), np.concatenate(corner)
    order = np.lexsort((np.concatenate(along_m), sides))
    sides, corners = sides[order], corners[order]
    same_side = sides[1:] == sides[:-1]
    return np.column_stack([corners[:-1], corners[1:]])[same_side], sides[:-1][same_side]


def _rows_of_sides(
    pieces: np.ndarray, side_of_piece: np.ndarray, side_of_row: np.ndarray, side_count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return corners (s, 2) and triangle (s,) of each piece of each side of each triangle."""
    count = np.bincount(side_of_piece, minlength=side_count)
    first = np.cumsum(count) - count
    row, within = expand(count[side_of_row])
    return np.sort(pieces[first[side_of_row[row]] + within], axis=1), row // 3


def expand(count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return, for `count[i]` repeats of each row i, the row and the number of the repeat.

    >>> [array.tolist() for array in expand(np.array([2, 0, 1]))]
    [[0, 0, 2], [0, 1, 0]]
    """
    row = np.repeat(np.arange(len(count)), count)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
