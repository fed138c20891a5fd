"""Mitsuba 3 / Sionna RT scene files, read without Mitsuba.

Read: `ply`, `obj`, `cube`, `rectangle` and `sphere` shapes (also within `merge`), `to_world`
transforms, materials by reference or inline, `<default>` parameters, `<include>` and `<path>`.
Cameras, lights and integrators have no meaning for radio and are skipped. This is the only reader
of scene XML: nothing of a file that is not read here reaches Mitsuba.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.inputs import require_within
from radiotwin.safe_xml import parse_elements

MAX_INCLUDE_DEPTH = 15  # the limit of Mitsuba


@dataclass
class Node:
    """An XML element with its position in the file."""

    tag: str
    attributes: dict[str, str]
    file: Path
    line: int
    children: list["Node"] = field(default_factory=list)

    @property
    def position(self) -> str:
        """File and line, for messages."""
        return f"{self.file}, line {self.line}"

    def get(self, tag: str, name: str) -> str | None:
        """Return the value of the child `<tag name="name" value="...">`, or None."""
        for node in self.children:
            if node.tag == tag and node.attributes.get("name") == name:
                return node.attributes.get("value")
        return None

    def number(self, name: str, default: float) -> float:
        """Return the value of the child `<float name="name">`, or the default."""
        text = self.get("float", name)
        return default if text is None else _numbers(self, text, (1,))[0]

    def walk(self) -> Iterator["Node"]:
        """Yield this element and all below it in the file's order, without recursion."""
        waiting = [self]
        while waiting:
            node = waiting.pop()
            yield node
            waiting += reversed(node.children)


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


def read_mitsuba_xml(path: Path | str, includes: bool = True) -> DeclaredCity:
    """Read a scene file and the files that it includes; meshes are not opened.

    Args:
        path: XML file; mesh files are looked for relative to the file that names them.
        includes: Whether `<include>` and `<path>` are allowed.

    Returns:
        Shapes and materials.

    Raises:
        BadInput: No such file, malformed XML, not a scene, an element that is not allowed, a value
            that is not a number, or a file outside the folder of `path`; with file and line.
    """
    return _Reader(Path(path), includes).city


class _Reader:
    def __init__(self, path: Path, includes: bool) -> None:
        self.city = DeclaredCity()
        self.includes = includes
        self.parameters: dict[str, str] = {}
        self.folders = [path.parent]
        self._read_file(path, 0)

    def _read_file(self, path: Path, depth: int) -> None:
        root = parse_xml(path)
        for node in () if self.includes else root.walk():
            if node.tag in ("include", "path"):
                raise BadInput(f"{node.position}: <{node.tag}> is not allowed in a scene folder; "
                               "build the scene with `radiotwin build-scene`")
        if root.tag != "scene":
            raise BadInput(f"{root.position}: the file begins with <{root.tag}>, not <scene>; "
                           "give a Mitsuba or Sionna RT scene file")
        self._read_children(root, depth)

    def _read_children(self, parent: Node, depth: int) -> None:
        waiting = parent.children[::-1]
        while waiting:
            node = waiting.pop()
            if node.tag == "default":
                self._substitute(node)
                self.parameters.setdefault(node.attributes.get("name", ""),
                                           node.attributes.get("value", ""))
                continue
            if node.tag not in ("include", "path", "bsdf", "shape"):
                continue
            if node.tag == "shape" and node.attributes.get("type") == "merge":
                waiting += reversed(node.children)
                continue
            for element in node.walk():
                self._substitute(element)
            if node.tag == "include":
                if depth >= MAX_INCLUDE_DEPTH:
                    raise BadInput(f"{node.position}: more than {MAX_INCLUDE_DEPTH} files include "
                                   "each other; remove the loop")
                self._read_file(self._find(node, node.attributes.get("filename", "")), depth + 1)
            elif node.tag == "path":
                self.folders.append(node.file.parent / node.attributes.get("value", ""))
            elif node.tag == "bsdf":
                self.city.materials[node.attributes.get("id", "")] = node
            else:
                self._read_shape(node)

    def _substitute(self, node: Node) -> None:
        """Replace `$name` by the parameter's value; identifiers may keep an undeclared `$`."""
        for key, text in node.attributes.items():
            if "$" not in text:
                continue
            for name in sorted(self.parameters, key=len, reverse=True):
                text = text.replace(f"${name}", self.parameters[name])
            if "$" in text and key not in ("id", "name"):
                raise BadInput(f"{node.position}: {key}={text!r} uses a parameter that is not "
                               'declared; add <default name="..." value="..."/> before it '
                               f"(declared: {', '.join(self.parameters) or 'none'})")
            node.attributes[key] = text

    def _find(self, node: Node, name: str) -> Path:
        name = name.replace("\\", "/")
        for folder in (node.file.parent, *self.folders):
            if (folder / name).is_file():
                return require_within(self.folders[0], folder / name, node.position)
        return require_within(self.folders[0], node.file.parent / name, node.position)

    def _read_shape(self, node: Node) -> None:
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


def parse_xml(path: Path) -> Node:
    """Parse one file into a tree of elements with line numbers.

    Args:
        path: XML file.

    Returns:
        The root element.

    Raises:
        BadInput: No such file, malformed XML (with line and column), or declared entities.
    """
    top = Node("", {}, path, 0)
    open_nodes = [top]

    def start(tag: str, attributes: dict[str, str], line: int) -> None:
        node = Node(tag, attributes, path, line)
        open_nodes[-1].children.append(node)
        open_nodes.append(node)

    def end(tag: str) -> None:
        open_nodes.pop()

    parse_elements(path, start, end)
    return top.children[0]


def _numbers(node: Node, text: str, counts: tuple[int, ...]) -> np.ndarray:
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        values = None
    if values is None or len(values) not in counts or not np.isfinite(values).all():
        allowed = " or ".join(str(count) for count in counts)
        raise BadInput(f"{node.position}: <{node.tag}> has {text!r} where {allowed} finite "
                       "number(s) should be")
    return values


def _vector(node: Node, default: float) -> np.ndarray:
    """Return the (3,) of `value="x, y, z"`, of `value="s"`, or of x=, y=, z=."""
    if "value" in node.attributes:
        return np.broadcast_to(_numbers(node, node.attributes["value"], (1, 3)), 3)
    return np.array([_numbers(node, node.attributes.get(axis, str(default)), (1,))[0]
                     for axis in "xyz"])


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
            operation[:3, 3] = _vector(step, 0.0)
        elif step.tag == "scale":
            operation[:3, :3] = np.diag(_vector(step, 1.0))
        elif step.tag == "rotate":
            angle_deg = _numbers(step, step.attributes.get("angle", "0"), (1,))[0]
            operation[:3, :3] = _rotation(step, _vector(step, 0.0), np.radians(angle_deg))
        elif step.tag == "matrix":
            values = _numbers(step, step.attributes.get("value", ""), (9, 16))
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
