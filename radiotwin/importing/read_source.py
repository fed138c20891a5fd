"""Open a file of measurements, whose format is recognised by its name and its first line.

Each sheet of a workbook (.xlsx) is read as comma-separated text.
"""

import csv
import io
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import date, datetime, time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput, optional_package
from radiotwin.importing.json_files import read_json_log, starts_json
from radiotwin.importing.log_files import (
    BINARIES,
    BLOCK_BYTES,
    HEAD_BYTES,
    JSON,
    TEXTS,
    LogFile,
    Sheet,
    open_archive,
    open_member,
)
from radiotwin.importing.settings import Settings
from radiotwin.importing.source import BadRows, Source
from radiotwin.importing.text_table import find_dialect, has_other_lines, read_text_table
from radiotwin.io.budgets import CELLS, COLUMNS, DOCUMENT_BYTES, FILE_BYTES
from radiotwin.io.cells import RaggedRows, listed, read_cells

_MAX_ROWS = 1_048_576  # of a sheet, by the format
_PICTURES = ("xl/media/", "xl/embeddings/")
_DOCTYPES = tuple("<!DOCTYPE".encode(name) for name in ("utf-8", "utf-16-le", "utf-16-be",
                                                        "utf-32-le", "utf-32-be"))


@dataclass(frozen=True)
class WithoutHeader:
    """A format of texts without a header.

    Attributes:
        first_line: regular expression of the whole first line.
        names: of the columns.
        read: reader; None: of a table with these columns.
    """

    first_line: str
    names: tuple[str, ...] = ()
    read: Callable[[LogFile, Settings], Source] | None = None


@dataclass(frozen=True)
class Expected:
    """Columns that a file may have.

    Attributes:
        columns: sets of column names in lower case, one of which the header probably contains.
        without_header: formats of texts without a header.
        is_wanted: whether to read the sheet with a given header; None: it is chosen by `columns`.
    """

    columns: tuple[frozenset[str], ...] = ()
    without_header: tuple[WithoutHeader, ...] = ()
    is_wanted: Callable[[list[str]], bool] | None = None


def _read_sheets(file: LogFile, declared: str | None) -> Iterator[tuple[str, Sheet]]:
    """Yield name and content of the declared sheet of a workbook, or of each that is no chart.

    Formulas have the values that were saved with them.
    """
    _check(file)
    openpyxl = optional_package(
        "openpyxl", f"{file}: workbooks need the package openpyxl; `pip install radiotwin[xlsx]`, "
                    "or save the sheet as CSV")
    try:
        book = openpyxl.load_workbook(file.path, read_only=True, data_only=True, keep_links=False)
        try:
            names = book.sheetnames
            if declared is not None and declared not in names:
                raise BadInput(f"{file} has no sheet {declared!r}; it has {listed(names)}")
            tables = [name for name in names if hasattr(book[name], "reset_dimensions")]
            if not tables or declared is not None and declared not in tables:
                raise BadInput(f"{file}: its sheet {declared or names[0]!r} is a chart; name one "
                               "with --sheet")
            for name in [declared] if declared is not None else tables:
                yield name, Sheet(file.path, file.name, text=_text(file, book[name]))
        finally:
            book.close()
    except BadInput:
        raise
    except Exception as error:  # openpyxl raises those of zipfile, XML and its own
        raise BadInput(f"{file} cannot be read as a workbook ({str(error)[:200]}); save it again, "
                       "or as CSV") from None


def _read_workbook(file: LogFile, settings: Settings, expected: Expected,
                   bad_rows: BadRows) -> Source:
    """Read the sheets of a workbook that belong together, as one table.

    They are those with the declared columns, else those with the columns of the first sheet; or the
    first that `expected.is_wanted` accepts. A note names the others.
    """
    settings = settings.model_copy(update={"delimiter": ","})
    sources: dict[str, Source] = {}
    failed: dict[str, BadInput] = {}
    prefix = bad_rows.prefix
    for name, sheet in _read_sheets(file, settings.sheet):
        if settings.sheet is None:
            bad_rows.prefix = f"{prefix}sheet {name}: "
        try:
            source = _read_text(sheet, settings, expected, bad_rows)
            if len(source):
                sources[name] = source
        except BadInput as error:  # as of one without a table
            failed[name] = error
    bad_rows.prefix = prefix
    if not sources:
        raise next(iter(failed.values()), BadInput(f"{file}: has no rows; it needs at least one "
                                                   "measurement"))
    declared = expected.columns[0] if expected.columns else frozenset()
    columns = {name: {str(column).lower() for column in source.table}
               for name, source in sources.items()}
    if expected.is_wanted is not None:
        wanted = (name for name in sources if expected.is_wanted(list(sources[name].table)))
        chosen = [next(wanted, next(iter(sources)))]
    else:
        chosen = [name for name in sources if declared and declared <= columns[name]] \
            or [name for name in sources if columns[name] == next(iter(columns.values()))]
    others = [*(name for name in sources if name not in chosen), *failed]
    notes = (f"{file.name}: sheets with other columns are not read: {listed(others)}"
             + "; name one with --sheet" * (expected.is_wanted is None),) if others else ()
    if len(chosen) == 1:
        only = sources[chosen[0]]
        return replace(only, notes=(*only.notes, *notes))
    return _joined(file, {name: sources[name] for name in chosen}, notes)


