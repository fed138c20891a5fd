"""Triangle meshes: reading OBJ and the shapes of scene files, cutting polygons, cleaning, tests."""

import io
import os
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mapbox_earcut
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from radiotwin.errors import BadInput
from radiotwin.io.budgets import CORNERS, CROSSINGS, DOCUMENT_BYTES, FACES, SHAPES, VERTICES
from radiotwin.io.inputs import read_bytes
from radiotwin.scene.mitsuba_xml import DeclaredShape, read_vector
from radiotwin.scene.ply import read_ply

WELD_M = 1e-4  # vertices equal when rounded to this are one; float32 resolves 6e-5 m at 1 km
# Height of a triangle over its longest side below which its normal is numerical noise
_MIN_ASPECT = 1e-6
_MAX_NAME = 200  # characters of an object's or a material's name
_FEW_CORNERS = 200  # a face with no more is cut within 0.01 s, even if it crosses itself
_SEGMENTS_AT_ONCE = 256  # bounds the memory of the search for crossings
# In the file's units: a city in UTM coordinates and millimetres reaches 10^10
_MAX_COORDINATE = 1e11


@dataclass(frozen=True, eq=False)
class RawMesh:
    """A mesh in the units of its file.

    Attributes:
        vertices: (v, 3)
        faces: (f, 3) triangles, indices of vertices.
        polygons: Number of faces in the file with more than three corners, which were cut.
    """

    vertices: np.ndarray
    faces: np.ndarray
    polygons: int = 0


class MeshBudget:
    """Counts the vertices and faces of a city's meshes against their budgets.

    Messages begin with `source`.
    """

    def __init__(self, source: Path) -> None:
        self._subject = f"{source} with its meshes"
        self._vertices = self._faces = 0

    def add(self, mesh: RawMesh) -> None:
        """Count a mesh; BadInput if all meshes so far have too many vertices or faces."""
        self._vertices += len(mesh.vertices)
        self._faces += len(mesh.faces)
        VERTICES.check(self._vertices, self._subject)
        FACES.check(self._faces, self._subject)


def load_shape(shape: DeclaredShape) -> RawMesh:
    """Return the mesh of a declared shape after its `to_world` transform, in the file's units.

    Raises:
        BadInput: A missing, truncated, unreadable or too large mesh file, an unsupported kind of
            shape, or coordinates that are not finite; with the mesh file, or the line of the XML
            file.
    """
    path = shape.mesh_path
    if shape.kind in ("ply", "obj"):
        if path is None:
            raise BadInput(f"{shape.node.position}: the shape names no mesh file; add "
                           '<string name="filename" value="meshes/NAME.ply"/>')
        if not os.path.exists(path):
            raise BadInput(f"mesh file {path} does not exist (named in {shape.node.position}); put "
                           "it there or remove the shape")
        if shape.kind == "ply":
            raw = cut_polygons(path, *read_ply(path))
        else:  # all objects are one mesh, as in Mitsuba
            vertices, groups = read_obj_groups(path)
            raw = cut_polygons(path, vertices, [one for found in groups.values() for one in found])
    elif shape.kind in ("cube", "rectangle", "sphere"):
        raw = _analytic(shape)
    else:
        raise BadInput(f"{shape.node.position}: a shape of type {shape.kind[:60]!r} is not read; "
                       "export it as ply (read are: ply, obj, cube, rectangle, sphere)")
    linear, offset = shape.to_world[:3, :3], shape.to_world[:3, 3]
    with np.errstate(all="ignore"):
        vertices = raw.vertices @ linear.T + offset
        mirrored = np.linalg.det(linear) < 0
    check_vertices(vertices, f"{shape.node.position}, after the transform")
    return RawMesh(vertices, raw.faces[:, ::-1] if mirrored else raw.faces, raw.polygons)


