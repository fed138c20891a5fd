"""The command `radiotwin`."""

import os

from radiotwin.io import signals


def main() -> None:
    """Run the command line and end the process; see `exit_status`."""
    signals.handle()  # before anything that takes time
    # On matrices as small as here several threads of a BLAS are slower than one, and wait busily;
    # what can be done side by side has threads and workers of its own. Read when it is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from radiotwin.cli.commands import app
    from radiotwin.io.signals import after_interrupt
    from radiotwin.runtime.command import exit_status

    signals.leave(exit_status(app, after_interrupt))
