"""Reader of Mitsuba 3 and Sionna RT scene files: shapes, transforms and materials, by an allowlist.

This is the only reader of scene XML. Mitsuba's own would load files and plugins that a file names;
it only gets the triangles and materials that are parsed here.

Read are `ply`, `obj`, `cube`, `rectangle` and `sphere` shapes (also within `merge`), `to_world`
transforms, materials by reference or inline, `<default>` parameters, `<include>` and `<path>`
within the file's folder. Cameras, lights and integrators have no meaning for radio and are skipped.

The `city.xml` of a scene folder is restricted:
- Read: `scene`; `bsdf` and `shape` of the types below; `ref`; `transform` with `translate`,
  `rotate`, `scale`, `matrix`; `string`, `float`, `integer`, `boolean`, `rgb`, `point`, `vector`.
- Ignored with their content: `integrator`, `sensor` and `emitter` beside the shapes.
- Refused: every other element, attribute or type, such as `default`, `include`, `path`, `alias`,
  `texture`; a `$` in a value; a text in the place of a number.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.io.budgets import DOCUMENT_BYTES, ELEMENTS, FILES, NESTING, SEARCH_FOLDERS, SHAPES
from radiotwin.io.inputs import parse_elements, require_within

SHAPE_TYPES = ("ply", "obj", "cube", "rectangle", "sphere", "merge")
# The last four are colours, as older files have: the ITU material follows from the name.
BSDF_TYPES = ("itu-radio-material", "radio-material", "diffuse", "twosided", "principled",
              "roughconductor")
IGNORED = ("integrator", "sensor", "emitter")
_BUILD = "build the scene with `radiotwin build-scene`"
_VALUES = ("string", "float", "integer", "boolean", "rgb")
_STEPS = ("translate", "rotate", "scale", "matrix")
_CHILDREN: dict[str, tuple[str, ...]] = {
    "scene": ("bsdf", "shape"),
    "bsdf": ("bsdf", *_VALUES),
    "shape": ("shape", "bsdf", "ref", "transform", "point", "vector", *_VALUES),
    "transform": _STEPS,
}
_ATTRIBUTES: dict[str, tuple[str, ...]] = {
    "scene": ("version",),
    "bsdf": ("type", "id", "name"),
    "shape": ("type", "id", "name"),
    "ref": ("id", "name"),
    "transform": ("name",),
    "rotate": ("value", "angle", "x", "y", "z"),
    "matrix": ("value",),
    **dict.fromkeys(("translate", "scale"), ("value", "x", "y", "z")),
    **dict.fromkeys(("point", "vector"), ("name", "value", "x", "y", "z")),
    **dict.fromkeys(_VALUES, ("name", "value")),
}
_COUNTS = {"float": (1,), "integer": (1,), "rgb": (1, 3)}
MAX_INCLUDE_DEPTH = 15  # the limit of Mitsuba
MAX_NAME = 1000  # characters of a file's name with its folders


@dataclass(slots=True)
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
        return default if text is None else float(read_numbers(self, text, (1,))[0])

    def walk(self) -> Iterator["Node"]:
        """Yield this element and all below it in the file's order, without recursion."""
        waiting = [self]
        while waiting:
            node = waiting.pop()
            yield node
            waiting += reversed(node.children)


def read_numbers(node: Node, text: str, counts: tuple[int, ...]) -> np.ndarray:
    """Parse finite numbers separated by blanks or commas.

    Args:
        node: Element that the text is from, for messages.
        text: Text to parse.
        counts: Allowed numbers of values.

    Raises:
        BadInput: Another text, or another number of values.
    """
    words = text.replace(",", " ").split(maxsplit=max(counts))
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = None
    # Python reads 1_000 and digits of other scripts, too; the programs that exchange scenes do not
    if (values is None or len(values) not in counts or not np.isfinite(values).all()
            or "_" in text or not text.isascii()):
        allowed = " or ".join(str(count) for count in counts)
        raise BadInput(f"{node.position}: <{node.tag}> has {shown(text)} where {allowed} finite "
                       "number(s) should be")
    return values


