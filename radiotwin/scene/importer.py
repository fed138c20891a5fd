"""A foreign city, read into the scene's frame with clean meshes, and with all that was found on the way."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from radiotwin.errors import BadInput
from radiotwin.progress import progress
from radiotwin.scene import checks
from radiotwin.scene.material_mapping import map_materials, safe_name, unique_name
from radiotwin.scene.materials import Material
from radiotwin.scene.meshes import clean, load_shape
from radiotwin.scene.mitsuba_xml import DeclaredShape, read_mitsuba_xml
from radiotwin.scene.problems import Problem, listed
from radiotwin.scene.surfaces import FLAT_M, Surfaces

FAR_M = 100e3  # beyond, single precision rounds positions to 8 mm and more
RESERVED_NAMES = {"merged-shapes", "__root__"}  # Sionna RT's own
MOST_UNREADABLE = 5


@dataclass(frozen=True, eq=False)
class ImportedCity:
    """A city in the scene's frame.

    Attributes:
        names: of the shapes; unique and safe.
        materials: of the shapes; None only together with an error among the problems.
        surfaces: the meshes of the shapes, or None when no shape could be read.
        ground: (f,) bool, the faces of `surfaces` that are ground.
        problems: in the order found.
        moved_m: what was added to the file's coordinates (after scale and axis).
    """

    names: list[str]
    materials: list[Material | None]
    surfaces: Surfaces | None
    ground: np.ndarray
    problems: list[Problem]
    moved_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


def import_city(
    path: Path,
    overrides: Mapping[str, str],
    scale: float | None = None,
    up: str | None = None,
    bbox: tuple[float, float, float, float] | None = None,
) -> ImportedCity:
    """Read and clean a city.

    Args:
        path: Mitsuba or Sionna RT XML file.
        overrides: name of a material in the file -> ITU material to take for it.
        scale: factor to metres; None: 1, with a warning where the city looks as if it were something else.
        up: axis that points up; None: z, with an error where it looks as if it were another.
        bbox: (x_min, y_min, x_max, y_max) [m], after `scale` and `up`: only shapes that reach into it
            are kept.

    Raises:
        BadInput: the XML file cannot be read, an override fits nothing, or nothing lies within `bbox`.
    """
    declared = read_mitsuba_xml(path)
    if not declared.shapes:
        raise BadInput(f"{path} declares no shapes; give a scene file with <shape> elements")
    materials, problems = map_materials(declared.shapes, declared.materials, overrides)
    names, name_problems = _safe_names(declared.shapes)
    meshes, mesh_problems = _load_meshes(declared.shapes, names, scale or 1.0, up or "z")
    problems += name_problems + mesh_problems
    kept = [index for index, mesh in enumerate(meshes) if mesh is not None]
    names, materials = [names[index] for index in kept], [materials[index] for index in kept]
    if not kept:
        problems.append(Problem("error", "", f"{path}: no shape could be read"))
        return ImportedCity([], [], None, np.zeros(0, dtype=bool), problems)
    surfaces, sense_problems = _outward(Surfaces([meshes[index] for index in kept]), names)
    names, materials, surfaces, join_problems = _joined(names, materials, surfaces)
    ground = surfaces.ground_faces()
    problems += sense_problems + join_problems
    problems += checks.check_up_axis(surfaces, ground) if up is None else []
    problems += checks.check_units(surfaces) if scale is None else []
    city = ImportedCity(names, materials, surfaces, ground, problems)
    if bbox is not None:
        city = _cut(city, bbox)
    city = _move_to_origin(city)
    assert city.surfaces is not None
    city.problems.extend(checks.check_ground(city.ground, city.surfaces))
    city.problems.extend(checks.check_closed(city.surfaces, city.ground, city.names))
    return city


def _safe_names(shapes: Sequence[DeclaredShape]) -> tuple[list[str], list[Problem]]:
    taken, names, changed, double = set(RESERVED_NAMES), [], [], []
    for shape in shapes:
        wish = shape.name.removeprefix("mesh-")
        safe = safe_name(wish)
        name = unique_name(safe, taken)
        names.append(name)
        if safe != wish:
            changed.append(f"{wish} -> {name}")
        elif name != safe:
            double.append(f"{wish} -> {name}")
    problems = []
    if changed:
        problems.append(
            Problem(
                "fixed",
                "",
                f"{len(changed)} name(s) had characters that Sionna RT or a file name "
                f"cannot have; replaced by '_' ({listed(changed)})",
            )
        )
    if double:
        problems.append(
            Problem(
                "fixed",
                "",
                f"{len(double)} shape(s) had the name of another or of Sionna RT itself; "
                f"renamed ({listed(double)})",
            )
        )
    return names, problems


def _load_meshes(shapes: Sequence[DeclaredShape], names: Sequence[str], scale: float, up: str):
    """(vertices, faces) of each shape or None, and the problems."""
    meshes, unreadable, empty, slivers, polygons = [], [], [], {}, {}
    with progress("reading meshes", total=len(shapes)) as advance:
        for shape, name in zip(shapes, names):
            mesh = None
            try:
                raw = load_shape(shape)
                vertices, faces, dropped = clean(checks.upright(raw.vertices * scale, up), raw.faces)
                if dropped:
                    slivers[name] = dropped
                if raw.polygons:
                    polygons[name] = raw.polygons
                if len(faces):
                    mesh = vertices, faces
                else:
                    empty.append(name)
            except BadInput as error:
                unreadable.append(Problem("error", name, str(error)))
            meshes.append(mesh)
            advance(1)
    problems = unreadable[:MOST_UNREADABLE]
    if len(unreadable) > MOST_UNREADABLE:
        more = [problem.shape for problem in unreadable[MOST_UNREADABLE:]]
        problems.append(Problem("error", "", f"{len(more)} more shapes cannot be read ({listed(more)})"))
    if polygons:
        problems.append(
            Problem(
                "fixed",
                "",
                f"{sum(polygons.values())} faces with more than three corners in "
                f"{len(polygons)} mesh(es) were cut into triangles ({listed(list(polygons))})",
            )
        )
    if slivers:
        problems.append(
            Problem(
                "fixed",
                "",
                f"{sum(slivers.values())} degenerate triangles (without area) in "
                f"{len(slivers)} mesh(es) were left out ({listed(list(slivers))})",
            )
        )
    if empty:
        problems.append(
            Problem(
                "fixed", "", f"{len(empty)} shape(s) have an empty mesh and were left out ({listed(empty)})"
            )
        )
    return meshes, problems


def _outward(surfaces: Surfaces, names: Sequence[str]) -> tuple[Surfaces, list[Problem]]:
    """Triangles of each mesh in one sense, solids facing outwards and sheets upwards."""
    problems = []
    mixed = surfaces.inconsistent_shapes()
    if len(mixed):
        meshes = surfaces.meshes()
        for index in mixed:
            mesh = trimesh.Trimesh(*meshes[index][:2], process=False)  # type: ignore[misc]
            trimesh.repair.fix_winding(mesh)
            meshes[index] = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        surfaces = Surfaces(meshes)
        problems.append(
            Problem(
                "fixed",
                "",
                f"{len(mixed)} mesh(es) had neighbouring triangles of opposite senses; "
                f"made equal ({listed([names[index] for index in mixed])})",
            )
        )
    inward = surfaces.inward()
    if inward.any():
        turned = np.unique(surfaces.shape[inward])
        surfaces = surfaces.turned(inward)
        problems.append(
            Problem(
                "fixed",
                "",
                f"{len(turned)} mesh(es) had triangles that faced inwards or down; turned "
                f"round ({listed([names[index] for index in turned])})",
            )
        )
    return surfaces, problems


def _joined(names: list[str], materials: list[Material | None], surfaces: Surfaces):
    """Roofs and walls of one material made one mesh, so that Sionna RT finds the edge between them."""
    pairs = surfaces.seams()
    pairs = pairs[[materials[a] is not None and materials[a] == materials[b] for a, b in pairs]]
    if len(pairs) == 0:
        return names, materials, surfaces, []
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(surfaces.shapes, surfaces.shapes))
    building = connected_components(graph, directed=False)[1]
    meshes, whole, first = surfaces.meshes(), [], []
    for index in range(building.max() + 1):
        members = np.flatnonzero(building == index)
        mesh: Any = trimesh.util.concatenate([trimesh.Trimesh(*meshes[one], process=False) for one in members])
        whole.append(clean(mesh.vertices, mesh.faces)[:2] if len(members) > 1 else meshes[members[0]])
        first.append(members[0])
    message = (
        f"{surfaces.shapes - len(whole)} mesh(es) were joined to others of the same material, roofs to walls, "
        "so that the edge between them diffracts"
    )
    return (
        [names[index] for index in first],
        [materials[index] for index in first],
        Surfaces(whole),
        [Problem("fixed", "", message)],
    )


def _cut(city: ImportedCity, bbox: tuple[float, float, float, float]) -> ImportedCity:
    """Whole shapes, and single triangles of the ground, whose bounds reach into the box."""
    assert city.surfaces is not None  # some shape was read
    surfaces = city.surfaces
    low, high = surfaces.face_bounds()
    overlaps = ((low[:, :2] <= bbox[2:]) & (high[:, :2] >= bbox[:2])).all(axis=1)
    shape_low, shape_high = np.full((surfaces.shapes, 2), np.inf), np.full((surfaces.shapes, 2), -np.inf)
    solid = ~city.ground
    np.minimum.at(shape_low, surfaces.shape[solid], low[solid, :2])
    np.maximum.at(shape_high, surfaces.shape[solid], high[solid, :2])
    reaches = ((shape_low <= bbox[2:]) & (shape_high >= bbox[:2])).all(axis=1)
    keep = np.where(city.ground, overlaps, np.asarray(reaches)[surfaces.shape])
    shapes = np.unique(surfaces.shape[keep])
    if len(shapes) == 0:
        (x_min, y_min, _), (x_max, y_max, _) = surfaces.vertices.min(axis=0), surfaces.vertices.max(axis=0)
        raise BadInput(
            f"the part x {bbox[0]:g} to {bbox[2]:g} m, y {bbox[1]:g} to {bbox[3]:g} m is empty; the city "
            f"lies in x {x_min:.0f} to {x_max:.0f} m, y {y_min:.0f} to {y_max:.0f} m"
        )
    return replace(
        city,
        names=[city.names[index] for index in shapes],
        materials=[city.materials[index] for index in shapes],
        surfaces=Surfaces(surfaces.meshes(keep)),
        ground=city.ground[keep],
    )


def _move_to_origin(city: ImportedCity) -> ImportedCity:
    """Flat ground to z = 0 (uneven ground: its lowest point), and a city far away to around the origin."""
    assert city.surfaces is not None  # some shape was read
    vertices, problems = city.surfaces.vertices, list(city.problems)
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    offset = np.zeros(3)
    if np.abs(middle[:2]).max() > FAR_M:
        offset[:2] = -np.round(middle[:2])
        problems.append(
            Problem(
                "fixed",
                "",
                f"the city lies {np.hypot(*middle[:2]) / 1000:.0f} km from the origin, too "
                f"far for single precision: moved by ({offset[0]:.0f}, {offset[1]:.0f}) m",
            )
        )
    if city.ground.any():
        corners = city.surfaces.faces[city.ground & (city.surfaces.area_vectors[:, 2] > 0)]
        lowest, highest = vertices[corners, 2].min(), vertices[corners, 2].max()
        datum = lowest if highest - lowest > 2 * FLAT_M else city.surfaces.level_m(city.ground)
        if datum != 0:
            offset[2] = -datum
            problems.append(
                Problem(
                    "fixed", "", f"the ground was at z = {datum:.3f} m: moved to 0, the datum of all heights"
                )
            )
        if highest - lowest > 2 * FLAT_M:
            problems.append(
                Problem(
                    "warning",
                    "",
                    f"the ground is not flat: it rises to {highest - lowest:.1f} m above "
                    "its lowest point; heights and altitudes count from that point, not from the "
                    "ground below",
                )
            )
    if not offset.any():
        return replace(city, problems=problems)
    return replace(city, problems=problems, surfaces=city.surfaces.moved(offset),
                   moved_m=(float(offset[0]), float(offset[1]), float(offset[2])))
