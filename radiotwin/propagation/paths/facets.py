"""Merge the triangles of a city to plane facets, and find the edges that diffract.

City models are rarely clean: corners are stored once per building, walls are cut into slices that
end elsewhere than those of the neighbour (T-junctions), and slivers are left over. So corners
closer than `WELD_M` are welded, every side of a triangle is split at the corners that lie on it,
and slivers are dropped; neighbours then meet along the same short segments.

A facet is a set of connected triangles of one material in one plane. Around a segment, the
triangles that meet there are sorted by angle; an open sector of more than 180 degrees between two
of them is an edge that diffracts. This also holds where buildings touch: a shared wall that is
built over leaves no edge.

Faces of two materials form no edge. In Sionna RT, whose gains are the truth here, they belong to
two meshes, and no ray is diffracted where two meshes meet; `build-scene --material` gives a
building one material so that the edge of its roof diffracts.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from radiotwin.errors import BadInput
from radiotwin.propagation.paths.surfaces import (
    GROUND_MATERIAL,
    MATERIAL,
    NORMAL,
    Surfaces,
    cross,
    dot,
)
from radiotwin.runtime.compiled import njit
from radiotwin.scene.citymap import CityMap

WELD_M = 0.002  # well above the single precision of PLY files: 0.06 mm at 1 km
QUERY_CHUNK = 2_000  # sides in a query of the tree: bounds the memory
COPLANAR_M = 0.005  # maximum distance of a neighbour's corner from the plane
MAX_TRIANGLES_AT_SEGMENT = 12  # triangles that may meet at one segment
FLAT_RAD = 0.1  # flatter folds approximate curved surfaces and hardly diffract
TRIED_SIDES = 16  # longest sides of a facet's triangles along which a rectangle is tried


@dataclass(frozen=True, eq=False)
class Topology:
    """Triangles and the segments that they share.

    Attributes:
        vertices_m: (v, 3) welded corners [m].
        triangles: (t, 3) indices of corners, counter-clockwise seen from outside; without slivers
            and without faces on flat ground.
        source: (t,) index of each triangle in the city's faces.
        normal: (t, 3) outward unit normals.
        segments: (s, 2) corners, lower index first, sorted; one row for each triangle at a segment.
        owner: (s,) triangle of each row of `segments`.
        group: (g + 1,) first row of each distinct segment in `segments`.
    """

    vertices_m: np.ndarray
    triangles: np.ndarray
    source: np.ndarray
    normal: np.ndarray
    segments: np.ndarray
    owner: np.ndarray
    group: np.ndarray


def _topology(city: CityMap) -> Topology:
    """Weld the corners of a city, split sides at corners on them, and find the shared segments.

    Slivers, and faces on flat ground (within 5 cm of z = 0), are left out.
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
    """Merge vertices (v, 3) [m] within `WELD_M`; return their means, and rows (v,) in these."""
    exact, index = np.unique(vertices_m, axis=0, return_inverse=True)
    pairs = cKDTree(exact).query_pairs(WELD_M, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T.reshape(2, -1)), shape=(len(exact),) * 2)
    count, label = connected_components(graph, directed=False)
    mean_m = np.zeros((count, 3))
    np.add.at(mean_m, label, exact)
    return mean_m / np.bincount(label)[:, None], label[index.reshape(-1)]


