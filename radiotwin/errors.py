"""The two errors that a command reports to its user, each with its exit status."""

from importlib import import_module
from typing import Any


class BadInput(Exception):
    """Input that cannot be used: exit status 2.

    The message names what was given, what is allowed and what to do, with file, row and column
    where there is one. Nothing has been written when it is raised.
    """


class MissingPackage(BadInput):
    """The request needs a package that is not installed; the message names the extra to install."""


class RunFailed(Exception):
    """Valid input on which the work could not be done: exit status 1."""


def optional_package(name: str, message: str) -> Any:
    """Return a module of a package that is not installed with the others.

    Args:
        name: of the module.
        message: what needs it, and how to install it or do without.

    Raises:
        MissingPackage: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError:
        raise MissingPackage(message) from None
