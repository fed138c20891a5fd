"""Mitsuba 3 / Sionna RT scene files, read without Mitsuba.

Read: `ply`, `obj`, `cube`, `rectangle` and `sphere` shapes (also within `merge`), `to_world`
transforms, materials by reference or inline, `<default>` parameters, `<include>` and `<path>`
within the file's folder. Cameras, lights and integrators have no meaning for radio and are
skipped. A scene folder may say less, see `radiotwin.scene.city_rules`. This is the only reader of
scene XML: nothing of a file reaches Mitsuba but the triangles and materials that are read here.
"""

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from radiotwin.budgets import DOCUMENT_BYTES, SEARCH_FOLDERS, SHAPES
from radiotwin.errors import BadInput
from radiotwin.inputs import require_within
from radiotwin.scene.city_rules import check_city
from radiotwin.scene.xml_tree import Node, XmlReader, read_numbers, read_vector, shown

MAX_INCLUDE_DEPTH = 15  # the limit of Mitsuba
MAX_NAME = 1000  # characters of a file's name with its folders: no system has longer ones


@dataclass(frozen=True, eq=False)
class DeclaredShape:
    """A `<shape>` element.

    Attributes:
        name: Its identifier, or a name made from its mesh file or kind.
        kind: Mitsuba's type: `ply`, `obj`, `cube`, ...
        node: The element.
        to_world: (4, 4) transform.
        mesh_path: Mesh file, if it has one.
        material: Its `<bsdf>`, the identifier of the one that it refers to, or None.
    """

    name: str
    kind: str
    node: Node
    to_world: np.ndarray
    mesh_path: Path | None
    material: Node | str | None


@dataclass
class DeclaredCity:
    """The declarations of a scene file that matter for radio.

    Attributes:
        shapes: In the file's order.
        materials: `<bsdf>` elements by identifier.
    """

    shapes: list[DeclaredShape] = field(default_factory=list)
    materials: dict[str, Node] = field(default_factory=dict)


def read_mitsuba_xml(path: Path | str, scene_folder: bool = False) -> DeclaredCity:
    """Read a scene file and the files that it includes; meshes are not opened.

    Args:
        path: XML file; mesh files are looked for relative to the file that names them.
        scene_folder: Whether it is the `city.xml` of a scene folder, which may say less.

    Returns:
        Shapes and materials.

    Raises:
        BadInput: No such file, malformed XML, not a scene, an element that is not allowed, a value
            that is not a number, a file outside the folder of `path`, or too much of anything;
            with file and line.
    """
    return _Reader(Path(path), scene_folder).city


