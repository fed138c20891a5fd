"""One shape's triangles: read from its file or made from its kind, moved to its place, and cleaned."""

from dataclasses import dataclass
from pathlib import Path

import mapbox_earcut
import numpy as np
import trimesh

from radiotwin.errors import BadInput
from radiotwin.scene.mitsuba_xml import DeclaredShape
from radiotwin.scene.ply import read_ply

WELD_M = 1e-4
SLIVER = 1e-6  # a triangle whose height is below this share of its longest side has no usable normal


@dataclass(frozen=True, eq=False)
class RawMesh:
    """Triangles as the file gives them.

    Attributes:
        vertices: (v, 3)
        faces: (f, 3)
        polygons: how many faces of the file had more than three corners.
    """

    vertices: np.ndarray
    faces: np.ndarray
    polygons: int = 0


def load_shape(shape: DeclaredShape) -> RawMesh:
    """Triangles of a declared shape with its `to_world` transform applied, in the file's units and axes.

    Raises:
        BadInput: missing, truncated or unreadable mesh file, a kind of shape that is not read, coordinates
            that are not finite; with the mesh file, or the line of the XML file.
    """
    if shape.kind in ("ply", "obj"):
        raw = _read_mesh_file(shape)
    elif shape.kind in ("cube", "rectangle", "sphere"):
        raw = _analytic(shape)
    else:
        raise BadInput(
            f"{shape.node.place}: a shape of type '{shape.kind}' is not read; export it as ply (read are: "
            "ply, obj, cube, rectangle, sphere)"
        )
    finite = np.isfinite(raw.vertices).all(axis=1)
    if not finite.all():
        raise BadInput(
            f"{shape.mesh_path or shape.node.place}: vertex {np.flatnonzero(~finite)[0] + 1} is not finite "
            f"(NaN or infinite; {np.count_nonzero(~finite)} such vertices); export the mesh again"
        )
    linear, offset = shape.to_world[:3, :3], shape.to_world[:3, 3]
    faces = raw.faces[:, ::-1] if np.linalg.det(linear) < 0 else raw.faces
    return RawMesh(raw.vertices @ linear.T + offset, faces, raw.polygons)


def _read_mesh_file(shape: DeclaredShape) -> RawMesh:
    path = shape.mesh_path
    if path is None:
        raise BadInput(
            f"{shape.node.place}: the shape names no mesh file; add "
            '<string name="filename" value="meshes/NAME.ply"/>'
        )
    if not path.is_file():
        raise BadInput(
            f"mesh file {path} does not exist (named in {shape.node.place}); put it there or remove the shape"
        )
    vertices, polygons = read_ply(path) if shape.kind == "ply" else read_obj(path)
    for group in polygons:
        wrong = (group < 0) | (group >= len(vertices))
        if wrong.any():
            raise BadInput(
                f"{path}: a face names vertex {group[wrong][0]}, there are {len(vertices)} (counted from "
                "0); export the mesh again"
            )
    faces = [_triangles(vertices, group) for group in polygons if group.ndim == 2 and group.shape[1] >= 3]
    many = sum(len(group) for group in polygons if group.ndim == 2 and group.shape[1] > 3)
    return RawMesh(vertices, np.concatenate(faces) if faces else np.zeros((0, 3), dtype=np.int64), many)


