"""The folder of a scene: reading and writing its city, replacing it safely, finding its source.

The author of a scene's `city.xml` and meshes may be unknown: everything that uses the geometry
reads it by this module. The ray tracer loads a copy that is written here from the parsed shapes,
in the form that Sionna RT 2.2 loads (one binary PLY file per shape), never the scene's own file.
"""

from __future__ import annotations

import filecmp
import os
import re
import shutil
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.io.files import require_folder
from radiotwin.io.forms import MAX_COORDINATE_M
from radiotwin.io.inputs import is_within
from radiotwin.runtime.console import progress
from radiotwin.scene.materials import (
    RESERVED_NAMES,
    Material,
    Names,
    map_materials,
    safe_name,
)
from radiotwin.scene.meshes import MeshBudget, RawMesh, load_shape
from radiotwin.scene.mitsuba_xml import DeclaredCity, read_mitsuba_xml
from radiotwin.scene.models import UP_AXES
from radiotwin.scene.ply import write_ply
from radiotwin.scene.streets import STREETS

if TYPE_CHECKING:
    import trimesh

EARLIER = "scene.toml.old"  # the scene.toml that a new one replaced
SCENE_FILES = frozenset({"scene.toml", EARLIER, "city.xml", "meshes", "preview.png",
                         "buildings.csv", STREETS})
MAP_SUFFIXES = ".osm, .osm.pbf, .geojson, .gpkg, .parquet, .shp, .zip, .json, .jsonl, .gml"


@dataclass(frozen=True, eq=False)
class CityShape:
    """One shape of a city: a mesh of one material.

    Attributes:
        name: Unique in the city; letters, digits, `_` and `-`.
        mesh: Triangles in the scene's frame [m].
        material: Radio material.
    """

    name: str
    mesh: trimesh.Trimesh
    material: Material


def write_city(folder: Path | str, shapes: Sequence[CityShape]) -> None:
    """Write `city.xml` and `meshes/*.ply` into an existing folder.

    A shape's name must differ from those of all shapes and materials: Sionna RT keeps both in one
    register.
    """
    folder = Path(folder)
    (folder / "meshes").mkdir(exist_ok=True)
    root = ET.Element("scene", version="2.1.0")
    for material in sorted({shape.material for shape in shapes}, key=lambda one: one.name):
        root.append(_material_element(material))
    with progress("writing meshes", total=len(shapes)) as advance:
        for shape in shapes:
            element = ET.SubElement(root, "shape", type="ply", id=f"mesh-{shape.name}")
            ET.SubElement(element, "string", name="filename", value=f"meshes/{shape.name}.ply")
            # Otherwise Mitsuba smooths the normals of walls that share vertices, and reflections
            # go astray
            ET.SubElement(element, "boolean", name="face_normals", value="true")
            ET.SubElement(element, "ref", id=f"mat-{shape.material.name}", name="bsdf")
            write_ply(folder / "meshes" / f"{shape.name}.ply", shape.mesh.vertices,
                      shape.mesh.faces)
            advance(1)
    ET.indent(root)
    ET.ElementTree(root).write(folder / "city.xml", encoding="utf-8", xml_declaration=True)


def _material_element(material: Material) -> ET.Element:
    """Return the `<bsdf>` element of a material."""
    # The identifier must not begin with "itu_": Sionna RT rebuilds such a material from its type
    # and thickness and drops its scattering.
    if material.itu is not None:
        element = ET.Element("bsdf", type="itu-radio-material", id=f"mat-{material.name}")
        ET.SubElement(element, "string", name="type", value=material.itu)
    else:
        element = ET.Element("bsdf", type="radio-material", id=f"mat-{material.name}")
        _add_float(element, "relative_permittivity", material.relative_permittivity)
        _add_float(element, "conductivity", material.conductivity_s_per_m)
        # Without a colour, Sionna RT draws one at random
        ET.SubElement(element, "rgb", name="color", value="0.6 0.6 0.6")
    _add_float(element, "thickness", material.thickness_m)
    if material.scattering_coefficient:
        _add_float(element, "scattering_coefficient", material.scattering_coefficient)
        _add_float(element, "xpd_coefficient", material.xpd_coefficient)
    return element


