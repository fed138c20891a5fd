"""All known formats."""

from collections.abc import Collection, Iterable

from radiotwin.errors import BadInput
from radiotwin.importing.formats.drive_test import DRIVE_TEST
from radiotwin.importing.formats.format import Format
from radiotwin.importing.formats.lora import LORA
from radiotwin.importing.formats.phone import PHONE
from radiotwin.importing.formats.scanner import SCANNER
from radiotwin.importing.read_source import Expected

FORMATS: tuple[Format, ...] = (*PHONE, *DRIVE_TEST, *LORA, *SCANNER)


def expected(formats: Iterable[Format], columns: Collection[str] = ()) -> Expected:
    """Return what a file may have.

    Args:
        formats: that it may be of.
        columns: of a declared mapping, in lower case.
    """
    formats = list(formats)
    signatures = [frozenset(name.lower() for name in each.signature) for each in formats]
    return Expected((frozenset(columns), *signatures),
                    tuple(each.without_header for each in formats if each.without_header))


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
