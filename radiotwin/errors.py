"""The two errors that a command reports to its user, each with its exit status."""


class BadInput(Exception):
    """Input that cannot be used: exit status 2.

    The message names what was given, what is allowed and what to do, with file, row and column
    where there is one. Nothing has been written when it is raised.
    """


class RunFailed(Exception):
    """Valid input on which the work could not be done: exit status 1."""
