"""Prisms -> watertight meshes, one for each group of prisms of one material that touch.

Walls that lie on one another would be hit twice by a ray tracer, so neighbours of one material are united, and between
neighbours of different materials a slot of 2 cm is left open.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
import trimesh
from manifold3d import Manifold, Mesh64, OpType
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from radiotwin.footprints.solids import Prism, neighbours
from radiotwin.progress import progress
from radiotwin.scene.materials import Material
from radiotwin.scene.meshes import clean

SLOT_M = 0.02
SIMPLIFY_M = 1e-3  # what a surface may move to lose a splinter; files hold single precision, 0.1 mm at 1 km


@dataclass(frozen=True, eq=False)
class Block:
    """A body of the city.

    Attributes:
        members: indices of its prisms, the largest first.
        material: of all of them.
        mesh: watertight, normals outwards [m].
    """

    members: list[int]
    material: Material
    mesh: trimesh.Trimesh


def make_blocks(prisms: Sequence[Prism]) -> list[Block]:
    """Unite prisms of one material that touch. Where blocks of different materials meet, the larger stays whole."""
    if not prisms:
        return []
    pairs = np.array(neighbours(prisms), dtype=int).reshape(-1, 2)
    same = np.array([prisms[a].material == prisms[b].material for a, b in pairs], dtype=bool)
    graph = coo_matrix((np.ones(same.sum()), pairs[same].T), shape=(len(prisms), len(prisms)))
    block_of = connected_components(graph, directed=False)[1]
    volume_m3 = np.array([prism.area.area * (prism.height.top_m - prism.height.bottom_m) for prism in prisms])
    block_m3 = np.bincount(block_of, volume_m3)
    before: dict[int, set[int]] = {}  # block -> prisms of larger blocks that it gives way to
    for a, b in pairs[~same]:
        large, small = sorted((a, b), key=lambda i: (-block_m3[block_of[i]], block_of[i]))
        before.setdefault(int(block_of[small]), set()).add(int(large))
    blocks = []
    with progress("extruding buildings", total=len(block_m3)) as advance:
        for block, members in enumerate(_members(block_of)):
            members = sorted(members, key=lambda i: -volume_m3[i])
            solid = Manifold.batch_boolean([_solid(prisms[i]) for i in members], OpType.Add)
            if block in before:
                around = Manifold.batch_boolean([_solid(prisms[i], SLOT_M) for i in sorted(before[block])], OpType.Add)
                solid = solid - around
            solid = solid.simplify(SIMPLIFY_M)
            if not solid.is_empty():
                blocks.append(Block(members, prisms[members[0]].material, _mesh(solid)))
            advance(1)
    return blocks


def extrude(area: shapely.Polygon, bottom_m: float, top_m: float) -> trimesh.Trimesh:
    """A watertight prism over a polygon, triangulated by earcut."""
    mesh = trimesh.creation.extrude_polygon(area, height=top_m - bottom_m, engine="earcut")
    mesh.apply_translation([0, 0, bottom_m])
    return mesh


def _members(block_of: np.ndarray) -> list[list[int]]:
    order = np.argsort(block_of, kind="stable")
    return [part.tolist() for part in np.split(order, np.flatnonzero(np.diff(block_of[order])) + 1)]


def _solid(prism: Prism, wider_m: float = 0.0) -> Manifold:
    area = prism.area.buffer(wider_m, join_style="mitre") if wider_m else prism.area
    mesh = extrude(area, prism.height.bottom_m - wider_m, prism.height.top_m + wider_m)
    return Manifold(Mesh64(np.ascontiguousarray(mesh.vertices, dtype=np.float64), mesh.faces.astype(np.uint64)))


def _mesh(solid: Manifold) -> trimesh.Trimesh:
    """With corners that lie together made one and triangles without area dropped, unless that opens the mesh: where
    a solid touches itself along an upright edge, its two sides need corners of their own."""
    found = solid.to_mesh64()
    vertices, faces, _ = clean(found.vert_properties[:, :3], found.tri_verts.astype(np.int64))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if mesh.is_volume:
        return mesh
    return trimesh.Trimesh(found.vert_properties[:, :3], found.tri_verts.astype(np.int64), process=False)
