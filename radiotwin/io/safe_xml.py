"""XML from unknown sources, parsed without the entities that a file may declare.

A few lines of entity declarations can expand to gigabytes of text ("billion laughs"), or include
another file of this machine. No city or map needs one.
"""

from collections.abc import Callable
from pathlib import Path
from xml.parsers import expat

from radiotwin.errors import BadInput
from radiotwin.io.budgets import FILE_BYTES, TAG_BYTES, Budget
from radiotwin.io.inputs import open_input

_BLOCK_BYTES = 2**20


def parse_elements(path: Path, start: Callable[[str, dict[str, str], int], None],
                   end: Callable[[str], None] = lambda tag: None,
                   budget: Budget = FILE_BYTES,
                   text: Callable[[str], None] | None = None) -> int:
    """Call back for every element of a file, in the file's order.

    Args:
        path: XML file.
        start: Called as `start(tag, attributes, line)` where an element begins.
        end: Called as `end(tag)` where it ends.
        budget: Of the file's bytes.
        text: Called with each piece of text between tags; None: texts are not read.

    Returns:
        Bytes read.

    Raises:
        BadInput: No such file, malformed XML (with line and column), declared entities, or a file
            or a tag that is too large.
    """
    parser = expat.ParserCreate()

    def refuse_entity(name: str, *_: object) -> None:
        raise BadInput(f"{path}, line {parser.CurrentLineNumber}: declares the entity "
                       f"{name[:60]!r}, which can stand for any amount of text or for another "
                       "file; remove the <!DOCTYPE …> with its entities")

    parser.StartElementHandler = lambda tag, attributes: start(
        tag, attributes, parser.CurrentLineNumber)
    parser.EndElementHandler = end
    if text is not None:
        parser.CharacterDataHandler = text
    parser.EntityDeclHandler = refuse_entity
    parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
    size = 0
    try:
        with open_input(path, "XML file", budget) as file:
            while block := file.read(_BLOCK_BYTES):
                size += len(block)
                budget.check(size, path)  # the file may grow
                parser.Parse(block, False)
                # Expat reads an unfinished tag from its beginning in every call.
                TAG_BYTES.check(size - max(parser.CurrentByteIndex, 0),
                                f"{path}, line {parser.CurrentLineNumber}")
            parser.Parse(b"", True)
    except (ValueError, LookupError, TypeError) as error:  # an encoding that Python does not know
        raise BadInput(f"{path}: its XML cannot be decoded ({error}); save it as UTF-8") from None
    except expat.ExpatError as error:
        raise BadInput(f"{path}, line {error.lineno}, column {error.offset + 1}: malformed XML "
                       f"({expat.ErrorString(error.code)}); correct or export the file "
                       "again") from None
    return size
