"""Extrusion of prisms to watertight meshes, one for each block of touching prisms of one material.

A ray tracer would hit coincident walls twice: so neighbours of one material are united, and a slot
of 2 cm is left between neighbours of different materials.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mapbox_earcut
import numpy as np
import shapely
import trimesh
from manifold3d import Manifold, OpType

from radiotwin.errors import BadInput
from radiotwin.runtime.console import progress
from radiotwin.scene.materials import Material
from radiotwin.scene.meshes import clean, connected, is_volume
from radiotwin.scene.readers.solids import GRID_M, Contacts, Prism, closed_solid

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
MIN_ROOF_COSINE = 0.2  # between a roof's normal and the vertical: slopes of up to 78 degrees
SLOT_M = 0.02  # [m], more than the 1 cm below which the 3D map takes two surfaces for one
# [m], tolerance for removing splinters; files have single precision, 0.1 mm at 1 km
SIMPLIFY_M = 1e-3


@dataclass(frozen=True, eq=False)
class Block:
    """Touching prisms of one material, as one mesh.

    Attributes:
        members: indices of the prisms, the largest first.
        material: material of all of them.
        mesh: watertight with outward normals, unless a 3D model is open [m].
    """

    members: list[int]
    material: Material
    mesh: trimesh.Trimesh


def make_blocks(prisms: Sequence[Prism], contacts: Contacts) -> list[Block]:
    """Unite buildings or parts (prisms) of one material that share a wall, not only a corner.

    Where blocks of different materials overlap or touch, the smaller one is cut back.
    """
    is_open = np.array([isinstance(prism.model_surfaces, tuple) for prism in prisms])
    pairs = contacts.pairs[contacts.shared_m > GRID_M]
    pairs = pairs[~is_open[pairs].any(axis=1)]
    same = np.array([prisms[a].material == prisms[b].material for a, b in pairs], dtype=bool)
    block_of = connected(pairs[same], len(prisms))
    volume_m3 = np.array([prism.area.area * (prism.height.top_m - prism.height.bottom_m)
                          for prism in prisms])
    block_m3 = np.bincount(block_of, volume_m3)
    cut_by: dict[int, set[int]] = {}  # block -> touching prisms of larger blocks
    for a, b in pairs[~same]:
        large, small = sorted((a, b), key=lambda i: (-block_m3[block_of[i]], block_of[i]))
        cut_by.setdefault(int(block_of[small]), set()).add(int(large))
    order = np.argsort(block_of, kind="stable")
    blocks = []
    with progress("extruding buildings", total=len(block_m3)) as advance:
        for block, part in enumerate(np.split(order, np.cumsum(np.bincount(block_of))[:-1])):
            members = sorted(part.tolist(), key=lambda i: -volume_m3[i])
            advance(1)
            surfaces = prisms[members[0]].model_surfaces
            if isinstance(surfaces, tuple):
                vertices, faces = surfaces
                rise_m = prisms[members[0]].height.top_m - vertices[:, 2].max()
                mesh = trimesh.Trimesh(vertices + [0, 0, rise_m], faces, process=False)
                blocks.append(Block(members, prisms[members[0]].material, mesh))
                continue
            solid = _union([_prism_solid(prisms[i]) for i in members])
            if block in cut_by:
                solid -= _union([_prism_solid(prisms[i], SLOT_M) for i in sorted(cut_by[block])])
            solid = solid.simplify(SIMPLIFY_M)
            if not solid.is_empty():
                blocks.append(Block(members, prisms[members[0]].material, _cleaned_mesh(solid)))
    return blocks


def split_roof(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, trimesh.Trimesh | None]:
    """Split a mesh into walls with bottom, and roofs: upward faces of slopes below 78 degrees.

    The roofs are None if no face, or every face, is one.
    """
    is_roof = mesh.face_normals[:, 2] > MIN_ROOF_COSINE
    if is_roof.all() or not is_roof.any():
        return mesh, None
    walls, roof = (trimesh.Trimesh(mesh.vertices, mesh.faces[part], process=False)
                   for part in (~is_roof, is_roof))
    for part in (walls, roof):
        part.remove_unreferenced_vertices()
    return walls, roof


def _union(solids: list[Manifold]) -> Manifold:
    """Return the union of solids."""
    return Manifold.batch_boolean(solids, OpType.Add)


def _prism_solid(prism: Prism, wider_m: float = 0.0) -> Manifold:
    """Return a building or part as a solid, with all its faces moved outwards by `wider_m`."""
    if prism.model_surfaces is not None:
        solid = _placed_model(prism)
        return _union([solid.translate(wider_m * corner) for corner in _CORNERS]) if wider_m \
            else solid
    assert isinstance(prism.area, shapely.Polygon)
    area = prism.area.buffer(wider_m, join_style="mitre") if wider_m else prism.area
    return _extruded(area, prism.height.bottom_m - wider_m, prism.height.top_m + wider_m)


def _placed_model(prism: Prism) -> Manifold:
    """Return the solid of a building from a 3D model, moved so that its top is at the prism's.

    On terrain the prism's bottom is lower than the moved solid's: vertical walls fill the gap.
    """
    assert isinstance(prism.model_surfaces, Manifold)
    _, _, low_m, _, _, high_m = prism.model_surfaces.bounding_box()
    rise_m, height = prism.height.top_m - high_m, prism.height
    solid = prism.model_surfaces.translate((0, 0, rise_m))
    if low_m + rise_m - height.bottom_m <= GRID_M:
        return solid
    return _union([solid, *(_extruded(polygon, height.bottom_m, low_m + rise_m)
                            for polygon in shapely.get_parts(prism.area))])


def _extruded(footprint: shapely.Polygon, bottom_m: float, top_m: float) -> Manifold:
    """Return the prism on a footprint between two heights [m]; BadInput if impossible."""
    rings = [shapely.get_coordinates(ring) for ring in (footprint.exterior, *footprint.interiors)]
    points, ends = np.concatenate(rings), np.cumsum([len(ring) for ring in rings])
    roof: np.ndarray = mapbox_earcut.triangulate_float64(points, ends).reshape(-1, 3)
    corner = np.arange(len(points))
    corner[ends - 1] = [0, *ends[:-1]]  # a ring's last point repeats its first
    used, roof = np.unique(corner[roof], return_inverse=True)  # drops points on straight walls
    points, roof, n = points[used], roof.reshape(-1, 3), len(used)
    (ax, ay), (bx, by) = ((points[roof[:, side]] - points[roof[:, 0]]).T for side in (1, 2))
    if (ax * by - ay * bx).sum() < 0:
        roof = roof[:, ::-1]
    # A wall stands on each edge that only one triangle of the roof has
    start, end = roof[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
    outer = ~np.isin(start * n + end, end * n + start)
    start, end = start[outer], end[outer]
    walls = np.stack([end + n, start + n, end, end, start + n, start], axis=1).reshape(-1, 3)
    height_m = np.repeat([bottom_m, top_m], n)
    vertices = np.column_stack([np.tile(points, (2, 1)), height_m])
    faces = np.concatenate([roof[:, ::-1], roof + n, walls])
    solid = closed_solid(vertices, faces)
    if solid is None:
        raise BadInput(f"the outline around x = {points[0, 0]:.1f} m, y = {points[0, 1]:.1f} m "
                       "cannot be cut into triangles; simplify it in the map, or leave it out")
    return solid


def _cleaned_mesh(solid: Manifold) -> trimesh.Trimesh:
    """Return the mesh of a solid, with coincident corners merged unless that would open it.

    Where a solid touches itself along a vertical edge, both sides need corners of their own.
    """
    found = solid.to_mesh64()
    vertices, faces = found.vert_properties[:, :3], found.tri_verts.astype(np.int64)
    cleaned = clean(vertices, faces)[:2]
    if is_volume(*cleaned):
        vertices, faces = cleaned
    return trimesh.Trimesh(vertices, faces, process=False)
