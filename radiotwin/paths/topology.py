"""A triangulated city as a graph: which triangles meet along which segments.

City models are rarely clean: corners are stored once per building, walls are cut into slices that do not end where
those of the neighbour do (T-junctions), and slivers are left over. So corners closer than `WELD_M` become one, every
side of a triangle is split at the corners that lie on it, and slivers are dropped; their neighbours then meet along
the same short segments.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

WELD_M = 0.002  # PLY files hold single precision: 0.06 mm at 1 km
GROUND_M = 0.05  # what lies within this height of z = 0 is the ground
QUERY_CHUNK = 2_000  # sides looked up at once


@dataclass(frozen=True, eq=False)
class Topology:
    """Triangles and the segments they share.

    Attributes:
        vertices_m: (v, 3) welded corners [m].
        triangles: (t, 3) indices of corners, counter-clockwise seen from outside; no slivers, nothing on the ground.
        source: (t,) face of the city that each triangle is.
        normal: (t, 3) outward unit normals.
        segments: (s, 2) corners, lower index first, one row for each triangle that borders on it, sorted.
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


def on_ground(city) -> np.ndarray:
    """(f,) bool: faces of a `CityMap` that lie on the ground plane z = 0."""
    return (np.abs(city.vertices[city.faces][:, :, 2]) < GROUND_M).all(axis=1)


def build_topology(city) -> Topology:
    """Weld, split and sort the triangles of a `CityMap`."""
    vertices_m, index = _weld(city.vertices)
    corners = index[city.faces]
    normal, height_m = _planes(vertices_m[corners])
    source = np.flatnonzero((height_m > WELD_M) & ~on_ground(city))
    triangles, normal = corners[source], normal[source]
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(sides, axis=0, return_inverse=True)
    pieces, piece_side = _split(vertices_m, unique)
    segments, owner = _rows_of_sides(pieces, piece_side, inverse.reshape(-1), len(unique))
    order = np.lexsort((owner, segments[:, 1], segments[:, 0]))
    segments, owner = segments[order], owner[order]
    new = np.ones(len(segments), dtype=bool)
    new[1:] = (segments[1:] != segments[:-1]).any(axis=1)
    group = np.append(np.flatnonzero(new), len(segments))
    return Topology(vertices_m, triangles, source, normal, segments, owner, group)


def _weld(vertices_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners that are one within `WELD_M`: their positions, and which of them each vertex is."""
    exact, index = np.unique(vertices_m, axis=0, return_inverse=True)
    pairs = cKDTree(exact).query_pairs(WELD_M, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T.reshape(2, -1)), shape=(len(exact), len(exact)))
    count, label = connected_components(graph, directed=False)
    mean_m = np.zeros((count, 3))
    np.add.at(mean_m, label, exact)
    return mean_m / np.bincount(label)[:, None], label[index.reshape(-1)]


def _planes(triangle_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals, and the least heights [m] of (n, 3, 3) triangles."""
    cross = np.cross(triangle_m[:, 1] - triangle_m[:, 0], triangle_m[:, 2] - triangle_m[:, 0])
    twice_area = np.linalg.norm(cross, axis=1)
    longest_m = np.linalg.norm(triangle_m - np.roll(triangle_m, 1, axis=1), axis=2).max(axis=1)
    return cross / np.maximum(twice_area, 1e-12)[:, None], twice_area / np.maximum(longest_m, 1e-12)


def _split(vertices_m: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The pieces of sides between the corners that lie on them: (p, 2) corners and (p,) side."""
    tree = cKDTree(vertices_m)
    start, end = vertices_m[sides[:, 0]], vertices_m[sides[:, 1]]
    length_m = np.linalg.norm(end - start, axis=1)
    side, corner, along = [np.arange(len(sides))] * 2, [sides[:, 0], sides[:, 1]], [np.zeros(len(sides)), length_m]
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
        along.append(at_m[on])
    sides, corners = np.concatenate(side), np.concatenate(corner)
    order = np.lexsort((np.concatenate(along), sides))
    sides, corners = sides[order], corners[order]
    within = sides[1:] == sides[:-1]
    return np.column_stack([corners[:-1], corners[1:]])[within], sides[:-1][within]


def _rows_of_sides(pieces, piece_side, side_of_row, side_count):
    """One row for each piece of each side of each triangle: (s, 2) sorted corners and (s,) triangle."""
    count = np.bincount(piece_side, minlength=side_count)
    first = np.cumsum(count) - count
    repeats = count[side_of_row]
    row = np.repeat(np.arange(len(side_of_row)), repeats)
    within = np.arange(len(row)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    piece = first[side_of_row[row]] + within
    return np.sort(pieces[piece], axis=1), row // 3
