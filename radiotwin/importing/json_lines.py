"""JSON lines: one object a line, whose nested values become columns with dots in their names."""

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from radiotwin.budgets import CELLS, COLUMNS, DOCUMENT_BYTES, ROWS
from radiotwin.errors import BadInput
from radiotwin.importing.lines import Lines
from radiotwin.importing.log_files import LogFile
from radiotwin.inputs import parse_json

LISTS = ("rxInfo", "rx_metadata", "rxpk", "gateways")
"""Lists of receptions: a row for each of their objects."""


def read_json_lines(file: LogFile) -> tuple[pd.DataFrame, np.ndarray]:
    """Read JSON lines.

    Args:
        file: of text in UTF-8.

    Returns:
        cells as texts, `""` where a value is null, missing, or a list other than `LISTS`; and the
        line of each row, from 1.

    Raises:
        BadInput: a line that is no JSON object, or too many values.
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
