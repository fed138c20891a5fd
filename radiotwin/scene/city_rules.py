"""Allowlist of the elements, types and attributes in `city.xml` of a scene folder.

- Read: `scene`; `bsdf` and `shape` of the types below; `ref`; `transform` with `translate`,
  `rotate`, `scale`, `matrix`; `string`, `float`, `integer`, `boolean`, `rgb`, `point`, `vector`.
- Ignored, with all that is in them: `integrator`, `sensor` and `emitter` beside the shapes. They
  have no meaning for radio.
- Refused: every other element, attribute or type, so `default`, `include`, `path`, `alias`,
  `texture`; a `$` in a value; a number that is none.

None of it reaches Mitsuba, which would load files and plugins that it names: the ray tracer gets a
file that `radiotwin.scene.writer` writes from the triangles and materials that were read.
"""

from radiotwin.errors import BadInput
from radiotwin.scene.xml_tree import Node, read_numbers, read_vector, shown

SHAPE_TYPES = ("ply", "obj", "cube", "rectangle", "sphere", "merge")
# The last four are colours of older files: the name of such a material says what it is made of.
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


def check_city(root: Node) -> None:
    """Check that `city.xml` of a scene folder says only what is allowed.

    Args:
        root: Its `<scene>`; elements that are ignored are removed from it.

    Raises:
        BadInput: Names file and line of what is not allowed.
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
