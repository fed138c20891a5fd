"""A file of measurements as a table whose cells can be named in a message."""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from radiotwin.budgets import CELLS, COLUMNS, DOCUMENT_BYTES, ROWS
from radiotwin.cells import as_numbers, listed, read_cells, shown
from radiotwin.errors import BadInput
from radiotwin.importing.dialect import find_dialect
from radiotwin.importing.json_lines import read_json_lines
from radiotwin.importing.log_files import BINARIES, TEXTS, LogFile
from radiotwin.importing.settings import Settings
from radiotwin.importing.text_table import read_text_table
from radiotwin.inputs import parse_json
from radiotwin.tables import name_fault

EMPTY = ("", "nan", "na", "n/a", "<na>", "nat", "null", "none")
"""Texts, in lower case, of cells without a value."""
ALWAYS = "always "
"""Prefix of a constant in place of a column's name."""
_HEAD_BYTES = 2**16  # in which the first line is looked for
_ROWS_AT_ONCE = 1_000_000  # of which stripped texts are made
_TEMPLATE = re.compile(r"\{([^{}]+)\}")


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
            purpose: what they are needed for, for the message.

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
        """Check that the file has all columns of a mapping.

        Args:
            specs: what they are needed for -> as in `cells`.

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

    def text(self, spec: str, purpose: str) -> pd.Series:
        """Return the cells as stripped texts, `""` where empty.

        Args:
            spec: name of a column, or `always VALUE`.
            purpose: what they are needed for, for the message.

        Raises:
            BadInput: no such column.
        """
        return as_text(self.cells(spec, purpose))

    def names(self, spec: str, purpose: str) -> np.ndarray:
        """Return the cells as names, (n,) texts, `""` where empty; equal ones are one object.

        Args:
            spec: name of a column, or `always VALUE`.
            purpose: what they are needed for, for the message.

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

    def without_cells(self) -> "Source":
        """Return the same file for messages only, without the memory of its cells."""
        return Source(self.path, self.table.iloc[:0], self.where, self.notes)

    def numbers(self, spec: str, purpose: str) -> np.ndarray:
        """Return the cells as numbers, (n,); NaN where empty.

        Args:
            spec: name of a column, or `always VALUE`.
            purpose: what they are needed for, for the message.

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
        """Raise BadInput about the first bad cell of a column, if there is one.

        Args:
            spec: the column.
            cells: (n,) with the index of the table.
            bad: (n,) bool.
            reason: end of the message, after the cell's text.

        Raises:
            BadInput: names file, row and column.
        """
        rows = np.flatnonzero(np.asarray(bad, dtype=bool))
        if len(rows):
            more = f" ({len(rows)} such rows)" if len(rows) > 1 else ""
            raise BadInput(f"{self.path}: {self.where(cells.index[rows[0]])}, column {spec}: "
                           f"{shown(cells.iloc[rows[0]])} {reason}{more}")


def as_text(cells: pd.Series) -> pd.Series:
    """Convert cells to stripped texts.

    Args:
        cells: (n,) of any type.

    Returns:
        texts, (n,): `""` for every spelling of an empty cell, whole numbers without a point.
    """
    if cells.dtype.kind == "f":
        whole = (cells == cells.round()) & (cells.abs() < 2.0**53)  # exact in double precision
        if (cells.isna() | whole).all():  # an integer column with gaps
            cells = cells.astype("Int64")
    text = cells.astype(str).str.strip()
    return text.mask(cells.isna() | text.str.lower().isin(EMPTY), "")


def columns_of(spec: str, header: Iterable[object]) -> list[str]:
    """Return the names of columns in an entry of a mapping.

    Args:
        spec: as in `Source.cells`.
        header: names of the file's columns; a name may have braces itself.
    """
    if spec.startswith(ALWAYS) and spec not in header:
        return []
    return _TEMPLATE.findall(spec) if _TEMPLATE.search(spec) and spec not in header else [spec]


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
    """What a file may have.

    Attributes:
        columns: sets of columns, of which a header is likely to have one, in lower case.
        without_header: formats of texts without a header.
    """

    columns: tuple[frozenset[str], ...] = ()
    without_header: tuple[WithoutHeader, ...] = ()


def read_source(file: LogFile | Path | str, settings: Settings | None = None,
                expected: Expected = Expected()) -> Source:
    """Open a file of measurements.

    Args:
        file: of one of the formats of `log_files`.
        settings: with what is declared about a text; the rest is found.
        expected: what it may have.

    Raises:
        BadInput: another format, unreadable, or without rows.
    """
    if not isinstance(file, LogFile):
        file = LogFile(Path(file), Path(file).name)
    if file.suffix == ".parquet":
        source = Source(file.path, read_cells(file.path), lambda index: f"row {index + 1}")
    elif file.suffix == ".geojson" or (file.suffix == ".json" and _is_document(file)):
        source = Source(str(file), _read_geojson(file), lambda index: f"feature {index + 1}")
    elif file.suffix in TEXTS:
        source = _read_text(file, settings or Settings(), expected)
    else:
        raise BadInput(f"{file}: unknown format; allowed are {', '.join((*TEXTS, *BINARIES))}, and "
                       "the first ones with .gz")
    if not len(source):
        raise BadInput(f"{file}: has no rows; it needs at least one measurement")
    return source


def _read_text(file: LogFile, settings: Settings, expected: Expected) -> Source:
    """Read a text: by the faster parser where it is plain CSV."""
    first = _first_line(file)
    kind = next((each for each in expected.without_header
                 if re.fullmatch(each.first_line, first)), None)
    notes: tuple[str, ...] = ()
    if first.startswith("{"):
        table, lines = read_json_lines(file)
    elif kind is not None and kind.read is not None:
        table, lines = kind.read(file, settings)
    else:
        names = settings.header or (list(kind.names) if kind is not None else [])
        dialect = find_dialect(file, settings, expected.columns, names)
        description = dialect.described()
        if not description and file.member is None and file.suffix == ".csv":
            return Source(file.path, read_cells(file.path), lambda index: f"row {index + 2}")
        notes = (f"{file.name}: {description}",) * bool(description)
        table, lines = read_text_table(file, dialect)
    return Source(str(file), table, lambda index: f"line {lines[index]}", notes)


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
