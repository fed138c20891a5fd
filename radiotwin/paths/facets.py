"""The flat surfaces of a city: triangles that share a segment and lie in one plane, however a wall is subdivided."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from radiotwin.errors import BadInput
from radiotwin.paths.topology import Topology, build_topology

COPLANAR_M = 0.005  # how far a neighbour's corner may lie off the plane
COPLANAR_COS = np.cos(np.radians(0.5))
WALL_SINE = 0.2  # walls lean by at most about 12 degrees
RECTANGLE_SHARE = 1 - 1e-6  # of the bounding rectangle that a facet fills to be called one
MOST_AROUND = 12  # triangles that may meet at a segment
SIDES_TRIED = 16  # longest ones, along which the bounding rectangle may lie


@dataclass(frozen=True, eq=False)
class Facets:
    """Planar facets; the plane of each is normal · p = offset_m.

    Attributes:
        normal: (f, 3) outward unit normals.
        offset_m: (f,) distances of the planes from the origin [m].
        origin_m: (f, 3) a corner of the bounding rectangle [m].
        axis_u, axis_v: (f, 3) unit vectors along its sides; u × v = normal.
        size_m: (f, 2) lengths of its sides [m].
        full: (f,) bool: the facet is its bounding rectangle.
        first: (f + 1,) first row in `triangle_uv_m` of each facet.
        triangle_uv_m: (t, 6) corners u, v, u, v, u, v of the triangles in the plane [m].
        wall: (f,) bool: upright.
        of_face: (city faces,) facet of each face of the city, -1: a sliver, or on the ground.
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
    wall: np.ndarray
    of_face: np.ndarray

    def __len__(self) -> int:
        return len(self.normal)


def extract_facets(city, topology: Topology | None = None) -> Facets:
    """Merge the triangles of a `CityMap` to facets; faces on the ground plane z = 0 are left out.

    Args:
        city: the map.
        topology: of this city, where it is known already.

    Raises:
        BadInput: a corner that is not finite.
    """
    topology = topology or checked_topology(city)
    label = _coplanar_groups(topology)
    count = int(label.max()) + 1 if len(label) else 0
    order = np.argsort(label, kind="stable")
    first = np.searchsorted(label[order], np.arange(count + 1))
    corners_m = topology.vertices_m[topology.triangles[order]]
    cross = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    frames = np.array([_frame(corners_m[a:b], cross[a:b]) for a, b in zip(first[:-1], first[1:])]).reshape(-1, 15)
    normal, origin_m, axis_u, axis_v = frames[:, :3], frames[:, 3:6], frames[:, 6:9], frames[:, 9:12]
    size_m, full = frames[:, 12:14], frames[:, 14] > 0
    of_row = label[order]
    offset_m = corners_m - origin_m[of_row, None]
    uv_m = np.stack([np.einsum("ikj,ij->ik", offset_m, axis[of_row]) for axis in (axis_u, axis_v)], axis=2)
    of_face = np.full(len(city.faces), -1)
    of_face[topology.source] = label
    return Facets(normal, np.einsum("ij,ij->i", normal, origin_m), origin_m, axis_u, axis_v, size_m, full, first,
                  uv_m.reshape(-1, 6), np.abs(normal[:, 2]) < WALL_SINE, of_face)


def checked_topology(city) -> Topology:
    """`build_topology`, but BadInput for corners that are not finite."""
    if not np.isfinite(city.vertices).all():
        raise BadInput("the city has corners that are not finite numbers [m]; repair its meshes")
    return build_topology(city)


def _coplanar_groups(topology: Topology) -> np.ndarray:
    """(t,) facet of each triangle."""
    size = np.diff(topology.group)
    pairs = [np.empty((0, 2), dtype=int)]
    for i in range(MOST_AROUND):
        for j in range(i + 1, MOST_AROUND):
            first = topology.group[:-1][size > j]
            pairs.append(np.column_stack([topology.owner[first + i], topology.owner[first + j]]))
    a, b = np.concatenate(pairs).T
    corners_m = topology.vertices_m[topology.triangles]
    normal = topology.normal
    same = np.einsum("ij,ij->i", normal[a], normal[b]) > COPLANAR_COS
    for one, other in ((a, b), (b, a)):
        off_m = np.einsum("ikj,ij->ik", corners_m[other] - corners_m[one][:, :1], normal[one])
        same &= (np.abs(off_m) < COPLANAR_M).all(axis=1)
    n = len(topology.triangles)
    return connected_components(coo_matrix((np.ones(same.sum()), (a[same], b[same])), shape=(n, n)),
                                directed=False)[1]


def _frame(corners_m: np.ndarray, cross: np.ndarray) -> np.ndarray:
    """(15,) normal, origin and axes of the least bounding rectangle, its size, and whether it is full, of one facet."""
    normal = cross.sum(axis=0)
    area_m2 = np.linalg.norm(normal) / 2
    normal = normal / (2 * area_m2)
    sides = (np.roll(corners_m, -1, axis=1) - corners_m).reshape(-1, 3)
    longest = np.argsort(-np.linalg.norm(sides, axis=1), kind="stable")[:SIDES_TRIED]
    best: Any = None
    for side in sides[longest]:
        axis_u = side - (side @ normal) * normal
        axis_u /= np.linalg.norm(axis_u)
        axis_v = np.cross(normal, axis_u)
        uv_m = corners_m.reshape(-1, 3) @ np.column_stack([axis_u, axis_v])
        low_m, size_m = uv_m.min(axis=0), np.ptp(uv_m, axis=0)
        if best is None or size_m.prod() < best[-1].prod() * (1 - 1e-9):
            best = axis_u, axis_v, low_m, size_m
    axis_u, axis_v, low_m, size_m = best
    distance_m = np.average((corners_m @ normal).mean(axis=1), weights=np.linalg.norm(cross, axis=1))
    origin_m = low_m[0] * axis_u + low_m[1] * axis_v + distance_m * normal
    full = area_m2 >= RECTANGLE_SHARE * size_m.prod()
    return np.concatenate([normal, origin_m, axis_u, axis_v, size_m, [full]])