def _joined(file: LogFile, sources: dict[str, Source], notes: tuple[str, ...]) -> Source:
    """Join the rows of several sheets of one workbook with the same columns."""
    starts = np.cumsum([0, *map(len, sources.values())])
    parts = list(sources.items())

    def where(index: int) -> str:
        part = int(np.searchsorted(starts, index, side="right")) - 1
        return f"sheet {parts[part][0]}: {parts[part][1].where(index - int(starts[part]))}"

    table = pd.concat([source.table for source in sources.values()], ignore_index=True).fillna("")
    joined = f"{file.name}: the sheets {listed(sources)} have the same columns and are read"
    return Source(
        file.path, table, where,
        (*dict.fromkeys(note for source in sources.values() for note in source.notes), joined,
         *notes),
        {int(start) + row: count for start, source in zip(starts, sources.values())
         for row, count in source.fields.items()},
        tuple((reason, number, f"sheet {name}: {place}") for name, source in sources.items()
              for reason, number, place in source.left_out))


def _check(file: LogFile) -> None:
    """Raise BadInput if a workbook is too large when unpacked, or declares XML entities."""
    with open_archive(file.path) as archive:
        # A part may have any name, so all are checked.
        entries = archive.infolist()
        DOCUMENT_BYTES.check(sum(entry.file_size for entry in entries
                                 if not entry.filename.startswith(_PICTURES)), file)
        for entry in entries:
            last, is_named_xml = b"", entry.filename.lower().endswith((".xml", ".rels"))
            with open_member(archive, entry.filename, file) as content:
                while block := content.read(BLOCK_BYTES):
                    # Entities can stand for any amount of text; UTF-16 would hide them.
                    text = last + block
                    if any(each in text for each in _DOCTYPES) or is_named_xml and b"\0" in block:
                        raise BadInput(f"{file}: {entry.filename[:100]!r} is no XML of a workbook "
                                       "(it has a DOCTYPE or null characters); save it again")
                    last = block[-64:]


def _text(file: LogFile, sheet: Any) -> bytes:
    """Convert a sheet of a workbook to comma-separated text; BadInput if it is too large."""
    sheet.reset_dimensions()  # those in the file may be wrong
    text = io.BytesIO()
    wrapper = io.TextIOWrapper(text, "utf-8", newline="", write_through=True)
    writer = csv.writer(wrapper)
    cells = 0
    for number, row in enumerate(sheet.iter_rows(values_only=True), start=1):
        if number > _MAX_ROWS:
            raise BadInput(f"{file}: more than {_MAX_ROWS:,} rows, the most that a sheet has")
        COLUMNS.check(len(row), f"{file}: row {number}")
        cells += len(row)
        CELLS.check(cells, file)
        writer.writerow([_shown(value) for value in row])
        FILE_BYTES.check(text.tell(), file)
    wrapper.flush()
    return text.getvalue()


def _shown(value: object) -> str:
    """Return a cell of a sheet as text: dates without midnight, whole numbers without a point."""
    if value is None:
        return ""
    if isinstance(value, datetime):
        return str(value.date()) if value.time() == time() else value.isoformat(sep=" ")
    if isinstance(value, (date, time)):
        return value.isoformat()
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        return str(int(value))
    return " ".join(str(value).split("\n")).replace("\r", " ")


def read_source(file: LogFile | Path | str, settings: Settings | None = None,
                expected: Expected = Expected(), bad_rows: BadRows | None = None) -> Source:
    """Read the table of a file of measurements.

    Args:
        file: in a format of `log_files`.
        settings: declared properties of the text; others are detected.
        expected: columns that help to find the header.
        bad_rows: where bad rows are noted; None: they are refused.

    Raises:
        BadInput: unknown format, unreadable, or without rows.
    """
    if not isinstance(file, LogFile):
        file = LogFile(Path(file), Path(file).name)
    settings, bad_rows = settings or Settings(), bad_rows or BadRows()
    if file.suffix == ".parquet":
        source = Source(file.path, read_cells(file.path), lambda index: f"row {index + 1}")
    elif file.suffix == ".xlsx" and file.member is None:
        source = _read_workbook(file, settings, expected, bad_rows)
    elif file.suffix in TEXTS:
        source = _read_text(file, settings, expected, bad_rows)
    else:
        raise BadInput(f"{file}: unknown format; allowed are {', '.join((*TEXTS, *BINARIES))}, and "
                       "the first ones with .gz")
    if not len(source):
        raise BadInput(f"{file}: has no rows; it needs at least one measurement")
    return replace(source, bad_rows=bad_rows)


def _read_text(file: LogFile, settings: Settings, expected: Expected,
               bad_rows: BadRows) -> Source:
    """Read a text file: JSON, a format without a header, or a table; plain CSV by pandas."""
    first = _first_line(file)
    kind = next((each for each in expected.without_header
                 if re.fullmatch(each.first_line, first)), None)
    if file.suffix in JSON or starts_json(first):
        declared, *may_be = expected.columns or (frozenset(),)
        return read_json_log(file, declared, frozenset().union(*may_be), settings.list_name,
                             settings.crs, bad_rows)
    if kind is not None and kind.read is not None:
        return kind.read(file, settings)
    names = settings.header or (list(kind.names) if kind is not None else [])
    dialect = find_dialect(file, settings, expected.columns, names)
    plain = dialect.quotes and not (dialect.described() or dialect.has_comments)
    if plain and file.member is None and file.suffix == ".csv":
        with suppress(RaggedRows):
            cells = read_cells(file.path)
            if not has_other_lines(cells):
                return Source(file.path, cells, lambda index: f"row {index + 2}")
    return read_text_table(file, dialect, bad_rows)


def _first_line(file: LogFile) -> str:
    """Return the first line that is not blank, at most its first `HEAD_BYTES`."""
    with file.open() as content:
        head = content.read(HEAD_BYTES).decode("latin-1").removeprefix("\u00ef\u00bb\u00bf")
    return next((line for line in map(str.strip, head.splitlines()) if line), "")
