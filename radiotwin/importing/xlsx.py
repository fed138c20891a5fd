"""A sheet of a workbook (.xlsx) as the text of a table."""

import csv
import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date, datetime, time
from typing import IO, Any

from radiotwin.budgets import CELLS, COLUMNS, DOCUMENT_BYTES, FILE_BYTES
from radiotwin.cells import listed
from radiotwin.errors import BadInput
from radiotwin.importing.log_files import LogFile, open_archive, open_member

_MAX_ROWS = 1_048_576  # of a sheet, by the format
_BLOCK_BYTES = 2**20
_PICTURES = ("xl/media/", "xl/embeddings/")
_DOCTYPES = tuple("<!DOCTYPE".encode(name) for name in ("utf-8", "utf-16-le", "utf-16-be",
                                                        "utf-32-le", "utf-32-be"))


@dataclass(frozen=True)
class Sheet(LogFile):
    """The text of a sheet, comma-separated; each row is a line.

    Attributes:
        text: in UTF-8.
    """

    text: bytes = b""

    @contextmanager
    def open(self) -> Iterator[IO[bytes]]:
        """Open it for reading."""
        yield io.BytesIO(self.text)


def read_sheet(file: LogFile, sheet: str | None) -> Sheet:
    """Read a sheet by openpyxl, row by row; formulas have the values that were saved with them.

    Args:
        file: `.xlsx`.
        sheet: name, or None for the first.

    Raises:
        BadInput: openpyxl is not installed, no such sheet, or the workbook is damaged or too large.
    """
    _check(file)
    try:
        import openpyxl
    except ImportError:
        raise BadInput(f"{file}: workbooks need the package openpyxl; `pip install "
                       "radiotwin[xlsx]`, or save the sheet as CSV") from None
    try:
        book = openpyxl.load_workbook(file.path, read_only=True, data_only=True, keep_links=False)
        try:
            names = book.sheetnames
            if sheet is not None and sheet not in names:
                raise BadInput(f"{file} has no sheet {sheet!r}; it has {listed(names)}")
            return Sheet(file.path, file.name, text=_text(file, book[sheet or names[0]]))
        finally:
            book.close()
    except BadInput:
        raise
    except Exception as error:  # openpyxl raises those of zipfile, XML and its own
        raise BadInput(f"{file} cannot be read as a workbook ({str(error)[:200]}); save it again, "
                       "or as CSV") from None


def _check(file: LogFile) -> None:
    """Refuse a workbook that is large when unpacked, or that declares XML entities."""
    with open_archive(file.path) as archive:
        # A part may have any name: what it is, others say of it.
        entries = archive.infolist()
        DOCUMENT_BYTES.check(sum(entry.file_size for entry in entries
                                 if not entry.filename.startswith(_PICTURES)), file)
        for entry in entries:
            last, is_named_xml = b"", entry.filename.lower().endswith((".xml", ".rels"))
            with open_member(archive, entry.filename, file) as content:
                while block := content.read(_BLOCK_BYTES):
                    # Entities can stand for any amount of text; UTF-16 would hide them.
                    text = last + block
                    if any(each in text for each in _DOCTYPES) or is_named_xml and b"\0" in block:
                        raise BadInput(f"{file}: {entry.filename[:100]!r} is no XML of a workbook "
                                       "(it has a DOCTYPE or null characters); save it again")
                    last = block[-64:]


def _text(file: LogFile, sheet: Any) -> bytes:
    if not hasattr(sheet, "reset_dimensions"):
        raise BadInput(f"{file}: its sheet {sheet.title!r} is a chart; name one with --sheet")
    sheet.reset_dimensions()  # which a file may declare as it likes
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
    """Return a cell as text; dates without a time, and whole numbers without a point."""
    if value is None:
        return ""
    if isinstance(value, datetime):
        return str(value.date()) if value.time() == time() else value.isoformat(sep=" ")
    if isinstance(value, (date, time)):
        return value.isoformat()
    if isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        return str(int(value))
    return " ".join(str(value).split("\n")).replace("\r", " ")
