"""How a command of `marl` ends."""

import signal
import sys
from collections.abc import Callable

from radiotwin.console import complain, show_warnings_plainly
from radiotwin.errors import BadInput, RunFailed


def exit_status(work: Callable[[], None], kept: str) -> int:
    """Do the work; what goes wrong becomes one message and a status: 0 done, 1 failed while running, 2 bad input,
    130 interrupted (`kept` says what is not lost).

    SIGTERM ends the process with 143 in a way that lets open files be cleaned up.
    """
    try:
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
        show_warnings_plainly()
        work()
        return 0
    except BadInput as error:
        complain(str(error))
        return 2
    except RunFailed as error:
        complain(str(error))
        return 1
    except KeyboardInterrupt:
        complain(f"interrupted; {kept}: the same command with --resume goes on")
        return 130
