"""Make texts of strangers safe to show: no hidden characters, bounded length, no formulas."""

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
    r"""Escape the hidden characters of a text, such as `\x1b` or `\u202e`, and cut a long one."""
    cut = text if len(text) <= max_length else text[:max_length - 1] + "…"
    return _HIDDEN.sub(lambda found: ascii(found[0])[1:-1], cut)


def moment(time_s: float) -> str:
    """Return the date and time (UTC) of a time in seconds since 1970."""
    return datetime.fromtimestamp(time_s, UTC).isoformat(sep=" ", timespec="seconds")


def percent(share: float) -> str:
    """Return a share as a percentage, in words below 1 % and above 99 %."""
    if 0 < share < 0.01:
        return "under 1%"
    return "over 99%" if 0.99 < share < 1 else f"{share:.0%}"


def shortly(value: float) -> str:
    """Return a number with three significant digits, or as a whole number from 1000."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def shown_data(value: Any) -> Any:
    """Apply `shown` to every text in nested lists and dictionaries, except packed arrays."""
    if isinstance(value, str):
        return shown(value)
    if isinstance(value, list):
        return [shown_data(each) for each in value]
    if isinstance(value, dict) and "shape" not in value:
        return {name: shown_data(each) for name, each in value.items()}
    return value


def escape_formula(text: Any) -> Any:
    """Prefix a text with an apostrophe if a spreadsheet would take it for a formula."""
    if isinstance(text, str) and _FORMULA.match(text) and not _NUMBER.fullmatch(text):
        return f"'{text}"
    return text


def unescape_formula(text: Any) -> Any:
    """Undo `escape_formula`."""
    is_quoted = isinstance(text, str) and text.startswith("'") and _FORMULA.match(text)
    return text[1:] if is_quoted else text


def escape_formulas(table: pd.DataFrame) -> pd.DataFrame:
    """Apply `escape_formula` to all texts and column names of a table."""
    table = table.rename(columns=escape_formula)
    for name in table.columns:
        if table[name].dtype.kind not in "biufmM":
            texts = table[name]
            escaped = {text: escape_formula(text) for text in texts.unique()}
            if any(safe is not text for text, safe in escaped.items()):
                table[name] = texts.astype(object).map(
                    lambda text, escaped=escaped: escaped.get(text, text))
    return table


def unescape_formulas(table: pd.DataFrame) -> pd.DataFrame:
    """Apply `unescape_formula` to all texts of a table, but not to its column names."""
    table = table.copy(deep=False)
    for name in table.columns:
        if table[name].dtype.kind in "OU" or isinstance(table[name].dtype, pd.StringDtype):
            texts = table[name]
            is_quoted = texts.str.startswith("'", na=False).to_numpy(dtype=bool)
            if is_quoted.any():
                texts = texts.copy()
                texts[is_quoted] = texts[is_quoted].map(unescape_formula)
                table[name] = texts
    return table
