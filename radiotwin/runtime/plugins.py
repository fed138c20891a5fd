"""Load the classes that installed packages register under an entry-point group."""

import warnings
from collections.abc import Callable
from functools import cache
from importlib import metadata
from typing import Any


@cache  # to read what all packages declare takes tens of milliseconds
def entry_points(group: str) -> metadata.EntryPoints:
    """Return the entry points of a group, such as `radiotwin.effects`."""
    return metadata.entry_points(group=group)


def load_plugins(group: str, register: Callable[[Any], Any], what: str) -> None:
    """Register every class of an entry-point group; warn about those that cannot be used.

    Args:
        group: of entry points.
        register: called with each class; may refuse it with an exception.
        what: kind of class, for the warning, such as `effect`.
    """
    for point in entry_points(group=group):
        try:
            register(point.load())
        except Exception as error:  # noqa: BLE001  # whatever a stranger's package raises
            warnings.warn(f"the {what} {point.name!r} of the package {point.value!r} cannot be "
                          f"used ({type(error).__name__}: {error})", stacklevel=3)
