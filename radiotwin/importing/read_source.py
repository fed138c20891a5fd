"""Opening of a file of measurements: the format by its name and its first line."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.budgets import CELLS, COLUMNS, DOCUMENT_BYTES, ROWS
from radiotwin.cells import read_cells
from radiotwin.errors import BadInput
from radiotwin.importing.dialect import find_dialect
from radiotwin.importing.json_lines import read_json_lines
from radiotwin.importing.log_files import BINARIES, TEXTS, LogFile
from radiotwin.importing.settings import Settings
from radiotwin.importing.source import Source
from radiotwin.importing.text_table import read_text_table
from radiotwin.importing.xlsx import read_sheet
from radiotwin.inputs import parse_json

_HEAD_BYTES = 2**16  # in which the first line is looked for


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
    elif file.suffix == ".xlsx" and file.member is None:
        settings = (settings or Settings()).model_copy(update={"decimal": ".", "delimiter": ","})
        source = _read_text(read_sheet(file, settings.sheet), settings, expected)
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
