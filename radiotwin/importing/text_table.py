"""Read tables from texts of any dialect: encoding, separator, decimal mark, surrounding lines."""

import codecs
import csv
import io
import re
from collections import Counter, deque
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import IO

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.importing.log_files import Lines, LogFile, Sheet
from radiotwin.importing.settings import BLANKS, DELIMITERS, Settings
from radiotwin.importing.source import BadRows, Source
from radiotwin.io.budgets import CELLS, COLUMNS, ROW_BYTES, ROWS
from radiotwin.io.cells import EMPTY, cell_text
from radiotwin.io.texts import unescape_formula, unescape_formulas

_BLOCK_BYTES, _TAIL_BYTES = 2**18, 2**16
_LINES, _HEADER_LINES = 400, 200  # first lines that are examined; among which the header is
_MAX_TRAILER = 20  # lines after the table; more mean a damaged table
_BOMS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"),
         (codecs.BOM_UTF16_BE, "utf-16"))
_UNDEFINED = b"\x81\x8d\x8f\x90\x9d"  # in Windows-1252
_POINT = re.compile(r"[+-]?(\d+\.\d*|\.\d+)([eE][+-]?\d+)?")
COMMA = re.compile(r"[+-]?(\d+,\d+|,\d+)([eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")
_NAMES = {"\t": "tabs", ";": "semicolons", ",": "commas", "|": "vertical bars", " ": "blanks",
          "  ": "two and more blanks"}
_RUNS = {" ": re.compile(r'"[^"]*"|[ \t]+'), "  ": re.compile(r'"[^"]*"| *\t *| {2,}')}
_COMMENT = re.compile(r"\s*(#|%|//)")
_CHUNK_CELLS = 2_000_000  # that are converted at once


@dataclass(frozen=True)
class Dialect:
    """Dialect of a table in a text.

    Attributes:
        encoding: Python's name.
        delimiter: one of `DELIMITERS`.
        decimal: `.` or `,`.
        before: number of lines before the header.
        after: number of lines after the last row, without blank ones.
        trailer: the first line after the last row, if that was detected and not declared.
        repeated: a column name that occurs more than once, or `""`.
        names: of the columns, if there is no header.
        units: line of units below the header (without a digit), or `""`.
        has_comments: whether some of the first lines, or the header, begin with `#`.
        is_mark: whether the first field of the header is a comment mark only.
        quotes: whether quotation marks enclose fields.
    """

    encoding: str = "utf-8"
    delimiter: str = ","
    decimal: str = "."
    before: int = 0
    after: int = 0
    trailer: str = ""
    repeated: str = ""
    names: tuple[str, ...] = ()
    units: str = ""
    has_comments: bool = False
    is_mark: bool = False
    quotes: bool = True

    def described(self) -> str:
        """Describe the differences from comma-separated UTF-8; `""` if there are none."""
        parts = [f"separated by {_NAMES[self.delimiter]}" * (self.delimiter != ","),
                 "decimal commas" * (self.decimal == ","),
                 f"encoding {self.encoding}" * (not self.encoding.startswith("utf-8")),
                 "no header" * bool(self.names), _lines(self.before, "before the header"),
                 _lines(self.after, "after the table")
                 + f" ({cell_text(self.trailer)})" * bool(self.trailer),
                 f"a row of units ({self.units})" * bool(self.units)]
        if self.repeated:
            parts.append(f"column {cell_text(self.repeated)} occurs more than once: the others are "
                         f"{self.repeated}.2, …")
        return ", ".join(filter(None, parts))


