"""Read and write tables: .csv, .csv.gz and .parquet, and the tables in a run's folder.

CSV gives cells as texts, after a check that every row has as many fields as the header; Parquet
gives typed columns.
"""

import csv
import gzip
import io
import re
from collections.abc import Callable, Collection, Iterable, Iterator
from itertools import chain
from pathlib import Path, PurePath
from typing import IO, Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from radiotwin.errors import BadInput, optional_package
from radiotwin.io.budgets import CELLS, COLUMNS, ROW_BYTES, ROWS, TABLE_BYTES
from radiotwin.io.forms import MAX_NUMBER, MAX_POSITION_M
from radiotwin.io.inputs import open_gzip, open_input
from radiotwin.io.texts import escape_formulas, unescape_formula, unescape_formulas

_BLOCK_BYTES = 2**20  # that are checked at once
_WHAT = "table (.csv, .csv.gz, .parquet)"
_CHUNK_CELLS = 2_000_000  # that are parsed at once
_NUMBERS_AT_ONCE = 1_000_000  # converted at once: pandas makes an object of each
_MAX_DIGITS = 1000  # in a number
_CELL_BYTES = 8  # of a number, or of a reference to a text
_PARQUET_ROWS, _NESTED_ROWS = 2**17, 2**10  # that are decoded at once
_SHOWN_CHARACTERS, _SHOWN_COLUMNS = 80, 50  # of a cell, and of a table, in a message
_SIGNS = re.compile("(?:^|(?<=[eE]))[\u2212\u2010-\u2014\ufe63\uff0d]")
POSITION = ("x_m", "y_m", "z_m")
TRACK = {"flight": "text", "uav": "text", "time_s": "number", "x_m": "number", "y_m": "number",
         "z_m": "number or nothing"}
RESIDUALS = {
    "flight": "text", "receiver": "text", "device": "text", "los": "0 or 1",
    **dict.fromkeys((f"{end}_{name}" for end in ("receiver", "device") for name in POSITION),
                    "number or nothing"),
    "before_db": "number or nothing", "after_db": "number or nothing"}
PLANNING = {"method": "text", "trained_in": "text", "real_episodes": "number",
            "truth_ratio": "number"}
"""Required columns of the tables in a run's folder -> kind of their cells."""
EMPTY = ("", "nan", "na", "n/a", "<na>", "nat", "null", "none")
"""Texts, in lower case, of cells without a value."""


class RaggedRows(BadInput):
    """Raised for a row with another number of fields than the header."""


