"""Runs the command line: in this process, where importing the package once serves all, or as it is installed."""

import contextlib
import io
import os
import shlex
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from marl.fedqmix.__main__ import app as planning
from radiotwin.cli import main
from radiotwin.io import signals
from radiotwin.runtime import console
from radiotwin.runtime.command import exit_status

COMMAND = Path(sys.executable).with_name("radiotwin")
COLUMNS = 100


@contextlib.contextmanager
def as_in_a_process_of_its_own(arguments: list[str], cwd: Path) -> Iterator[None]:
    """Restore the state of the process that a command changes."""
    argv, folder, show = sys.argv, Path.cwd(), warnings.showwarning
    handlers = {number: signal.getsignal(number) for number in (*signals.NUMBERS, signal.SIGALRM)}
    width = console.console.width
    try:
        sys.argv, console.console.width = ["radiotwin", *arguments], COLUMNS
        os.chdir(cwd)
        with warnings.catch_warnings():  # whatever was shown once would not be shown again
            warnings.simplefilter("default")
            yield
    finally:
        os.chdir(folder)
        sys.argv, console.console.width, warnings.showwarning = argv, width, show
        for number, handler in handlers.items():
            signal.signal(number, handler)


def run_in_this_process(work: Callable[[], int | None], arguments: list[str], cwd: Path) -> subprocess.CompletedProcess:
    """Run a command as it would run in a process of its own: exit status, and what it said."""
    out, error, status = io.StringIO(), io.StringIO(), 0
    with as_in_a_process_of_its_own(arguments, cwd), contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        try:
            status = work() or 0
        except SystemExit as end:
            status = end.code or 0
    return subprocess.CompletedProcess(shlex.join(arguments), status, out.getvalue(), error.getvalue())


def run_planning(arguments: list[str], cwd: Path) -> subprocess.CompletedProcess:
    """Run `python -m marl.fedqmix`."""
    return run_in_this_process(lambda: exit_status(planning, "the same command with --resume goes on"), arguments, cwd)


@pytest.fixture(scope="session")
def run():
    """Run the command with a line of arguments in a folder."""
    def run(arguments: str, cwd: Path) -> subprocess.CompletedProcess:
        return run_in_this_process(main, shlex.split(arguments), cwd)
    return run


@pytest.fixture(scope="session")
def run_installed():
    """The same with the command as it is installed: seconds more for each."""
    def run_installed(arguments: str, cwd: Path) -> subprocess.CompletedProcess:
        return subprocess.run([str(COMMAND), *shlex.split(arguments)], cwd=cwd, capture_output=True, text=True,
                              timeout=300, env=os.environ | {"COLUMNS": str(COLUMNS)})
    return run_installed
