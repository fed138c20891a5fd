"""Cells of a table in a text of any dialect."""

import csv
import io
from collections import deque
from collections.abc import Iterator
from itertools import islice

import numpy as np
import pandas as pd

from radiotwin.budgets import CELLS, COLUMNS, ROW_BYTES, ROWS
from radiotwin.errors import BadInput
from radiotwin.importing.dialect import COMMA, Dialect, fits, header_names
from radiotwin.importing.lines import Lines
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
        lines = _QuotedLines(text, file)
        for _ in islice(lines, dialect.before):
            lines.row_characters = 0
        reader = _rows(csv.reader(lines, delimiter=dialect.delimiter, skipinitialspace=True,
                                  strict=True), lines)
        try:
            return _read(file, dialect, reader, lines)
        except csv.Error as error:
            raise BadInput(f"{file}: line {lines.number}: {error}; is a quotation mark not "
                           "closed?") from None
        except UnicodeDecodeError:
            raise BadInput(f"{file} is not text in {dialect.encoding}; give --encoding") from None


class _QuotedLines(Lines):
    """Lines of rows, which quotation marks may carry over any number of lines."""

    row_characters = 0  # of the row that is being read

    def __next__(self) -> str:
        line = super().__next__()
        self.row_characters += len(line)
        if self.row_characters > ROW_BYTES.limit:
            ROW_BYTES.refuse(f"{self._source}: line {self.number}",
                             f"a row of more than {ROW_BYTES.limit:,} characters")
        return line


def _rows(reader: Iterator[list[str]], lines: _QuotedLines) -> Iterator[list[str]]:
    """Yield all rows; each is counted by itself."""
    for row in reader:
        lines.row_characters = 0
        yield row


def _read(file: LogFile, dialect: Dialect, reader: Iterator[list[str]],
          lines: Lines) -> tuple[pd.DataFrame, np.ndarray]:
    names = list(dialect.names)
    if not names:
        fields = next(filter(None, reader), [])
        COLUMNS.check(len(fields), f"{file}: header")
        names = header_names([unquoted(name) for name in fields])
    if not names:
        raise BadInput(f"{file} is empty; it needs a row with the names of the columns")
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


def _without_last(reader: Iterator[list[str]], lines: Lines,
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