class CsvLayout:
    """Check that every row of a CSV file has as many fields as its header.

    Attributes:
        header: names of the columns.
        rows: number of rows with the header, without blank lines.
        has_apostrophes: whether the file has any apostrophe.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.header: list[str] = []
        self.rows = 0
        self.has_apostrophes = False

    def check(self, file: IO[bytes]) -> None:
        """Check all rows of a file; BadInput names the first bad one.

        Separators are counted, which is fast, up to the first quotation mark.
        """
        blocks = self._blocks(file)
        for block in blocks:
            if b'"' in block or block.count(b"\r") != block.count(b"\r\n"):
                self._check_fields(chain([block], blocks))
                break
            self._count_separators(block)
        if not self.header:
            raise BadInput(f"{self._path} is empty; it needs a first row with the names of the "
                           "columns")

    def _blocks(self, file: IO[bytes]) -> Iterator[bytes]:
        """Yield blocks of whole lines of UTF-8 text, without a byte-order mark."""
        rest = file.read(3).removeprefix(b"\xef\xbb\xbf")
        while data := file.read(_BLOCK_BYTES):
            whole, newline, rest_of_data = data.rpartition(b"\n")
            if not newline:
                rest += data
                if len(rest) > ROW_BYTES.limit:
                    ROW_BYTES.refuse(f"{self._path}: after row {self.rows}",
                                     f"a row of more than {ROW_BYTES.limit:,} bytes")
                continue
            yield self._checked(rest + whole + newline)
            rest = rest_of_data
        if rest:
            yield self._checked(rest)

    def _checked(self, block: bytes) -> bytes:
        """Return a block unchanged if it is UTF-8 text; note whether it has apostrophes."""
        block.decode()
        if b"\0" in block:
            raise BadInput(f"{self._path} is not text in UTF-8 (it has null characters); allowed "
                           "is comma-separated, UTF-8")
        self.has_apostrophes = self.has_apostrophes or b"'" in block
        return block

    def _count_separators(self, block: bytes) -> None:
        """Check rows without quotation marks by the number of their commas."""
        if not self.header:
            line, _, block = block.lstrip(b"\r\n").partition(b"\n")
            COLUMNS.check(line.count(b",") + 1, f"{self._path}: row 1")
            if not line:
                return
            self._begin(next(csv.reader([line.decode()], skipinitialspace=True)))
        if not block:
            return
        if not block.endswith(b"\n"):
            block += b"\n"
        codes = np.frombuffer(block, dtype=np.uint8)
        ends = np.flatnonzero(codes == ord("\n"))
        fields = np.diff(np.searchsorted(np.flatnonzero(codes == ord(",")), ends), prepend=0) + 1
        length = np.diff(ends, prepend=-1) - 1
        blank = (length == 0) | ((length == 1) & (codes[ends - 1] == ord("\r")))
        fields = fields[~blank]
        wrong = fields != len(self.header)
        if wrong.any():
            row = int(np.argmax(wrong))
            self._refuse(self.rows + row + 1, int(fields[row]))
        self._add(len(fields))

    def _check_fields(self, blocks: Iterable[bytes]) -> None:
        """Check rows with quotation marks, or with any line ends, by parsing them as CSV."""
        lines = (line for block in blocks
                 for line in re.findall(r"[^\r\n]*(?:\r\n|\r|\n)|[^\r\n]+$", block.decode()))
        try:
            for fields in filter(None, csv.reader(lines, skipinitialspace=True)):
                if not self.header:
                    COLUMNS.check(len(fields), f"{self._path}: row 1")
                    self._begin(fields)
                    continue
                if len(fields) != len(self.header):
                    self._refuse(self.rows + 1, len(fields))
                self._add(1)
        except csv.Error as error:
            raise BadInput(f"{self._path}: row {self.rows + 1}: {error}; is a quotation mark not "
                           "closed?") from None

    def _begin(self, header: list[str]) -> None:
        self.header, self.rows = [unescape_formula(name.strip()) for name in header], 1
        if len(header) == 1 and not self.header[0].isidentifier():
            raise BadInput(f"{self._path}: its header {self.header[0][:60]!r} is one single "
                           "column; allowed is comma-separated, UTF-8")

    def _add(self, rows: int) -> None:
        self.rows += rows
        ROWS.check(self.rows - 1, self._path)
        CELLS.check((self.rows - 1) * len(self.header), self._path)

    def _refuse(self, row: int, fields: int) -> None:
        raise RaggedRows(f"{self._path}: row {row} has {fields} fields, the header has "
                         f"{len(self.header)}; every row needs as many commas as the header")


def read_cells(path: Path, required: Collection[str] = (),
               optional: Collection[str] | None = None,
               binary: Collection[str] = ()) -> pd.DataFrame:
    """Read the cells of a table without converting them.

    Args:
        path: `.csv`, `.csv.gz` or `.parquet`, in upper or lower case.
        required: columns that the table must have.
        optional: further columns to read; None: all.
        binary: columns of Parquet with binary data; bytes in other columns must be UTF-8.

    Returns:
        columns of texts (`""`: empty) from CSV, typed columns from Parquet; rows are numbered from
        0 in the order of the file.

    Raises:
        BadInput: no such file, unreadable, too large, no header, a missing or repeated column, or a
            row with too few or too many fields.
    """
    check_suffix(path)
    try:
        if path.suffix.lower() == ".parquet":
            return _read_parquet(path, required, optional, binary)
        return _read_csv(path, required, optional)
    except BadInput:
        raise
    except UnicodeDecodeError:
        raise BadInput(f"{path} is not text in UTF-8; allowed is comma-separated, UTF-8") from None
    except Exception as error:  # pandas, gzip and pyarrow each have their own
        raise BadInput(f"{path} cannot be read as {''.join(path.suffixes[-2:])}: "
                       f"{str(error)[:500]}") from None


def column_names(path: Path) -> list[str]:
    """Read the names of all columns of a table, see `read_cells`."""
    if path.suffix.lower() == ".parquet":
        from pyarrow.parquet import ParquetFile

        with open_input(path, _WHAT) as file:
            return list(ParquetFile(file).schema_arrow.names)
    with open_gzip(path, _WHAT) as file, \
            io.TextIOWrapper(file, "utf-8-sig", newline="") as text:
        first = next(filter(None, csv.reader(text, skipinitialspace=True)))
    return [unescape_formula(name.strip()) for name in first]


def write_csv(table: pd.DataFrame, target: Path | IO[bytes], float_format: str | None = None,
              header: bool = True) -> None:
    """Write a table, without its index, as CSV in which a spreadsheet finds no formula.

    A text that begins like a formula, and is not a number, gets a leading apostrophe, which
    `read_cells` removes again.

    Args:
        table: any columns.
        target: temporary path from `radiotwin.io.files`, compressed if it ends in `.gz`; or a file.
        float_format: such as `%.4f`; by default all digits.
        header: whether to write the names of the columns.
    """
    table = escape_formulas(table)
    if not isinstance(target, Path) or target.suffix.lower() != ".gz":
        table.to_csv(target, index=False, float_format=float_format, header=header)
        return
    # Neither a name nor a time in the header: the same table gives the same bytes.
    with open(target, "wb") as file, gzip.GzipFile("", "wb", 9, file, mtime=0) as packed:
        table.to_csv(packed, index=False, float_format=float_format, header=header)


def check_suffix(path: Path) -> None:
    """Raise BadInput unless a path ends in .csv, .csv.gz or .parquet, in upper or lower case."""
    name = PurePath(path.name.lower())  # some loggers write A.CSV
    if name.suffix not in (".csv", ".parquet") and name.suffixes[-2:] != [".csv", ".gz"]:
        raise BadInput(f"{path}: unknown format; allowed are .csv, .csv.gz and .parquet")


def require_pyarrow(path: Path) -> None:
    """Raise BadInput about a Parquet file unless pyarrow is installed."""
    optional_package("pyarrow", f"{path}: Parquet needs the package pyarrow; `pip install "
                                "radiotwin[parquet]`, or use .csv.gz")


def refuse(path: Path | str, name: str, column: pd.Series, bad: ArrayLike, reason: str,
           where: Callable[[int], str] = lambda index: f"row {index + 2}") -> None:
    """Raise BadInput about the first bad cell of a column, if any; it names file, row and column.

    Args:
        path: of the table.
        name: of the column.
        column: (n,) cells.
        bad: (n,) bool.
        reason: end of the message, after the cell's text.
        where: number of a row -> its place in the file; by default row 1 is the header.
    """
    rows = np.flatnonzero(np.asarray(bad, dtype=bool))
    if len(rows):
        more = f" ({len(rows)} such rows)" if len(rows) > 1 else ""
        raise BadInput(f"{path}: {where(int(rows[0]))}, column {name}: "
                       f"{cell_text(column.iloc[rows[0]])} {reason}{more}")


def as_numbers(text: pd.Series) -> np.ndarray:
    """Convert stripped texts (n,) to numbers; NaN if a text is empty or no number.

    Unicode minus signs and dashes, as set by word processors, count as `-`.
    """
    numbers = np.empty(len(text))
    for start in range(0, len(text), _NUMBERS_AT_ONCE):
        rows = slice(start, start + _NUMBERS_AT_ONCE)
        try:
            numbers[rows] = pd.to_numeric(text.iloc[rows], errors="coerce")
        except ValueError:  # an integer of more digits than Python converts
            short = text.iloc[rows].mask(text.iloc[rows].str.len() > _MAX_DIGITS, "")
            numbers[rows] = pd.to_numeric(short, errors="coerce")
    odd = np.flatnonzero(np.isnan(numbers))
    signs = text.iloc[odd].str.contains(_SIGNS).to_numpy(dtype=bool)
    if signs.any():
        odd = odd[signs]
        numbers[odd] = as_numbers(text.iloc[odd].str.replace(_SIGNS, "-", regex=True))
    return numbers


def as_text(cells: pd.Series) -> pd.Series:
    """Convert cells (n,) of any type to stripped texts; `""`: no value.

    NaN and the words in `EMPTY`, in upper or lower case (`NA`, `none`), have no value. A column of
    whole numbers gets no decimal points; one with any fraction keeps them all.
    """
    if cells.dtype.kind == "f":
        whole = (cells == cells.round()) & (cells.abs() < 2.0**53)  # exact in double precision
        if (cells.isna() | whole).all():  # an integer column with gaps
            cells = cells.astype("Int64")
    text = cells.astype(str).str.strip()
    return text.mask(cells.isna() | text.str.lower().isin(EMPTY), "")


def cell_text(cell: object) -> str:
    """Return a cell in quotation marks for a message; a long text is cut."""
    text = str(cell)
    return repr(text) if len(text) <= _SHOWN_CHARACTERS else f"{text[:_SHOWN_CHARACTERS]!r}…"


def listed(names: Iterable[object]) -> str:
    """Join names of columns for a message; only the first ones of many."""
    texts = [str(name)[:_SHOWN_CHARACTERS] for name in names]
    more = f", … ({len(texts):,} columns)" if len(texts) > _SHOWN_COLUMNS else ""
    return ", ".join(texts[:_SHOWN_COLUMNS]) + more


def _selected(path: Path, names: list[str], required: Collection[str],
              optional: Collection[str] | None) -> list[str]:
    """Check the names of all columns; return those that are required or optional (None: all)."""
    repeated = pd.Index(names, dtype=object).duplicated()
    if repeated.any():
        name = names[int(np.argmax(repeated))]
        raise BadInput(f"{path}: row 1: column {cell_text(name)} occurs twice; every name must be "
                       "unique")
    missing = [name for name in required if name not in names]
    if missing:
        raise BadInput(f"{path}: column {missing[0]!r} is missing; it needs "
                       f"{', '.join(required)}, it has {listed(names)}")
    return [name for name in names if optional is None or name in required or name in optional]


def _read_parquet(path: Path, required: Collection[str], optional: Collection[str] | None,
                  binary: Collection[str]) -> pd.DataFrame:
    """Read Parquet as a table with rows numbered from 0.

    An index that pandas saved is ignored, since messages count rows. Texts are measured in batches
    before they are decoded: a dictionary can expand to far more than its size in the file.
    """
    require_pyarrow(path)
    import pyarrow
    from pyarrow.parquet import ParquetFile

    with open_input(path, _WHAT) as file:
        content = ParquetFile(file)
        schema, metadata = content.schema_arrow, content.metadata
        COLUMNS.check(metadata.num_columns, path)
        ROWS.check(metadata.num_rows, path)
        names = _selected(path, schema.names, required, optional)
        CELLS.check(metadata.num_rows * len(names), path)
        TABLE_BYTES.check(metadata.num_rows * len(names) * _CELL_BYTES, path)
        nested = any(pyarrow.types.is_nested(schema.field(name).type) for name in names)
        texts = [name for name in names
                 if name not in binary and _is_text(schema.field(name).type)]
        table = ParquetFile(file, read_dictionary=texts)
        batches, rows, size = [], 0, 0
        for batch in table.iter_batches(_NESTED_ROWS if nested else _PARQUET_ROWS, columns=names):
            size += sum(map(_decoded_bytes, batch.columns))
            ROWS.check(rows + len(batch), path)
            TABLE_BYTES.check(size, path)
            batches.append(pyarrow.record_batch(
                [column.dictionary.take(column.indices)
                 if pyarrow.types.is_dictionary(column.type) else column
                 for column in batch.columns], names=names))
            rows += len(batch)
    if not batches:
        return schema.empty_table().select(names).to_pandas(ignore_metadata=True)
    whole = pyarrow.Table.from_batches(batches)
    del batches, batch
    for index, name in enumerate(names):
        if name not in binary and _is_text(whole.schema.field(name).type):
            whole = whole.set_column(index, name, _text_of(path, name, whole[name]))
    return whole.to_pandas(ignore_metadata=True, split_blocks=True, self_destruct=True)


def _text_of(path: Path, name: str, column: Any) -> Any:
    """Convert an Arrow column of texts or bytes to texts; BadInput names a row that is not UTF-8.

    A column of bytes without any text, such as UUIDs, becomes hexadecimal digits.
    """
    import pyarrow
    from pyarrow import types

    data = column.cast(pyarrow.large_binary())
    try:
        return data.cast(pyarrow.large_string())
    except pyarrow.ArrowInvalid:
        cells = data.to_pylist()
    texts = [cell.decode(errors="replace") for cell in cells if cell]
    if not any(text.isprintable() and "\ufffd" not in text for text in texts) and not (
            types.is_string(column.type) or types.is_large_string(column.type)
            or types.is_string_view(column.type)):
        return pyarrow.array([cell if cell is None else cell.hex() for cell in cells],
                             pyarrow.large_string())
    for row, cell in enumerate(cells, start=2):
        try:
            (cell or b"").decode()
        except UnicodeDecodeError:
            raise BadInput(f"{path}: row {row}, column {name}: {cell[:60]!r} is not text in UTF-8; "
                           "write the table again") from None
    raise AssertionError(name)


def _is_text(kind: Any) -> bool:
    """Return whether an Arrow type is one of texts, or of bytes that may be texts."""
    from pyarrow import types

    return any(is_kind(kind) for is_kind in (
        types.is_string, types.is_large_string, types.is_string_view, types.is_binary,
        types.is_large_binary, types.is_binary_view, types.is_fixed_size_binary))


def _decoded_bytes(column: Any) -> int:
    """Return the memory [bytes] of an Arrow array when decoded, with a repeated text each time."""
    import pyarrow
    from pyarrow import compute

    if pyarrow.types.is_nested(column.type):
        return column.nbytes
    is_dictionary = pyarrow.types.is_dictionary(column.type)
    try:
        lengths = compute.binary_length(column.dictionary if is_dictionary else column)
    except pyarrow.ArrowNotImplementedError:  # numbers
        return _CELL_BYTES * len(column)
    texts = compute.sum(lengths.take(column.indices) if is_dictionary else lengths).as_py() or 0
    return texts + _CELL_BYTES * len(column)


def _read_csv(path: Path, required: Collection[str],
              optional: Collection[str] | None) -> pd.DataFrame:
    """Read the cells of a CSV file as texts.

    Fields are counted first: pandas would fill short rows with blanks, and a blank level means "not
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
        chunks = [unescape_formulas(chunk) if layout.has_apostrophes else chunk for chunk in reader]
    return pd.concat(chunks, ignore_index=True)