def find_dialect(file: LogFile, settings: Settings, expected: Sequence[Collection[str]],
                 names: Sequence[str]) -> Dialect:
    """Detect encoding, header, delimiter, decimal mark, … of a text, where they are not declared.

    One of the sets of column names `expected`, in lower case, is probably in the header; `names`
    are those of a text without a header.

    Raises:
        BadInput: the file is no text, not in the declared encoding, or its decimal mark is
            ambiguous.
    """
    with file.open() as content:
        head, tail, whole, encoding = _scan(content, file, settings.encoding)
    head_lines = _split(head.decode(encoding, "replace").removeprefix("\ufeff"))
    lines = (head_lines if whole else head_lines[:-1])[:_LINES]
    if names:
        before = settings.lines_before_header or 0
        delimiter = settings.delimiter or _delimiter(lines[before:], len(names))
        header, first = list(names), before
    else:
        before, delimiter = _header(lines, settings, expected)
        header = _fields(lines[before], delimiter) if before < len(lines) else []
        first = before + 1
    rows = [_fields(line, delimiter) for line in lines[first:]]
    decimal = settings.decimal or _decimal(file, delimiter, rows, isinstance(file, Sheet))
    after, trailer = settings.lines_after_table, ""
    if after is None:
        lengths = Counter(map(len, rows))
        last = head_lines[first:] if whole else _split(tail.decode(encoding, "replace"))[1:]
        after = _trailer(last, delimiter, header,
                         {each for each, number in lengths.items() if each > 1 and number > 1})
        if after:
            trailer = [line.strip() for line in last if line.strip(f"{delimiter} \r\n\t")][-after]
    stripped = [name.strip() for name in header]
    repeated = next((name for i, name in enumerate(stripped) if name and name in stripped[:i]), "")
    columns = len(header_names(header))
    filled = [row for row in rows if any(field.strip() for field in row)][:2]
    units = ", ".join(filter(None, map(str.strip, filled[0]))) \
        if not names and _is_of_units(filled, columns) else ""
    has_comments = any(is_comment(row, columns, filled[:1]) for row in rows) \
        or (not names and bool(header) and _COMMENT.match(header[0]) is not None)
    is_mark = bool(has_comments and header and filled and _COMMENT.fullmatch(header[0].strip())
                   and fits(filled[0], columns - 1))
    return Dialect(encoding, delimiter, decimal, before, after, trailer, repeated, tuple(names),
                   units, has_comments, is_mark, settings.quotes)


def fits(row: Sequence[str], columns: int) -> bool:
    """Return whether a row has as many fields as the header, apart from empty last ones."""
    return len(row) >= columns and not any(field.strip() for field in row[columns:])


def is_comment(row: Sequence[str], columns: int, first: Sequence[Sequence[str]]) -> bool:
    """Return whether a row is a comment: it begins with a mark such as `#`.

    If the `first` row does too, a comment is only a row that does not fit the `columns`.
    """
    mark = _COMMENT.match(row[0]) if row else None
    if mark is None:
        return False
    return not fits(row, columns) or not any(_COMMENT.match(each[0]) for each in first if each)


def has_other_lines(cells: pd.DataFrame) -> bool:
    """Return whether some rows may be comments, or repeat the header."""
    first = cells.iloc[:, 0]
    return bool((first == cells.columns[0]).any() or first.str.startswith(("#", "%", "//")).any())


def _is_of_units(rows: Sequence[Sequence[str]], columns: int) -> bool:
    """Return whether the first of two rows has units: no digits, above at least two numbers."""
    if len(rows) < 2 or not fits(rows[0], columns) or _COMMENT.match(rows[0][0]):
        return False
    digits = [any(character.isdigit() for character in above) for above in rows[0]]
    return not any(digits) and sum(
        bool(above.strip()) and above.strip().lower() not in EMPTY
        and any(character.isdigit() for character in below)
        for above, below in zip(*rows)) > 1


def header_names(fields: Sequence[str]) -> list[str]:
    """Return column names: empty and repeated ones get a number, an empty last one is left out."""
    names = [re.sub("[\u200b\ufeff]", "", name).strip() for name in fields]  # zero-width
    if names and (mark := _COMMENT.match(names[0])):  # as NumPy writes a header
        names[0] = names[0][mark.end():].strip() or names[0]
    if len(names) > 1 and not names[-1]:
        names = names[:-1]
    names = [name or f"column {number}" for number, name in enumerate(names, start=1)]
    used, count = set(names), Counter[str]()
    for i, name in enumerate(names):
        count[name] += 1
        if count[name] > 1:
            while f"{name}.{count[name]}" in used:
                count[name] += 1
            names[i] = f"{name}.{count[name]}"
            used.add(names[i])
    return names


