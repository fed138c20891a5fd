"""Write a city as Sionna RT 2.2 loads it: `city.xml`, and one binary PLY file for each shape."""

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from radiotwin.progress import progress
from radiotwin.scene.materials import Material
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