def _add_float(element: ET.Element, name: str, value: float | None) -> None:
    """Add a `<float>` to an element, with all digits of its value."""
    assert value is not None  # a material outside the ITU table has both constants
    ET.SubElement(element, "float", name=name, value=repr(float(value)))


def read_triangles(xml_path: Path | str) -> list[tuple[RawMesh, Material | None, str]]:
    """Read mesh, material (None: unknown) and name of every shape of a `city.xml`, in its order.

    Raises:
        BadInput: No such file, malformed XML, an element or a mesh that cannot be read, or a file
            outside the folder.
    """
    declared = _parse_city_xml(Path(xml_path))
    materials = map_materials(declared.shapes, declared.materials, {})[0]
    names = [shape.name.removeprefix("mesh-") for shape in declared.shapes]
    return list(zip(_load_meshes(Path(xml_path), declared), materials, names, strict=True))


def read_city(xml_path: Path | str) -> list[CityShape]:
    """Read the shapes of a `city.xml` with their materials, in the file's order.

    Names that Sionna RT or a file system would not accept are replaced. A city that `write_city`
    wrote keeps its names, and written again has the same bytes.

    Raises:
        BadInput: As `read_triangles`; or a shape without a known material.
    """
    import trimesh  # slow to load, and not needed for the 3D map

    declared = _parse_city_xml(Path(xml_path))
    materials, problems = map_materials(declared.shapes, declared.materials, {})
    errors = [problem.message for problem in problems if problem.severity == "error"]
    if errors:
        raise BadInput("\n".join([f"{xml_path}: not every shape has a usable material:", *errors]))
    taken = Names(RESERVED_NAMES)
    names = [taken.unique(safe_name(shape.name.removeprefix("mesh-")))
             for shape in declared.shapes]
    used = sorted({material for material in materials if material is not None}, key=repr)
    unique = {material: replace(material, name=taken.unique(material.name)) for material in used}
    meshes = _load_meshes(Path(xml_path), declared)
    return [CityShape(name, trimesh.Trimesh(mesh.vertices, mesh.faces, process=False),
                      unique[material])
            for name, mesh, material in zip(names, meshes, materials) if material is not None]


def mesh_paths(xml_path: Path | str) -> set[Path]:
    """Return the mesh files that a scene folder's `city.xml` names.

    Raises:
        BadInput: No such file, malformed XML, or a mesh outside the folder.
    """
    return {shape.mesh_path for shape in _parse_city_xml(Path(xml_path)).shapes
            if shape.mesh_path is not None}


def _parse_city_xml(xml_path: Path) -> DeclaredCity:
    """Parse a scene folder's `city.xml`; BadInput if it does not exist."""
    if not os.path.lexists(xml_path):
        raise BadInput(f"{xml_path} does not exist; `radiotwin build-scene` makes a scene folder")
    return read_mitsuba_xml(xml_path, scene_folder=True)


def _load_meshes(xml_path: Path, declared: DeclaredCity) -> list[RawMesh]:
    """Load the meshes of a city, and check that they are triangles near the origin."""
    meshes, budget = [], MeshBudget(xml_path)
    for shape in declared.shapes:
        mesh = load_shape(shape)
        budget.add(mesh)
        farthest_m = float(np.abs(mesh.vertices).max(initial=0.0))
        if farthest_m > MAX_COORDINATE_M:
            raise BadInput(f"{shape.node.position}: the shape reaches {farthest_m:g} m from the "
                           f"origin; at most {MAX_COORDINATE_M:g} m are allowed: build the scene "
                           "with `radiotwin build-scene`, which moves it there")
        if mesh.polygons:
            raise BadInput(f"{shape.mesh_path}: has faces that are not of triangles; build the "
                           "scene with `radiotwin build-scene`")
        meshes.append(mesh)
    if not any(len(mesh.faces) for mesh in meshes):
        raise BadInput(f"{xml_path} names no meshes; build the scene with `radiotwin build-scene`")
    return meshes


