"""Signals that end a command: Ctrl-C, termination, a closed terminal.

Before the work begins, the first one ends the process with its message: nothing has to be undone.
During the work it is raised as `Stopped`, so that temporaries are removed. Whatever runs then may
swallow it, or turn it into an error of its own (Dr.Jit in a loop that it records, a module while it
is imported, `__del__`): then it is raised again, and what became of it still counts as a stop. A
second one does not disturb the removal of temporaries. The message counts the finished parts that
the next run will not do again.
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
AGAIN_S = 0.25  # between attempts to get through
INTERRUPTED, TERMINATED = "interrupted", "terminated"
_finished = 0


class Stopped(BaseException):
    """A signal. Typer would swallow a KeyboardInterrupt without a message."""


class _State:
    """State that the handlers share.

    Attributes:
        raising: whether a signal is raised; before and after the work it ends the process.
        deferred: depth of `deferred`.
        received: number of the first signal since the work began.
        flying: the last `Stopped`, as long as something holds it.
        after: exit status of the finished work.
    """

    raising = False
    deferred = 0
    received: int | None = None
    flying: weakref.ref | None = None
    after: int | None = None


_state = _State()


def handle() -> None:
    """Install the handlers; until `begin`, a signal ends the process with one line."""
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
    """Raise signals from now on."""
    _state.received, _state.flying, _state.deferred = None, None, 0
    sys.unraisablehook = _show_unraisable
    _state.raising = True


def end() -> None:
    """Raise none any more; the work is done, or has been stopped."""
    _state.raising = False
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, 0)


def finish(status: int) -> None:
    """End the process with this status at the next signal, such as one at the end of Python."""
    _state.after = status


def leave(status: int) -> NoReturn:
    """End the process; at once if a signal has stopped it, whatever its threads still do."""
    if _state.received is not None:
        os._exit(status)
    sys.exit(status)


def received() -> int | None:
    """Return the number of the signal that stopped the work, or None."""
    return _state.received


def word(number: int) -> str:
    """Return what a signal did to the command, for the message."""
    return INTERRUPTED if number == signal.SIGINT else TERMINATED


@contextmanager
def deferred() -> Iterator[None]:
    """Let a few steps that belong together be done; a signal among them is raised after them."""
    if threading.current_thread() is not threading.main_thread():  # it gets no signals
        yield
        return
    _state.deferred += 1
    try:
        yield
    finally:
        _state.deferred -= 1
        if _state.received is not None:
            _raise_unless_flying()


@contextmanager
def kept_from_children() -> Iterator[None]:
    """Start processes that never get a Ctrl-C: this one ends them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing.resource_tracker import ensure_running

    ensure_running()  # it would let SIGINT through again, if it were started with the first process
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _on_signal(number: int, frame: FrameType | None) -> None:
    if _state.raising:
        if _state.received is None:
            _state.received = number
        _raise_unless_flying()
    elif _state.after is not None:
        os._exit(_state.after)
    elif _state.received is None:  # otherwise its message is being written
        line = f"radiotwin: {word(number)}; nothing had been done yet\n"
        try:
            os.write(2, line.encode())
        finally:
            os._exit(128 + number)


def _ignore() -> None:
    """Let nothing disturb the end of Python, which restores the system's handlers too early."""
    for number in NUMBERS:
        signal.signal(number, signal.SIG_IGN)


def _on_alarm(number: int, frame: FrameType | None) -> None:
    if _state.raising and _state.received is not None:
        _raise_unless_flying()


def _raise_unless_flying() -> None:
    if not _state.raising or _state.deferred:
        return
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
    if _state.flying is None or _state.flying() is None:
        raise _new()  # no variable here: the frame, in its traceback, would keep it alive


def _new() -> Stopped:
    stopped = Stopped()
    _state.flying = weakref.ref(stopped)
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
    """Return what is kept and how to go on: part of a message."""
    if not _finished:
        return "nothing is kept; run the same command again"
    parts = "1 finished part is" if _finished == 1 else f"{_finished:,} finished parts are"
    return f"{parts} kept; run the same command again to go on"
