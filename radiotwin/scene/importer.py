"""Import of a city model: clean meshes in the scene's frame, and the problems of the file."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from radiotwin.errors import BadInput
from radiotwin.runtime.console import progress
from radiotwin.scene import checks
from radiotwin.scene.checks import Problem, error, fixed, listed, warning
from radiotwin.scene.materials import (
    RESERVED_NAMES,
    Material,
    Names,
    map_materials,
    materials_by_name,
    safe_name,
)
from radiotwin.scene.meshes import MeshBudget, RawMesh, clean, connected, load_shape
from radiotwin.scene.mitsuba_xml import read_mitsuba_xml
from radiotwin.scene.models import UP_AXES, read_model
from radiotwin.scene.surfaces import FLAT_M, Surfaces

_MAX_DISTANCE_M = 100e3  # from the origin: beyond, float32 rounds positions to 8 mm and more
_MAX_UNREADABLE = 5  # messages about single unreadable shapes; further ones are counted

Box = tuple[float, float, float, float]
Mesh = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class ImportedCity:
    """A city in the scene's frame.

    Attributes:
        names: Names of the shapes; unique and safe.
        materials: Materials of the shapes; None only together with an error among the problems.
        surfaces: Meshes of the shapes; None if no shape could be read.
        ground: (f,) bool, faces of `surfaces` that are ground.
        problems: Problems of the city, in the order found.
        moved_m: Offset that was added to the file's coordinates, after scale and axis [m].
    """

    names: list[str]
    materials: list[Material | None]
    surfaces: Surfaces | None
    ground: np.ndarray
    problems: list[Problem]
    moved_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


def import_city(path: Path, overrides: Mapping[str, str], scale: float | None = None,
                up: str | None = None, bbox: Box | None = None) -> ImportedCity:
    """Read and clean a city.

    Args:
        path: Mitsuba or Sionna RT XML file, or a model with a suffix of `UP_AXES`.
        overrides: Name of a material in the file -> ITU material to use for it.
        scale: Factor to metres; None: 1, with a warning if the city seems to be in another unit.
        up: Axis that points up; None: y in glTF, where that is a rule, and z otherwise, with an
            error if another one seems to.
        bbox: (x_min, y_min, x_max, y_max) after `scale` and `up` [m]: only shapes that reach into
            it are kept.

    Returns:
        The city with its problems.

    Raises:
        BadInput: The file cannot be read, an override matches nothing, or nothing lies within
            `bbox`.
    """
    source = _read_source(path, overrides)
    usual_up = UP_AXES.get(path.suffix.lower(), "z")
    loaded = _load_meshes(path, source, scale or 1.0, up or usual_up, bbox)
    materials, problems = source.materials_of(loaded.inside)
    names, name_problems = _safe_names([source.names[index] for index in loaded.inside])
    problems += name_problems + loaded.problems
    kept = [row for row, index in enumerate(loaded.inside) if index in loaded.meshes]
    meshes = [loaded.meshes[index] for index in loaded.inside if index in loaded.meshes]
    names, materials = [names[row] for row in kept], [materials[row] for row in kept]
    if not kept:
        if bbox is not None and loaded.bounds is not None:
            raise _empty_box_error(bbox, *loaded.bounds)
        problems.append(error(f"{path}: no shape could be read"))
        return ImportedCity([], [], None, np.zeros(0, dtype=bool), problems)
    surfaces, sense_problems = _orient(Surfaces(meshes), names)
    names, materials, surfaces, join_problems = _join_roofs_to_walls(names, materials, surfaces)
    ground = surfaces.ground_faces()
    problems += sense_problems + join_problems
    if up is None and usual_up == "z":  # a convention only; in glTF, y is up by its specification
        problems += checks.check_up_axis(surfaces, ground)
    problems += checks.check_units(surfaces) if scale is None else []
    city = ImportedCity(names, materials, surfaces, ground, problems)
    if bbox is not None:
        city = _cut_to_box(city, surfaces, bbox)
    city = _move_to_origin(city)
    assert city.surfaces is not None
    city.problems.extend(checks.check_ground(city.ground, city.surfaces))
    city.problems.extend(checks.check_closed(city.surfaces, city.ground, city.names))
    return city


@dataclass(frozen=True, eq=False)
class _Source:
    """Names of the shapes in a file, and functions of their indices: their meshes, materials."""

    names: Sequence[str]
    load: Callable[[int], RawMesh]
    materials_of: Callable[[Sequence[int]], tuple[list[Material | None], list[Problem]]]


def _read_source(path: Path, overrides: Mapping[str, str]) -> _Source:
    """Open a city's file: a mesh model or an XML scene; BadInput if an override fits no material.

    `overrides` are ITU materials by a material's name. Meshes of XML scenes are read when used.
    """
    if path.suffix.lower() in UP_AXES:
        parts = read_model(path)
        materials_by_name([part.material for part in parts], overrides)
        return _Source([part.name for part in parts], lambda index: parts[index].mesh,
                       lambda chosen: materials_by_name(
                           [parts[index].material for index in chosen], overrides, False))
    declared = read_mitsuba_xml(path)
    if not declared.shapes:
        raise BadInput(f"{path} declares no shapes; give a scene file with <shape> elements")
    map_materials(declared.shapes, declared.materials, overrides)
    return _Source([shape.name.removeprefix("mesh-") for shape in declared.shapes],
                   lambda index: load_shape(declared.shapes[index]),
                   lambda chosen: map_materials([declared.shapes[index] for index in chosen],
                                                declared.materials, overrides, False))


def _safe_names(wanted_names: Sequence[str]) -> tuple[list[str], list[Problem]]:
    """Return unique names that Sionna RT and file systems accept, and which were changed."""
    taken = Names(RESERVED_NAMES)
    names, changed, double = [], [], []
    for wanted in wanted_names:
        safe = safe_name(wanted)
        name = taken.unique(safe)
        names.append(name)
        if safe != wanted:
            changed.append(f"{wanted} -> {name}")
        elif name != safe:
            double.append(f"{wanted} -> {name}")
    problems = []
    if changed:
        problems.append(fixed(
            f"{len(changed)} name(s) had characters that Sionna RT or a file name cannot have; "
            f"replaced by '_' ({listed(changed)})"))
    if double:
        problems.append(fixed(f"{len(double)} shape(s) had the name of another or of Sionna RT "
                              f"itself; renamed ({listed(double)})"))
    return names, problems


@dataclass
class _Loaded:
    """Shapes that reach into the box or cannot be read, their meshes by index, all bounds [m]."""

    inside: list[int] = field(default_factory=list)
    meshes: dict[int, Mesh] = field(default_factory=dict)
    bounds: tuple[np.ndarray, np.ndarray] | None = None
    problems: list[Problem] = field(default_factory=list)


def _load_meshes(path: Path, source: _Source, scale: float, up: str, bbox: Box | None) -> _Loaded:
    """Read the shapes of a city, convert them to metres with z up, and clean them.

    Shapes that do not reach into the box are dropped (None: all are kept). `scale` is the factor to
    metres, `up` the file's axis that points up.
    """
    loaded = _Loaded()
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    budget = MeshBudget(path)
    unreadable, empty = [], []
    slivers: dict[str, int] = {}
    polygons: dict[str, int] = {}
    with progress("reading meshes", total=len(source.names)) as advance:
        for index, wanted in enumerate(source.names):
            advance(1)
            name = safe_name(wanted)
            try:
                raw = source.load(index)
            except BadInput as bad:
                unreadable.append(error(str(bad), name))
                loaded.inside.append(index)
                continue
            budget.add(raw)
            vertices = checks.upright(raw.vertices * scale, up)
            if len(vertices):
                lowest, highest = vertices[:, :2].min(axis=0), vertices[:, :2].max(axis=0)
                low, high = np.minimum(low, lowest), np.maximum(high, highest)
                loaded.bounds = low, high
                if bbox is not None and ((lowest > bbox[2:]) | (highest < bbox[:2])).any():
                    continue
            loaded.inside.append(index)
            vertices, faces, dropped = clean(vertices, raw.faces)
            if dropped:
                slivers[name] = dropped
            if raw.polygons:
                polygons[name] = raw.polygons
            if not len(faces):
                empty.append(name)
            else:
                loaded.meshes[index] = vertices, faces
    problems = unreadable[:_MAX_UNREADABLE]
    if len(unreadable) > _MAX_UNREADABLE:
        more = [problem.shape for problem in unreadable[_MAX_UNREADABLE:]]
        problems.append(error(f"{len(more)} more shapes cannot be read ({listed(more)})"))
    if polygons:
        problems.append(fixed(
            f"{sum(polygons.values())} faces with more than three corners in {len(polygons)} "
            f"mesh(es) were cut into triangles ({listed(list(polygons))})"))
    if slivers:
        problems.append(fixed(
            f"{sum(slivers.values())} degenerate triangles (without area) in {len(slivers)} "
            f"mesh(es) were left out ({listed(list(slivers))})"))
    if empty:
        problems.append(fixed(f"{len(empty)} shape(s) have an empty mesh and were left out "
                              f"({listed(empty)})"))
    loaded.problems = problems
    return loaded


def _orient(surfaces: Surfaces, names: Sequence[str]) -> tuple[Surfaces, list[Problem]]:
    """Turn triangles so that solids face outwards and sheets upwards; also return problems."""
    problems = []
    mixed = surfaces.inconsistent_shapes()
    if len(mixed):
        meshes = surfaces.meshes()
        for index in mixed:
            vertices, faces = meshes[index]
            mesh = trimesh.Trimesh(vertices, faces, process=False)
            trimesh.repair.fix_winding(mesh)
            meshes[index] = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        surfaces = Surfaces(meshes)
        problems.append(fixed(
            f"{len(mixed)} mesh(es) had neighbouring triangles of opposite senses; made equal "
            f"({listed([names[index] for index in mixed])})"))
    inward = surfaces.inward()
    if inward.any():
        turned = np.unique(surfaces.shape[inward])
        surfaces = surfaces.turned(inward)
        problems.append(fixed(
            f"{len(turned)} mesh(es) had triangles that faced inwards or down; turned round "
            f"({listed([names[index] for index in turned])})"))
    return surfaces, problems


def _join_roofs_to_walls(names: list[str], materials: list[Material | None], surfaces: Surfaces
                         ) -> tuple[list[str], list[Material | None], Surfaces, list[Problem]]:
    """Join meshes of one material where a roof meets a wall; also return the problems.

    Sionna RT lets an edge diffract only within a mesh. A joined mesh has its first one's name.
    """
    pairs = surfaces.seams()
    pairs = pairs[[materials[a] is not None and materials[a] == materials[b] for a, b in pairs]]
    if len(pairs) == 0:
        return names, materials, surfaces, []
    building = connected(pairs, surfaces.shapes)
    meshes, buildings, first = surfaces.meshes(), [], []
    order = np.argsort(building, kind="stable")
    for members in np.split(order, np.cumsum(np.bincount(building))[:-1]):
        first.append(members[0])
        if len(members) == 1:
            buildings.append(meshes[members[0]])
            continue
        mesh: Any = trimesh.util.concatenate(
            [trimesh.Trimesh(meshes[index][0], meshes[index][1], process=False)
             for index in members])
        buildings.append(clean(mesh.vertices, mesh.faces)[:2])
    joined = fixed(f"{surfaces.shapes - len(buildings)} mesh(es) were joined to others of the same "
                   "material, roofs to walls, so that the edge between them diffracts")
    return ([names[index] for index in first], [materials[index] for index in first],
            Surfaces(buildings), [joined])


def _cut_to_box(city: ImportedCity, surfaces: Surfaces, bbox: Box) -> ImportedCity:
    """Keep the shapes whose bounds reach into the box; of the ground, the single triangles."""
    low, high = surfaces.face_bounds()
    overlaps = ((low[:, :2] <= bbox[2:]) & (high[:, :2] >= bbox[:2])).all(axis=1)
    shape_low = np.full((surfaces.shapes, 2), np.inf)
    shape_high = np.full((surfaces.shapes, 2), -np.inf)
    solid = ~city.ground
    np.minimum.at(shape_low, surfaces.shape[solid], low[solid, :2])
    np.maximum.at(shape_high, surfaces.shape[solid], high[solid, :2])
    reaches = ((shape_low <= bbox[2:]) & (shape_high >= bbox[:2])).all(axis=1)
    keep = np.where(city.ground, overlaps, np.asarray(reaches)[surfaces.shape])
    shapes = np.unique(surfaces.shape[keep])
    if len(shapes) == 0:
        raise _empty_box_error(bbox, surfaces.vertices.min(axis=0), surfaces.vertices.max(axis=0))
    return replace(city, names=[city.names[index] for index in shapes],
                   materials=[city.materials[index] for index in shapes],
                   surfaces=Surfaces(surfaces.meshes(keep)), ground=city.ground[keep])


def _empty_box_error(bbox: Box, low: np.ndarray, high: np.ndarray) -> BadInput:
    """Return the error that the box holds no shape of a city with these bounds (2,) [m]."""
    return BadInput(f"the part x {bbox[0]:g} to {bbox[2]:g} m, y {bbox[1]:g} to {bbox[3]:g} m "
                    f"is empty; the city lies in x {low[0]:.0f} to {high[0]:.0f} m, y {low[1]:.0f} "
                    f"to {high[1]:.0f} m")


def _move_to_origin(city: ImportedCity) -> ImportedCity:
    """Move the ground (if uneven, its lowest point) to z = 0, and a far city to x = y = 0."""
    assert city.surfaces is not None  # some shape was read
    vertices, problems = city.surfaces.vertices, list(city.problems)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    offset = np.zeros(3)
    if np.abs(middle[:2]).max() > _MAX_DISTANCE_M:
        offset[:2] = -np.round(middle[:2])
        problems.append(fixed(
            f"the city lies {np.hypot(*middle[:2]) / 1000:.0f} km from the origin, too far for "
            f"single precision: moved by ({offset[0]:.0f}, {offset[1]:.0f}) m"))
    if city.ground.any():
        upward = city.ground & (city.surfaces.area_vectors[:, 2] > 0)
        corners = city.surfaces.faces[upward if upward.any() else city.ground]
        lowest, highest = vertices[corners, 2].min(), vertices[corners, 2].max()
        uneven = highest - lowest > 2 * FLAT_M
        datum = lowest if uneven else city.surfaces.level_m(city.ground)
        if datum != 0:
            offset[2] = -datum
            problems.append(fixed(f"the ground was at z = {datum:.3f} m: moved to 0, the datum of "
                                  "all heights"))
        if uneven:
            problems.append(warning(
                f"the ground is not flat: it rises to {highest - lowest:.1f} m above its lowest "
                "point; heights and altitudes count from that point, not from the ground below"))
    if not offset.any():
        return replace(city, problems=problems)
    x_m, y_m, z_m = offset.tolist()
    return replace(city, problems=problems, surfaces=city.surfaces.moved(offset),
                   moved_m=(x_m, y_m, z_m))
