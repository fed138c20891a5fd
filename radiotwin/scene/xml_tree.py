"""XML as a tree of elements that know their line, and the numbers in their attributes."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from radiotwin.budgets import DOCUMENT_BYTES, ELEMENTS, FILES, NESTING
from radiotwin.errors import BadInput
from radiotwin.safe_xml import parse_elements


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


class XmlReader:
    """Reads files into trees within one budget of bytes and elements for all of them.

    Args:
        path: First file, which messages about the budget name.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._bytes = self._elements = self._files = 0

    def read(self, path: Path) -> Node:
        """Parse one file.

        Args:
            path: XML file.

        Returns:
            The root element.

        Raises:
            BadInput: No such file, malformed XML (with line and column), declared entities, too
                large, or nested too deep.
        """
        self._files += 1
        FILES.check(self._files, self._path)
        top = Node("", {}, path, 0)
        open_nodes = [top]
        limits = ELEMENTS.limit, NESTING.limit

        def start(tag: str, attributes: dict[str, str], line: int) -> None:
            self._elements += 1
            node = Node(tag, attributes, path, line)
            if self._elements > limits[0] or len(open_nodes) > limits[1]:
                ELEMENTS.check(self._elements, self._path)
                NESTING.check(len(open_nodes), node.position)
            open_nodes[-1].children.append(node)
            open_nodes.append(node)

        def end(tag: str) -> None:
            open_nodes.pop()

        self._bytes += parse_elements(path, start, end, DOCUMENT_BYTES)
        DOCUMENT_BYTES.check(self._bytes, f"{self._path} with the files that it includes")
        return top.children[0]


def read_numbers(node: Node, text: str, counts: tuple[int, ...]) -> np.ndarray:
    """Return the finite numbers in a text.

    Args:
        node: Element that has the text, for the message.
        text: Numbers separated by blanks or commas.
        counts: How many there may be.

    Raises:
        BadInput: Something else, or another count.
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
    """Return the (3,) of `value="x, y, z"`, of `value="s"`, or of x=, y=, z=.

    Args:
        node: Element with these attributes.
        default: Value of an axis that is not given.

    Raises:
        BadInput: Something else than finite numbers.
    """
    if "value" in node.attributes:
        return np.broadcast_to(read_numbers(node, node.attributes["value"], (1, 3)), 3)
    return np.array([read_numbers(node, node.attributes.get(axis, str(default)), (1,))[0]
                     for axis in "xyz"])


def shown(text: str) -> str:
    """Return a text for a message: quoted, control characters escaped, the end of a long one cut.

    Args:
        text: As it stands in the file.
    """
    return repr(text if len(text) <= 60 else text[:60] + "…")
