"""Opens a file of measurements as a table whose cells can be named in a message."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.measurements import read_cells

EMPTY = ("", "nan", "na", "n/a", "<na>", "nat", "null", "none")
"""Texts, in lower case, of cells without a value."""
FORMATS = (".csv", ".parquet", ".geojson", ".json")
ALWAYS = "always "
EXACT = 2.0**53  # below it, every whole number is one in double precision
WGS84 = ("CRS84", "4326")


@dataclass(frozen=True)
class Source:
    """A table whose index is the place of each row in the file.

    Attributes:
        path: of the file.
        table: cells as they stand.
        where: index -> `row 7`, as a person finds it in the file.
    """

    path: Path
    table: pd.DataFrame
    where: Callable[[int], str]

    def __len__(self) -> int:
        return len(self.table)

    def cells(self, spec: str, purpose: str) -> pd.Series:
        """The column `spec`, or its value in every row for `always VALUE`; raises BadInput where there is none."""
        if spec.startswith(ALWAYS):
            return pd.Series(spec.removeprefix(ALWAYS), index=self.table.index)
        if spec not in self.table:
            raise BadInput(f"{self.path}: column {spec!r} ({purpose}) is missing; the file has "
                           f"{', '.join(map(str, self.table.columns))}. Correct the mapping")
        return self.table[spec]

    def text(self, spec: str, purpose: str) -> pd.Series:
        """Stripped texts, `""` where empty."""
        return as_text(self.cells(spec, purpose))

    def numbers(self, spec: str, purpose: str) -> np.ndarray:
        """(n,) numbers, NaN where empty; raises BadInput for a text and for what is not finite."""
        cells = self.cells(spec, purpose)
        if cells.dtype.kind in "fiu":
            numbers = cells.to_numpy(dtype=float, na_value=np.nan)
        else:
            text = as_text(cells)
            parsed = pd.to_numeric(text, errors="coerce")
            self.refuse(spec, text, parsed.isna() & (text != ""), "is not a number")
            numbers = parsed.to_numpy(dtype=float)
        self.refuse(spec, cells, np.isinf(numbers), "is not finite")
        return numbers

    def refuse(self, spec: str, cells: pd.Series, bad, why: str) -> None:
        """Raise BadInput about the first row where `bad` (n,)."""
        bad = np.asarray(bad, dtype=bool)
        if bad.any():
            first = int(np.flatnonzero(bad)[0])
            more = f" ({bad.sum()} such rows)" if bad.sum() > 1 else ""
            raise BadInput(f"{self.path}: {self.where(cells.index[first])}, column {spec}: "
                           f"{str(cells.iloc[first])!r} {why}{more}")


def as_text(cells: pd.Series) -> pd.Series:
    """Stripped texts, `""` for every spelling of an empty cell; whole numbers without a point."""
    if cells.dtype.kind == "f":
        whole = (cells == cells.round()) & (cells.abs() < EXACT)
        if (cells.isna() | whole).all():  # an integer column with gaps
            cells = cells.astype("Int64")
    text = cells.astype(str).str.strip()
    return text.mask(cells.isna() | text.str.lower().isin(EMPTY), "")


def read_source(path: Path | str) -> Source:
    """Open .csv, .csv.gz, .parquet, or .geojson of points; raises BadInput."""
    path = Path(path)
    if path.suffix not in FORMATS and path.suffixes[-2:] != [".csv", ".gz"]:
        raise BadInput(f"{path}: unknown format; allowed are .csv.gz, {', '.join(FORMATS)}")
    if path.suffix in FORMATS[2:]:
        source = Source(path, _read_geojson(path), lambda index: f"feature {index + 1}")
    else:
        first = 1 if path.suffix == ".parquet" else 2
        source = Source(path, read_cells(path), lambda index: f"row {index + first}")
    if not len(source):
        raise BadInput(f"{path}: has no rows; it needs at least one measurement")
    return source


def _read_geojson(path: Path) -> pd.DataFrame:
    """One row a point: its properties, and columns longitude, latitude and altitude (RFC 7946, 3.1.1 and 4)."""
    try:
        data = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise BadInput(f"{path} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise BadInput(f"{path} is not GeoJSON: {error}") from None
    features = data.get("features") if isinstance(data, dict) else None
    if not isinstance(features, list):
        raise BadInput(f"{path} is not a GeoJSON FeatureCollection; allowed is one of points")
    crs = str(data.get("crs") or WGS84[0])
    if not any(name in crs for name in WGS84):
        raise BadInput(f"{path}: its crs is {crs}; allowed is WGS84, the only one of GeoJSON since RFC 7946")
    rows = []
    for number, feature in enumerate(features, start=1):
        geometry = feature.get("geometry") if isinstance(feature, dict) else None
        kind = geometry.get("type") if isinstance(geometry, dict) else None
        coordinates = geometry.get("coordinates") if geometry and kind == "Point" else None
        if not isinstance(coordinates, list) or not all(isinstance(n, int | float) for n in coordinates) \
                or len(coordinates) not in (2, 3):
            raise BadInput(f"{path}: feature {number} is {kind or 'without a geometry'}; allowed are points with two "
                           "or three coordinates: leave the others out")
        properties = feature.get("properties")
        rows.append((properties if isinstance(properties, dict) else {})
                    | dict(zip(("longitude", "latitude", "altitude"), coordinates)))
    return pd.DataFrame(rows)
