"""XML from unknown sources, parsed without the entities that a file may declare.

A few lines of entity declarations can expand to gigabytes of text ("billion laughs"), or include
another file of this machine. No city or map needs one.
"""

from collections.abc import Callable
from pathlib import Path
from xml.parsers import expat

from radiotwin.errors import BadInput


def parse_elements(path: Path, start: Callable[[str, dict[str, str], int], None],
                   end: Callable[[str], None] = lambda tag: None) -> None:
    """Call back for every element of a file, in the file's order.

    Args:
        path: XML file.
        start: Called as `start(tag, attributes, line)` where an element begins.
        end: Called as `end(tag)` where it ends.

    Raises:
        BadInput: No such file, malformed XML (with line and column), or declared entities.
    """
    parser = expat.ParserCreate()

    def refuse_entity(name: str, *_: object) -> None:
        raise BadInput(f"{path}, line {parser.CurrentLineNumber}: declares the entity {name!r}, "
                       "which can stand for any amount of text or for another file; remove the "
                       "<!DOCTYPE …> with its entities")

    parser.StartElementHandler = lambda tag, attributes: start(
        tag, attributes, parser.CurrentLineNumber)
    parser.EndElementHandler = end
    parser.EntityDeclHandler = refuse_entity
    parser.SetParamEntityParsing(expat.XML_PARAM_ENTITY_PARSING_NEVER)
    try:
        with open(path, "rb") as file:
            parser.ParseFile(file)
    except OSError as error:
        raise BadInput(f"{path} cannot be read ({error.strerror}); give the path of an XML "
                       "file") from None
    except (ValueError, LookupError) as error:  # an encoding that neither expat nor Python knows
        raise BadInput(f"{path}: its XML cannot be decoded ({error}); save it as UTF-8") from None
    except expat.ExpatError as error:
        raise BadInput(f"{path}, line {error.lineno}, column {error.offset + 1}: malformed XML "
                       f"({expat.ErrorString(error.code)}); correct or export the file "
                       "again") from None
