"""`Source`: a table whose rows can be named in messages; and the errors and counts of an import.

All errors of an import become one message. Readings that are left out are counted by reason, so
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
from radiotwin.io.cells import as_numbers, as_text, cell_text, listed, refuse
from radiotwin.io.forms import name_fault
from radiotwin.links.plausible import MAX_DEGREES
from radiotwin.links.site_table import dms_degrees

ALWAYS = "always "
"""Prefix of a constant in place of a column's name."""
ROWS_AT_ONCE = 1_000_000  # that are converted at once
_TEMPLATE = re.compile(r"\{([^{}]+)\}")
_SHOWN = 20  # errors in a message
_FEW, _FEW_SHARE = 20, 0.1  # number and share of damaged rows in a file that is otherwise right


def are_few(number: int, total: int) -> bool:
    """Return whether damaged rows are few (at most 20, and 10 %): they may just be dropped."""
    return number <= min(_FEW, _FEW_SHARE * total)


@dataclass
class BadRows:
    """Unreadable rows that are left out, as far as the user allows.

    Attributes:
        limit: allowed number in all files, `skip_bad_rows`; -1: of files that have no such option.
        prefix: of places in the present file: its name if there are several.
        rows: place, column, cell and reason of each row that is left out.
        fresh: index -> column of the rows that `note_rows` noted since the last `drop_noted`.
    """

    limit: int = -1
    prefix: str = ""
    rows: dict[str, dict[str, str]] = field(default_factory=dict)
    fresh: dict[int, str] = field(default_factory=dict)

    def add(self, where: str, column: str, cell: object, reason: str) -> bool:
        """Note a bad row to leave out; return False, and do not, if that exceeds the limit."""
        if where not in self.rows and len(self.rows) >= self.limit:
            return False
        self.rows.setdefault(where, {"row": where, "column": column, "cell": cell_text(cell),
                                     "reason": reason.partition(";")[0]})
        return True

    def note_rows(self, source: "Source", spec: str, cells: pd.Series, rows: np.ndarray,
                  reason: str) -> bool:
        """Note several bad rows of a column; return False, and note none, if that is too many."""
        index = [int(cells.index[row]) for row in rows] if len(rows) <= self.limit else []
        places = [source.where(each) for each in index]
        if not places or len(self.rows.keys() | set(places)) > self.limit:
            return False
        for row, place in zip(rows, places):
            self.add(place, spec, cells.iloc[row], reason)
        self.fresh |= dict.fromkeys(index, spec)
        return True

    def hint(self, number: int) -> str:
        """Return the end of a message: the option, if any, that leaves out `number` more rows."""
        option = f"; --skip-bad-rows {len(self.rows) + number} leaves such rows out"
        return option if self.limit >= 0 else ""

    def drop_noted(self, links: pd.DataFrame, tally: "Tally", readings: int,
                   where: Callable[[int], str]) -> pd.DataFrame:
        """Drop the links of rows that were noted since the last call, and count them in the tally.

        Each row counts as `readings` readings; noted rows are forgotten.
        """
        fresh, self.fresh = self.fresh, {}
        for spec in dict.fromkeys(fresh.values()):
            bad = links.index[links.index.isin([row for row in fresh if fresh[row] == spec])]
            if len(bad):
                tally.count("bad row", spec, len(bad) * readings, where(bad[0]))
        return links[~links.index.isin(list(fresh))] if fresh else links


