"""What is wrong with a city, said so that it can be put right."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "fixed"]


@dataclass(frozen=True)
class Problem:
    """One finding.

    Attributes:
        severity: `error`: tracing would fail; `warning`: tracing works, the result may not be what is meant;
            `fixed`: put right in the scene that is written.
        shape: name of the shape or material it is about, or "" for the whole city.
        message: what was found, and what to do or what was done.
    """

    severity: Severity
    shape: str
    message: str


def listed(names: Sequence[str], most: int = 3) -> str:
    """`'a', 'b', 'c' and 7 more`: names for a message about many shapes at once."""
    text = ", ".join(repr(name) for name in names[:most])
    return text if len(names) <= most else f"{text} and {len(names) - most} more"