class _Reader:
    def __init__(self, path: Path, scene_folder: bool) -> None:
        self.city = DeclaredCity()
        self.scene_folder = scene_folder
        self.parameters: dict[str, str] = {}
        self.lengths: list[int] = []  # of the parameters' names, from the longest
        self.substituted = 0  # characters
        self.folders = [path.parent]
        self.xml = XmlReader(path)
        self._read_file(path, ())

    def _read_file(self, path: Path, above: tuple[Path, ...]) -> None:
        root = self.xml.read(path)
        if root.tag != "scene":
            raise BadInput(f"{root.position}: the file begins with <{root.tag[:60]}>, not <scene>; "
                           "give a Mitsuba or Sionna RT scene file")
        if self.scene_folder:
            check_city(root)
        self._read_children(root, (*above, path.resolve()))

    def _read_children(self, parent: Node, files: tuple[Path, ...]) -> None:
        waiting = parent.children[::-1]
        while waiting:
            node = waiting.pop()
            if node.tag == "default":
                self._substitute(node)
                self._declare(node.attributes.get("name", ""), node.attributes.get("value", ""))
                continue
            if node.tag not in ("include", "path", "bsdf", "shape"):
                continue
            if node.tag == "shape" and node.attributes.get("type") == "merge":
                waiting += reversed(node.children)
                continue
            for element in node.walk():
                self._substitute(element)
            if node.tag == "include":
                self._include(node, files)
            elif node.tag == "path":
                folder = node.file.parent / node.attributes.get("value", "")
                if folder not in self.folders:
                    self.folders.append(folder)
                    SEARCH_FOLDERS.check(len(self.folders), node.position)
            elif node.tag == "bsdf":
                self.city.materials[node.attributes.get("id", "")] = node
            else:
                self._read_shape(node)

    def _include(self, node: Node, files: tuple[Path, ...]) -> None:
        path = self._find(node, node.attributes.get("filename", ""))
        if len(files) > MAX_INCLUDE_DEPTH or path.resolve() in files:
            raise BadInput(f"{node.position}: more than {MAX_INCLUDE_DEPTH} files include each "
                           "other, or one itself; remove the loop")
        self._read_file(path, files)

    def _declare(self, name: str, value: str) -> None:
        self.parameters.setdefault(name, value)
        if name and len(name) not in self.lengths:
            self.lengths = sorted([*self.lengths, len(name)], reverse=True)

    def _substitute(self, node: Node) -> None:
        """Replace `$name` by the parameter's value; identifiers may keep an undeclared `$`."""
        for key, text in node.attributes.items():
            if "$" not in text:
                continue
            first, *rest = text.split("$")
            parts = [first]
            for part in rest:
                length = next((length for length in self.lengths
                               if part[:length] in self.parameters), 0)
                if not length and key not in ("id", "name"):
                    declared = ", ".join(list(self.parameters)[:20]) or "none"
                    raise BadInput(
                        f"{node.position}: {key}={shown(text)} uses a parameter that is not "
                        'declared; add <default name="..." value="..."/> before it '
                        f"(declared: {declared})")
                parts += [self.parameters[part[:length]] if length else "$", part[length:]]
                self.substituted += len(parts[-1]) + len(parts[-2])
                DOCUMENT_BYTES.check(self.substituted, f"{node.position}: with its parameters")
            node.attributes[key] = "".join(parts)

    def _find(self, node: Node, name: str) -> Path:
        if len(name) > MAX_NAME:
            raise BadInput(f"{node.position}: {shown(name)} is not the name of a file: it has "
                           f"{len(name):,} characters")
        name = name.replace("\\", "/")
        for folder in (node.file.parent, *self.folders):
            if os.path.isfile(folder / name):
                return require_within(self.folders[0], folder / name, node.position)
        return require_within(self.folders[0], node.file.parent / name, node.position)

    def _read_shape(self, node: Node) -> None:
        SHAPES.check(len(self.city.shapes) + 1, node.file)
        kind = node.attributes.get("type", "")
        file_name = node.get("string", "filename")
        mesh_path = None if file_name is None else self._find(node, file_name)
        identifier = node.attributes.get("id")
        if identifier is None:
            identifier = mesh_path.stem if mesh_path else f"{kind}_{len(self.city.shapes) + 1}"
        material: Node | str | None = None
        for child in node.children:
            if child.tag == "bsdf":
                material = child
            elif child.tag == "ref" and child.attributes.get("name", "bsdf") == "bsdf":
                material = child.attributes.get("id", "")
        transform = next((child for child in node.children if child.tag == "transform"), None)
        to_world = np.eye(4) if transform is None else read_transform(transform)
        self.city.shapes.append(
            DeclaredShape(identifier, kind, node, to_world, mesh_path, material))


def read_transform(node: Node) -> np.ndarray:
    """Return the matrix of a `<transform>`: its operations, each applied after the one before.

    Args:
        node: The element.

    Returns:
        (4, 4) matrix.

    Raises:
        BadInput: An operation that meshes do not need (`lookat`), an unknown one, or wrong numbers.
    """
    matrix = np.eye(4)
    for step in node.children:
        operation = np.eye(4)
        if step.tag == "translate":
            operation[:3, 3] = read_vector(step, 0.0)
        elif step.tag == "scale":
            operation[:3, :3] = np.diag(read_vector(step, 1.0))
        elif step.tag == "rotate":
            angle_deg = read_numbers(step, step.attributes.get("angle", "0"), (1,))[0]
            operation[:3, :3] = _rotation(step, read_vector(step, 0.0), np.radians(angle_deg))
        elif step.tag == "matrix":
            values = read_numbers(step, step.attributes.get("value", ""), (9, 16))
            size = 3 if len(values) == 9 else 4
            operation[:size, :size] = values.reshape(size, size)
        else:
            raise BadInput(f"{step.position}: <{step.tag}> within <transform> is not read; "
                           "allowed: translate, rotate, scale, matrix")
        matrix = operation @ matrix
    return matrix


def _rotation(node: Node, axis: np.ndarray, angle_rad: float) -> np.ndarray:
    """Return the (3, 3) rotation about an axis, by Rodrigues' formula."""
    length = np.linalg.norm(axis)
    if length == 0:
        raise BadInput(f"{node.position}: <rotate> has no axis; give x, y or z")
    x, y, z = axis / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle_rad) * cross + (1 - np.cos(angle_rad)) * cross @ cross
