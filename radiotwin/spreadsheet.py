"""Texts in which a spreadsheet finds no formula: those that look like one get an apostrophe."""

import re
from typing import Any

import pandas as pd

# A spreadsheet takes a cell for a formula that begins so; the last four are full-width.
_FORMULA = re.compile("'*[=+\\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


def quoted(text: Any) -> Any:
    """Return a text as it is written to CSV, the same object where nothing changes.

    Args:
        text: cell or name of a column; what is not a text stays.
    """
    if isinstance(text, str) and _FORMULA.match(text) and not _NUMBER.fullmatch(text):
        return f"'{text}"
    return text


def unquoted(text: Any) -> Any:
    """Return what `quoted` was given.

    Args:
        text: cell or name of a column; what is not a text stays.
    """
    is_quoted = isinstance(text, str) and text.startswith("'") and _FORMULA.match(text)
    return text[1:] if is_quoted else text


def with_quotes(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table with `quoted` texts and names of columns.

    Args:
        table: any columns; it is not changed.
    """
    table = table.rename(columns=quoted)
    for name in table.columns:
        if table[name].dtype.kind not in "biufmM":
            texts = table[name]
            odd = {text: quoted(text) for text in texts.unique() if quoted(text) is not text}
            if odd:
                table[name] = texts.astype(object).map(lambda text, odd=odd: odd.get(text, text))
    return table


def without_quotes(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table whose cells are `unquoted`; names of columns stay.

    Args:
        table: columns of texts or others; it is not changed.
    """
    table = table.copy(deep=False)
    for name in table.columns:
        if table[name].dtype.kind in "OU" or isinstance(table[name].dtype, pd.StringDtype):
            texts = table[name]
            is_quoted = texts.str.startswith("'", na=False).to_numpy(dtype=bool)
            if is_quoted.any():
                texts = texts.copy()
                texts[is_quoted] = texts[is_quoted].map(unquoted)
                table[name] = texts
    return table
