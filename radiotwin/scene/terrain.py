"""Terrain: heights of the ground on a regular grid, and the triangles that approximate them.

The triangles are refined greedily [1]: a Delaunay triangulation [2] of few nodes takes in, round by
round, the node of each triangle that is farthest from it, until none is farther than a tolerance or
there are as many triangles as are wanted.

[1] Garland, Heckbert, "Fast polygonal approximation of terrains and height fields", CMU-CS-95-181,
    1995.
[2] Barber, Dobkin, Huhdanpaa, "The Quickhull algorithm for convex hulls", ACM TOMS 22(4), 1996.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field
from scipy.spatial import Delaunay

from radiotwin.io.forms import Number, Table

Kind = Literal["geoid", "ellipsoid", "unknown"]
BORDER_NODES = 8  # of the first triangulation, along each side


class TerrainConfig(Table):
    """The ground of a scene, declared in `scene.toml`; without it the ground is flat, at z = 0.

    Attributes:
        shape: name of the ground's shape in `city.xml`.
        source: file that the heights are from.
        datum_m: height of z = 0 above the zero of `reference` [m].
        reference: vertical reference of the file's heights.
        kind: of that reference.
    """

    shape: str = Field(min_length=1, max_length=200)
    source: str = Field("", max_length=300)
    datum_m: Number = Field(0.0, ge=-12_000, le=100_000)
    reference: str = Field("not declared", max_length=200)
    kind: Kind = "unknown"


@dataclass(frozen=True, eq=False)
class HeightGrid:
    """Heights of the ground at the nodes of a regular grid in the local frame.

    Attributes:
        x_m: (nx,) east coordinates, ascending [m].
        y_m: (ny,) north coordinates, ascending [m].
        height_m: (ny, nx) heights above the zero of the vertical reference [m].
        filled: share of the nodes that the source has no height for; they have the nearest one.
        reference: name of the vertical reference, for people.
        kind: of the reference.
        notes: on how the source was read.
    """

    x_m: np.ndarray
    y_m: np.ndarray
    height_m: np.ndarray
    filled: float = 0.0
    reference: str = "not declared"
    kind: Kind = "unknown"
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class GroundMesh:
    """Triangles of the ground, all facing up.

    Attributes:
        vertices: (v, 3) [m].
        faces: (f, 3) indices of vertices, counter-clockwise seen from above.
        max_error_m: largest distance of a node of the grid from the triangles, upwards [m].
        rms_error_m: root mean square of these distances [m].
    """

    vertices: np.ndarray
    faces: np.ndarray
    max_error_m: float
    rms_error_m: float


def triangulate(grid: HeightGrid, tolerance_m: float, max_faces: int) -> GroundMesh:
    """Approximate the heights of a grid by few triangles.

    Args:
        grid: heights; at least 2 x 2 nodes.
        tolerance_m: distance of a node from the triangles that is small enough [m].
        max_faces: number of triangles that is not exceeded by more than the borders' first ones.

    Returns:
        Triangles whose corners are nodes of the grid; they cover its rectangle without gaps.
    """
    height_m = np.asarray(grid.height_m, dtype=float)
    rows, columns = np.indices(height_m.shape)
    # Whole numbers: nodes in a line stay in a line, and the rectangle has no notches
    node = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    z_m, chosen = height_m.ravel(), _border(height_m.shape)
    while True:
        mesh = Delaunay(node[chosen])
        triangle, error_m = _errors(mesh, node, z_m, chosen)
        room = (max_faces - len(mesh.simplices)) // 2  # a node in a triangle makes two more
        worst = _worst_of_each(triangle, error_m, tolerance_m)[:max(room, 0)]
        if not len(worst):
            break
        chosen = np.union1d(chosen, worst)
    corners = np.column_stack([grid.x_m[columns.ravel()[chosen]], grid.y_m[rows.ravel()[chosen]],
                               z_m[chosen]])
    return GroundMesh(corners, _upward(node[chosen], mesh.simplices), float(error_m.max()),
                      float(np.sqrt(np.mean(error_m**2))))


def _border(shape: tuple[int, ...]) -> np.ndarray:
    """Return the (n,) flat indices of some nodes along the border, the corners among them."""
    across, up = (np.unique(np.linspace(0, size - 1, min(size, BORDER_NODES)).round().astype(int))
                  for size in (shape[1], shape[0]))
    return np.unique(np.concatenate([across, (shape[0] - 1) * shape[1] + across,
                                     up * shape[1], up * shape[1] + shape[1] - 1]))


def _upward(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the (f, 3) triangles of points (n, 2) counter-clockwise, without flat ones."""
    a, b, c = points[faces].swapaxes(0, 1)
    double_area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    faces = np.where((double_area < 0)[:, None], faces[:, ::-1], faces)
    return faces[np.abs(double_area) > 0.5].astype(np.int64)  # of whole numbers: 0, or 1 and more


def _errors(mesh: Delaunay, node: np.ndarray, z_m: np.ndarray,
            chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the (n,) triangle that each node lies in, and its distance from it, upwards [m]."""
    triangle = mesh.find_simplex(node)
    affine = mesh.transform[triangle]
    share = np.einsum("nij,nj->ni", affine[:, :2], node - affine[:, 2])
    share = np.column_stack([share, 1 - share.sum(axis=1)])
    at_m = np.einsum("ni,ni->n", share, z_m[chosen][mesh.simplices[triangle]])
    error_m = np.nan_to_num(np.abs(at_m - z_m))  # not a number: in a flat triangle of the border
    error_m[chosen] = 0.0
    return triangle, error_m


def _worst_of_each(triangle: np.ndarray, error_m: np.ndarray, tolerance_m: float) -> np.ndarray:
    """Return the farthest node of each triangle that has one beyond a tolerance, worst first."""
    order = np.argsort(-error_m, kind="stable")
    order = order[error_m[order] > tolerance_m]
    _, first = np.unique(triangle[order], return_index=True)
    return order[np.sort(first)]