def cut_polygons(path: Path, vertices: np.ndarray, polygons: list[np.ndarray]) -> RawMesh:
    """Check polygons, and cut them into the triangles of a mesh.

    Args:
        path: File, for messages.
        vertices: (v, 3) positions.
        polygons: For each number of corners k, (n, k) indices of vertices; with k below 3, ignored.

    Raises:
        BadInput: A coordinate is not finite or too large, a face names a vertex that does not
            exist, or there are too many faces.
    """
    check_vertices(vertices, str(path))
    for group in polygons:
        wrong = (group < 0) | (group >= len(vertices))
        if wrong.any():
            raise BadInput(f"{path}: a face names vertex {group[wrong][0]}, there are "
                           f"{len(vertices)} (counted from 0); export the mesh again")
    areal = [group for group in polygons if group.ndim == 2 and group.shape[1] >= 3]
    FACES.check(sum(len(group) * (group.shape[1] - 2) for group in areal), path)
    faces = [triangulate(vertices, group) for group in areal]
    return RawMesh(vertices, np.concatenate(faces) if faces else np.zeros((0, 3), dtype=np.int64),
                   sum(len(group) for group in areal if group.shape[1] > 3))


def check_vertices(vertices: np.ndarray, source: str) -> None:
    """Raise BadInput if a coordinate of (v, 3) is not finite or too large; `source` is named."""
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():
        raise BadInput(f"{source}: vertex {np.flatnonzero(~finite)[0] + 1} is not finite (NaN or "
                       f"infinite; {np.count_nonzero(~finite)} such vertices); export the mesh "
                       "again")
    farthest = np.abs(vertices).max(axis=1, initial=0)
    if not (farthest <= _MAX_COORDINATE).all():
        row = int(farthest.argmax())
        raise BadInput(f"{source}: vertex {row + 1} is {farthest[row]:g} from the origin; allowed "
                       f"is up to {_MAX_COORDINATE:g}: correct the mesh or its transform")


def triangulate(vertices: np.ndarray, polygons: np.ndarray) -> np.ndarray:
    """Cut planar polygons, convex or not, (n, k) indices of vertices, into triangles (t, 3)."""
    k = polygons.shape[1]
    if k == 3:
        return polygons
    corners = vertices[polygons]
    ahead = np.roll(corners, -1, axis=1) - corners
    turn = np.cross(ahead, np.roll(ahead, -1, axis=1))
    from_first = corners - corners[:, :1]
    normal = np.cross(from_first, np.roll(corners, -1, axis=1) - corners[:, :1]).sum(axis=1)
    convex = (np.einsum("nki,ni->nk", turn, normal) >= 0).all(axis=1)
    fan = np.stack([np.zeros(k - 2, dtype=int), np.arange(1, k - 1), np.arange(2, k)], axis=1)
    triangles = [polygons[convex][:, fan].reshape(-1, 3)]
    triangles += [polygon[cut_polygon(points, [k])]
                  for polygon, points in zip(polygons[~convex], corners[~convex])]
    return np.concatenate(triangles)


def cut_polygon(corners: np.ndarray, ends: Sequence[int]) -> np.ndarray:
    """Cut a planar polygon with holes into triangles, oriented as its outline.

    Args:
        corners: (n, 3) corners of the rings; the first ring is the outline, others are holes.
        ends: Number of corners up to the end of each ring.

    Returns:
        (t, 3) indices of corners.
    """
    outline = corners[:ends[0]]
    # Twice its area, as a vector (Newell)
    normal = np.cross(outline - outline[0], np.roll(outline, -1, axis=0) - outline[0]).sum(axis=0)
    flat = np.ascontiguousarray(np.delete(corners, int(np.abs(normal).argmax()), axis=1))
    if len(flat) > _FEW_CORNERS:
        _check_crossings([flat[first:last] for first, last in zip((0, *ends[:-1]), ends)])
    ears: Any = mapbox_earcut.triangulate_float64(flat, np.array(ends, dtype=np.uint32))
    triangles = ears.astype(np.int64).reshape(-1, 3)
    a, b, c = corners[triangles].swapaxes(0, 1)
    turned = np.cross(b - a, c - a).sum(axis=0) @ normal < 0
    return _with_left_out_corners(triangles[:, ::-1] if turned else triangles, ends)