def _lines(number: int, where: str) -> str:
    return f"{number} line{'s' * (number > 1)} {where}" if number else ""


def _scan(content: IO[bytes], file: LogFile,
          declared: str | None) -> tuple[bytes, bytes, bool, str]:
    """Read a text once; return first and last block, whether that is one, and the encoding."""
    head = tail = content.read(_BLOCK_BYTES)
    encoding = codecs.lookup(declared).name if declared else next(
        (name for bom, name in _BOMS if head.startswith(bom)), "utf-8")
    decoder = codecs.getincrementaldecoder(encoding)()
    readable, undefined, whole, block = True, False, True, head
    while block:
        if b"\0" in block and not encoding.startswith("utf-16"):  # as `codecs` spells it
            raise BadInput(f"{file} is not text (it has null characters); allowed are text, "
                           "Parquet and XLSX. If it is UTF-16 without a mark, give --encoding "
                           "utf-16-le")
        undefined = undefined or bool(block.translate(None, delete=_UNDEFINED) != block)
        try:
            if readable:
                decoder.decode(block)
        except UnicodeDecodeError:
            readable = False
        block = content.read(_BLOCK_BYTES)
        if block:
            whole, tail = False, (tail + block)[-_TAIL_BYTES:]
    try:
        decoder.decode(b"", True)
    except UnicodeDecodeError:
        readable = False
    if not readable and (declared or encoding != "utf-8"):
        raise BadInput(f"{file} is not text in {encoding}; give another --encoding, or leave it "
                       "out to have it found")
    if not readable:
        encoding = "latin-1" if undefined else "cp1252"
    if encoding == "utf-16":  # the end of the file has no mark of the order of bytes
        encoding = "utf-16-le" if head.startswith(codecs.BOM_UTF16_LE) else "utf-16-be"
    return head, tail, whole, encoding


def _split(text: str) -> list[str]:
    """Split a text into lines as `Lines` counts them, unlike `str.splitlines`."""
    lines = re.split(r"\r\n|\r|\n", text)
    return lines if lines[-1] else lines[:-1]


def _fields(line: str, delimiter: str) -> list[str]:
    """Split a line into fields; return no field if Python's csv module refuses the line."""
    line, delimiter = _with_tabs(line, delimiter), "\t" if delimiter in BLANKS else delimiter
    try:
        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:
        return []


def _with_tabs(line: str, delimiter: str) -> str:
    """Replace runs of blanks by tabs outside quotation marks, if blanks are the delimiter."""
    if delimiter not in BLANKS:
        return line
    return _RUNS[delimiter].sub(lambda run: run[0] if run[0].startswith('"') else "\t",
                                line.strip(" \t\r\n"))


def _delimiter(lines: list[str], columns: int) -> str:
    """Return the delimiter that splits most lines into a number of fields."""
    return max((*DELIMITERS, *BLANKS), key=lambda each: sum(fits(_fields(line, each), columns)
                                                            for line in lines))


