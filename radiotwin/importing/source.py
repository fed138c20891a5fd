"""A file of measurements as a table whose cells can be named in a message, and what is wrong in it.

All problems of an import become one message. Readings that are left out are counted by reason, so
that read = kept + left out.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from radiotwin.errors import BadInput
from radiotwin.io.cells import as_numbers, listed, refuse
from radiotwin.io.forms import name_fault

EMPTY = ("", "nan", "na", "n/a", "<na>", "nat", "null", "none")
"""Texts, in lower case, of cells without a value."""
ALWAYS = "always "
"""Prefix of a constant in place of a column's name."""
_ROWS_AT_ONCE = 1_000_000  # of which stripped texts are made
_TEMPLATE = re.compile(r"\{([^{}]+)\}")
_SHOWN = 20  # of the problems in a message


@dataclass(frozen=True)
class Source:
    """A table whose index is the position of each row in the file.

    Attributes:
        path: of the file, or a name of several, for messages.
        table: cells as in the file.
        where: index -> `row 7`, as the file's user counts.
        notes: on how the file was read.
    """

    path: Path | str
    table: pd.DataFrame
    where: Callable[[int], str]
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.table)

    def cells(self, spec: str, purpose: str) -> pd.Series:
        """Return the cells of a column, a constant, or texts made of several columns.

        Args:
            spec: name of a column, `always VALUE`, or a text with names in braces, such as
                `{Date} {Time}`, which is empty where one of these cells is.
            purpose: what they are needed for, for the message; as in the other methods.

        Raises:
            BadInput: no such column.
        """
        if spec in self.table:
            return self.table[spec]
        if spec.startswith(ALWAYS):
            return pd.Series(spec.removeprefix(ALWAYS), index=self.table.index)
        self.require({purpose: spec})
        pieces = _TEMPLATE.split(spec)  # constant, name, constant, name, …
        columns = {name: as_text(self.table[name]) for name in pieces[1::2]}
        text = pd.Series(pieces[0], index=self.table.index, dtype=str)
        for name, constant in zip(pieces[1::2], pieces[2::2]):
            text = text + columns[name] + constant
        for cells in columns.values():
            text = text.mask(cells == "", "")
        return text

    def require(self, specs: Mapping[str, str]) -> None:
        """Check that the file has all columns of a mapping: purpose -> as in `cells`.

        Raises:
            BadInput: names all that are missing.
        """
        missing = [f"{name!r} ({purpose})" for purpose, spec in specs.items()
                   for name in columns_of(spec, self.table) if name not in self.table]
        if missing:
            several = len(missing) > 1
            raise BadInput(f"{self.path}: column{'s' * several} {', '.join(missing)} "
                           f"{'are' if several else 'is'} missing; the file has "
                           f"{listed(self.table.columns)}. Correct the mapping")

    def names(self, spec: str, purpose: str) -> np.ndarray:
        """Return the cells as names, (n,) texts, `""` where empty; equal ones are one object.

        Raises:
            BadInput: no such column, or a text that cannot be a name.
        """
        cells = self.cells(spec, purpose)
        if not isinstance(cells.dtype, pd.StringDtype):
            cells = as_text(cells)
        number, different = pd.factorize(cells, use_na_sentinel=False)
        names = as_text(pd.Series(different))
        for i, name in enumerate(names):
            if name and (fault := name_fault(name)):
                self.refuse(spec, pd.Series(name, index=self.table.index), number == i, fault)
        return names.to_numpy(dtype=object)[number]

    def numbers(self, spec: str, purpose: str) -> np.ndarray:
        """Return the cells as numbers, (n,); NaN where empty.

        Raises:
            BadInput: no such column, a text, or a number that is not finite.
        """
        cells = self.cells(spec, purpose)
        if cells.dtype.kind in "fiu":
            numbers = cells.to_numpy(dtype=float, na_value=np.nan)
        else:
            numbers = np.full(len(cells), np.nan)
            wrong = np.zeros(len(cells), dtype=bool)
            for start in range(0, len(cells), _ROWS_AT_ONCE):
                rows = slice(start, start + _ROWS_AT_ONCE)
                text = as_text(cells.iloc[rows])
                numbers[rows] = as_numbers(text)
                wrong[rows] = np.isnan(numbers[rows]) & (text != "")
            if wrong.any():
                self.refuse(spec, as_text(cells), wrong, "is not a number")
        self.refuse(spec, cells, np.isinf(numbers), "is not finite")
        return numbers

    def refuse(self, spec: str, cells: pd.Series, bad: ArrayLike, reason: str) -> None:
        """Raise BadInput about the first bad cell (n,) of a column, if there is one.

        The message names file, row and column, and ends with the reason.
        """
        refuse(self.path, spec, cells, bad, reason, lambda row: self.where(cells.index[row]))


