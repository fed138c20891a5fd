"""Opening of a file of measurements: its format is known by its name and its first line.

Of JSON lines, one object a line, nested values become columns with dots in their names. A sheet of
a workbook (.xlsx) becomes the text of a table.
"""

import csv
import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import date, datetime, time
from pathlib import Path
from typing import IO, Any

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput, optional_package
from radiotwin.importing.log_files import BINARIES, TEXTS, Lines, LogFile, open_archive, open_member
from radiotwin.importing.settings import Settings
from radiotwin.importing.source import BadRows, Source
from radiotwin.importing.text_table import find_dialect, has_other_lines, read_text_table
from radiotwin.io.budgets import CELLS, COLUMNS, DOCUMENT_BYTES, FILE_BYTES, ROWS
from radiotwin.io.cells import RaggedRows, listed, read_cells
from radiotwin.io.inputs import parse_json

LISTS = ("rxInfo", "rx_metadata", "rxpk", "gateways")
"""Lists of receptions: a row for each of their objects."""
_MAX_ROWS = 1_048_576  # of a sheet, by the format
_BLOCK_BYTES = 2**20
_PICTURES = ("xl/media/", "xl/embeddings/")
_DOCTYPES = tuple("<!DOCTYPE".encode(name) for name in ("utf-8", "utf-16-le", "utf-16-be",
                                                        "utf-32-le", "utf-32-be"))
_HEAD_BYTES = 2**16  # in which the first line is looked for


def _read_json_lines(file: LogFile) -> tuple[pd.DataFrame, np.ndarray]:
    """Return the cells of JSON lines as texts, and the line of each row, from 1.

    A cell is `""` where a value is null, missing, or a list other than `LISTS`.
    """
    rows: list[dict[str, str]] = []
    numbers: list[int] = []
    columns: dict[str, None] = {}  # in the order of their first use
    cells = 0
    with file.open() as content, io.TextIOWrapper(content, "utf-8", newline="") as text:
        lines = Lines(text, file)
        try:
            for line in lines:
                if not line.strip():
                    continue
                record = parse_json(line, f"{file}: line {lines.number}")
                if not isinstance(record, dict):
                    raise BadInput(f"{file}: line {lines.number} is no JSON object; allowed is "
                                   "one object a line")
                for row in _rows(record):
                    rows.append(row)
                    numbers.append(lines.number)
                    columns |= dict.fromkeys(row)
                    cells += len(row)
                    # After each: one line may stand for many rows.
                    COLUMNS.check(len(columns), file)
                    ROWS.check(len(rows), file)
                    CELLS.check(len(rows) * len(columns), file)
                    DOCUMENT_BYTES.check(10 * cells, file)  # each is an object in memory
        except UnicodeDecodeError:
            raise BadInput(f"{file} is not text in UTF-8; save it as UTF-8") from None
    table = pd.DataFrame({name: pd.Series([row.get(name, "") for row in rows], dtype=str)
                          for name in columns})
    return table, np.array(numbers, dtype=np.int64)


def _rows(record: dict[str, Any]) -> Iterator[dict[str, str]]:
    """Yield a row for each reception of a record; one where it has no list of them."""
    flat: dict[str, str] = {}
    receptions: list[tuple[str, list[Any]]] = []
    _flatten(record, "", flat, receptions)
    if not receptions:
        yield flat
    for name, items in receptions:
        for item in items:
            own: dict[str, str] = {}
            _flatten(item, f"{name}.", own, [])
            yield flat | own


def _flatten(value: dict[str, Any], prefix: str, flat: dict[str, str],
             receptions: list[tuple[str, list[Any]]]) -> None:
    for key, item in value.items():
        name = f"{prefix}{key}"
        if isinstance(item, dict):
            _flatten(item, f"{name}.", flat, receptions)
        elif isinstance(item, list):
            if key in LISTS and item and all(isinstance(each, dict) for each in item):
                receptions.append((name, item))
        elif item is not None:
            flat[name] = str(item)


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


def _read_sheet(file: LogFile, sheet: str | None) -> Sheet:
    """Read a sheet, or the first, by openpyxl; formulas have the values saved with them."""
    _check(file)
    openpyxl = optional_package(
        "openpyxl", f"{file}: workbooks need the package openpyxl; `pip install radiotwin[xlsx]`, "
                    "or save the sheet as CSV")
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


@dataclass(frozen=True)
class WithoutHeader:
    """A text whose file has no header.

    Attributes:
        first_line: regular expression of its whole first line.
        names: of its columns.
        read: returns cells and the line of each row, where it is no table with these columns.
    """

    first_line: str
    names: tuple[str, ...] = ()
    read: Callable[[LogFile, Settings], tuple[pd.DataFrame, np.ndarray]] | None = None


@dataclass(frozen=True)
class Expected:
    """Columns that a file may have.

    Attributes:
        columns: sets of columns, of which a header is likely to have one, in lower case.
        without_header: formats of texts without a header.
    """

    columns: tuple[frozenset[str], ...] = ()
    without_header: tuple[WithoutHeader, ...] = ()