def check_target(folder: Path, allowed: Set[str] = SCENE_FILES, source: Path | None = None,
                 mark: str = "scene.toml") -> None:
    """Raise BadInput if replacing a folder would erase its source, or files of other names.

    Args:
        folder: Output folder; fine if it does not exist.
        allowed: Names of files and folders that may be replaced.
        source: File that the scene is built from.
        mark: Name of a file by which a folder is recognised as replaceable.
    """
    require_folder(folder, allowed, mark)
    if source is not None and is_within(source, folder):
        raise BadInput(f"{source} lies in {folder}, which the new scene would replace; choose "
                       "another output folder")


def keep_declarations(folder: Path, new: Path) -> None:
    """Save a scene's earlier `scene.toml`, which may be edited by hand, as `scene.toml.old`.

    Args:
        folder: Scene folder that is to be replaced.
        new: Folder that replaces it, with a `scene.toml`. If the earlier one differs, it is copied
            there, with a warning; else an older `scene.toml.old` is.
    """
    before = folder / "scene.toml"
    if before.is_file() and not filecmp.cmp(before, new / "scene.toml", shallow=False):
        shutil.copyfile(before, new / EARLIER)
        warnings.warn(f"{folder} held a scene with other declarations; its scene.toml is kept as "
                      f"{EARLIER}", stacklevel=4)
    elif (folder / EARLIER).is_file():
        shutil.copyfile(folder / EARLIER, new / EARLIER)


def published_scene(name: str) -> Path:
    """Return the folder of a published scene, `rbm` or `rdm`.

    It is looked for in `scenes` of the working directory, then of the source tree that the package
    was imported from, then inside the installed package. If it is nowhere, `scenes/NAME` is
    returned, so that the message of a missing scene names it.
    """
    package = Path(__file__).parents[1]
    relative = Path("scenes") / name
    candidates = (relative, package.parent / relative, package / relative)
    return next((folder for folder in candidates if (folder / "scene.toml").is_file()), relative)


def sionna_scenes() -> dict[str, Path]:
    """Return name -> XML file of the scenes in the package sionna-rt, without importing it."""
    spec = find_spec("sionna")
    roots = [] if spec is None else spec.submodule_search_locations or []
    return {path.parent.name: path for root in roots
            for path in sorted((Path(root) / "rt" / "scenes").glob("*/*.xml"))
            if path.stem == path.parent.name}


def find_source(source: Path | str) -> Path:
    """Return the file of a scene or model, not of a map: a path, or `sionna:NAME` of sionna-rt.

    Raises:
        BadInput: Unknown name (the message lists the known ones), no such file, or neither XML nor
            a model.
    """
    text = str(source)
    if text.startswith("sionna:"):
        scenes = sionna_scenes()
        if not scenes:
            raise BadInput(f"{text}: no scenes of sionna-rt were found; install it with "
                           "`pip install 'radiotwin[trace]'`")
        name = text.removeprefix("sionna:")
        if name not in scenes:
            raise BadInput(f"{text}: sionna-rt has no scene {name!r}; it has: {', '.join(scenes)}")
        return scenes[name]
    path = Path(source)
    if not os.path.isfile(path):  # unlike Path, False for an impossible name, too
        raise BadInput(f"{path} is not a file; give a map, a Mitsuba or Sionna RT scene (.xml), a "
                       f"model ({', '.join(UP_AXES)}), or "
                       "sionna:NAME with one of: "
                       f"{', '.join(sionna_scenes()) or '(sionna-rt is not installed)'}")
    if path.suffix.lower() not in (".xml", *UP_AXES):
        raise BadInput(f"{path}: '{path.suffix}' is not read; give a map ({MAP_SUFFIXES}), a "
                       f"Mitsuba or Sionna RT scene (.xml), or a model ({', '.join(UP_AXES)})")
    return path


def scene_name(source: Path | str) -> str:
    """Return a name for the scene of a source, in the characters that `scene.toml` allows.

    >>> scene_name("sionna:munich"), scene_name("data/My city.xml")
    ('munich', 'My_city')
    """
    text = str(source)
    name = text.removeprefix("sionna:") if text.startswith("sionna:") else Path(source).stem
    return re.sub(r"[^A-Za-z0-9_.+-]", "_", name).lstrip(".")[:64] or "city"


def source_text(source: Path | str) -> str:
    """Return a source as text for `scene.toml`; bytes that are not UTF-8 are escaped."""
    return str(source).encode("utf-8", "backslashreplace").decode("utf-8")
