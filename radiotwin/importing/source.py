"""A file of measurements as a table whose cells can be named in a message."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from radiotwin.budgets import CELLS, COLUMNS, ROWS
from radiotwin.cells import as_numbers, listed, read_cells, shown
from radiotwin.errors import BadInput
from radiotwin.inputs import read_json
from radiotwin.tables import name_fault

EMPTY = ("", "nan", "na", "n/a", "<na>", "nat", "null", "none")
"""Texts, in lower case, of cells without a value."""
ALWAYS = "always "
"""Prefix of a constant in place of a column's name."""
_ROWS_AT_ONCE = 1_000_000  # of which stripped texts are made
FORMATS = (".csv", ".parquet", ".geojson", ".json")


@dataclass(frozen=True)
class Source:
    """A table whose index is the position of each row in the file.

    Attributes:
        path: of the file.
        table: cells as in the file.
        where: index -> `row 7`, as the file's user counts.
    """

    path: Path
    table: pd.DataFrame
    where: Callable[[int], str]

    def __len__(self) -> int:
        return len(self.table)

    def cells(self, spec: str, purpose: str) -> pd.Series:
        """Return the cells of a column, or a constant.

        Args:
            spec: name of a column, or `always VALUE`.
            purpose: what they are needed for, for the message.

        Raises:
            BadInput: no such column.
        """
        if spec.startswith(ALWAYS):
            return pd.Series(spec.removeprefix(ALWAYS), index=self.table.index)
        if spec not in self.table:
            raise BadInput(f"{self.path}: column {spec!r} ({purpose}) is missing; the file has "
                           f"{listed(self.table.columns)}. Correct the mapping")
        return self.table[spec]

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
        return Source(self.path, self.table.iloc[:0], self.where)

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


def read_source(path: Path | str) -> Source:
    """Open a file of measurements.

    Args:
        path: `.csv`, `.csv.gz`, `.parquet`, or `.geojson` of points.

    Raises:
        BadInput: another format, unreadable, or without rows.
    """
    path = Path(path)
    if path.suffix not in FORMATS and path.suffixes[-2:] != [".csv", ".gz"]:
        raise BadInput(f"{path}: unknown format; allowed are .csv.gz, {', '.join(FORMATS)}")
    if path.suffix in (".geojson", ".json"):
        source = Source(path, _read_geojson(path), lambda index: f"feature {index + 1}")
    else:
        first = 1 if path.suffix == ".parquet" else 2
        source = Source(path, read_cells(path), lambda index: f"row {index + first}")
    if not len(source):
        raise BadInput(f"{path}: has no rows; it needs at least one measurement")
    return source


def _read_geojson(path: Path) -> pd.DataFrame:
    """Return one row per point: longitude, latitude, altitude (RFC 7946, 3.1.1) and properties."""
    data = read_json(path, "GeoJSON file")
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


def _point(path: Path, number: int, feature: object) -> dict[str, object]:
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
