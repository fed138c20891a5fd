"""The layout of a CSV file: its header, and as many fields in every row, counted in blocks."""

import csv
import re
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import IO

import numpy as np

from radiotwin.budgets import CELLS, COLUMNS, ROW_BYTES, ROWS
from radiotwin.errors import BadInput
from radiotwin.spreadsheet import unquoted

_BLOCK_BYTES = 2**20  # that are checked at a time


class CsvLayout:
    """Checks that every row of a CSV file has as many fields as its header.

    Args:
        path: of the file, for messages.

    Attributes:
        header: names of the columns.
        rows: with the header, without blank lines.
        has_apostrophes: whether there is any.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.header: list[str] = []
        self.rows = 0
        self.has_apostrophes = False

    def check(self, file: IO[bytes]) -> None:
        """Check all rows; counts separators as long as there are no quotation marks.

        Args:
            file: decompressed.

        Raises:
            BadInput: names the row.
        """
        blocks = self._blocks(file)
        for block in blocks:
            if b'"' in block or block.count(b"\r") != block.count(b"\r\n"):
                self._check_fields(chain([block], blocks))
                break
            self._count_separators(block)
        if not self.header:
            raise BadInput(f"{self._path} is empty; it needs a first row with the names of the "
                           "columns")

    def _blocks(self, file: IO[bytes]) -> Iterator[bytes]:
        """Yield whole lines, checked to be text."""
        rest = file.read(3).removeprefix(b"\xef\xbb\xbf")
        while data := file.read(_BLOCK_BYTES):
            whole, newline, rest_of_data = data.rpartition(b"\n")
            if not newline:
                rest += data
                if len(rest) > ROW_BYTES.limit:
                    ROW_BYTES.refuse(f"{self._path}: after row {self.rows}",
                                     f"a row of more than {ROW_BYTES.limit:,} bytes")
                continue
            yield self._checked(rest + whole + newline)
            rest = rest_of_data
        if rest:
            yield self._checked(rest)

    def _checked(self, block: bytes) -> bytes:
        block.decode()
        if b"\0" in block:
            raise BadInput(f"{self._path} is not text in UTF-8 (it has null characters); allowed "
                           "is comma-separated, UTF-8")
        self.has_apostrophes = self.has_apostrophes or b"'" in block
        return block

    def _count_separators(self, block: bytes) -> None:
        if not self.header:
            line, _, block = block.lstrip(b"\r\n").partition(b"\n")
            COLUMNS.check(line.count(b",") + 1, f"{self._path}: row 1")
            if not line:
                return
            self._begin(next(csv.reader([line.decode()], skipinitialspace=True)))
        if not block:
            return
        if not block.endswith(b"\n"):
            block += b"\n"
        codes = np.frombuffer(block, dtype=np.uint8)
        ends = np.flatnonzero(codes == ord("\n"))
        fields = np.diff(np.searchsorted(np.flatnonzero(codes == ord(",")), ends), prepend=0) + 1
        length = np.diff(ends, prepend=-1) - 1
        blank = (length == 0) | ((length == 1) & (codes[ends - 1] == ord("\r")))
        fields = fields[~blank]
        wrong = fields != len(self.header)
        if wrong.any():
            row = int(np.argmax(wrong))
            self._refuse(self.rows + row + 1, int(fields[row]))
        self._add(len(fields))

    def _check_fields(self, blocks: Iterable[bytes]) -> None:
        """Check rows that may have fields in quotation marks, or lines that end in any way."""
        lines = (line for block in blocks
                 for line in re.findall(r"[^\r\n]*(?:\r\n|\r|\n)|[^\r\n]+$", block.decode()))
        try:
            for fields in filter(None, csv.reader(lines, skipinitialspace=True)):
                if not self.header:
                    COLUMNS.check(len(fields), f"{self._path}: row 1")
                    self._begin(fields)
                    continue
                if len(fields) != len(self.header):
                    self._refuse(self.rows + 1, len(fields))
                self._add(1)
        except csv.Error as error:
            raise BadInput(f"{self._path}: row {self.rows + 1}: {error}; is a quotation mark not "
                           "closed?") from None

    def _begin(self, header: list[str]) -> None:
        self.header, self.rows = [unquoted(name.strip()) for name in header], 1
        if len(header) == 1 and not self.header[0].isidentifier():
            raise BadInput(f"{self._path}: its header {self.header[0][:60]!r} is one single "
                           "column; allowed is comma-separated, UTF-8")

    def _add(self, rows: int) -> None:
        self.rows += rows
        ROWS.check(self.rows - 1, self._path)
        CELLS.check((self.rows - 1) * len(self.header), self._path)

    def _refuse(self, row: int, fields: int) -> None:
        raise BadInput(f"{self._path}: row {row} has {fields} fields, the header has "
                       f"{len(self.header)}; every row needs as many commas as the header")
