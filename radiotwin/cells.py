"""The cells of a table in a file: text from .csv and .csv.gz, typed columns from .parquet."""

import csv
import gzip
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from radiotwin.errors import BadInput


def read_cells(path: Path) -> pd.DataFrame:
    """Read the cells of a table as they are.

    Args:
        path: `.csv`, `.csv.gz` or `.parquet`.

    Returns:
        columns of texts (`""` where empty) from CSV, typed columns from Parquet; rows are numbered
        from 0 in the order of the file.

    Raises:
        BadInput: no such file, unreadable, no header, a repeated column name, or a row with too few
            or too many fields.
    """
    check_suffix(path)
    if not path.is_file():
        raise BadInput(f"{path} does not exist")
    try:
        return _read_parquet(path) if path.suffix == ".parquet" else _read_csv(path)
    except BadInput:
        raise
    except UnicodeDecodeError:
        raise BadInput(f"{path} is not text in UTF-8; allowed is comma-separated, UTF-8") from None
    except Exception as error:  # pandas, gzip and pyarrow each have their own
        raise BadInput(f"{path} cannot be read as {''.join(path.suffixes)}: {error}") from None


def check_suffix(path: Path) -> None:
    """Check that a table has one of the formats that are read and written.

    Args:
        path: of the table.

    Raises:
        BadInput: another suffix.
    """
    if path.suffix not in (".csv", ".parquet") and path.suffixes[-2:] != [".csv", ".gz"]:
        raise BadInput(f"{path}: unknown format; allowed are .csv, .csv.gz and .parquet")


def require_pyarrow(path: Path) -> None:
    """Check that pyarrow is installed.

    Args:
        path: of the Parquet file, for the message.

    Raises:
        BadInput: it is not.
    """
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        raise BadInput(f"{path}: Parquet needs the package pyarrow; `pip install "
                       "radiotwin[parquet]`, or use .csv.gz") from None


def refuse(path: Path, name: str, column: pd.Series, bad: ArrayLike, reason: str) -> None:
    """Raise BadInput about the first bad cell of a column, if there is one.

    Args:
        path: of the table.
        name: of the column.
        column: its cells, (n,).
        bad: (n,) bool.
        reason: end of the message, after the cell's text.

    Raises:
        BadInput: names file, row (1 is the header) and column.
    """
    rows = np.flatnonzero(np.asarray(bad, dtype=bool))
    if len(rows):
        more = f" ({len(rows)} such rows)" if len(rows) > 1 else ""
        raise BadInput(f"{path}: row {rows[0] + 2}, column {name}: "
                       f"{str(column.iloc[rows[0]])!r} {reason}{more}")


def _read_parquet(path: Path) -> pd.DataFrame:
    """Read Parquet without the index that pandas may have saved.

    A table that was filtered or sorted before it was saved would keep its old row labels; messages
    count rows.
    """
    require_pyarrow(path)
    from pyarrow.parquet import read_schema, read_table

    _check_header(path, read_schema(path).names)
    return read_table(path).to_pandas(ignore_metadata=True)


def _read_csv(path: Path) -> pd.DataFrame:
    """Read all cells of a CSV file as text.

    The fields are counted first: pandas fills short rows with blanks, and a blank level means "not
    detected".
    """
    rows = _fields(path)
    header = [name.strip() for name in next(rows, [])]
    if not header:
        raise BadInput(f"{path} is empty; it needs a first row with the names of the columns")
    _check_header(path, header)
    if len(header) == 1 and not header[0].isidentifier():
        raise BadInput(f"{path}: its header {header[0][:60]!r} is one single column; allowed is "
                       "comma-separated, UTF-8")
    for number, fields in enumerate(rows, start=2):
        if len(fields) != len(header):
            raise BadInput(f"{path}: row {number} has {len(fields)} fields, the header has "
                           f"{len(header)}; every row needs as many commas as the header")
    return pd.read_csv(path, dtype=str, keep_default_na=False, skipinitialspace=True, header=0,
                       names=header, index_col=False, encoding="utf-8-sig")


def _fields(path: Path) -> Iterator[list[str]]:
    """Yield the fields of each line that is not blank."""
    opener = gzip.open if path.suffix == ".gz" else open
    with opener(path, "rt", encoding="utf-8-sig", newline="") as file:
        yield from filter(None, csv.reader(file, skipinitialspace=True))


def _check_header(path: Path, names: list[str]) -> None:
    for number, name in enumerate(names):
        if name in names[:number]:
            raise BadInput(f"{path}: row 1: column {name!r} occurs twice; every name must be "
                           "unique")
