"""Planar facets of a city: triangles of one material that share a segment and lie in one plane."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from radiotwin.paths.topology import Topology, build_topology
from radiotwin.scene.citymap import CityMap

COPLANAR_M = 0.005  # [m], maximum distance of a neighbour's corner from the plane
MAX_TRIANGLES_AT_SEGMENT = 12  # triangles that may meet at one segment


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
        of_face: (city faces,) facet of each face of the city; -1: a sliver, or on the ground.
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
    """Merge the triangles of a city to facets; faces on the ground plane z = 0 are left out.

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
    frames = np.array([_frame(corners_m[a:b], cross[a:b]) for a, b in zip(first[:-1], first[1:])])
    normal, origin_m, axis_u, axis_v, size_m, full = np.split(
        frames.reshape(-1, 15), [3, 6, 9, 12, 14], axis=1)
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


def _frame(corners_m: np.ndarray, cross: np.ndarray) -> np.ndarray:
    """Return the plane of one facet and its smallest bounding rectangle.

    The rectangle is tried along the 16 longest sides of the triangles.

    Args:
        corners_m: (t, 3, 3) triangles [m].
        cross: (t, 3) outward normals of the triangles, twice as long as their areas [m²].

    Returns:
        (15,) normal, origin, axes u and v, size, and whether the facet fills the rectangle.
    """
    normal = cross.sum(axis=0)
    area_m2 = np.linalg.norm(normal) / 2
    normal = normal / (2 * area_m2)
    sides = (np.roll(corners_m, -1, axis=1) - corners_m).reshape(-1, 3)
    longest = np.argsort(-np.linalg.norm(sides, axis=1), kind="stable")[:16]
    min_area_m2 = np.inf
    for side in sides[longest]:
        along = side - (side @ normal) * normal
        along /= np.linalg.norm(along)
        across = np.cross(normal, along)
        uv_m = corners_m.reshape(-1, 3) @ np.column_stack([along, across])
        extent_m = np.ptp(uv_m, axis=0)
        if extent_m.prod() < min_area_m2 * (1 - 1e-9):
            axis_u, axis_v, low_m, size_m = along, across, uv_m.min(axis=0), extent_m
            min_area_m2 = size_m.prod()
    distance_m = np.average((corners_m @ normal).mean(axis=1),
                            weights=np.linalg.norm(cross, axis=1))
    origin_m = low_m[0] * axis_u + low_m[1] * axis_v + distance_m * normal
    full = area_m2 >= (1 - 1e-6) * min_area_m2
    return np.concatenate([normal, origin_m, axis_u, axis_v, size_m, [full]])