def _check_crossings(rings: list[np.ndarray]) -> None:
    """Raise BadInput if a polygon (rings of (n, 2) corners) crosses itself too often.

    The time to cut it into triangles grows with the square of the number of corners, or faster.
    """
    import shapely

    from radiotwin.scene.vegetation import count_meetings

    if not shapely.Polygon(rings[0], rings[1:]).is_valid:
        segments: Any = shapely.linestrings(np.concatenate(
            [np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in rings]))
        count_meetings(segments, _SEGMENTS_AT_ONCE, lambda count: CROSSINGS.check(
            count, f"a face of {len(segments):,} corners"))


def _with_left_out_corners(triangles: np.ndarray, ends: Sequence[int]) -> np.ndarray:
    """Add triangles at corners that earcut dropped because they lie on a straight line.

    Neighbouring faces still have these corners: without such triangles a closed surface would open.
    `ends` are the numbers of corners up to the end of each ring. If the ring seems to cross itself,
    the triangles are returned unchanged.
    """
    n = ends[-1]
    if len(triangles) == n + 2 * len(ends) - 4 or len(triangles) == 0:  # every corner is used
        return triangles
    start, end = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
    edges, back = set((start * n + end).tolist()), (end * n + start).tolist()
    border = edges.difference(back)
    ahead: dict[int, int] = {}  # corner -> the next one along its ring, as the triangles turn
    for first, last in zip((0, *ends[:-1]), ends):
        ring = list(range(first, last))
        forth = dict(zip(ring, ring[1:] + ring[:1]))
        known = sum((a * n + b in border) - (b * n + a in border) for a, b in forth.items())
        ahead |= forth if known >= 0 else {b: a for a, b in forth.items()}
    added = []
    for edge in border:  # an edge that skips corners of the ring: fill them in by a fan at a
        a, b = divmod(edge, n)
        corner = ahead[a]
        while corner != b and corner != a:
            added.append((a, corner, ahead[corner]))
            corner = ahead[corner]
    if not added or len(added) > n:  # more than corners: the ring crosses itself
        return triangles
    return np.concatenate([triangles, np.array(added, dtype=np.int64)])


