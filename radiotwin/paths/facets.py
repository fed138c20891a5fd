"""Planar facets of a city: triangles of one material that share a segment and lie in one plane."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from radiotwin.paths.topology import Topology, build_topology
from radiotwin.paths.vectors import cross as cross_product
from radiotwin.paths.vectors import dot
from radiotwin.scene.citymap import CityMap

COPLANAR_M = 0.005  # [m], maximum distance of a neighbour's corner from the plane
MAX_TRIANGLES_AT_SEGMENT = 12  # triangles that may meet at one segment
TRIED_SIDES = 16  # of a facet's triangles, to lay its bounding rectangle along


@dataclass(frozen=True, eq=False)
class Facets:
    """Planar facets; the plane of each is normal · p = offset_m.

    Attributes:
        normal: (f, 3) outward unit normals.
        offset_m: (f,) distances of the planes from the origin [m].
        origin_m: (f, 3) a corner of the bounding rectangle [m].
        axis_u: (f, 3) unit vectors along one side of it.
        axis_v: (f, 3) unit vectors along the other; u × v = normal.
        size_m: (f, 2) lengths of the sides [m].
        full: (f,) bool: the facet fills its bounding rectangle.
        first: (f + 1,) first row in `triangle_uv_m` of each facet.
        triangle_uv_m: (t, 6) corners u, v, u, v, u, v of the triangles in the plane [m].
        of_face: (city faces,) facet of each face of the city; -1: a sliver, or on flat ground.
        material: (f,) row of the city's materials.
    """

    normal: np.ndarray
    offset_m: np.ndarray
    origin_m: np.ndarray
    axis_u: np.ndarray
    axis_v: np.ndarray
    size_m: np.ndarray
    full: np.ndarray
    first: np.ndarray
    triangle_uv_m: np.ndarray
    of_face: np.ndarray
    material: np.ndarray

    def __len__(self) -> int:
        return len(self.normal)


def extract_facets(city: CityMap, topology: Topology | None = None) -> Facets:
    """Merge the triangles of a city to facets; faces on flat ground, z = 0, are left out.

    Args:
        city: 3D map.
        topology: of this city; None: built here.

    Returns:
        The facets, in the order of their first triangle.

    Raises:
        BadInput: a corner is not finite.
    """
    topology = topology or build_topology(city)
    material = city.material[topology.source]
    label = _coplanar_groups(topology, material)
    count = int(label.max()) + 1 if len(label) else 0
    order = np.argsort(label, kind="stable")
    first = np.searchsorted(label[order], np.arange(count + 1))
    corners_m = topology.vertices_m[topology.triangles[order]]
    cross = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    normal, origin_m, axis_u, axis_v, size_m, full = np.split(
        _frames(corners_m, cross, first), [3, 6, 9, 12, 14], axis=1)
    of_row = label[order]
    offset_m = corners_m - origin_m[of_row, None]
    uv_m = np.stack([np.einsum("ikj,ij->ik", offset_m, axis[of_row]) for axis in (axis_u, axis_v)],
                    axis=2)
    of_face = np.full(len(city.faces), -1)
    of_face[topology.source] = label
    return Facets(normal, np.einsum("ij,ij->i", normal, origin_m), origin_m, axis_u, axis_v,
                  size_m, full[:, 0] > 0, first, uv_m.reshape(-1, 6), of_face,
                  material[order][first[:-1]])


def _coplanar_groups(topology: Topology, material: np.ndarray) -> np.ndarray:
    """Return the facet (t,) of each triangle, which is of a material (t,)."""
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
    for one, other in ((a, b), (b, a)):
        off_m = np.einsum("ikj,ij->ik", corners_m[other] - corners_m[one][:, :1], normal[one])
        same &= (np.abs(off_m) < COPLANAR_M).all(axis=1)
    graph = coo_matrix((np.ones(same.sum()), (a[same], b[same])), shape=(len(normal),) * 2)
    return connected_components(graph, directed=False)[1]


@njit(cache=True)
def _frames(corners_m: np.ndarray, cross: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return the planes of facets and their smallest bounding rectangles.

    A rectangle is tried along the `TRIED_SIDES` longest sides of a facet's triangles.

    Args:
        corners_m: (t, 3, 3) triangles, facet after facet [m].
        cross: (t, 3) outward normals of the triangles, twice as long as their areas [m²].
        first: (f + 1,) first triangle of each facet.

    Returns:
        (f, 15) normal, origin, axes u and v, size, and whether the facet fills the rectangle.
    """
    out = np.empty((len(first) - 1, 15))
    for facet in range(len(first) - 1):
        points_m = corners_m[first[facet]:first[facet + 1]].copy().reshape(-1, 3)
        weight = cross[first[facet]:first[facet + 1]]
        normal = weight.sum(axis=0)
        area_m2 = np.sqrt(dot(normal, normal)) / 2.0
        normal = normal / (2.0 * area_m2)
        distance_m = whole = 0.0
        sides = np.empty_like(points_m)
        for k in range(len(points_m)):
            sides[k] = points_m[k + 1 if k % 3 < 2 else k - 2] - points_m[k]
            share = np.sqrt(dot(weight[k // 3], weight[k // 3]))
            distance_m += share * dot(points_m[k], normal)
            whole += share
        longest = np.argsort(-(sides ** 2).sum(axis=1), kind="mergesort")[:TRIED_SIDES]
        min_area_m2 = np.inf
        for k in longest:
            along = sides[k] - dot(sides[k], normal) * normal
            along = along / np.sqrt(dot(along, along))
            across = cross_product(normal, along)
            low_u = low_v = np.inf
            high_u = high_v = -np.inf
            for point_m in points_m:
                u, v = dot(point_m, along), dot(point_m, across)
                low_u, high_u = min(low_u, u), max(high_u, u)
                low_v, high_v = min(low_v, v), max(high_v, v)
            tried_m2 = (high_u - low_u) * (high_v - low_v)
            if tried_m2 < min_area_m2 * (1.0 - 1e-9):
                min_area_m2 = tried_m2
                out[facet, 3:6] = low_u * along + low_v * across + distance_m / whole * normal
                out[facet, 6:9], out[facet, 9:12] = along, across
                out[facet, 12], out[facet, 13] = high_u - low_u, high_v - low_v
        out[facet, :3] = normal
        out[facet, 14] = area_m2 >= (1.0 - 1e-6) * min_area_m2
    return out