@dataclass(frozen=True)
class Source:
    """A table of a file; its index is the position of each row in the file.

    Attributes:
        path: of the file, or a label of several files, for messages.
        table: cells as in the file.
        where: index -> `row 7`, as in the file.
        notes: on how the file was read.
        fields: index -> number of fields, for rows with fewer fields than the header.
        left_out: rows that are not in the table: reason, number, and the first one.
        bad_rows: where unreadable cells are noted.
    """

    path: Path | str
    table: pd.DataFrame
    where: Callable[[int], str]
    notes: tuple[str, ...] = ()
    fields: Mapping[int, int] = field(default_factory=dict)
    left_out: tuple[tuple[str, int, str], ...] = ()
    bad_rows: BadRows = field(default_factory=BadRows)

    def __len__(self) -> int:
        return len(self.table)

    def select(self, keep: np.ndarray) -> Self:
        """Select rows by a mask (n,)."""
        return replace(self, table=self.table[keep])

    def cells(self, spec: str, purpose: str) -> pd.Series:
        """Return the cells of a column, a constant, or texts made of several columns.

        Args:
            spec: name of a column, `always VALUE`, or a template such as `{Date} {Time}`, which is
                empty if one of its cells is.
            purpose: quantity that the cells hold, for messages.

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
        """Raise BadInput unless the file has all columns in a mapping: quantity -> entry."""
        missing = [f"{name!r} ({purpose})" for purpose, spec in specs.items()
                   for name in columns_of(spec, self.table) if name not in self.table]
        if missing:
            several = len(missing) > 1
            raise BadInput(f"{self.path}: column{'s' * several} {', '.join(missing)} "
                           f"{'are' if several else 'is'} missing; the file has "
                           f"{listed(self.table.columns)}. Correct the mapping")

    def names(self, spec: str, purpose: str) -> np.ndarray:
        """Return the cells as names, (n,) texts, `""`: empty; see `cells`.

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
        """Return the cells as numbers, (n,), NaN: empty; see `cells`.

        Raises:
            BadInput: no such column, a text, or a number that is not finite.
        """
        cells = self.cells(spec, purpose)
        if cells.dtype.kind in "fiu":
            numbers = cells.to_numpy(dtype=float, na_value=np.nan)
        else:
            numbers = np.full(len(cells), np.nan)
            wrong = np.zeros(len(cells), dtype=bool)
            for start in range(0, len(cells), ROWS_AT_ONCE):
                rows = slice(start, start + ROWS_AT_ONCE)
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
        """Raise BadInput about bad cells (a mask) of a column, unless so many may be bad.

        Allowed ones are noted in `bad_rows`. The message names file, row and column of the first
        one, and ends with the reason.
        """
        rows = np.flatnonzero(np.asarray(bad, dtype=bool))
        if not len(rows):
            return
        if spec in self.table:  # as in the file, where `N/A` is an empty cell
            texts = self.table[spec].reindex(cells.index)
            cells = texts.where(texts.map(lambda cell: isinstance(cell, str)), cells)
        if self.bad_rows.note_rows(self, spec, cells, rows, reason):
            return
        if len(rows) < len(cells) / 2:  # else it is not the rows that are wrong
            reason += self.bad_rows.hint(len(rows))
        refuse(self.path, spec, cells, bad, reason, lambda row: self.where(cells.index[row]))


def columns_of(spec: str, header: Iterable[object]) -> list[str]:
    """Return the columns in an entry of a mapping: a name, names in braces, or none (`always X`).

    An entry that is in the header is that column, also if it has braces.
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
        """Catch a `BadInput` of the block and keep its message, so that others are found, too."""
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
    """Counts of readings that were left out.

    Attributes:
        left_out: (reason, column) -> number of readings, in the order of first use.
        first: (reason, column) -> place of the first one, such as `row 7`.
        notes: on odd values.
    """

    notes: list[str] = field(default_factory=list)
    left_out: dict[tuple[str, str], int] = field(default_factory=dict)
    first: dict[tuple[str, str], str] = field(default_factory=dict)

    def count(self, reason: str, column: str, number: int, where: str) -> None:
        """Add a number of readings left out for a reason and column; `where` is the first one."""
        if number:
            self.left_out[reason, column] = self.left_out.get((reason, column), 0) + int(number)
            self.first.setdefault((reason, column), where)

    def drop(self, links: pd.DataFrame, bad: ArrayLike, reason: str, column: str,
             where: Callable[[int], str]) -> pd.DataFrame:
        """Drop the links of a mask (n,), and count them under a reason and a column.

        `where` tells the place of a link in its file, for the first one that is dropped.
        """
        bad = np.asarray(bad, dtype=bool)
        if not bad.any():
            return links
        self.count(reason, column, bad.sum(), where(links.index[int(np.argmax(bad))]))
        return links[~bad]
