"""The cells of a table in a file: text from .csv and .csv.gz, typed columns from .parquet."""

import gzip
from collections.abc import Collection, Iterable
from pathlib import Path, PurePath
from typing import IO, Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from radiotwin.budgets import CELLS, COLUMNS, FILE_BYTES, ROWS
from radiotwin.csv_layout import CsvLayout
from radiotwin.errors import BadInput
from radiotwin.inputs import open_gzip, open_input
from radiotwin.spreadsheet import with_quotes, without_quotes

_WHAT = "table (.csv, .csv.gz, .parquet)"
_CHUNK_CELLS = 2_000_000  # that are parsed at a time
_NUMBERS_AT_ONCE = 1_000_000  # pandas makes an object of each
_MAX_DIGITS = 1000  # of a number
_PARQUET_ROWS, _NESTED_ROWS = 2**17, 2**10  # that are decoded at a time
_SHOWN_CHARACTERS, _SHOWN_COLUMNS = 80, 50  # of a cell, and of a table, in a message


def read_cells(path: Path, required: Collection[str] = (),
               optional: Collection[str] | None = None) -> pd.DataFrame:
    """Read the cells of a table as they are.

    Args:
        path: `.csv`, `.csv.gz` or `.parquet`, in any case.
        required: columns that it must have.
        optional: other columns that are read; None for all.

    Returns:
        columns of texts (`""` where empty) from CSV, typed columns from Parquet; rows are numbered
        from 0 in the order of the file.

    Raises:
        BadInput: no such file, unreadable, too large, no header, a missing or repeated column, or a
            row with too few or too many fields.
    """
    check_suffix(path)
    try:
        read = _read_parquet if path.suffix.lower() == ".parquet" else _read_csv
        return read(path, required, optional)
    except BadInput:
        raise
    except UnicodeDecodeError:
        raise BadInput(f"{path} is not text in UTF-8; allowed is comma-separated, UTF-8") from None
    except Exception as error:  # pandas, gzip and pyarrow each have their own
        raise BadInput(f"{path} cannot be read as {''.join(path.suffixes[-2:])}: "
                       f"{str(error)[:500]}") from None


def write_csv(table: pd.DataFrame, target: Path | IO[bytes], float_format: str | None = None,
              header: bool = True) -> None:
    """Write a table, without its index, as CSV in which a spreadsheet finds no formula.

    A text that begins as a formula does, and is not a number, gets an apostrophe in front, which
    `read_cells` takes off again, as it does where a text has apostrophes and then such a beginning.

    Args:
        table: any columns.
        target: temporary path from `radiotwin.files`, compressed if it ends in `.gz`; or a file.
        float_format: such as `%.4f`; all digits by default.
        header: whether to write the names of the columns.
    """
    table = with_quotes(table)
    if not isinstance(target, Path) or target.suffix.lower() != ".gz":
        table.to_csv(target, index=False, float_format=float_format, header=header)
        return
    # Neither a name nor a time in the header: the same table gives the same bytes.
    with open(target, "wb") as file, gzip.GzipFile("", "wb", 9, file, mtime=0) as packed:
        table.to_csv(packed, index=False, float_format=float_format, header=header)


def check_suffix(path: Path) -> None:
    """Check that a table has one of the formats that are read and written.

    Args:
        path: of the table; its suffix counts in any case.

    Raises:
        BadInput: another suffix.
    """
    name = PurePath(path.name.lower())  # some loggers write A.CSV
    if name.suffix not in (".csv", ".parquet") and name.suffixes[-2:] != [".csv", ".gz"]:
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
                       f"{shown(column.iloc[rows[0]])} {reason}{more}")


def as_numbers(text: pd.Series) -> np.ndarray:
    """Convert texts to numbers, (n,); NaN where one is not a number, or empty.

    Args:
        text: (n,) without spaces around.
    """
    numbers = np.empty(len(text))
    for start in range(0, len(text), _NUMBERS_AT_ONCE):
        rows = slice(start, start + _NUMBERS_AT_ONCE)
        try:
            numbers[rows] = pd.to_numeric(text.iloc[rows], errors="coerce")
        except ValueError:  # an integer of more digits than Python converts
            short = text.iloc[rows].mask(text.iloc[rows].str.len() > _MAX_DIGITS, "")
            numbers[rows] = pd.to_numeric(short, errors="coerce")
    return numbers


def shown(cell: object) -> str:
    """Return the text of a cell in quotation marks for a message, cut where it is long."""
    text = str(cell)
    return repr(text) if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]!r}…"


