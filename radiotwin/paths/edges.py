"""Edges of a city that diffract: roof edges and corners of buildings.

Faces of two materials form no edge. In Sionna RT, whose gains are the truth here, they belong to
two meshes, and no ray is diffracted where two meshes meet; `build-scene --material` gives a
building one material where its roof is to diffract.

Around a segment the triangles that meet there are sorted by angle; an open sector of more than
180 degrees between two of them is a wedge. This also holds where several buildings touch: a shared
wall that is built over leaves no wedge.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from radiotwin.paths.facets import COPLANAR_M, Facets, extract_facets
from radiotwin.paths.topology import Topology, build_topology
from radiotwin.paths.vectors import cross, dot
from radiotwin.scene.citymap import CityMap


@dataclass(frozen=True, eq=False)
class Edges:
    """Convex edges between two facets.

    Where a building leans on a higher one without sharing its corners, the edge of its roof in
    that wall is listed, too; it lies inside the other building, so no ray reaches it. A half plane
    sweeps the open space when it is turned from face 0 by `exterior_rad` towards `normal_0`.

    Attributes:
        start_m: (e, 3) starts [m].
        end_m: (e, 3) ends [m].
        direction: (e, 3) unit vectors from start to end.
        facet: (e, 2) face 0 and face n, rows of `Facets`.
        tangent_0: (e, 3) unit vectors in face 0, at right angles to the edge, into the face.
        normal_0: (e, 3) outward unit normals of face 0.
        normal_n: (e, 3) outward unit normals of face n.
        exterior_rad: (e,) angle of the open space [rad], π to 2 π.
    """

    start_m: np.ndarray
    end_m: np.ndarray
    direction: np.ndarray
    facet: np.ndarray
    tangent_0: np.ndarray
    normal_0: np.ndarray
    normal_n: np.ndarray
    exterior_rad: np.ndarray

    def __len__(self) -> int:
        return len(self.start_m)


def extract_edges(
    city: CityMap, facets: Facets | None = None, topology: Topology | None = None
) -> Edges:
    """Find the convex edges of a city: roof edges and corners, without those on the ground.

    Args:
        city: 3D map.
        facets: of this city; None: extracted here.
        topology: of this city; None: built here.

    Returns:
        The edges, sorted by their facets.

    Raises:
        BadInput: a corner is not finite.
    """
    topology = topology or build_topology(city)
    facets = facets or extract_facets(city, topology)
    if not len(facets):
        none = np.empty((0, 3))
        no_facets = np.empty((0, 2), dtype=int)
        return Edges(none, none, none, no_facets, none, none, none, np.empty(0))
    # Folds flatter than 0.1 rad approximate curved surfaces and diffract too little to count
    found = _wedges(topology.vertices_m, topology.triangles, topology.normal, topology.segments,
                    topology.owner, topology.group, np.pi + 0.1)
    segment = topology.segments[found[:, 0]]
    pair = np.sort(facets.of_face[topology.source[found[:, 1:]]], axis=1)
    keep = (pair[:, 0] != pair[:, 1]) \
        & (facets.material[pair[:, 0]] == facets.material[pair[:, 1]])
    start_m, end_m, pair = _join(topology.vertices_m[segment[keep]], pair[keep])
    direction = end_m - start_m
    direction /= np.maximum(np.linalg.norm(direction, axis=1), 1e-12)[:, None]
    normal_0, normal_n = facets.normal[pair[:, 0]], facets.normal[pair[:, 1]]
    # At a convex edge each face runs against the normal of the other
    tangent_0 = _tangent(direction, normal_0, normal_n)
    tangent_n = _tangent(direction, normal_n, normal_0)
    sine = np.einsum("ij,ij->i", tangent_n, normal_0)
    cosine = np.einsum("ij,ij->i", tangent_n, tangent_0)
    exterior_rad = np.mod(np.arctan2(sine, cosine), 2 * np.pi)
    return Edges(start_m, end_m, direction, pair, tangent_0, normal_0, normal_n, exterior_rad)


def _tangent(direction: np.ndarray, normal: np.ndarray, other: np.ndarray) -> np.ndarray:
    tangent = np.cross(normal, direction)
    sign = -np.sign(np.einsum("ij,ij->i", tangent, other))
    return tangent * np.where(sign == 0, 1.0, sign)[:, None]


def _join(ends_m: np.ndarray, pair: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Join consecutive pieces between the same two facets; return starts, ends and facets."""
    order = np.lexsort((pair[:, 1], pair[:, 0]))
    ends_m, pair = ends_m[order], pair[order]
    is_new = np.append(True, (pair[1:] != pair[:-1]).any(axis=1))[:len(pair)]
    first = np.append(np.flatnonzero(is_new), len(pair))
    joined_m, row = _joined(ends_m, first)
    return joined_m[:, 0], joined_m[:, 1], pair[row]


@njit(cache=True)
def _joined(ends_m: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Join pieces (p, 2, 3) of groups that overlap; return ends (e, 2, 3) and one row (e,) each."""
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


@njit(cache=True)
def _wedges(
    vertices_m: np.ndarray, triangles: np.ndarray, normal: np.ndarray, segments: np.ndarray,
    owner: np.ndarray, group: np.ndarray, min_rad: float,
) -> np.ndarray:
    """Return (w, 3) row of `segments` and the two triangles of each open sector over `min_rad`."""
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
                y = cross(axis, x)
            cosine, sine = (middle * x).sum(), (middle * y).sum()
            angle[i] = np.arctan2(sine, cosine)
            turn = cosine * y - sine * x  # towards a larger angle
            opens[i] = (turn * normal[owner[a + i]]).sum()
        # Of two coincident faces the one that looks back comes first: no space opens between them
        order = np.argsort(angle + np.where(opens > 0, 1e-4, -1e-4))
        for k in range(n):
            i, j = order[k], order[(k + 1) % n]
            width = (angle[j] - angle[i]) % (2 * np.pi)
            if opens[i] > 0 and opens[j] < 0 and min_rad < width < 2 * np.pi - 1e-3:
                found.append((a, owner[a + i], owner[a + j]))
    out = np.empty((len(found), 3), dtype=np.int64)
    for k in range(len(found)):
        out[k, 0], out[k, 1], out[k, 2] = found[k]
    return out