def read_obj_groups(path: Path
                    ) -> tuple[np.ndarray, dict[tuple[str, str | None], list[np.ndarray]]]:
    """Read vertices and polygons of a Wavefront OBJ file by object (`o`, else `g`) and material.

    A file of materials (`mtllib`) is not opened.

    Returns:
        (v, 3) vertices, and (object, material) -> polygons: for each number of corners k, (n, k)
        indices of vertices.

    Raises:
        BadInput: No such file, too large, or a line with a wrong number, with its row.
    """
    vertices = array("d")
    groups: dict[tuple[str, str | None], dict[int, array]] = {}
    has_objects, name, material = False, "", None
    polygons: dict[int, array] = groups.setdefault((name, material), {})
    data = read_bytes(path, "OBJ mesh", DOCUMENT_BYTES)
    for row, line in enumerate(io.TextIOWrapper(io.BytesIO(data), "utf-8", "replace"), start=1):
        words = line.split()
        try:
            if words[:1] == ["v"]:
                x, y, z = (float(word) for word in words[1:4])
                vertices.extend((x, y, z))
            elif words[:1] == ["f"]:
                CORNERS.check(len(words) - 1, f"{path}, row {row}")
                numbers = [int(word.split("/")[0]) for word in words[1:]]
                # OBJ counts from 1, and from -1 backwards from the last vertex so far
                corners = [n - 1 if n > 0 else len(vertices) // 3 + n if n else -1
                           for n in numbers]
                polygons.setdefault(len(corners), array("q")).extend(corners)
            elif words[:1] in (["o"], ["g"], ["usemtl"]):
                value = " ".join(words[1:])[:_MAX_NAME]
                if words[0] == "usemtl":
                    material = value or None
                elif words[0] == "o" or not has_objects:
                    has_objects, name = has_objects or words[0] == "o", value
                if (name, material) not in groups:
                    SHAPES.check(len(groups), path)
                polygons = groups.setdefault((name, material), {})
        except (ValueError, OverflowError):
            raise BadInput(f"{path}, row {row}: {line.strip()[:60]!r} is not a vertex or face as "
                           "OBJ has them; export the mesh again") from None
    VERTICES.check(len(vertices) // 3, path)
    return (np.array(vertices, dtype=float).reshape(-1, 3),
            {key: [np.array(group, dtype=np.int64).reshape(-1, k)
                   for k, group in polygons.items() if k]
             for key, polygons in groups.items() if polygons})


def _analytic(shape: DeclaredShape) -> RawMesh:
    """Return the mesh of a cube, rectangle or sphere, as Mitsuba defines them."""
    import trimesh  # slow to load, and few scenes have such shapes

    if shape.kind == "cube":
        mesh = trimesh.creation.box(extents=(2, 2, 2))
        return RawMesh(mesh.vertices, mesh.faces)
    if shape.kind == "rectangle":
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
        return RawMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    radius = shape.node.number("radius", 1.0)
    if abs(radius) > _MAX_COORDINATE:
        raise BadInput(f"{shape.node.position}: a radius of {radius:g} is not possible; allowed is "
                       f"up to {_MAX_COORDINATE:g}")
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    centre = next((child for child in shape.node.children
                   if child.attributes.get("name") == "center"), None)
    return RawMesh(ball.vertices + (0 if centre is None else read_vector(centre, 0.0)), ball.faces)


def clean(vertices_m: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Weld coincident vertices, and drop triangles without area and unused vertices.

    Sionna RT takes an edge for a diffracting one if two triangles share its two vertices: a mesh
    that repeats vertices for every face would never diffract.

    Returns:
        (v', 3) vertices [m], (f', 3) faces, and the number of triangles dropped.
    """
    first, index = _distinct_rows(np.round(vertices_m / WELD_M).astype(np.int64))
    faces = index[faces]
    corners = vertices_m[first][faces]
    sides = corners - np.roll(corners, 1, axis=1)
    longest = (sides**2).sum(axis=2).max(axis=1)
    double_area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    good = double_area > _MIN_ASPECT * longest
    used, faces = np.unique(faces[good], return_inverse=True)
    return vertices_m[first][used], faces.reshape(-1, 3), int(np.count_nonzero(~good))


def _distinct_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of each distinct row of (n, 3), sorted, and which one each row is, (n,).

    As `np.unique(rows, axis=0, return_index=True, return_inverse=True)`, but in a tenth of the time
    for few rows.
    """
    order = np.lexsort(rows.T[::-1])
    ordered = rows[order]
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    index = np.empty(len(rows), dtype=np.int64)
    index[order] = np.cumsum(new) - 1
    return order[new], index


def is_closed(faces: np.ndarray) -> bool:
    """Return whether a surface of triangles (f, 3) is closed and consistently oriented.

    Then the triangles run along every edge as often in one direction as in the other.
    """
    forward, backward = _edges(faces)
    return len(forward) > 0 and bool((forward == backward).all())


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the sorted keys of all directed edges of triangles, and of the reversed edges."""
    start, end = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
    count = int(faces.max(initial=0)) + 1
    return np.sort(start * count + end), np.sort(end * count + start)


def is_volume(vertices_m: np.ndarray, faces: np.ndarray) -> bool:
    """Return whether triangles enclose a volume: exactly two at every edge, normals outwards."""
    forward, backward = _edges(faces)
    if (len(forward) == 0 or (forward != backward).any()
            or (forward[1:] == forward[:-1]).any()):
        return False
    a, b, c = (vertices_m - vertices_m[0])[faces].swapaxes(0, 1)
    return bool(np.einsum("ij,ij->", a, np.cross(b, c)) > 0)


def connected(pairs: np.ndarray, count: int) -> np.ndarray:
    """Return the connected component (count,) of each node of a graph with edges (n, 2)."""
    graph = coo_matrix((np.ones(len(pairs), dtype=bool), pairs.T), shape=(count, count))
    return connected_components(graph, directed=False)[1]
