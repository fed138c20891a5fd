"""Texts of strangers as pages, figures and spreadsheets may show them.

Nothing is hidden or endless in them, and a spreadsheet finds no formula: what looks like one gets
an apostrophe.
"""

import re
from datetime import UTC, datetime
from typing import Any

import pandas as pd

MAX_TEXT = 2000  # characters
# Control characters, those that turn the direction of writing or have no width, and halves of
# characters. Joiners (U+200C, U+200D) belong to some scripts.
_HIDDEN = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\xad\u061c\u180e\u200b\u200e\u200f\u2028-\u202e"
                     "\u2060-\u206f\ufeff\ufff9-\ufffb\ud800-\udfff\U000e0000-\U000e007f]")
# A spreadsheet takes a cell for a formula that begins so; the last four are full-width.
_FORMULA = re.compile("'*[=+\\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


def shown(text: str, max_length: int = MAX_TEXT) -> str:
    r"""Return a text with its hidden characters as `\x1b` or `\u202e`, cut where it is too long."""
    cut = text if len(text) <= max_length else text[:max_length - 1] + "…"
    return _HIDDEN.sub(lambda found: ascii(found[0])[1:-1], cut)


def moment(time_s: float) -> str:
    """Return the date and time (UTC) of seconds since 1970."""
    return datetime.fromtimestamp(time_s, UTC).isoformat(sep=" ", timespec="seconds")


def percent(share: float) -> str:
    """Return a share as a percentage that is neither 0 nor 100 where the share is not."""
    if 0 < share < 0.01:
        return "under 1%"
    return "over 99%" if 0.99 < share < 1 else f"{share:.0%}"


def shortly(value: float) -> str:
    """Return a number with three digits, or all before the point."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def shown_data(value: Any) -> Any:
    """Return data for a script with every text in it as `shown`, but for packed arrays."""
    if isinstance(value, str):
        return shown(value)
    if isinstance(value, list):
        return [shown_data(each) for each in value]
    if isinstance(value, dict) and "shape" not in value:
        return {name: shown_data(each) for name, each in value.items()}
    return value


def quoted(text: Any) -> Any:
    """Return a cell or a name as it is written to CSV, the same object where nothing changes."""
    if isinstance(text, str) and _FORMULA.match(text) and not _NUMBER.fullmatch(text):
        return f"'{text}"
    return text


def unquoted(text: Any) -> Any:
    """Return what `quoted` was given."""
    is_quoted = isinstance(text, str) and text.startswith("'") and _FORMULA.match(text)
    return text[1:] if is_quoted else text


def with_quotes(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table with `quoted` texts and names of columns."""
    table = table.rename(columns=quoted)
    for name in table.columns:
        if table[name].dtype.kind not in "biufmM":
            texts = table[name]
            odd = {text: quoted(text) for text in texts.unique() if quoted(text) is not text}
            if odd:
                table[name] = texts.astype(object).map(lambda text, odd=odd: odd.get(text, text))
    return table


def without_quotes(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table whose cells are `unquoted`; names of columns stay."""
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
