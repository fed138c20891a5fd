"""A known format: which columns hold what, in which unit, and where that is described."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from radiotwin.importing.read_source import WithoutHeader
from radiotwin.importing.source import columns_of

MADE_UP = "made-up"
"""Tried on a file that was made up after the description only."""


@dataclass(frozen=True)
class Format:
    """The mapping of a known format.

    Attributes:
        name: as of `--format`.
        title: of the program that writes it.
        columns: quantity of `Columns` -> entry of a mapping, or several, of which the first counts
            whose columns the file has; names in any case.
        signature: columns by which a file is recognised.
        level: what the level is, with its unit.
        source: of the description.
        settings: others than `columns`.
        tried_on: `MADE_UP`, or which original.
        caution: of the units, which is printed at every import.
        without_header: how a file without a header is recognised and read, or None.
    """

    name: str
    title: str
    columns: Mapping[str, str | tuple[str, ...]]
    signature: tuple[str, ...]
    level: str
    source: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    tried_on: str = MADE_UP
    caution: str = ""
    without_header: WithoutHeader | None = None

    def fits(self, header: Iterable[str]) -> bool:
        """Return whether a header has the signature."""
        return set(map(_plain, self.signature)) <= set(map(_plain, header))

    def mapping(self, header: Iterable[str]) -> dict[str, str]:
        """Return the entries of `columns` for a header, without what it does not have.

        Args:
            header: names of the file's columns.
        """
        actual = {_plain(name): name for name in reversed(list(header))}  # the first one counts
        result = {}
        for quantity, entries in self.columns.items():
            for entry in (entries,) if isinstance(entries, str) else entries:
                names = columns_of(entry, ())
                if all(_plain(name) in actual for name in names):
                    for name in names:
                        entry = entry.replace(name, actual[_plain(name)])
                    result[quantity] = entry
                    break
        return result


def _plain(name: str) -> str:
    """Return a name in lower case without what programs put after it: an index, `(Text)`."""
    return re.sub(r"(\s*(\(text\)|\[\d+\]))+$", "", name.strip().lower())
