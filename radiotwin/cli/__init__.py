"""The entry point of the command `radiotwin`.

Commands that pass strangers' files to libraries in C and C++ run in a child process. We check what
these libraries assume about a file, but a fault that we do not check for may crash the process. The
parent process then reports the command and the file, and exits with 2.
"""

import os
import signal
import sys

from radiotwin.errors import BadInput
from radiotwin.io import signals
from radiotwin.runtime.processes import die_with_parent

GUARDED = ("build-scene", "import")
"""Commands that read other programs' files, and so run in a child process."""
CRASHES = tuple(getattr(signal, name) for name in ("SIGSEGV", "SIGABRT", "SIGBUS", "SIGFPE",
                                                   "SIGILL") if hasattr(signal, name))


def main() -> None:
    """Run the command line, and end the process with the command's exit status."""
    signals.handle()  # before anything that takes time
    if sys.argv[1:2] and sys.argv[1] in GUARDED:
        status = go_on_in_a_child()
        if status is not None:
            signals.leave(status)
    # Our matrices are small: several BLAS threads are slower than one, and wait busily. Parallel
    # work has threads and workers of its own. OpenBLAS reads the variable when it is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from radiotwin.cli.commands import app
    from radiotwin.io.signals import after_interrupt
    from radiotwin.runtime.command import exit_status

    signals.leave(exit_status(app, after_interrupt))


def go_on_in_a_child() -> int | None:
    """Fork; return None in the child, and the child's exit status in the parent.

    Where a fork is not safe (not on Linux, or once NumPy has made threads), return None in this
    process. Signals are passed on to the child. A signal that ends the child, other than a crash,
    ends the parent, too.
    """
    if sys.platform != "linux" or "numpy" in sys.modules:
        return None
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        die_with_parent(parent)
        return None
    for number in signals.NUMBERS:
        if signal.getsignal(number) is not signal.SIG_IGN:  # as nohup sets
            signal.signal(number, lambda number, _: os.kill(child, number))
    _, status = os.waitpid(child, 0)
    code = os.waitstatus_to_exitcode(status)
    if -code in CRASHES:
        from radiotwin.runtime.command import exit_status

        def refuse() -> None:
            raise BadInput(f"{' '.join(sys.argv[1:3])}: a library ended on this file "
                           f"({signal.strsignal(-code)}): it breaks what its format promises. "
                           "Export it again, and please report it with the file")

        return exit_status(refuse, "")
    if code < 0:  # killed from outside, or out of memory
        if -code != signal.SIGKILL:
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    return code
