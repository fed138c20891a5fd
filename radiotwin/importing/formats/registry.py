"""All known formats."""

from collections.abc import Iterable

from radiotwin.errors import BadInput
from radiotwin.importing.formats import phone
from radiotwin.importing.formats.format import Format

FORMATS: tuple[Format, ...] = (*phone.FORMATS,)


def signatures() -> list[set[str]]:
    """Return the columns by which each format is recognised, in lower case."""
    return [{name.lower() for name in each.signature} for each in FORMATS]


def find_format(header: Iterable[str]) -> Format | None:
    """Return the format with the longest signature in a header, or None."""
    names = list(header)
    return max((each for each in FORMATS if each.fits(names)),
               key=lambda each: len(each.signature), default=None)


def format_named(name: str) -> Format:
    """Return a format by its name.

    Raises:
        BadInput: unknown.
    """
    for each in FORMATS:
        if each.name == name:
            return each
    raise BadInput(f"format {name!r} is unknown; allowed are "
                   f"{', '.join(each.name for each in FORMATS)}")
