"""Mitsuba 3 / Sionna RT scene files: what they declare, read without Mitsuba.

Read: `ply`, `obj`, `cube`, `rectangle` and `sphere` shapes (also within `merge`), `to_world` transforms,
materials by reference or inline, `<default>` parameters, `<include>` and `<path>`. Cameras, lights and
integrators say nothing about radio and are passed over.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.safe_xml import parse_elements
from radiotwin.scene.own_files import require_within

INCLUDE_DEPTH = 15  # as Mitsuba


@dataclass
class Node:
    """An XML element that knows where it stands."""

    tag: str
    attributes: dict[str, str]
    file: Path
    line: int
    children: list["Node"] = field(default_factory=list)

    @property
    def place(self) -> str:
        return f"{self.file}, line {self.line}"

    def get(self, tag: str, name: str) -> str | None:
        """Value of the child `<tag name="name" value="...">`, or None."""
        for node in self.children:
            if node.tag == tag and node.attributes.get("name") == name:
                return node.attributes.get("value")
        return None

    def number(self, name: str, default: float) -> float:
        """Value of the child `<float name="name">`."""
        text = self.get("float", name)
        if text is None:
            return default
        return _numbers(self, text, (1,))[0]

    def walk(self) -> Iterator["Node"]:
        """This element and all below it, in the file's order, however deep."""
        waiting = [self]
        while waiting:
            node = waiting.pop()
            yield node
            waiting += reversed(node.children)


@dataclass(frozen=True, eq=False)
class DeclaredShape:
    """A `<shape>`: `material` is its `<bsdf>`, or the identifier it refers to, or None."""

    name: str
    kind: str
    node: Node
    to_world: np.ndarray
    mesh_path: Path | None
    material: Node | str | None


@dataclass
class DeclaredCity:
    """All that a scene file says about radio.

    Attributes:
        shapes: in the file's order.
        materials: `<bsdf>` elements by identifier.
    """

    shapes: list[DeclaredShape] = field(default_factory=list)
    materials: dict[str, Node] = field(default_factory=dict)


def read_mitsuba_xml(path: Path | str) -> DeclaredCity:
    """Read a scene file and the files it includes; meshes are not opened.

    Args:
        path: of the XML file; mesh files are looked for relative to the file that names them.

    Raises:
        BadInput: no such file, malformed XML, not a scene, a value that is no number, or a file outside of the
            folder that `path` lies in; with file and line.
    """
    return _Reader(Path(path)).city


class _Reader:
    def __init__(self, path: Path):
        self.city = DeclaredCity()
        self.parameters: dict[str, str] = {}
        self.folders = [path.parent]
        self._read_file(path, 0)

    def _read_file(self, path: Path, depth: int) -> None:
        root = parse_xml(path)
        if root.tag != "scene":
            raise BadInput(
                f"{root.place}: the file begins with <{root.tag}>, not <scene>; "
                "give a Mitsuba or Sionna RT scene file"
            )
        self._read_children(root, depth)

    def _read_children(self, parent: Node, depth: int) -> None:
        for node in parent.children:
            if node.tag == "default":
                self._substitute(node)
                self.parameters.setdefault(node.attributes.get("name", ""), node.attributes.get("value", ""))
                continue
            if node.tag not in ("include", "path", "bsdf", "shape"):
                continue
            if node.tag == "shape" and node.attributes.get("type") == "merge":
                self._read_children(node, depth)
                continue
            for element in node.walk():
                self._substitute(element)
            if node.tag == "include":
                if depth >= INCLUDE_DEPTH:
                    raise BadInput(
                        f"{node.place}: more than {INCLUDE_DEPTH} files include each other; remove the loop"
                    )
                self._read_file(self._find(node, node.attributes.get("filename", "")), depth + 1)
            elif node.tag == "path":
                self.folders.append(node.file.parent / node.attributes.get("value", ""))
            elif node.tag == "bsdf":
                self.city.materials[node.attributes.get("id", "")] = node
            else:
                self._read_shape(node)

    def _substitute(self, node: Node) -> None:
        """Put the values of parameters for `$name`; an identifier keeps a `$` that names none."""
        for key, text in node.attributes.items():
            if "$" not in text:
                continue
            for name in sorted(self.parameters, key=len, reverse=True):
                text = text.replace(f"${name}", self.parameters[name])
            if "$" in text and key not in ("id", "name"):
                raise BadInput(
                    f"{node.place}: {key}={text!r} uses a parameter that is not declared; add "
                    f'<default name="..." value="..."/> before it (declared: '
                    f"{', '.join(self.parameters) or 'none'})"
                )
            node.attributes[key] = text

    def _find(self, node: Node, name: str) -> Path:
        name = name.replace("\\", "/")
        for folder in (node.file.parent, *self.folders):
            if (folder / name).is_file():
                return require_within(self.folders[0], folder / name, node.place)
        return require_within(self.folders[0], node.file.parent / name, node.place)

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
        self.city.shapes.append(DeclaredShape(identifier, kind, node, to_world, mesh_path, material))


def parse_xml(path: Path) -> Node:
    """Parse one file into elements with line numbers.

    Raises:
        BadInput: no such file, malformed XML (with line and column), or one that declares entities.
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


def scene_meshes(xml_path: Path) -> list[Path]:
    """Mesh files that the `city.xml` of a scene folder names, in its order.

    Raises:
        BadInput: no such file, malformed XML, or one that reads other files than those in its folder.
    """
    root = parse_xml(xml_path)
    for node in root.walk():
        if node.tag in ("include", "path"):
            raise BadInput(f"{node.place}: <{node.tag}> is not allowed in a scene folder; build the scene with "
                           "`radiotwin build-scene`")
        for key, name in node.attributes.items():
            if key == "filename" or (key == "value" and node.attributes.get("name") == "filename"):
                require_within(xml_path.parent, xml_path.parent / name, node.place)
    names = [node.get("string", "filename") for node in root.children if node.tag == "shape"]
    return [xml_path.parent / name for name in names if name is not None]


def _numbers(node: Node, text: str, counts: tuple[int, ...]) -> np.ndarray:
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        values = None
    if values is None or len(values) not in counts or not np.isfinite(values).all():
        allowed = " or ".join(str(count) for count in counts)
        raise BadInput(f"{node.place}: <{node.tag}> has {text!r} where {allowed} finite number(s) should be")
    return values


def _vector(node: Node, default: float) -> np.ndarray:
    """The (3,) of `value="x, y, z"`, of `value="s"`, or of x=, y=, z=."""
    if "value" in node.attributes:
        return np.broadcast_to(_numbers(node, node.attributes["value"], (1, 3)), 3)
    return np.array([_numbers(node, node.attributes.get(axis, str(default)), (1,))[0] for axis in "xyz"])


def read_transform(node: Node) -> np.ndarray:
    """(4, 4) matrix of a `<transform>`: its operations in order, each applied after the one before.

    Raises:
        BadInput: an operation that meshes do not need (`lookat`), an unknown one, or wrong numbers.
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
            raise BadInput(
                f"{step.place}: <{step.tag}> within <transform> is not read; allowed: translate, rotate, "
                "scale, matrix"
            )
        matrix = operation @ matrix
    return matrix


def _rotation(node: Node, axis: np.ndarray, angle_rad: float) -> np.ndarray:
    """Rodrigues' formula."""
    length = np.linalg.norm(axis)
    if length == 0:
        raise BadInput(f"{node.place}: <rotate> has no axis; give x, y or z")
    x, y, z = axis / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle_rad) * cross + (1 - np.cos(angle_rad)) * cross @ cross