def _header(lines: list[str], settings: Settings,
            expected: Sequence[Collection[str]]) -> tuple[int, str]:
    """Find the index of the header line and the delimiter.

    The header with most expected names wins, then the largest table. Blanks also occur within
    texts, so they are delimiters only if they alone find all names, or no other delimiter fits.
    """
    delimiters = [settings.delimiter] if settings.delimiter else [*DELIMITERS, *BLANKS]
    places = range(min(len(lines), _HEADER_LINES))
    if settings.lines_before_header is not None:
        places = range(settings.lines_before_header, settings.lines_before_header + 1)
    best, result = (-1.0, 0), (settings.lines_before_header or 0, delimiters[0])
    for delimiter in delimiters:
        rows = [_fields(line, delimiter) for line in lines]
        counts = [len(row) for row in rows]
        for place in places:
            if place >= len(rows) or counts[place] < 2:
                continue
            names = header_names(rows[place])
            if sum(map(_is_number, names)) > len(names) / 2:
                continue
            known = {name.lower() for name in names}
            found = max((len(known & set(each)) / len(each) for each in expected if each),
                        default=0.0)
            good = sum(fits(row, len(names)) for row in rows[place + 1:])
            bad = sum(count > 0 for count in counts[place + 1:]) - good
            score = (found, len(names) * (1 + good - bad))
            if score > best and (delimiter not in BLANKS or score[0] == 1 > best[0]
                                 or best[0] < 0 or result[1] in BLANKS):
                best, result = score, (place, delimiter)
    return result


def _is_number(text: str) -> bool:
    """Return whether a text is a number, with a decimal point or comma."""
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def _decimal(file: LogFile, delimiter: str, rows: list[list[str]], is_typed: bool) -> str:
    """Return the decimal mark; BadInput if a comma may also separate thousands.

    In a sheet (`is_typed`) only numbers that were entered as texts can have commas.
    """
    cells = [cell.strip() for row in rows for cell in row]
    commas = [cell for cell in cells if COMMA.fullmatch(cell)]
    if not commas:
        return "."
    if all(_THOUSANDS.fullmatch(cell) for cell in commas):
        raise BadInput(f"{file}: {cell_text(commas[0])} may be a number with a decimal comma, or "
                       "one with separated thousands; give --decimal , for the first, or "
                       "--decimal . and write the number without its comma")
    has_points = delimiter == "," and not is_typed and any(map(_POINT.fullmatch, cells))
    return "." if has_points else ","


def _trailer(lines: list[str], delimiter: str, header: list[str], lengths: set[int]) -> int:
    """Count the last lines that are neither as long as the header nor of the rows' `lengths`."""
    columns, count = len(header_names(header)), 0
    for line in reversed(lines):
        fields = _fields(line, delimiter)
        if not any(field.strip() for field in fields):
            continue
        if fits(fields, columns) or len(fields) in lengths or line.count('"') % 2:
            return count if count <= _MAX_TRAILER else 0
        count += 1
    return 0  # no row is left: reading raises BadInput


def read_text_table(file: LogFile, dialect: Dialect, bad_rows: BadRows) -> Source:
    """Read the rows of a text file as a table of texts with decimal points, `""`: empty.

    Rows with too many fields are noted in `bad_rows`, and those with too few filled up, if it has a
    limit.

    Raises:
        BadInput: no header, a repeated name, or a row with too few or too many fields.
    """
    with file.open() as content, io.TextIOWrapper(content, dialect.encoding, newline="") as text:
        lines = _QuotedLines(text, file)
        for _ in islice(lines, dialect.before):
            lines.row_characters = 0
        delimiter = dialect.delimiter
        reader = _rows(csv.reader(
            (_with_tabs(line, delimiter) for line in lines),
            delimiter="\t" if delimiter in BLANKS else delimiter, skipinitialspace=True,
            strict=True, quoting=csv.QUOTE_MINIMAL if dialect.quotes else csv.QUOTE_NONE), lines)
        try:
            return _read(file, dialect, reader, lines, bad_rows)
        except csv.Error as error:
            raise BadInput(f"{file}: line {lines.number}: {error}; is a quotation mark not "
                           "closed? --no-quotes takes these marks for letters") from None
        except UnicodeDecodeError:
            raise BadInput(f"{file} is not text in {dialect.encoding}; give --encoding") from None


class _QuotedLines(Lines):
    """Lines with a bound of the length of a row, which may have line feeds in quotation marks."""

    row_characters = 0  # of the present row

    def __next__(self) -> str:
        line = super().__next__()
        self.row_characters += len(line)
        if self.row_characters > ROW_BYTES.limit:
            ROW_BYTES.refuse(f"{self._source}: line {self.number}",
                             f"a row of more than {ROW_BYTES.limit:,} characters")
        return line


