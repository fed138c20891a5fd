"""Findings about a city, each with a message that says what was found and what to do."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "fixed"]


@dataclass(frozen=True)
class Problem:
    """One finding.

    Attributes:
        severity: `error`: tracing would fail; `warning`: tracing works, but the result may not be
            the intended one; `fixed`: corrected in the scene that is written.
        shape: Name of the shape or material concerned, or "" for the whole city.
        message: What was found, and what to do or what was done.
    """

    severity: Severity
    shape: str
    message: str


def error(message: str, shape: str = "") -> Problem:
    """Return a finding that makes tracing fail."""
    return Problem("error", shape, message)


def warning(message: str, shape: str = "") -> Problem:
    """Return a finding that leaves the scene traceable but may not be intended."""
    return Problem("warning", shape, message)


def fixed(message: str, shape: str = "") -> Problem:
    """Return a finding that has been corrected."""
    return Problem("fixed", shape, message)


def listed(names: Sequence[str], most: int = 3) -> str:
    """Return `'a', 'b', 'c' and 7 more`: names for a message about many shapes at once."""
    text = ", ".join(repr(name) for name in names[:most])
    return text if len(names) <= most else f"{text} and {len(names) - most} more"