def _triangles(vertices: np.ndarray, polygons: np.ndarray) -> np.ndarray:
    """(t, 3) triangles of (n, k) planar polygons, convex or not."""
    k = polygons.shape[1]
    if k == 3:
        return polygons
    corners = vertices[polygons]
    ahead = np.roll(corners, -1, axis=1) - corners
    turn = np.cross(ahead, np.roll(ahead, -1, axis=1))
    normal = np.cross(corners - corners[:, :1], np.roll(corners, -1, axis=1) - corners[:, :1]).sum(axis=1)
    convex = (np.einsum("nki,ni->nk", turn, normal) >= 0).all(axis=1)
    fan = np.stack([np.zeros(k - 2, dtype=int), np.arange(1, k - 1), np.arange(2, k)], axis=1)
    triangles = [polygons[convex][:, fan].reshape(-1, 3)]
    for polygon, points, axis in zip(
        polygons[~convex], corners[~convex], np.abs(normal[~convex]).argmax(axis=1)
    ):
        flat = np.ascontiguousarray(np.delete(points, axis, axis=1))
        ears = (
            mapbox_earcut.triangulate_float64(flat, np.array([k], dtype=np.uint32)).reshape(-1, 3).astype(int)
        )
        made = np.cross(points[ears[:, 1]] - points[ears[:, 0]], points[ears[:, 2]] - points[ears[:, 0]]).sum(
            axis=0
        )
        kept = np.cross(points - points[0], np.roll(points, -1, axis=0) - points[0]).sum(axis=0)
        triangles.append(polygon[ears if made @ kept >= 0 else ears[:, ::-1]])
    return np.concatenate(triangles)


def read_obj(path: Path) -> tuple[np.ndarray, list[np.ndarray]]:
    """Read vertices and polygons of a Wavefront OBJ file; all its objects are one mesh, as in Mitsuba.

    Returns:
        (v, 3) vertices, and one (n, k) array of vertex indices for each number of corners k that occurs.

    Raises:
        BadInput: a line with a wrong number, with its row.
    """
    vertices: list = []
    polygons: dict[int, list] = {}
    for row, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        words = line.split()
        try:
            if words[:1] == ["v"]:
                vertices.append([float(word) for word in words[1:4]])
                if len(vertices[-1]) < 3:
                    raise ValueError
            elif words[:1] == ["f"]:
                corners = [int(word.split("/")[0]) for word in words[1:]]
                # OBJ counts from 1, and from -1 back from the last vertex so far; 0 stands for nothing
                corners = [
                    corner - 1 if corner > 0 else len(vertices) + corner if corner else -1
                    for corner in corners
                ]
                polygons.setdefault(len(corners), []).append(corners)
        except ValueError:
            raise BadInput(
                f"{path}, row {row}: {line.strip()[:60]!r} is not a vertex or face as OBJ has them; export "
                "the mesh again"
            ) from None
    return np.array(vertices, dtype=float).reshape(-1, 3), [np.array(group) for group in polygons.values()]


def _analytic(shape: DeclaredShape) -> RawMesh:
    if shape.kind == "cube":
        mesh = trimesh.creation.box(extents=(2, 2, 2))
        return RawMesh(mesh.vertices, mesh.faces)
    if shape.kind == "rectangle":
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
        return RawMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    ball = trimesh.creation.icosphere(subdivisions=3, radius=shape.node.number("radius", 1.0))
    centre = next((child for child in shape.node.children if child.attributes.get("name") == "center"), None)
    offset = (
        np.zeros(3) if centre is None else np.array([float(centre.attributes.get(axis, 0)) for axis in "xyz"])
    )
    return RawMesh(ball.vertices + offset, ball.faces)


def clean(vertices_m: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Weld vertices that lie together, and drop triangles without area and vertices that nothing uses.

    Sionna RT finds a diffracting edge where two triangles share its two vertices, so a mesh that repeats
    vertices for every face would never diffract.

    Args:
        vertices_m: (v, 3)
        faces: (f, 3)

    Returns:
        (v', 3) vertices, (f', 3) faces, and how many triangles were dropped.
    """
    _, first, index = np.unique(
        np.round(vertices_m / WELD_M).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    faces = index.reshape(-1)[faces]
    corners = vertices_m[first][faces]
    sides = corners - np.roll(corners, 1, axis=1)
    longest = (sides**2).sum(axis=2).max(axis=1)
    double_area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    good = double_area > SLIVER * longest
    used, faces = np.unique(faces[good], return_inverse=True)
    return vertices_m[first][used], faces.reshape(-1, 3), int(np.count_nonzero(~good))