def read_vector(node: Node, default: float) -> np.ndarray:
    """Return the vector (3,) in `value="x, y, z"`, `value="s"` (for all three), or x=, y=, z=.

    A missing x, y or z has the default.

    Raises:
        BadInput: A value is no finite number.
    """
    if "value" in node.attributes:
        return np.broadcast_to(read_numbers(node, node.attributes["value"], (1, 3)), 3)
    return np.array([read_numbers(node, node.attributes.get(axis, str(default)), (1,))[0]
                     for axis in "xyz"])


def shown(text: str) -> str:
    """Format a stranger's text for a message: quoted, escaped, cut at 60 characters."""
    return repr(text if len(text) <= 60 else text[:60] + "…")


def _check_city(root: Node) -> None:
    """Raise BadInput if the `city.xml` of a scene folder has an element that is not allowed.

    Elements without meaning for radio (`IGNORED`) are first removed from `root`.
    """
    root.children = [child for child in root.children if child.tag not in IGNORED]
    waiting = [root]
    while waiting:
        node = waiting.pop()
        _check_attributes(node)
        allowed = _CHILDREN.get(node.tag, ())
        for child in node.children:
            if child.tag not in allowed:
                raise BadInput(f"{child.position}: <{child.tag[:60]}> is not allowed in "
                               f"<{node.tag}> of a scene folder; {_BUILD}")
        waiting += reversed(node.children)


def _check_attributes(node: Node) -> None:
    """Raise BadInput if an element of `city.xml` has an attribute, type or value not allowed."""
    for name, value in node.attributes.items():
        if name not in _ATTRIBUTES[node.tag]:
            raise BadInput(f"{node.position}: <{node.tag}> has {shown(name)}, which is not "
                           f"allowed in a scene folder; {_BUILD}")
        if "$" in value:
            raise BadInput(f"{node.position}: {name}={shown(value)} has a $, which is not allowed "
                           f"in a scene folder; {_BUILD}")
    kind, types = node.attributes.get("type", ""), {"shape": SHAPE_TYPES, "bsdf": BSDF_TYPES}
    if kind not in types.get(node.tag, (kind,)):
        raise BadInput(f"{node.position}: a {node.tag} of type {shown(kind)} is not read; allowed "
                       f"are {', '.join(types[node.tag])}; {_BUILD}")
    if node.tag in _COUNTS:
        read_numbers(node, node.attributes.get("value", ""), _COUNTS[node.tag])
    elif node.tag in ("point", "vector"):
        read_vector(node, 0.0)


@dataclass(frozen=True, eq=False)
class DeclaredShape:
    """A `<shape>` element.

    Attributes:
        name: Identifier, or a name made from its mesh file or kind.
        kind: Mitsuba's type: `ply`, `obj`, `cube`, ...
        node: The element.
        to_world: (4, 4) transform.
        mesh_path: Mesh file; None: it has none.
        material: Inline `<bsdf>`, or the identifier of a declared one; None: it has none.
    """

    name: str
    kind: str
    node: Node
    to_world: np.ndarray
    mesh_path: Path | None
    material: Node | str | None


@dataclass
class DeclaredCity:
    """The shapes and materials of a scene file.

    Attributes:
        shapes: Shapes in the file's order.
        materials: Identifier -> `<bsdf>` element.
    """

    shapes: list[DeclaredShape] = field(default_factory=list)
    materials: dict[str, Node] = field(default_factory=dict)


def read_mitsuba_xml(path: Path | str, scene_folder: bool = False) -> DeclaredCity:
    """Read shapes and materials of a scene file and its includes; mesh files are not opened.

    Args:
        path: XML file; mesh files are looked for relative to the file that names them.
        scene_folder: Whether it is the `city.xml` of a scene folder, which is restricted.

    Raises:
        BadInput: No such file, malformed XML, not a scene, an element that is not allowed, a value
            that is not a number, a file outside the folder of `path`, or too much of anything;
            with file and line.
    """
    return _Reader(Path(path), scene_folder).city


