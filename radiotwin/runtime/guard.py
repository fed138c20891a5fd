"""A process of its own for a command that gives files of strangers to libraries in C and C++.

What these take for granted is checked before they get a file; what no check foresaw may end the
process. Then the one that waits for it still says which command it was, and ends as it should.
"""

import os
import signal
import sys

from radiotwin.errors import BadInput
from radiotwin.io import signals

GUARDED = ("build-scene", "import")
"""Commands of `radiotwin` that read other programs' files."""
CRASHES = tuple(getattr(signal, name) for name in ("SIGSEGV", "SIGABRT", "SIGBUS", "SIGFPE",
                                                   "SIGILL") if hasattr(signal, name))
_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG of prctl(2)


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
        import ctypes

        ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(128 + signal.SIGKILL)
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