def listed(names: Iterable[object]) -> str:
    """Return the names of columns for a message, the first ones where there are many."""
    texts = [str(name)[:_SHOWN_CHARACTERS] for name in names]
    more = f", … ({len(texts):,} columns)" if len(texts) > _SHOWN_COLUMNS else ""
    return ", ".join(texts[:_SHOWN_COLUMNS]) + more


def _selected(path: Path, names: list[str], required: Collection[str],
              optional: Collection[str] | None) -> list[str]:
    """Check the names of all columns; return those that are to be read, in their order."""
    repeated = pd.Index(names, dtype=object).duplicated()
    if repeated.any():
        name = names[int(np.argmax(repeated))]
        raise BadInput(f"{path}: row 1: column {shown(name)} occurs twice; every name must be "
                       "unique")
    missing = [name for name in required if name not in names]
    if missing:
        raise BadInput(f"{path}: column {missing[0]!r} is missing; it needs "
                       f"{', '.join(required)}, it has {listed(names)}")
    return [name for name in names if optional is None or name in required or name in optional]


def _read_parquet(path: Path, required: Collection[str],
                  optional: Collection[str] | None) -> pd.DataFrame:
    """Read Parquet without the index that pandas may have saved.

    A table that was filtered or sorted before it was saved would keep its old row labels; messages
    count rows. It is decoded in batches, whose texts count before they are written out: a
    dictionary can stand for far more than it takes in the file.
    """
    require_pyarrow(path)
    import pyarrow
    from pyarrow.parquet import ParquetFile

    with open_input(path, _WHAT) as file:
        schema, metadata = ParquetFile(file).schema_arrow, ParquetFile(file).metadata
        COLUMNS.check(metadata.num_columns, path)
        ROWS.check(metadata.num_rows, path)
        names = _selected(path, schema.names, required, optional)
        CELLS.check(metadata.num_rows * len(names), path)
        nested = any(pyarrow.types.is_nested(schema.field(name).type) for name in names)
        texts = [name for name in names if pyarrow.types.is_string(schema.field(name).type)
                 or pyarrow.types.is_large_string(schema.field(name).type)]
        table = ParquetFile(file, read_dictionary=texts)
        batches, rows, size = [], 0, 0
        for batch in table.iter_batches(_NESTED_ROWS if nested else _PARQUET_ROWS, columns=names):
            rows, size = rows + len(batch), size + sum(map(_decoded_bytes, batch.columns))
            ROWS.check(rows, path)
            FILE_BYTES.check(size, path)
            batches.append(pyarrow.record_batch(
                [column.dictionary_decode() if name in texts else column
                 for name, column in zip(names, batch.columns)], names=names))
    if not batches:
        return schema.empty_table().select(names).to_pandas(ignore_metadata=True)
    whole = pyarrow.Table.from_batches(batches)
    del batches, batch
    return whole.to_pandas(ignore_metadata=True, split_blocks=True, self_destruct=True)


def _decoded_bytes(column: Any) -> int:
    """Return the size of an Arrow array that the number of rows does not bound: of its texts."""
    import pyarrow
    from pyarrow import compute

    if pyarrow.types.is_nested(column.type):
        return column.nbytes
    is_dictionary = pyarrow.types.is_dictionary(column.type)
    try:
        lengths = compute.binary_length(column.dictionary if is_dictionary else column)
    except pyarrow.ArrowNotImplementedError:  # numbers
        return 0
    return compute.sum(lengths.take(column.indices) if is_dictionary else lengths).as_py() or 0


def _read_csv(path: Path, required: Collection[str],
              optional: Collection[str] | None) -> pd.DataFrame:
    """Read cells of a CSV file as text.

    The fields are counted first: pandas fills short rows with blanks, and a blank level means "not
    detected".
    """
    with open_gzip(path, _WHAT) as file:
        layout = CsvLayout(path)
        layout.check(file)
    names = _selected(path, layout.header, required, optional)
    with open_gzip(path, _WHAT) as file, \
            pd.read_csv(file, dtype=str, keep_default_na=False, skipinitialspace=True, header=0,
                        names=layout.header, usecols=names, index_col=False, encoding="utf-8",
                        chunksize=max(_CHUNK_CELLS // len(layout.header), 1)) as reader:
        chunks = [without_quotes(chunk) if layout.has_apostrophes else chunk for chunk in reader]
    return pd.concat(chunks, ignore_index=True)
