"""The city of a scene folder: `city.xml` and its meshes, read and written.

Read the city of a scene folder: `city.xml` and its meshes, whose source may be unknown.

All that uses a scene's geometry goes through here. The ray tracer loads a file that
`radiotwin.scene.city_files` writes from what was read here, never the scene's own.

Write a city as Sionna RT 2.2 loads it: `city.xml`, and one binary PLY file for each shape.
"""

import os
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.io.forms import MAX_COORDINATE_M
from radiotwin.runtime.console import progress
from radiotwin.scene.materials import (
    RESERVED_NAMES,
    Material,
    Names,
    map_materials,
    safe_name,
    unique_name,
)
from radiotwin.scene.meshes import RawMesh, load_shapes
from radiotwin.scene.mitsuba_xml import DeclaredCity, read_mitsuba_xml
from radiotwin.scene.ply import write_ply

if TYPE_CHECKING:
    import trimesh




@dataclass(frozen=True, eq=False)
class CityShape:
    """One surface or body of a city.

    Attributes:
        name: Unique in the city; letters, digits, `_` and `-`.
        mesh: Triangles in the scene's frame [m].
        material: Shapes that share one have equal `Material` objects.
    """

    name: str
    mesh: "trimesh.Trimesh"
    material: Material


def write_city(folder: Path | str, shapes: Sequence[CityShape]) -> None:
    """Write `city.xml` and `meshes/*.ply` into an existing folder.

    Args:
        folder: Scene folder; `atomic_folder` gives one that appears only when all is written.
        shapes: Shapes with names that are unique, also among the names of materials (Sionna RT
            keeps both in one register).
    """
    folder = Path(folder)
    (folder / "meshes").mkdir(exist_ok=True)
    root = ET.Element("scene", version="2.1.0")
    for material in sorted({shape.material for shape in shapes}, key=lambda one: one.name):
        root.append(_material_element(material))
    with progress("writing meshes", total=len(shapes)) as advance:
        for shape in shapes:
            root.append(_shape_element(shape))
            write_ply(folder / "meshes" / f"{shape.name}.ply", shape.mesh.vertices,
                      shape.mesh.faces)
            advance(1)
    ET.indent(root)
    ET.ElementTree(root).write(folder / "city.xml", encoding="utf-8", xml_declaration=True)


def _material_element(material: Material) -> ET.Element:
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
    assert value is not None  # a material outside the ITU table has both constants
    ET.SubElement(element, "float", name=name, value=repr(float(value)))


def _shape_element(shape: CityShape) -> ET.Element:
    element = ET.Element("shape", type="ply", id=f"mesh-{shape.name}")
    ET.SubElement(element, "string", name="filename", value=f"meshes/{shape.name}.ply")
    # Otherwise Mitsuba smooths the normals of walls that share vertices, and reflections go astray
    ET.SubElement(element, "boolean", name="face_normals", value="true")
    ET.SubElement(element, "ref", id=f"mat-{shape.material.name}", name="bsdf")
    return element


def read_triangles(xml_path: Path | str) -> list[tuple[RawMesh, Material | None, str]]:
    """Read the triangles of every shape, whatever it is made of.

    Args:
        xml_path: `city.xml` of a scene folder.

    Returns:
        The mesh, the material and the name of each shape in the file's order; None: no known
        material.

    Raises:
        BadInput: No such file, malformed XML, an element or a mesh that cannot be read, or a file
            outside the folder.
    """
    declared = _declared(Path(xml_path))
    materials = map_materials(declared.shapes, declared.materials, {})[0]
    names = [shape.name.removeprefix("mesh-") for shape in declared.shapes]
    return list(zip(_meshes(Path(xml_path), declared), materials, names, strict=True))


def read_city(xml_path: Path | str) -> list[CityShape]:
    """Read the shapes with their materials.

    Names that Sionna RT or a file system would not accept are changed; those of a city that
    `write_city` wrote stay, and writing it again gives the same bytes.

    Args:
        xml_path: `city.xml` of a scene folder.

    Returns:
        The shapes in the file's order.

    Raises:
        BadInput: As `read_triangles`; or a shape without a known material.
    """
    import trimesh  # slow to load, and not needed for the 3D map

    declared = _declared(Path(xml_path))
    materials, problems = map_materials(declared.shapes, declared.materials, {})
    errors = [problem.message for problem in problems if problem.severity == "error"]
    if errors:
        raise BadInput("\n".join([f"{xml_path}: not every shape has a usable material:", *errors]))
    taken = Names(RESERVED_NAMES)
    names = [unique_name(safe_name(shape.name.removeprefix("mesh-")), taken)
             for shape in declared.shapes]
    used = sorted({material for material in materials if material is not None}, key=repr)
    unique = {material: replace(material, name=unique_name(material.name, taken))
              for material in used}
    return [CityShape(name, trimesh.Trimesh(mesh.vertices, mesh.faces, process=False),
                      unique[material])
            for name, mesh, material in zip(names, _meshes(Path(xml_path), declared), materials)
            if material is not None]


def mesh_paths(xml_path: Path | str) -> set[Path]:
    """Return the files of meshes that a scene folder's `city.xml` names.

    Raises:
        BadInput: No such file, malformed XML, or a mesh outside the folder.
    """
    return {shape.mesh_path for shape in _declared(Path(xml_path)).shapes
            if shape.mesh_path is not None}


def _declared(xml_path: Path) -> DeclaredCity:
    if not os.path.lexists(xml_path):
        raise BadInput(f"{xml_path} does not exist; `radiotwin build-scene` makes a scene folder")
    return read_mitsuba_xml(xml_path, scene_folder=True)


def _meshes(xml_path: Path, declared: DeclaredCity) -> list[RawMesh]:
    meshes = []
    for shape, mesh in zip(declared.shapes, load_shapes(declared.shapes, xml_path)):
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
