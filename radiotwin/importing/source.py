"""A file of measurements as a table whose cells can be named in a message, and what is wrong in it.

All problems of an import become one message. Readings that are left out are counted by reason, so
that read = kept + left out.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from radiotwin.errors import BadInput
from radiotwin.io.cells import as_numbers, as_text, listed, refuse, shown
from radiotwin.io.forms import name_fault
from radiotwin.links.plausible import MAX_DEGREES
from radiotwin.links.site_table import dms_degrees

ALWAYS = "always "
"""Prefix of a constant in place of a column's name."""
_ROWS_AT_ONCE = 1_000_000  # of which stripped texts are made
_TEMPLATE = re.compile(r"\{([^{}]+)\}")
_SHOWN = 20  # of the problems in a message
_FEW, _FEW_SHARE = 20, 0.1  # damaged rows that are no sign of a file that is read wrongly


def are_few(number: int, total: int) -> bool:
    """Return whether so many damaged rows of a file are left out without being asked for."""
    return number <= min(_FEW, _FEW_SHARE * total)


@dataclass
class BadRows:
    """Rows that cannot be read, and are left out where the user allows so many.

    Attributes:
        limit: of the rows of all files, `skip_bad_rows`.
        prefix: of places in the file that is read, as its name where there are several.
        rows: where, column, cell and reason of each that is left out.
        fresh: index -> column of those that `take` noted last.
    """

    limit: int = 0
    prefix: str = ""
    rows: dict[str, dict[str, str]] = field(default_factory=dict)
    fresh: dict[int, str] = field(default_factory=dict)

    def add(self, where: str, column: str, cell: object, reason: str) -> bool:
        """Note a row; False if that would be more than allowed."""
        if where not in self.rows and len(self.rows) >= self.limit:
            return False
        self.rows.setdefault(where, {"row": where, "column": column, "cell": shown(cell),
                                     "reason": reason.partition(";")[0]})
        return True

    def take(self, source: "Source", spec: str, cells: pd.Series, rows: np.ndarray,
             reason: str) -> bool:
        """Note rows (n,) of cells; False, and none is noted, if they are more than allowed."""
        index = [int(cells.index[row]) for row in rows] if len(rows) <= self.limit else []
        places = [source.where(each) for each in index]
        if not places or len(self.rows.keys() | set(places)) > self.limit:
            return False
        for row, place in zip(rows, places):
            self.add(place, spec, cells.iloc[row], reason)
        self.fresh |= dict.fromkeys(index, spec)
        return True

    def hint(self, number: int) -> str:
        """Return how so many more rows can be left out, for the end of a message."""
        return f"; --skip-bad-rows {len(self.rows) + number} leaves such rows out"

    def without(self, links: pd.DataFrame, tally: "Tally", readings: int,
                where: Callable[[int], str]) -> pd.DataFrame:
        """Return links without the rows noted last; each counts as so many readings."""
        fresh, self.fresh = self.fresh, {}
        for spec in dict.fromkeys(fresh.values()):
            own = links.index[links.index.isin([row for row in fresh if fresh[row] == spec])]
            if len(own):
                tally.count("bad row", spec, len(own) * readings, where(own[0]))
        return links[~links.index.isin(list(fresh))] if fresh else links


@dataclass(frozen=True)
class Source:
    """A table whose index is the position of each row in the file.

    Attributes:
        path: of the file, or a name of several, for messages.
        table: cells as in the file.
        where: index -> `row 7`, as the file's user counts.
        notes: on how the file was read.
        fields: index -> number of fields, of the rows that had fewer than the header.
        left_out: rows that are not in the table: reason, number, and the first of them.
        bad_rows: where cells that cannot be read are noted; None where all must be readable.
    """

    path: Path | str
    table: pd.DataFrame
    where: Callable[[int], str]
    notes: tuple[str, ...] = ()
    fields: Mapping[int, int] = field(default_factory=dict)
    left_out: tuple[tuple[str, int, str], ...] = ()
    bad_rows: BadRows | None = None

    def __len__(self) -> int:
        return len(self.table)

    def select(self, keep: np.ndarray) -> Self:
        """Return the rows (n,) that are kept."""
        return replace(self, table=self.table[keep])

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
                quantity = purpose.removeprefix("device_")
                if quantity in MAX_DEGREES:
                    odd = start + np.flatnonzero(np.isnan(numbers[rows]) & (text != ""))
                    numbers[odd] = [dms_degrees(text.iloc[row - start], quantity) for row in odd]
                wrong[rows] = np.isnan(numbers[rows]) & (text != "")
            if wrong.any():
                self.refuse(spec, as_text(cells), wrong, "is not a number")
        self.refuse(spec, cells, np.isinf(numbers), "is not finite")
        return numbers

    def refuse(self, spec: str, cells: pd.Series, bad: ArrayLike, reason: str) -> None:
        """Raise BadInput about the first bad cell (n,) of a column, if there is one.

        The message names file, row and column, and ends with the reason. Nothing is raised where
        the user allows so many bad rows; they are noted.
        """
        rows = np.flatnonzero(np.asarray(bad, dtype=bool))
        if not len(rows):
            return
        if spec in self.table:  # as in the file, where `N/A` is an empty cell
            own = self.table[spec].reindex(cells.index)
            cells = own.where(own.map(lambda cell: isinstance(cell, str)), cells)
        if self.bad_rows is not None:
            if self.bad_rows.take(self, spec, cells, rows, reason):
                return
            if len(rows) < len(cells) / 2:  # else it is not the rows that are wrong
                reason += self.bad_rows.hint(len(rows))
        refuse(self.path, spec, cells, bad, reason, lambda row: self.where(cells.index[row]))


def columns_of(spec: str, header: Iterable[object]) -> list[str]:
    """Return the names of columns in an entry of a mapping, as of `Source.cells`.

    A name of the header may have braces itself.
    """
    if spec.startswith(ALWAYS) and spec not in header:
        return []
    return _TEMPLATE.findall(spec) if _TEMPLATE.search(spec) and spec not in header else [spec]


def constants_of(spec: str) -> list[str]:
    """Return the texts between the columns of an entry such as `2024-05-01 {Time}`."""
    return _TEMPLATE.split(spec)[::2]


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
        notes: on what was found in the values.
    """

    notes: list[str] = field(default_factory=list)
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
