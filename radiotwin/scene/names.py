"""Names of shapes and materials that Sionna RT, Mitsuba and file systems accept."""

import re
from collections.abc import Iterable

RESERVED_NAMES = {"merged-shapes", "__root__"}  # of objects that Sionna RT adds to a scene


def safe_name(text: str) -> str:
    """Return the text with everything but ASCII letters, digits, `_` and `-` replaced by `_`.

    Sionna RT 2.2 stops at `$` (a Mitsuba parameter) in a name, and reads scene files in the
    system's own encoding; `.` is Mitsuba's separator; `/` and the like cannot be in a file name.

    Args:
        text: Any text; more than 100 characters are cut off.
    """
    return re.sub(r"[^A-Za-z0-9_-]", "_", text)[:100] or "unnamed"


class Names(set[str]):
    """Names in use, in lower case, that remember the last number of each: for many equal names."""

    def __init__(self, names: Iterable[str] = ()) -> None:
        super().__init__(names)
        self.last_numbers: dict[str, int] = {}


def unique_name(name: str, taken: set[str]) -> str:
    """Return the name, with a number appended where it is taken, and add it to `taken`.

    Args:
        name: Name to use.
        taken: Names in use, in lower case; grows by one. `Names` where they may be many.
    """
    numbers = taken.last_numbers if isinstance(taken, Names) else {}
    free, number = name, numbers.get(name.lower(), 1)
    while free.lower() in taken:
        number += 1
        free = f"{name}_{number}"
    numbers[name.lower()] = number
    taken.add(free.lower())
    return free
