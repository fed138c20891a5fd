"""Handle signals that end a command: Ctrl-C, termination, a closed terminal.

Before the work begins, a signal ends the process with a message. During the work it is raised as
`Stopped`, so that temporaries are removed. Code that is running may swallow it, or turn it into
another error (Dr.Jit in a recorded loop, an import, `__del__`): then it is raised again. A second
signal does not disturb the removal of temporaries. The message counts the finished parts that the
next run can use.
"""

import atexit
import os
import signal
import sys
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, NoReturn

NUMBERS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP")
                if hasattr(signal, name))
AGAIN_S = 0.25  # until a swallowed signal is raised again
INTERRUPTED, TERMINATED = "interrupted", "terminated"
_finished = 0


class Stopped(BaseException):
    """Raised for a signal in place of KeyboardInterrupt, which Typer swallows without a message."""


class _State:
    """State that the handlers share.

    Attributes:
        raising: whether a signal is raised, as during the work; else it ends the process.
        deferred: nesting depth of `deferred`.
        received: number of the first signal since the work began.
        on_its_way: the last `Stopped`, until it is freed.
        after: exit status of the finished work.
    """

    raising = False
    deferred = 0
    received: int | None = None
    on_its_way: weakref.ref | None = None
    after: int | None = None


_state = _State()


def handle() -> None:
    """Install the handlers of signals; until `begin`, a signal ends the process with one line."""
    _state.raising, _state.after = False, None
    for number in NUMBERS:
        hung_up_ignored = (number not in (signal.SIGINT, signal.SIGTERM)
                           and signal.getsignal(number) is signal.SIG_IGN)  # nohup
        if not hung_up_ignored:
            signal.signal(number, _on_signal)
    if hasattr(signal, "SIGALRM"):
        signal.signal(signal.SIGALRM, _on_alarm)
    atexit.unregister(_ignore)
    atexit.register(_ignore)


def begin() -> None:
    """Raise signals as `Stopped` from now on, as the work begins."""
    _state.received, _state.on_its_way, _state.deferred = None, None, 0
    sys.unraisablehook = _show_unraisable
    _state.raising = True


def end() -> None:
    """Stop raising signals: the work is done, or has been stopped."""
    _state.raising = False
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, 0)


def finish(status: int) -> None:
    """Let a signal from now on end the process at once with this status."""
    _state.after = status


def leave(status: int) -> NoReturn:
    """Exit with a status; after a signal at once, without waiting for threads."""
    if _state.received is not None:
        os._exit(status)
    sys.exit(status)


def received() -> int | None:
    """Return the number of the signal that stopped the work, or None."""
    return _state.received


def word(number: int) -> str:
    """Return `interrupted` or `terminated`, for the message about a signal."""
    return INTERRUPTED if number == signal.SIGINT else TERMINATED


@contextmanager
def deferred() -> Iterator[None]:
    """Delay signals until the end of the block, so that they cannot interrupt its steps."""
    if threading.current_thread() is not threading.main_thread():  # it gets no signals
        yield
        return
    _state.deferred += 1
    try:
        yield
    finally:
        _state.deferred -= 1
        if _state.received is not None:
            _raise_stopped_once()


@contextmanager
def kept_from_children() -> Iterator[None]:
    """Block Ctrl-C for processes that are started in this block; this process is to end them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing.resource_tracker import ensure_running

    ensure_running()  # started later, it would unblock SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _on_signal(number: int, frame: FrameType | None) -> None:
    """Handle a signal: raise `Stopped` during the work; before and after it, end the process."""
    if _state.raising:
        if _state.received is None:
            _state.received = number
        _raise_stopped_once()
    elif _state.after is not None:
        os._exit(_state.after)
    elif _state.received is None:  # otherwise its message is being written
        line = f"radiotwin: {word(number)}; nothing had been done yet\n"
        try:
            os.write(2, line.encode())
        finally:
            os._exit(128 + number)


def _ignore() -> None:
    """Ignore signals at the exit of Python, which restores the default handlers too early."""
    for number in NUMBERS:
        signal.signal(number, signal.SIG_IGN)


def _on_alarm(number: int, frame: FrameType | None) -> None:
    """Raise a signal again that was swallowed."""
    if _state.raising and _state.received is not None:
        _raise_stopped_once()


def _raise_stopped_once() -> None:
    """Raise `Stopped` for a signal, unless one raised before is still on its way up.

    A timer tries again after `AGAIN_S`, as code on the way may swallow it. Deferred signals wait.
    """
    if not _state.raising or _state.deferred:
        return
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
    if _state.on_its_way is None or _state.on_its_way() is None:
        raise _new()  # no variable here: the frame, in its traceback, would keep it alive


def _new() -> Stopped:
    stopped = Stopped()
    _state.on_its_way = weakref.ref(stopped)
    return stopped


def _show_unraisable(unraisable: Any) -> None:
    """Say nothing of a stop where nothing can be raised, such as in `__del__`."""
    if _state.received is None:
        sys.__unraisablehook__(unraisable)


def note_finished() -> None:
    """Count a finished part that the next run will not do again."""
    global _finished
    _finished += 1


def after_interrupt() -> str:
    """Return the end of a message after an interrupt: what is kept, and how to go on."""
    if not _finished:
        return "nothing is kept; run the same command again"
    parts = "1 finished part is" if _finished == 1 else f"{_finished:,} finished parts are"
    return f"{parts} kept; run the same command again to go on"
