"""The command `radiotwin`.

A command that gives files of strangers to libraries in C and C++ runs in a process of its own. What
these libraries take for granted is checked before they get a file; what no check foresaw may end
the process. Then the one that waits for it still says which command it was, and exits with 2.
"""

import os
import signal
import sys
from functools import partial

from radiotwin.errors import BadInput
from radiotwin.io import signals
from radiotwin.runtime.processes import die_with_parent

GUARDED = ("build-scene", "import")
"""Commands of `radiotwin` that read other programs' files."""
CRASHES = tuple(getattr(signal, name) for name in ("SIGSEGV", "SIGABRT", "SIGBUS", "SIGFPE",
                                                   "SIGILL") if hasattr(signal, name))


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


def go_on_in_a_child() -> int | None:
    """Return None in a child, which goes on, and in this process, once it has ended, its status.

    Only where that is safe, on Linux before any library has threads; else None in this process.

    Raises:
        BadInput: a library has ended the child.
    """
    if sys.platform != "linux" or "numpy" in sys.modules:
        return None
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        die_with_parent(parent)
        return None
    for number in signals.NUMBERS:
        if signal.getsignal(number) is not signal.SIG_IGN:  # nohup
            signal.signal(number, lambda number, _: os.kill(child, number))
    _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    if -code in CRASHES:
        raise BadInput(f"{' '.join(sys.argv[1:3])}: a library ended on this file "
                       f"({signal.strsignal(-code)}): it breaks what its format promises. Export "
                       "it again, and please report it with the file")
    if code < 0:  # killed from outside, or for want of memory
        if -code != signal.SIGKILL:
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    return code