def read_source(file: LogFile | Path | str, settings: Settings | None = None,
                expected: Expected = Expected(), bad_rows: BadRows | None = None) -> Source:
    """Open a file of measurements of one of the formats of `log_files`.

    What the settings do not declare of a text, and what is expected to be in it, is found. Bad rows
    are noted where a user may allow them, see `Source`.

    Raises:
        BadInput: another format, unreadable, or without rows.
    """
    if not isinstance(file, LogFile):
        file = LogFile(Path(file), Path(file).name)
    if file.suffix == ".parquet":
        source = Source(file.path, read_cells(file.path), lambda index: f"row {index + 1}")
    elif file.suffix == ".geojson" or (file.suffix == ".json" and _is_document(file)):
        source = Source(str(file), _read_geojson(file), lambda index: f"feature {index + 1}")
    elif file.suffix == ".xlsx" and file.member is None:
        settings = (settings or Settings()).model_copy(update={"decimal": ".", "delimiter": ","})
        source = _read_text(_read_sheet(file, settings.sheet), settings, expected, bad_rows)
    elif file.suffix in TEXTS:
        source = _read_text(file, settings or Settings(), expected, bad_rows)
    else:
        raise BadInput(f"{file}: unknown format; allowed are {', '.join((*TEXTS, *BINARIES))}, and "
                       "the first ones with .gz")
    if not len(source):
        raise BadInput(f"{file}: has no rows; it needs at least one measurement")
    return replace(source, bad_rows=bad_rows)


def _read_text(file: LogFile, settings: Settings, expected: Expected,
               bad_rows: BadRows | None) -> Source:
    """Read a text: by the faster parser where it is plain CSV."""
    first = _first_line(file)
    kind = next((each for each in expected.without_header
                 if re.fullmatch(each.first_line, first)), None)
    if first.startswith("{"):
        table, lines = _read_json_lines(file)
    elif kind is not None and kind.read is not None:
        table, lines = kind.read(file, settings)
    else:
        names = settings.header or (list(kind.names) if kind is not None else [])
        dialect = find_dialect(file, settings, expected.columns, names)
        description = dialect.described()
        plain = dialect.quotes and not (description or dialect.has_comments)
        if plain and file.member is None and file.suffix == ".csv":
            with suppress(RaggedRows):
                cells = read_cells(file.path)
                if not has_other_lines(cells):
                    return Source(file.path, cells, lambda index: f"row {index + 2}")
        text = read_text_table(file, dialect, bad_rows)
        notes = (*(f"{file.name}: {description}",) * bool(description), *text.notes)
        left_out = (("bad row", len(text.bad), f"line {text.bad[0]}"),) if text.bad else ()
        return Source(str(file), text.cells, lambda index: f"line {text.lines[index]}", notes,
                      text.fields, left_out)
    return Source(str(file), table, lambda index: f"line {lines[index]}")


def _first_line(file: LogFile) -> str:
    """Return the first line that is not blank, or as much of it as is enough to recognise it."""
    with file.open() as content:
        head = content.read(_HEAD_BYTES).decode("latin-1").removeprefix("\u00ef\u00bb\u00bf")
    return next((line for line in map(str.strip, head.splitlines()) if line), "")


def _is_document(file: LogFile) -> bool:
    """Return whether a JSON file is one document: its first line is none by itself, or GeoJSON."""
    first = _first_line(file)
    return "FeatureCollection" in first or not (first.startswith("{") and first.endswith("}"))


def _read_geojson(path: LogFile) -> pd.DataFrame:
    """Return one row per point: longitude, latitude, altitude (RFC 7946, 3.1.1) and properties."""
    data = parse_json(path.read_text(DOCUMENT_BYTES), path)
    features = data.get("features") if isinstance(data, dict) else None
    if not isinstance(features, list):
        raise BadInput(f"{path} is not a GeoJSON FeatureCollection; allowed is one of points")
    crs = str(data.get("crs") or "CRS84")
    if not ("CRS84" in crs or "4326" in crs):
        raise BadInput(f"{path}: its crs is {crs}; allowed is WGS84, the only one of GeoJSON since "
                       "RFC 7946")
    ROWS.check(len(features), path)
    points = [_point(path, number, feature) for number, feature in enumerate(features, start=1)]
    columns = set().union(*points)
    COLUMNS.check(len(columns), path)
    CELLS.check(len(columns) * len(points), path)
    return pd.DataFrame(points)


def _point(path: LogFile, number: int, feature: object) -> dict[str, object]:
    """Return the properties and coordinates of a GeoJSON feature."""
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    coordinates = geometry.get("coordinates") if geometry and kind == "Point" else None
    if (not isinstance(coordinates, list) or len(coordinates) not in (2, 3)
            or not all(type(value) in (int, float) for value in coordinates)):
        what = str(kind or "without a geometry")[:80]
        raise BadInput(f"{path}: feature {number} is {what}; allowed are points with two or three "
                       "coordinates: leave the others out")
    properties = feature.get("properties") if isinstance(feature, dict) else None
    return ((properties if isinstance(properties, dict) else {})
            | dict(zip(("longitude", "latitude", "altitude"), coordinates)))
