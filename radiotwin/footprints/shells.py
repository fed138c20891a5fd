"""Prisms of buildings that a file has in three dimensions: their shells, in the local frame.

Closed shells become solids like the extruded ones, so that coincident walls of neighbours are
united. Open ones are kept as they are, and reported. Each building stands on the flat ground, with
its lowest point: where the file has terrain below it, that is left out.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mapbox_earcut
import numpy as np
import shapely
import trimesh
from manifold3d import Error, Manifold, Mesh64
from shapely.geometry.base import BaseGeometry

from radiotwin.budgets import CORNERS, FACES
from radiotwin.footprints.features import Feature, Shell, problems_of
from radiotwin.footprints.heights import MAX_HEIGHT_M, Height
from radiotwin.footprints.material_table import MaterialTable
from radiotwin.footprints.solids import GRID_M, SLIVER_AREA_M2, Body, Prism
from radiotwin.geodesy import to_local
from radiotwin.scene.meshes import clean
from radiotwin.scene.problems import Problem
from radiotwin.scene.surfaces import Surfaces
from radiotwin.tables import Origin

_WALL_SINE = 0.02  # of a triangle's area, seen from above, below which it belongs to a wall
_DECIMALS = 4  # of corners [m]: those that are equal are one, as in `meshes.WELD_M`


def make_shell_prisms(features: Sequence[Feature], origin: Origin, table: MaterialTable
                      ) -> tuple[list[Prism], list[Problem]]:
    """Make a prism with a body from each feature that has a shell.

    Args:
        features: buildings and parts, with shells.
        origin: of the local frame.
        table: materials by tag.

    Returns:
        The prisms, and the defects that were found.
    """
    prisms: list[Prism] = []
    no_area, too_high, opened, unknown = [], [], [], []
    faces_so_far = 0
    for feature in features:
        assert feature.shell is not None
        vertices, faces = triangulate(feature.shell, origin)
        faces_so_far += len(faces)
        FACES.check(faces_so_far, "the map")
        area = _footprint(vertices, faces)
        if area.area < SLIVER_AREA_M2:
            no_area.append(feature.name)
            continue
        bottom_m, top_m = vertices[:, 2].min(), vertices[:, 2].max()
        if not 0 < top_m <= MAX_HEIGHT_M:
            too_high.append(f"{feature.name}: {top_m:.4g} m")
            continue
        body, closed = _body(vertices, faces)
        if not closed:
            opened.append(feature.name)
        if value := table.unknown(feature.tags):
            unknown.append(f"{feature.name}: {value}")
        height = Height(float(bottom_m), float(top_m), "model")
        prisms.append(Prism(feature.name, area, height, *table.material_of(feature.tags), body))
    return _with_sites(prisms), [
        *problems_of(no_area, "building(s) have no area seen from above: left out"),
        *problems_of(too_high, f"building(s) are not between 0 and {MAX_HEIGHT_M:g} m tall: left "
                               "out; are their elevations in metres?"),
        *problems_of(opened, "building(s) are not closed, or cross themselves: kept as they are, "
                             "and not united with what they touch"),
        *problems_of(unknown, "building(s) have a building:material that is not in the table; the "
                              "default was taken. Name it in --material-table or with --material "
                              "NAME=ITU")]


def _with_sites(prisms: Sequence[Prism]) -> list[Prism]:
    """Return prisms that know the area of their whole building: heights count from its ground."""
    areas: dict[str, list[BaseGeometry]] = {}
    for prism in prisms:
        areas.setdefault(prism.name, []).append(prism.area)
    sites = {name: shapely.union_all(parts) for name, parts in areas.items()}
    return [replace(prism, site=sites[prism.name]) for prism in prisms]


def elevation_fact(features: Sequence[Feature]) -> str:
    """Return where the ground of buildings was, a line for a report.

    Args:
        features: buildings with shells, at least one.
    """
    ground_m = [feature.shell.ground_m for feature in features if feature.shell is not None]
    return (f"buildings begin at {min(ground_m):.1f} to {max(ground_m):.1f} m above the file's "
            "vertical datum; each was put on the ground")


def triangulate(shell: Shell, origin: Origin) -> tuple[np.ndarray, np.ndarray]:
    """Cut the polygons of a shell into triangles.

    Args:
        shell: as in the file.
        origin: of the local frame.

    Returns:
        (v, 3) corners in the local frame, above the ground of the building [m], and (f, 3) faces.
    """
    points = shell.points
    x_m, y_m = to_local(origin, points[:, 0], points[:, 1])
    vertices = np.column_stack([x_m, y_m, points[:, 2] - shell.ground_m])
    vertices, same = np.unique(np.round(vertices, _DECIMALS), axis=0, return_inverse=True)
    same = same.reshape(-1)
    found = [np.zeros((0, 3), dtype=np.int64)]
    for rings in shell.polygons:
        faces = _cut(vertices, [same[ring] for ring in rings])
        found.append(faces)
    return vertices, np.concatenate(found)


def _cut(vertices: np.ndarray, rings: list[np.ndarray]) -> np.ndarray:
    """Return the triangles of a polygon with holes, which turn as its outline does."""
    rings = [ring[ring != np.roll(ring, 1)] for ring in rings]
    rings = [rings[0], *(ring for ring in rings[1:] if len(ring) > 2)]
    outline = vertices[rings[0]]
    if len(outline) < 3:
        return np.zeros((0, 3), dtype=np.int64)
    if len(outline) == 3 and len(rings) == 1:
        return rings[0][None]
    corners = np.concatenate(rings)
    CORNERS.check(len(corners), "the map")
    # Twice its area, as a vector (Newell)
    normal = np.cross(outline - outline[0], np.roll(outline, -1, axis=0) - outline[0]).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    flat = np.delete(vertices[corners], axis, axis=1)
    ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    ears: Any = mapbox_earcut.triangulate_float64(np.ascontiguousarray(flat), ends)
    faces = corners[ears.astype(np.int64).reshape(-1, 3)]
    a, b, c = vertices[faces].swapaxes(0, 1)
    turned = np.cross(b - a, c - a).sum(axis=0) @ normal < 0
    return faces[:, ::-1] if turned else faces


def _footprint(vertices: np.ndarray, faces: np.ndarray) -> shapely.MultiPolygon:
    """Return what a building covers, seen from above."""
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    level = np.abs(normals[:, 2]) > _WALL_SINE * np.linalg.norm(normals, axis=1)
    if not level.any():
        return shapely.MultiPolygon()
    flat: Any = shapely.polygons(corners[level][:, :, :2])
    area = shapely.union_all(shapely.set_precision(flat, GRID_M))
    parts = [part for part in shapely.get_parts(area) if part.geom_type == "Polygon"]
    return shapely.MultiPolygon(parts)


def _body(vertices: np.ndarray, faces: np.ndarray) -> tuple[Body, bool]:
    """Return the surfaces, as a solid where they are closed, and whether they are."""
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    solid = _solid(vertices, faces)
    if solid is None:  # surfaces that stand beside a solid may face either way
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        trimesh.repair.fix_winding(mesh)
        faces = np.asarray(mesh.faces)
        solid = _solid(vertices, faces)
    if solid is not None:
        return Body(solid, None), True
    cleaned = clean(vertices, faces)[:2]
    surfaces = Surfaces([cleaned])
    return Body(None, (cleaned[0], surfaces.turned(surfaces.inward()).faces)), False


def _solid(vertices: np.ndarray, faces: np.ndarray) -> Manifold | None:
    """Return the solid that triangles enclose; None where they do not."""
    solid = Manifold(Mesh64(vertices, faces.astype(np.uint64)))
    if solid.status() == Error.NoError and solid.volume() < 0:
        solid = Manifold(Mesh64(vertices, faces[:, ::-1].astype(np.uint64)))
    return solid if solid.status() == Error.NoError and solid.volume() > 0 else None
