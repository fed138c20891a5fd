"""Rows of a file that repeat an earlier one."""

import numpy as np
import pandas as pd

from radiotwin.importing.source import Source

HASHED_AT_ONCE = 500_000  # rows; bounds the memory of that


def without_repetition(source: Source) -> tuple[Source, list[int]]:
    """Remove the rows that equal an earlier one in every column.

    Args:
        source: the file.

    Returns:
        the file without them, and their indices.
    """
    table = source.table
    rows = np.arange(len(table))  # that repeat, or are repeated, in the columns so far
    key = np.zeros(len(table), dtype=np.uint64)
    for name in table:
        key = key * np.uint64(0x9E3779B97F4A7C15) + _hashes(table[name], rows)
        again = pd.Series(key).duplicated(keep=False).to_numpy()
        rows, key = rows[again], key[again]
    if not len(rows):
        return source, []
    comparable = table.iloc[rows]  # equal hashes may be of different rows
    if table.dtypes.eq(object).any():
        comparable = comparable.astype(str)
    repeats = np.zeros(len(table), dtype=bool)
    repeats[rows] = comparable.duplicated()
    unique = Source(source.path, table[~repeats], source.where, source.notes)
    return unique, list(table.index[repeats])


def _hashes(cells: pd.Series, rows: np.ndarray) -> np.ndarray:
    """Return hashes (n,) of the cells of some rows; equal cells have equal ones."""
    parts = [np.empty(0, dtype=np.uint64)]
    for start in range(0, len(rows), HASHED_AT_ONCE):
        part = cells.iloc[rows[start:start + HASHED_AT_ONCE]]
        if part.dtype.kind == "O":
            part = part.astype(str)
        elif part.dtype.kind == "f":
            part = part + 0.0  # of two zeros that are equal, one is negative
        parts.append(pd.util.hash_pandas_object(part, index=False).to_numpy())
    return np.concatenate(parts)