def _normals_and_heights(triangle_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals (n, 3) and smallest heights (n,) [m] of triangles (n, 3, 3) [m]."""
    outward = np.cross(triangle_m[:, 1] - triangle_m[:, 0], triangle_m[:, 2] - triangle_m[:, 0])
    twice_area = np.linalg.norm(outward, axis=1)
    sides_m = np.linalg.norm(triangle_m - np.roll(triangle_m, 1, axis=1), axis=2)
    longest_m = np.maximum(sides_m.max(axis=1), 1e-12)
    return outward / np.maximum(twice_area, 1e-12)[:, None], twice_area / longest_m


def _split(vertices_m: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split sides (s, 2) at corners on them; return pieces (p, 2) and the side (p,) of each."""
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


def _rows_of_sides(pieces: np.ndarray, side_of_piece: np.ndarray, side_of_row: np.ndarray,
                   side_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return corners (s, 2) and triangle (s,) of each piece of each triangle's sides.

    Pieces (p, 2) are in the order of distinct sides; `side_of_row` (3 t,) are those of triangles.
    """
    count = np.bincount(side_of_piece, minlength=side_count)
    first = np.cumsum(count) - count
    row, within = expand(count[side_of_row])
    return np.sort(pieces[first[side_of_row[row]] + within], axis=1), row // 3


def expand(count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Repeat each index i `count[i]` times; return the indices, and 0, 1, … within each repetition.

    >>> [array.tolist() for array in expand(np.array([2, 0, 1]))]
    [[0, 0, 2], [0, 1, 0]]
    """
    row = np.repeat(np.arange(len(count)), count)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)


class CityFacets(NamedTuple):
    """Facets and edges of a city.

    Attributes:
        surfaces: facets and edges as arrays for compiled code.
        of_face: (city faces,) facet of each face of the city; -1: a sliver, or on flat ground.
        edge_ends_m: (e, 2, 3) starts and ends of the edges [m].
        edge_facets: (e, 2) facets that are face 0 and face n of the edges.
        corners: (c, 2) pairs of facets that meet in a reentrant corner, in both orders.
    """

    surfaces: Surfaces
    of_face: np.ndarray
    edge_ends_m: np.ndarray
    edge_facets: np.ndarray
    corners: np.ndarray


def extract_facets(city: CityMap) -> CityFacets:
    """Merge the triangles of a city to facets, and find the convex edges between them.

    Faces and edges on flat ground, z = 0, are left out.

    Raises:
        BadInput: a corner is not finite.
    """
    topology = _topology(city)
    planes, triangle_uv_m, of_face = _facets(city, topology)
    edges, ends_m, facet = _edges(planes, of_face, topology)
    ground = [0, 0, 1, 0.0 if city.terrain is None else np.inf, 0, 0, 0, 1, 0, 0, 0, 1, 0, np.inf,
              np.inf, 1, 0, 0, GROUND_MATERIAL]
    surfaces = Surfaces(np.concatenate([planes, [ground]]), triangle_uv_m, edges)
    corners = np.empty((0, 2), dtype=int)
    if len(planes):
        meeting = of_face[topology.source[_wedges(topology, FLAT_RAD, np.pi - FLAT_RAD)[:, 1:]]]
        corners = np.unique(np.concatenate([meeting, meeting[:, ::-1]]), axis=0)
    return CityFacets(surfaces, of_face, ends_m, facet, corners)


def _facets(city: CityMap, topology: Topology) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `planes` (f, 19), `triangle_uv_m` (t, 6), and each city face's facet; -1: none."""
    material = city.material[topology.source]
    if city.terrain is not None:
        material = np.where(city.terrain[topology.source], GROUND_MATERIAL, material)
    label = _coplanar_groups(topology, material)
    count = int(label.max()) + 1 if len(label) else 0
    order = np.argsort(label, kind="stable")
    first = np.searchsorted(label[order], np.arange(count + 1))
    corners_m = topology.vertices_m[topology.triangles[order]]
    outward = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    frames = _frames(corners_m, outward, first)
    normal, origin_m, axis_u, axis_v = np.split(frames[:, :12], 4, axis=1)
    of_row = label[order]
    offset_m = corners_m - origin_m[of_row, None]
    uv_m = np.stack([np.einsum("ikj,ij->ik", offset_m, axis[of_row]) for axis in (axis_u, axis_v)],
                    axis=2)
    of_face = np.full(len(city.faces), -1)
    of_face[topology.source] = label
    planes = np.column_stack([normal, np.einsum("ij,ij->i", normal, origin_m), frames[:, 3:],
                              first[:-1], first[1:], material[order][first[:-1]]])
    return planes, np.ascontiguousarray(uv_m.reshape(-1, 6)), of_face


def _coplanar_groups(topology: Topology, material: np.ndarray) -> np.ndarray:
    """Return the facet (t,) of each triangle: connected, coplanar, and of one `material` (t,)."""
    size = np.diff(topology.group)
    pairs = [np.empty((0, 2), dtype=int)]
    for i in range(MAX_TRIANGLES_AT_SEGMENT):
        for j in range(i + 1, MAX_TRIANGLES_AT_SEGMENT):
            first = topology.group[:-1][size > j]
            pairs.append(np.column_stack([topology.owner[first + i], topology.owner[first + j]]))
    a, b = np.concatenate(pairs).T
    corners_m = topology.vertices_m[topology.triangles]
    normal = topology.normal
    same = np.einsum("ij,ij->i", normal[a], normal[b]) > np.cos(np.radians(0.5))
    same &= material[a] == material[b]
    for first, second in ((a, b), (b, a)):
        off_m = np.einsum("ikj,ij->ik", corners_m[second] - corners_m[first][:, :1], normal[first])
        same &= (np.abs(off_m) < COPLANAR_M).all(axis=1)
    graph = coo_matrix((np.ones(same.sum()), (a[same], b[same])), shape=(len(normal),) * 2)
    return connected_components(graph, directed=False)[1]


@njit(cache=True)
def _frames(corners_m: np.ndarray, outward: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Compute the plane of each facet and its smallest rectangle along a side of `TRIED_SIDES`.

    Triangles (t, 3, 3) [m] and normals `outward` (t, 3), twice as long as areas [m²], are in the
    order of facets, which begin at `first` (f + 1,). Returns (f, 15): normal, origin [m], axes u
    and v, size [m], and 1 if the facet fills the rectangle.
    """
    out = np.empty((len(first) - 1, 15))
    for facet in range(len(first) - 1):
        points_m = corners_m[first[facet]:first[facet + 1]].copy().reshape(-1, 3)
        weight = outward[first[facet]:first[facet + 1]]
        normal = weight.sum(axis=0)
        area_m2 = np.sqrt(dot(normal, normal)) / 2.0
        normal = normal / (2.0 * area_m2)
        distance_m = total = 0.0
        sides = np.empty_like(points_m)
        for k in range(len(points_m)):
            sides[k] = points_m[k + 1 if k % 3 < 2 else k - 2] - points_m[k]
            area = np.sqrt(dot(weight[k // 3], weight[k // 3]))
            distance_m += area * dot(points_m[k], normal)
            total += area
        longest = np.argsort(-(sides ** 2).sum(axis=1), kind="mergesort")[:TRIED_SIDES]
        min_area_m2 = np.inf
        for k in longest:
            along = sides[k] - dot(sides[k], normal) * normal
            along = along / np.sqrt(dot(along, along))
            across = np.array(cross(normal, along))
            low_u = low_v = np.inf
            high_u = high_v = -np.inf
            for point_m in points_m:
                u, v = dot(point_m, along), dot(point_m, across)
                low_u, high_u = min(low_u, u), max(high_u, u)
                low_v, high_v = min(low_v, v), max(high_v, v)
            tried_m2 = (high_u - low_u) * (high_v - low_v)
            if tried_m2 < min_area_m2 * (1.0 - 1e-9):
                min_area_m2 = tried_m2
                out[facet, 3:6] = low_u * along + low_v * across + distance_m / total * normal
                out[facet, 6:9], out[facet, 9:12] = along, across
                out[facet, 12], out[facet, 13] = high_u - low_u, high_v - low_v
        out[facet, :3] = normal
        out[facet, 14] = area_m2 >= (1.0 - 1e-6) * min_area_m2
    return out


def _edges(planes: np.ndarray, of_face: np.ndarray, topology: Topology
           ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the convex edges between facets of one material, at which rays are diffracted.

    Returns `Surfaces.edges` (e, 19), their ends (e, 2, 3) [m], and two facets (e, 2), ascending.
    """
    if not len(planes):
        return np.empty((0, 19)), np.empty((0, 2, 3)), np.empty((0, 2), dtype=int)
    normal, material = planes[:, NORMAL:NORMAL + 3], planes[:, MATERIAL]
    found = _wedges(topology, np.pi + FLAT_RAD, 2 * np.pi - 1e-3)
    segment = topology.segments[found[:, 0]]
    pair = np.sort(of_face[topology.source[found[:, 1:]]], axis=1)
    keep = (pair[:, 0] != pair[:, 1]) & (material[pair[:, 0]] == material[pair[:, 1]])
    ends_m, pair = _join(topology.vertices_m[segment[keep]], pair[keep])
    direction = ends_m[:, 1] - ends_m[:, 0]
    length_m = np.linalg.norm(direction, axis=1)
    direction /= np.maximum(length_m, 1e-12)[:, None]
    normal_0, normal_n = normal[pair[:, 0]], normal[pair[:, 1]]
    # At a convex edge, each face extends against the normal of the other face.
    tangent_0 = _tangent(direction, normal_0, normal_n)
    tangent_n = _tangent(direction, normal_n, normal_0)
    sine = np.einsum("ij,ij->i", tangent_n, normal_0)
    cosine = np.einsum("ij,ij->i", tangent_n, tangent_0)
    exterior_rad = np.mod(np.arctan2(sine, cosine), 2 * np.pi)
    edges = np.column_stack([ends_m[:, 0], direction, length_m, tangent_0, normal_0, normal_n,
                             exterior_rad, material[pair]])
    return edges, ends_m, pair


def _tangent(direction: np.ndarray, normal: np.ndarray, other_normal: np.ndarray) -> np.ndarray:
    """Return unit vectors (e, 3) in a face, at right angles to its edge, pointing into the face."""
    tangent = np.cross(normal, direction)
    sign = -np.sign(np.einsum("ij,ij->i", tangent, other_normal))
    return tangent * np.where(sign == 0, 1.0, sign)[:, None]


def _join(ends_m: np.ndarray, pair: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Join touching pieces of edge (p, 2, 3) [m] if both lie between the same two facets (p, 2)."""
    order = np.lexsort((pair[:, 1], pair[:, 0]))
    ends_m, pair = ends_m[order], pair[order]
    is_new = np.append(True, (pair[1:] != pair[:-1]).any(axis=1))[:len(pair)]
    first = np.append(np.flatnonzero(is_new), len(pair))
    joined_m, row = _joined(ends_m, first)
    return joined_m, pair[row]


@njit(cache=True)
def _joined(ends_m: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Join collinear pieces (p, 2, 3) [m] that touch; return ends, and first row of each group."""
    out_m, row = np.empty_like(ends_m), np.empty(len(ends_m), dtype=np.int64)
    count = 0
    for g in range(len(first) - 1):
        pieces = ends_m[first[g]:first[g + 1]].copy()
        along = pieces[np.argmax(((pieces[:, 1] - pieces[:, 0]) ** 2).sum(axis=1))]
        along = along[1] - along[0]
        along = along / np.sqrt(dot(along, along))
        low_m, high_m = np.empty(len(pieces)), np.empty(len(pieces))
        for k in range(len(pieces)):
            low_m[k], high_m[k] = dot(pieces[k, 0], along), dot(pieces[k, 1], along)
            if low_m[k] > high_m[k]:
                low_m[k], high_m[k] = high_m[k], low_m[k]
                pieces[k] = pieces[k, ::-1].copy()
        reached_m = -np.inf
        for k in np.argsort(low_m, kind="mergesort"):
            if low_m[k] > reached_m + COPLANAR_M:
                out_m[count], row[count] = pieces[k], first[g]
                reached_m = high_m[k]
                count += 1
            elif high_m[k] > reached_m:
                out_m[count - 1, 1] = pieces[k, 1]
                reached_m = high_m[k]
    return out_m[:count], row[:count]


def _wedges(topology: Topology, min_rad: float, max_rad: float) -> np.ndarray:
    """Find the open sectors with an angle in a range: segment row and two triangles, (w, 3)."""
    return _open_sectors(topology.vertices_m, topology.triangles, topology.normal,
                         topology.segments, topology.owner, topology.group, min_rad, max_rad)


@njit(cache=True)
def _open_sectors(vertices_m: np.ndarray, triangles: np.ndarray, normal: np.ndarray,
                  segments: np.ndarray, owner: np.ndarray, group: np.ndarray, min_rad: float,
                  max_rad: float) -> np.ndarray:
    """Find where the open space between two triangles at one segment has an angle in a range.

    Returns (w, 3): first row of the segment, and the triangles at both sides of the open space.
    """
    found = []
    for g in range(len(group) - 1):
        a, n = group[g], group[g + 1] - group[g]
        if n < 2:
            continue
        start = vertices_m[segments[a, 0]]
        axis = vertices_m[segments[a, 1]] - start
        axis = axis / np.sqrt((axis * axis).sum())
        angle, opens = np.empty(n), np.empty(n)
        for i in range(n):
            corners = triangles[owner[a + i]]
            middle = (vertices_m[corners[0]] + vertices_m[corners[1]] + vertices_m[corners[2]]) \
                / 3.0 - start
            middle = middle - (middle * axis).sum() * axis
            if i == 0:
                x = middle / np.sqrt((middle * middle).sum())
                y = np.array(cross(axis, x))
            cosine, sine = (middle * x).sum(), (middle * y).sum()
            angle[i] = np.arctan2(sine, cosine)
            turn = cosine * y - sine * x  # towards a larger angle
            opens[i] = (turn * normal[owner[a + i]]).sum()
        # Of two coincident faces, that with the open space before it is sorted first.
        order = np.argsort(angle + np.where(opens > 0, 1e-4, -1e-4))
        for k in range(n):
            i, j = order[k], order[(k + 1) % n]
            width = (angle[j] - angle[i]) % (2 * np.pi)
            if opens[i] > 0 and opens[j] < 0 and min_rad < width < max_rad:
                found.append((a, owner[a + i], owner[a + j]))
    out = np.empty((len(found), 3), dtype=np.int64)
    for k in range(len(found)):
        out[k, 0], out[k, 1], out[k, 2] = found[k]
    return out