def as_text(cells: pd.Series) -> pd.Series:
    """Convert cells (n,) of any type to stripped texts.

    `""` stands for every spelling of an empty cell; whole numbers have no point.
    """
    if cells.dtype.kind == "f":
        whole = (cells == cells.round()) & (cells.abs() < 2.0**53)  # exact in double precision
        if (cells.isna() | whole).all():  # an integer column with gaps
            cells = cells.astype("Int64")
    text = cells.astype(str).str.strip()
    return text.mask(cells.isna() | text.str.lower().isin(EMPTY), "")


def columns_of(spec: str, header: Iterable[object]) -> list[str]:
    """Return the names of columns in an entry of a mapping, as of `Source.cells`.

    A name of the header may have braces itself.
    """
    if spec.startswith(ALWAYS) and spec not in header:
        return []
    return _TEMPLATE.findall(spec) if _TEMPLATE.search(spec) and spec not in header else [spec]


class Problems:
    """Collects messages of `BadInput`, so that reading goes on and finds the others."""

    def __init__(self) -> None:
        self._messages: list[str] = []

    def __len__(self) -> int:
        return len(self._messages)

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Keep the message of a `BadInput` raised within, and go on after it."""
        try:
            yield
        except BadInput as error:
            if str(error) not in self._messages:
                self._messages.append(str(error))

    def check(self) -> None:
        """Raise all messages as one BadInput, if there are any."""
        if not self._messages:
            return
        if len(self._messages) == 1:
            raise BadInput(self._messages[0])
        more = len(self._messages) - _SHOWN
        lines = self._messages[:_SHOWN] + [f"and {more} more"] * (more > 0)
        raise BadInput("\n".join([f"{len(self._messages)} things are wrong:",
                                  *(f"- {line}" for line in lines)]))


@dataclass
class Tally:
    """Readings that were left out.

    Attributes:
        left_out: (reason, column) -> number of readings, in the order of the reasons' first use.
        first: (reason, column) -> the first of them, such as `row 7`.
    """

    left_out: dict[tuple[str, str], int] = field(default_factory=dict)
    first: dict[tuple[str, str], str] = field(default_factory=dict)

    def count(self, reason: str, column: str, number: int, where: str) -> None:
        """Add readings left out for a reason; of none there is no entry.

        Args:
            reason: why they are left out.
            column: of the file, or `""`.
            number: of readings.
            where: the first of them, such as `row 7`.
        """
        if number:
            self.left_out[reason, column] = self.left_out.get((reason, column), 0) + int(number)
            self.first.setdefault((reason, column), where)

    def drop(self, links: pd.DataFrame, bad: ArrayLike, reason: str, column: str,
             where: Callable[[int], str]) -> pd.DataFrame:
        """Return links without the bad ones (n,), which are counted; `where` as of `Source`."""
        bad = np.asarray(bad, dtype=bool)
        if not bad.any():
            return links
        self.count(reason, column, bad.sum(), where(links.index[int(np.argmax(bad))]))
        return links[~bad]