def _rows(reader: Iterator[list[str]], lines: _QuotedLines) -> Iterator[list[str]]:
    """Yield all rows, and restart the count of characters after each."""
    for row in reader:
        lines.row_characters = 0
        yield row


def _read(file: LogFile, dialect: Dialect, reader: Iterator[list[str]],
          lines: Lines, bad_rows: BadRows) -> Source:
    """Read the header and the rows from a CSV reader, without comments and repeated headers."""
    names = list(dialect.names)
    if not names:
        fields = next(filter(None, reader), [])
        COLUMNS.check(len(fields), f"{file}: header")
        names = header_names([unescape_formula(name) for name in fields[dialect.is_mark:]])
    if not names:
        raise BadInput(f"{file} is empty; it needs a row with the names of the columns")
    chunk_rows = max(_CHUNK_CELLS // len(names), 1)
    chunks, numbers, bad, comments, headers = [], [], [], [], []
    rows: list[list[str]] = []
    few: dict[int, int] = {}
    first: list[list[str]] = []
    total, width = 0, len(names)
    has_units = bool(dialect.units)
    for number, row in _without_last(reader, lines, dialect.after):
        if is_comment(row, width, first):
            comments.append(number)
            continue
        if header_names([unescape_formula(name) for name in row]) == names:  # files were joined
            headers.append(number)
            continue
        first = first or [row]
        if has_units:
            has_units = False
            continue
        if len(row) != width and not fits(row, width):
            # With blanks as delimiters it is unknown which cell is missing.
            if bad_rows.limit < 0 or len(row) > width or dialect.delimiter in BLANKS:
                if bad_rows.add(f"{bad_rows.prefix}line {number}", "", f"{len(row)} fields",
                                f"is not the {width} of the header"):
                    bad.append(number)
                    continue
                hint = bad_rows.hint(1)
                if dialect.delimiter in BLANKS:
                    hint += "; where blanks are in a cell, --header names its parts"
                raise BadInput(f"{file}: line {number} has {len(row)} fields, the header has "
                               f"{width}; every row needs as many{hint}. If it is no row, leave it "
                               "out, or give --lines-before-header or --lines-after-table")
            few[total] = len(row)
            row = [*row, *[""] * (width - len(row))]
        rows.append(row[:width])
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
    notes = [f"{file.name}: {_lines(len(those), what)} left out, the first is line {those[0]}"
             for those, what in ((comments, "of comments"), (headers, "like the header")) if those]
    if description := dialect.described():
        notes.insert(0, f"{file.name}: {description}")
    left_out = (("bad row", len(bad), f"line {bad[0]}"),) if bad else ()
    line_of = np.array(numbers, dtype=np.int64)
    return Source(str(file), pd.concat(chunks, ignore_index=True),
                  lambda index: f"line {line_of[index]}", tuple(notes), few, left_out)


def _without_last(reader: Iterator[list[str]], lines: Lines,
                  after: int) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and fields of rows that are not blank, except the last `after` ones."""
    waiting: deque[tuple[int, list[str]]] = deque()
    for row in reader:
        if any(field.strip() for field in row):
            waiting.append((lines.number, row))
            if len(waiting) > after:
                yield waiting.popleft()


def _cells(rows: list[list[str]], names: list[str], decimal: str) -> pd.DataFrame:
    """Make a table of texts from rows, with points in place of decimal commas."""
    table = unescape_formulas(pd.DataFrame(rows, columns=names, dtype=str))
    if decimal == ",":
        for name in names:
            cells = table[name]
            comma = cells.str.fullmatch(COMMA.pattern).to_numpy(dtype=bool)
            if comma.any():
                table[name] = cells.mask(comma, cells.str.replace(",", ".", regex=False))
    return table