def read_table(path: Path, kinds: dict[str, str], optional: dict[str, str] | None = None,
               ) -> pd.DataFrame:
    """Read columns of a table in a run's folder.

    Args:
        path: `.csv` or `.csv.gz`.
        kinds: column -> `text`, `number`, `number or nothing` (NaN), or `0 or 1`.
        optional: the same for columns that may be missing.

    Raises:
        BadInput: the file cannot be read, a column is missing, or a cell is of another kind.
    """
    cells = read_cells(path)
    missing = [name for name in kinds if name not in cells]
    if missing:
        raise BadInput(f"{path}: column {missing[0]!r} is missing; make the run again")
    wanted = kinds | {name: kind for name, kind in (optional or {}).items() if name in cells}
    return pd.DataFrame({name: cells[name] if kind == "text" else
                         _numbers(path, name, cells[name], kind)
                         for name, kind in wanted.items()})


def _numbers(path: Path, name: str, column: pd.Series, kind: str) -> pd.Series:
    """Convert texts of a kind, see `read_table`, to numbers; BadInput on any other text."""
    numbers = pd.to_numeric(column, errors="coerce").astype(float)
    nothing = column.str.strip().isin(["", "nan"]) & (kind == "number or nothing")
    largest = MAX_POSITION_M if name.endswith("_m") else MAX_NUMBER
    refuse(path, name, column, ~nothing & ~(np.abs(numbers) <= largest),
           f"is not a number within ±{largest:g}; make the run again")
    if kind == "0 or 1":
        refuse(path, name, column, ~numbers.isin([0.0, 1.0]), "is neither 0 nor 1; make the run "
                                                              "again")
    return numbers
