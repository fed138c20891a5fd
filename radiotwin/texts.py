"""Texts of a run as pages and figures show them: nothing hidden, nothing endless."""

import re
from datetime import UTC, datetime
from typing import Any

MAX_TEXT = 2000  # characters
# Control characters, those that turn the direction of writing or have no width, and halves of
# characters. Joiners (U+200C, U+200D) belong to some scripts.
_HIDDEN = re.compile("[\0-\x08\x0b-\x1f\x7f-\x9f\xad\u061c\u180e\u200b\u200e\u200f\u2028-\u202e"
                     "\u2060-\u206f\ufeff\ufff9-\ufffb\ud800-\udfff\U000e0000-\U000e007f]")


def shown(text: str, max_length: int = MAX_TEXT) -> str:
    r"""Return a text with its hidden characters as `\x1b` or `\u202e`, cut where it is too long.

    Args:
        text: may hold anything.
        max_length: longest that is left as it is, in characters.
    """
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
