"""Read the city of a scene folder: `city.xml` and its meshes, whose source may be unknown.

All that uses a scene's geometry goes through here. The ray tracer loads a file that
`radiotwin.scene.writer` writes from what was read here, never the scene's own.
"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.scene.material_mapping import map_materials
from radiotwin.scene.materials import Material
from radiotwin.scene.meshes import RawMesh, load_shapes
from radiotwin.scene.mitsuba_xml import DeclaredCity, read_mitsuba_xml
from radiotwin.scene.names import RESERVED_NAMES, Names, safe_name, unique_name
from radiotwin.scene.writer import CityShape
from radiotwin.tables import MAX_COORDINATE_M


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
