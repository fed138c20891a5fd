"""Cells of a table in a text of any dialect."""

import csv
import io
from collections import deque
from collections.abc import Iterator
from itertools import islice

import numpy as np
import pandas as pd

from radiotwin.budgets import CELLS, COLUMNS, ROW_BYTES, ROWS
from radiotwin.cells import shown
from radiotwin.errors import BadInput
from radiotwin.importing.dialect import COMMA, Dialect, fits, header_names
from radiotwin.importing.log_files import LogFile
from radiotwin.spreadsheet import unquoted, without_quotes

_CHUNK_CELLS = 2_000_000  # of which a table is made at a time


def read_text_table(file: LogFile, dialect: Dialect) -> tuple[pd.DataFrame, np.ndarray]:
    """Read all cells as texts.

    Args:
        file: of text.
        dialect: of the text.

    Returns:
        cells, `""` where empty, decimal commas as points; and the line of each row, from 1.

    Raises:
        BadInput: no header, a repeated name, or a row with too few or too many fields.
    """
    with file.open() as content, io.TextIOWrapper(content, dialect.encoding, newline="") as text:
        lines = _Lines(text, file)
        for _ in islice(lines, dialect.before):
            pass
        reader = csv.reader(lines, delimiter=dialect.delimiter, skipinitialspace=True)
        try:
            return _read(file, dialect, reader, lines)
        except csv.Error as error:
            raise BadInput(f"{file}: line {lines.number}: {error}; is a quotation mark not "
                           "closed?") from None
        except UnicodeDecodeError:
            raise BadInput(f"{file} is not text in {dialect.encoding}; give --encoding") from None


class _Lines:
    """Lines of a text, counted and bounded."""

    def __init__(self, text: io.TextIOWrapper, file: LogFile) -> None:
        self._text, self._file, self.number = text, file, 0

    def __iter__(self) -> Iterator[str]:
        return self

    def __next__(self) -> str:
        line = self._text.readline(ROW_BYTES.limit)
        if not line:
            raise StopIteration
        if len(line) == ROW_BYTES.limit and not line.endswith(("\n", "\r")):
            ROW_BYTES.refuse(f"{self._file}: line {self.number + 1}",
                             f"a line of {ROW_BYTES.limit:,} characters and more")
        self.number += 1
        return line if self.number > 1 else line.removeprefix("\ufeff")


def _read(file: LogFile, dialect: Dialect, reader: Iterator[list[str]],
          lines: _Lines) -> tuple[pd.DataFrame, np.ndarray]:
    fields = next(filter(None, reader), [])
    COLUMNS.check(len(fields), f"{file}: header")
    names = [unquoted(name) for name in header_names(fields)]
    if not names:
        raise BadInput(f"{file} is empty; it needs a row with the names of the columns")
    repeated = pd.Index(names, dtype=object).duplicated()
    if repeated.any():
        raise BadInput(f"{file}: line {lines.number}: column "
                       f"{shown(names[int(np.argmax(repeated))])} occurs twice; every name must be "
                       "unique")
    chunk_rows = max(_CHUNK_CELLS // len(names), 1)
    chunks, numbers = [], []
    rows: list[list[str]] = []
    total = 0
    for number, row in _without_last(reader, lines, dialect.after):
        if not fits(row, len(names)):
            raise BadInput(f"{file}: line {number} has {len(row)} fields, the header has "
                           f"{len(names)}; every row needs as many. If it is no row, leave it out, "
                           "or give --lines-before-header or --lines-after-table")
        rows.append(row[:len(names)])
        numbers.append(number)
        total += 1
        if len(rows) == chunk_rows:
            ROWS.check(total, file)
            CELLS.check(total * len(names), file)
            chunks.append(_cells(rows, names, dialect.decimal))
            rows = []
    if rows or not chunks:
        chunks.append(_cells(rows, names, dialect.decimal))
    ROWS.check(total, file)
    return pd.concat(chunks, ignore_index=True), np.array(numbers, dtype=np.int64)


def _without_last(reader: Iterator[list[str]], lines: _Lines,
                  after: int) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows that are not blank, with their lines, without the last ones."""
    waiting: deque[tuple[int, list[str]]] = deque()
    for row in reader:
        if any(field.strip() for field in row):
            waiting.append((lines.number, row))
            if len(waiting) > after:
                yield waiting.popleft()


def _cells(rows: list[list[str]], names: list[str], decimal: str) -> pd.DataFrame:
    table = without_quotes(pd.DataFrame(rows, columns=names, dtype=str))
    if decimal == ",":
        for name in names:
            cells = table[name]
            comma = cells.str.fullmatch(COMMA.pattern).to_numpy(dtype=bool)
            if comma.any():
                table[name] = cells.mask(comma, cells.str.replace(",", ".", regex=False))
    return table