class _Reader:
    """Reads one scene file with its includes into a `DeclaredCity`."""

    def __init__(self, path: Path, scene_folder: bool) -> None:
        self.city = DeclaredCity()
        self.scene_folder = scene_folder
        self.parameters: dict[str, str] = {}  # name -> value, by the first <default>
        self.lengths: list[int] = []  # of the parameters' names, the longest first
        self.substituted = 0  # characters that parameters were replaced by
        self.folders = [path.parent]
        self.path = path
        self.bytes = self.elements = self.files = 0  # of all files, which share one budget
        self._read_file(path, ())

    def _read_file(self, path: Path, above: tuple[Path, ...]) -> None:
        """Read a scene file; `above` are the files that include it, from the outermost."""
        root = self._parse(path)
        if root.tag != "scene":
            raise BadInput(f"{root.position}: the file begins with <{root.tag[:60]}>, not <scene>; "
                           "give a Mitsuba or Sionna RT scene file")
        if self.scene_folder:
            _check_city(root)
        self._read_children(root, (*above, path.resolve()))

    def _parse(self, path: Path) -> Node:
        """Parse one file and return its root element."""
        self.files += 1
        FILES.check(self.files, self.path)
        top = Node("", {}, path, 0)
        open_nodes = [top]
        max_elements, max_depth = ELEMENTS.limit, NESTING.limit  # looked up once

        def start(tag: str, attributes: dict[str, str], line: int) -> None:
            self.elements += 1
            node = Node(tag, attributes, path, line)
            if self.elements > max_elements or len(open_nodes) > max_depth:
                ELEMENTS.check(self.elements, self.path)
                NESTING.check(len(open_nodes), node.position)
            open_nodes[-1].children.append(node)
            open_nodes.append(node)

        def end(tag: str) -> None:
            open_nodes.pop()

        self.bytes += parse_elements(path, start, end, DOCUMENT_BYTES)
        DOCUMENT_BYTES.check(self.bytes, f"{self.path} with the files that it includes")
        return top.children[0]

    def _read_children(self, parent: Node, files: tuple[Path, ...]) -> None:
        """Read the children of a `<scene>` in `files`, the file and those that include it."""
        waiting = parent.children[::-1]
        while waiting:
            node = waiting.pop()
            if node.tag == "default":
                self._substitute(node)
                name = node.attributes.get("name", "")
                self.parameters.setdefault(name, node.attributes.get("value", ""))
                if name and len(name) not in self.lengths:
                    self.lengths = sorted([*self.lengths, len(name)], reverse=True)
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
        """Read the file of an `<include>`; BadInput if it is among `files`, which include it."""
        path = self._find_file(node, node.attributes.get("filename", ""))
        if len(files) > MAX_INCLUDE_DEPTH or path.resolve() in files:
            raise BadInput(f"{node.position}: more than {MAX_INCLUDE_DEPTH} files include each "
                           "other, or one itself; remove the loop")
        self._read_file(path, files)

    def _substitute(self, node: Node) -> None:
        """Replace each `$name` in an element's attributes by the parameter's value, in place.

        BadInput if there is no such parameter, except in identifiers and names: there `$` stays.
        """
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

    def _find_file(self, node: Node, name: str) -> Path:
        """Return the path of a file that an element names; it must lie in the scene file's folder.

        It is looked for beside the element's file, then in the folders of `<path>` elements.
        """
        if len(name) > MAX_NAME:
            raise BadInput(f"{node.position}: {shown(name)} is not the name of a file: it has "
                           f"{len(name):,} characters")
        name = name.replace("\\", "/")
        for folder in (node.file.parent, *self.folders):
            if os.path.isfile(folder / name):
                return require_within(self.folders[0], folder / name, node.position)
        return require_within(self.folders[0], node.file.parent / name, node.position)

    def _read_shape(self, node: Node) -> None:
        """Add a `<shape>` element to the city's shapes, with transform, file and material."""
        SHAPES.check(len(self.city.shapes) + 1, node.file)
        kind = node.attributes.get("type", "")
        file_name = node.get("string", "filename")
        mesh_path = None if file_name is None else self._find_file(node, file_name)
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
        to_world = np.eye(4) if transform is None else _read_transform(transform)
        self.city.shapes.append(
            DeclaredShape(identifier, kind, node, to_world, mesh_path, material))


def _read_transform(node: Node) -> np.ndarray:
    """Return the (4, 4) matrix of a `<transform>`: its operations, applied one after another."""
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
