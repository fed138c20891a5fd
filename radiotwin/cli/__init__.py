"""The command `radiotwin`."""

import os
import sys
from functools import partial

from radiotwin.errors import BadInput
from radiotwin.io import signals
from radiotwin.runtime.guard import GUARDED, go_on_in_a_child


def main() -> None:
    """Run the command line and end the process; see `exit_status`."""
    signals.handle()  # before anything that takes time
    if sys.argv[1:2] and sys.argv[1] in GUARDED:
        _guard()
    # On matrices as small as here several threads of a BLAS are slower than one, and wait busily;
    # what can be done side by side has threads and workers of its own. Read when it is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from radiotwin.cli.commands import app
    from radiotwin.io.signals import after_interrupt
    from radiotwin.runtime.command import exit_status

    signals.leave(exit_status(app, after_interrupt))


def _guard() -> None:
    """Go on in a child, or end as it has ended."""
    try:
        status = go_on_in_a_child()
    except BadInput as error:
        from radiotwin.runtime.command import exit_status

        status = exit_status(partial(_refuse, error), "")
    if status is not None:
        signals.leave(status)


def _refuse(error: BadInput) -> None:
    raise error
