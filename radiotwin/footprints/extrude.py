"""Prisms -> watertight meshes, one for each group of prisms of one material that touch.

Walls that lie on one another would be hit twice by a ray tracer, so neighbours of one material are united, and between
neighbours of different materials a slot of 2 cm is left open.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from radiotwin.footprints.solids import Prism, neighbours
from radiotwin.progress import progress
from radiotwin.scene.materials import Material

SLOT_M = 0.02


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
    """Unite prisms that touch; the largest block of each group is whole, others give way to it."""
    pairs = np.array(neighbours(prisms), dtype=int).reshape(-1, 2)
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(prisms), len(prisms)))
    group = connected_components(graph, directed=False)[1] if len(prisms) else np.zeros(0, dtype=int)
    order = np.argsort(group, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(group[order])) + 1) if len(prisms) else []
    blocks = []
    with progress("extruding buildings", total=len(prisms)) as advance:
        for members in groups:
            blocks += _unite(prisms, members)
            advance(len(members))
    return blocks


def extrude(area: shapely.Polygon, bottom_m: float, top_m: float) -> trimesh.Trimesh:
    """A watertight prism over a polygon, triangulated by earcut."""
    mesh = trimesh.creation.extrude_polygon(area, height=top_m - bottom_m, engine="earcut")
    mesh.apply_translation([0, 0, bottom_m])
    return mesh


def _unite(prisms: Sequence[Prism], members: np.ndarray) -> list[Block]:
    by_material: dict[Material, list[int]] = {}
    volume = {i: prisms[i].area.area * (prisms[i].height.top_m - prisms[i].height.bottom_m) for i in members.tolist()}
    for index in sorted(volume, key=volume.get, reverse=True):
        by_material.setdefault(prisms[index].material, []).append(index)
    blocks, before = [], []
    for material, indices in by_material.items():
        solids = [extrude(prisms[i].area, prisms[i].height.bottom_m, prisms[i].height.top_m) for i in indices]
        mesh = solids[0] if len(solids) == 1 else trimesh.boolean.union(solids, engine="manifold")
        around = [_inflated(prisms[i]) for i in before
                  if any(prisms[i].area.intersects(prisms[k].area) for k in indices)]
        if around:
            mesh = trimesh.boolean.difference([mesh, *around], engine="manifold")
        if len(mesh.faces):
            blocks.append(Block(indices, material, mesh))
        before += indices
    return blocks


def _inflated(prism: Prism) -> trimesh.Trimesh:
    wide = prism.area.buffer(SLOT_M, join_style="mitre")
    return extrude(wide, prism.height.bottom_m - SLOT_M, prism.height.top_m + SLOT_M)
